"""Writes `messages.json`: messages as independent encoders make them: asn1tools all of them, pycrate CAMs too.

    pip install asn1tools==0.169.0 pycrate==0.8.1
    python messages.py FOLDER

FOLDER has ETSI's modules as files: `cam_1_4_1.asn`, `cdd_1_3_1_1.asn`, `cpm_2_1_1.asn` and `cdd_2_2_1.asn` (all
five modules of the collective perception message in one file), as the crate c-its-parser 2.4.2 carries them in
`autogen/asn.1`.
"""

import json
import random
import re
import sys
from pathlib import Path

import asn1tools
from pycrate_asn1dir.ITS_CAM_2 import CAM_PDU_Descriptions

MESSAGES = 30
FOLDER = Path(sys.argv[1])


def read(*names: str) -> list[str]:
    """The modules as text, without comments, and without constraints on inner components.

    No bit of the packed encoding shows these constraints, and pycrate does not read all of them.
    """
    texts = [(FOLDER / name).read_text() for name in names]
    return [without_inner_constraints(re.sub(r"/\*.*?\*/|--.*?$", "", text, flags=re.S | re.M)) for text in texts]


def without_inner_constraints(text: str) -> str:
    """Leaves out every pair of parentheses around `WITH COMPONENT…`."""
    while found := re.search(r"\((?:\s*\()*\s*WITH\s+COMPONENT", text):
        depth, end = 0, found.start()
        while depth or end == found.start():
            depth += {"(": 1, ")": -1}.get(text[end], 0)
            end += 1
        text = text[: found.start()] + text[end:]
    return text


def optional(draw: random.Random, value: int) -> int | None:
    """`value`, or nothing in a quarter of all cases."""
    return value if draw.random() < 0.75 else None


def position(draw: random.Random) -> dict[str, int | None]:
    """A position as the Rust type has it."""
    return {
        "latitude": draw.choice([-900_000_000, 900_000_000, draw.randint(-900_000_000, 900_000_000)]),
        "longitude": draw.randint(-1_800_000_000, 1_800_000_000),
        "accuracy_cm": optional(draw, draw.randint(0, 4094)),
        "altitude_cm": optional(draw, draw.randint(-100_000, 800_000)),
    }


def reference_position(values: dict[str, int | None]) -> dict[str, object]:
    """The same in ETSI's names."""
    axis = values["accuracy_cm"]
    return {
        "latitude": values["latitude"],
        "longitude": values["longitude"],
        "positionConfidenceEllipse": {
            "semiMajorConfidence": 4095 if axis is None else axis,
            "semiMinorConfidence": 4095 if axis is None else axis,
            "semiMajorOrientation": 3601 if axis is None else 0,
        },
        "altitude": {
            "altitudeValue": 800_001 if values["altitude_cm"] is None else values["altitude_cm"],
            "altitudeConfidence": "unavailable",
        },
    }


def cam(draw: random.Random) -> dict[str, object]:
    """Values of a cooperative awareness message."""
    path = [
        {
            "delta_latitude": draw.randint(-131_071, 131_072),
            "delta_longitude": draw.randint(-131_071, 131_072),
            "time_10ms": optional(draw, draw.randint(1, 65_535)),
        }
        for _ in range(draw.choice([0, 1, 5, 40]))
    ]
    return {
        "station": draw.randint(0, 2**32 - 1),
        "kind": draw.randint(0, 255),
        "generation_delta_ms": draw.randint(0, 65_535),
        "position": position(draw),
        "heading": optional(draw, draw.randint(0, 3600)),
        "heading_confidence": optional(draw, draw.randint(1, 126)),
        "speed_cmps": optional(draw, draw.randint(0, 16_382)),
        "speed_confidence": optional(draw, draw.randint(1, 126)),
        "length_10cm": draw.randint(1, 1023),
        "width_10cm": draw.randint(1, 62),
        "acceleration": optional(draw, draw.randint(-160, 160)),
        "yaw_rate": optional(draw, draw.randint(-32_766, 32_766)),
        "path": path if draw.random() < 0.5 else None,
    }


