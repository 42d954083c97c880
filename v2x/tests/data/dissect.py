"""Checks by hand that an independent dissector reads a capture: `tshark`, of Wireshark.

    caraware simulate town --set v2x.share=1.0 --set v2x.pcap=true
    python dissect.py runs/NAME/messages/episode-0.pcap

Every CAM and DENM must be dissected to its end without a complaint; headers and messages must agree on the station and
on the place. Wireshark 4.0 dissects CPMs of an earlier version only and does not know the port of VAMs: their headers
are checked.
"""

import json
import subprocess
import sys
from collections import Counter

PORTS = {"2001": "CAM", "2002": "DENM", "2009": "CPM", "2018": "VAM"}
"""BTP ports."""
DISSECTED = {"CAM": "2", "DENM": "1"}
"""`messageID` of the messages whose version every Wireshark from 4.0 on dissects."""


def values(layer: object, name: str) -> list[str]:
    """All values of a field below a layer."""
    found: list[str] = []
    if isinstance(layer, dict):
        for key, value in layer.items():
            if key == name and isinstance(value, str):
                found.append(value)
            found += values(value, name)
    elif isinstance(layer, list):
        for item in layer:
            found += values(item, name)
    return found


def check(frame: dict) -> str:
    """Name of the message of a frame. Raises `AssertionError`."""
    layers = frame["_source"]["layers"]
    names = layers["frame"]["frame.protocols"].split(":")
    assert "_ws.malformed" not in layers, layers
    if "wsmp" in names:
        return "BSM"
    assert "gnw" in names and "btpb" in names, names
    kind = PORTS[layers["btpb"]["btpb.dstport"]]
    if kind == "VAM" and "its" not in layers:
        return kind
    (station,) = values(layers["its"], "its.stationID")
    # The last four bytes of both addresses are the station of the message, unless a warning is sent once more.
    address = layers["eth"]["eth.src"].replace(":", "")
    assert values(layers["gnw"], "geonw.src_pos.addr.mid") == [layers["eth"]["eth.src"]], layers
    assert kind == "DENM" or address == f"0200{int(station):08x}", (address, station)
    if kind not in DISSECTED:
        return kind
    assert "_ws.expert" not in json.dumps(layers), layers
    (message_id,) = values(layers["its"], "its.messageID")
    assert message_id == DISSECTED[kind], (kind, message_id)
    if kind == "CAM":
        for axis, field in (("latitude", "geonw.src_pos.lat"), ("longitude", "geonw.src_pos.long")):
            (stated,), (header,) = values(layers["its"], f"its.{axis}"), values(layers["gnw"], field)
            assert int(stated) == int(header), (axis, stated, header)
    return kind


def main() -> None:
    """Dissect the whole file and count its messages."""
    command = ["tshark", "-r", sys.argv[1], "-T", "json", "--no-duplicate-keys"]
    frames = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    counts = Counter(check(frame) for frame in frames)
    assert frames, "the capture is empty"
    print(", ".join(f"{count} {kind}s" for kind, count in sorted(counts.items())))


if __name__ == "__main__":
    main()