def or_else(value: object, unavailable: int) -> object:
    """`value`, or the number that stands for none."""
    return unavailable if value is None else value


def cam_pdu(values: dict) -> dict:
    """The message in ETSI's names."""
    high = {
        "heading": {
            "headingValue": or_else(values["heading"], 3601),
            "headingConfidence": or_else(values["heading_confidence"], 127),
        },
        "speed": {
            "speedValue": or_else(values["speed_cmps"], 16_383),
            "speedConfidence": or_else(values["speed_confidence"], 127),
        },
        "driveDirection": "forward",
        "vehicleLength": {
            "vehicleLengthValue": values["length_10cm"],
            "vehicleLengthConfidenceIndication": "noTrailerPresent",
        },
        "vehicleWidth": values["width_10cm"],
        "longitudinalAcceleration": {
            "longitudinalAccelerationValue": or_else(values["acceleration"], 161),
            "longitudinalAccelerationConfidence": 102,
        },
        "curvature": {"curvatureValue": 1023, "curvatureConfidence": "unavailable"},
        "curvatureCalculationMode": "unavailable",
        "yawRate": {"yawRateValue": or_else(values["yaw_rate"], 32_767), "yawRateConfidence": "unavailable"},
    }
    parameters = {
        "basicContainer": {"stationType": values["kind"], "referencePosition": reference_position(values["position"])},
        "highFrequencyContainer": ("basicVehicleContainerHighFrequency", high),
    }
    if values["path"] is not None:
        points = []
        for point in values["path"]:
            delta = {
                "deltaLatitude": point["delta_latitude"],
                "deltaLongitude": point["delta_longitude"],
                "deltaAltitude": 12_800,
            }
            time = {} if point["time_10ms"] is None else {"pathDeltaTime": point["time_10ms"]}
            points.append({"pathPosition": delta, **time})
        low = {"vehicleRole": "default", "exteriorLights": (b"\0", 8), "pathHistory": points}
        parameters["lowFrequencyContainer"] = ("basicVehicleContainerLowFrequency", low)
    return {
        "header": {"protocolVersion": 2, "messageID": 2, "stationID": values["station"]},
        "cam": {"generationDeltaTime": values["generation_delta_ms"], "camParameters": parameters},
    }


def cpm(draw: random.Random) -> dict:
    """Values of a collective perception message."""
    objects = [
        {
            "object": draw.randint(0, 65_535),
            "delta_ms": draw.randint(-2048, 2047),
            "position_cm": [draw.randint(-131_072, 131_071) for _ in range(2)],
            "position_confidence_cm": draw.randint(1, 4096),
            "velocity_cmps": [draw.randint(-16_383, 16_383) for _ in range(2)],
            "velocity_confidence": draw.randint(1, 127),
            "angle": draw.randint(0, 3601),
            "size_10cm": [draw.randint(1, 256) for _ in range(2)],
            "quality": draw.randint(0, 15),
            "is_person": draw.random() < 0.3,
        }
        for _ in range(draw.choice([0, 1, 3, 10, 40]))
    ]
    return {
        "station": draw.randint(0, 2**32 - 1),
        "reference_time_ms": draw.randint(0, 4_398_046_511_103),
        "position": position(draw),
        "heading": draw.randint(0, 3601),
        "sensor_range_10cm": optional(draw, draw.randint(0, 4095)),
        "perceived": draw.randint(0, 255) if objects else 0,
        "objects": objects,
    }


def cpm_pdu(values: dict) -> dict:
    """The message in ETSI's names."""
    angle = {"value": values["heading"], "confidence": 127}
    containers = [{"containerId": 1, "containerData": ("OriginatingVehicleContainer", {"orientationAngle": angle})}]
    if values["sensor_range_10cm"] is not None:
        sensor = {
            "sensorId": 1,
            "sensorType": 12,
            "perceptionRegionShape": ("circular", {"radius": values["sensor_range_10cm"]}),
            "shadowingApplies": True,
        }
        containers.append({"containerId": 3, "containerData": ("SensorInformationContainer", [sensor])})
    if values["objects"]:
        content = {
            "numberOfPerceivedObjects": values["perceived"],
            "perceivedObjects": [cpm_object(one) for one in values["objects"]],
        }
        containers.append({"containerId": 5, "containerData": ("PerceivedObjectContainer", content)})
    return {
        "header": {"protocolVersion": 2, "messageId": 14, "stationId": values["station"]},
        "payload": {
            "managementContainer": {
                "referenceTime": values["reference_time_ms"],
                "referencePosition": reference_position(values["position"]),
            },
            "cpmContainers": containers,
        },
    }


def cpm_object(values: dict) -> dict:
    """A perceived object in ETSI's names."""
    coordinates = [{"value": value, "confidence": values["position_confidence_cm"]} for value in values["position_cm"]]
    components = [{"value": value, "confidence": values["velocity_confidence"]} for value in values["velocity_cmps"]]
    along, across = ({"value": value, "confidence": 32} for value in values["size_10cm"])
    person = {"objectClass": ("vruSubClass", ("pedestrian", 1)), "confidence": 101}
    return {
        "objectId": values["object"],
        "measurementDeltaTime": values["delta_ms"],
        "position": {"xCoordinate": coordinates[0], "yCoordinate": coordinates[1]},
        "velocity": ("cartesianVelocity", {"xVelocity": components[0], "yVelocity": components[1]}),
        "angles": {"zAngle": {"value": values["angle"], "confidence": 127}},
        "objectDimensionX": along,
        "objectDimensionY": across,
        "objectPerceptionQuality": values["quality"],
        **({"classification": [person]} if values["is_person"] else {}),
    }


def for_asn1tools(pdu: dict, codec: object) -> dict:
    """asn1tools takes open types as bytes."""
    containers = [
        {"containerId": one["containerId"], "containerData": codec.encode(*one["containerData"])}
        for one in pdu["payload"]["cpmContainers"]
    ]
    return {**pdu, "payload": {**pdu["payload"], "cpmContainers": containers}}


def for_pycrate(value: object) -> object:
    """pycrate takes a bit string as number and length."""
    if isinstance(value, dict):
        return {key: for_pycrate(part) for key, part in value.items()}
    if isinstance(value, list):
        return [for_pycrate(part) for part in value]
    if isinstance(value, tuple) and isinstance(value[0], bytes):
        return (int.from_bytes(value[0], "big") >> (8 * len(value[0]) - value[1]), value[1])
    if isinstance(value, tuple):
        return (value[0], for_pycrate(value[1]))
    return value


def main() -> None:
    """Encode with both, compare, decode with both, write."""
    draw = random.Random(302_637)
    cam_files, cpm_files = ("cam_1_4_1.asn", "cdd_1_3_1_1.asn"), ("cpm_2_1_1.asn", "cdd_2_2_1.asn")
    codecs = [asn1tools.compile_string("\n".join(read(*names)), "uper") for names in (cam_files, cpm_files)]
    # pycrate brings the module of one, and cannot read all of the other's.
    types = [CAM_PDU_Descriptions.CAM, None]
    out = {"cam": [], "cpm": []}
    for kind, make, pdu, codec, name, pycrate in (
        ("cam", cam, cam_pdu, codecs[0], "CAM", types[0]),
        ("cpm", cpm, cpm_pdu, codecs[1], "CollectivePerceptionMessage", types[1]),
    ):
        for _ in range(MESSAGES):
            values = make(draw)
            message = pdu(values)
            first = codec.encode(name, for_asn1tools(message, codec) if kind == "cpm" else message)
            assert codec.encode(name, codec.decode(name, first)) == first
            if pycrate is not None:
                pycrate.set_val(for_pycrate(message))
                assert pycrate.to_uper() == first, (kind, values)
                pycrate.from_uper(first)
                assert pycrate.to_uper() == first
            out[kind].append({"hex": first.hex(), "values": values})
    rows = {kind: ",\n".join(json.dumps(one) for one in messages) for kind, messages in out.items()}
    text = ",\n".join(f'"{kind}": [\n{row}\n]' for kind, row in rows.items())
    Path(__file__).with_suffix(".json").write_text("{" + text + "}\n")


if __name__ == "__main__":
    main()
