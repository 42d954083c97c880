"""The valley is what its page says: it builds without a warning, climbs, crosses itself, and its traffic flows."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import sumo  # type: ignore[import-untyped]  # the wheel of SUMO has no stubs
from caraware.data.recording import open_recording
from caraware.ipc.image import split_planes

VALLEY = Path(__file__).parents[1]
ROOT = VALLEY.parents[1]
CARAWARE = ROOT / "target" / "release" / "caraware"
BIN = Path(sumo.SUMO_HOME) / "bin"
SOURCES = sorted(path.name for path in VALLEY.iterdir() if path.suffix in (".xml", ".netccfg", ".sumocfg"))
SOURCES = [name for name in SOURCES if not name.endswith(".net.xml")]
WRITTEN = ("valley.nod.xml", "valley.edg.xml", "valley.poly.xml", "valley.stops.add.xml", "valley.rou.xml")
Points = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def built() -> Iterator[Path]:
    """A copy of the valley with its net."""
    with tempfile.TemporaryDirectory(prefix="cw-") as short:
        copy = Path(short)
        for name in SOURCES:
            shutil.copy(VALLEY / name, copy / name)
        command: list[str | Path] = [BIN / "netconvert", "-c", copy / "valley.netccfg", "-o", copy / "valley.net.xml"]
        built = subprocess.run(command, capture_output=True, text=True, check=True)
        assert "Warning" not in built.stderr + built.stdout, built.stderr
        yield copy


@pytest.fixture(scope="module")
def net(built: Path) -> ET.Element:
    return ET.parse(built / "valley.net.xml").getroot()


def points(shape: str) -> Points:
    """Points [n, 3] of a lane, metres."""
    corners = [[float(value) for value in corner.split(",")] for corner in shape.split()]
    return np.array([[*corner, 0.0][:3] for corner in corners])


def street(net: ET.Element, name: str) -> Points:
    """The outermost lane of a street for vehicles, metres."""
    lanes = net.findall(f"edge[@id='{name}']/lane")
    return points(lanes[-1].attrib["shape"])


def test_the_program_writes_the_sources_as_they_are(tmp_path: Path) -> None:
    (tmp_path / "generate.py").write_text((VALLEY / "generate.py").read_text())
    subprocess.run([sys.executable, tmp_path / "generate.py"], check=True)
    for name in WRITTEN:
        assert (tmp_path / name).read_bytes() == (VALLEY / name).read_bytes(), name


def test_it_is_larger_than_the_town_climbs_and_has_bridges_and_a_roundabout(net: ET.Element) -> None:
    edges = [edge for edge in net.findall("edge") if edge.get("function") is None]
    assert len(edges) == 132
    lengths = [float(edge.findall("lane")[-1].attrib["length"]) for edge in edges]
    assert sum(lengths) > 20_000
    grades = []
    for edge in edges:
        line = points(edge.findall("lane")[-1].attrib["shape"])
        for a, b in pairwise(line):
            along = np.hypot(*(b[:2] - a[:2]))
            grades += [abs(b[2] - a[2]) / along] if along > 1.0 else []
    assert np.percentile(grades, 90) > 0.055 and max(grades) < 0.10
    assert len(net.findall("roundabout")) == 1
    for bridge in ("bridge300", "bridge700", "bridge1100"):
        line = street(net, bridge)
        assert line[:, 2].max() > 2.0 and line[0, 2] < 0.5 and line[-1, 2] < 0.5


def test_the_bypass_crosses_the_climbing_streets_on_a_bridge(net: ET.Element) -> None:
    bypass, crossed = street(net, "bypass"), 0
    for x in (300, 700, 1100):
        climb = street(net, f"n{x}_480")
        above = np.interp(climb[0, 0], bypass[:, 0], bypass[:, 2])
        y = np.interp(climb[0, 0], bypass[:, 0], bypass[:, 1])
        below = np.interp(y, climb[:, 1], climb[:, 2])
        assert above - below > 4.5, x
        crossed += 1
    assert crossed == 3


def test_an_hours_traffic_begins_without_jam_or_collision(built: Path) -> None:
    outputs: list[str | Path] = ["--statistic-output", built / "stats.xml", "--tripinfo-output", built / "trips.xml"]
    command: list[str | Path] = [
        BIN / "sumo",
        "-c",
        built / "valley.sumocfg",
        "--end",
        "900",
        "--no-step-log",
        "--step-length",
        "0.5",
    ]
    subprocess.run([*command, *outputs, "--collision.check-junctions"], check=True, capture_output=True)
    stats = ET.parse(built / "stats.xml").getroot()
    counts = {name: stats.find(name) for name in ("teleports", "safety", "vehicles")}
    values = {name: element.attrib for name, element in counts.items() if element is not None}
    assert int(values["teleports"]["total"]) == 0
    assert int(values["safety"]["collisions"]) <= 2
    assert int(values["vehicles"]["waiting"]) <= 3
    kinds = Counter(trip.attrib["vType"] for trip in ET.parse(built / "trips.xml").getroot().findall("tripinfo"))
    assert set(kinds) == {"tram", "bicycle", "bus", "truck", "van", "car"}
    assert kinds["tram"] >= 4 and kinds["bicycle"] > 60 and kinds["car"] > 200, kinds


def simulate(built: Path, name: str, end_s: int, settings: tuple[str, ...] = ()) -> Path:
    """Simulates the valley; returns the directory of the run."""
    arguments = ["simulate", "valley.sumocfg", "--end", str(end_s), "--name", name, "--quiet"]
    arguments += [word for setting in ("fanout.enabled=false", *settings) for word in ("--set", setting)]
    environment = os.environ | {"CARAWARE_RUNTIME_DIR": f"{built}/r", "CARAWARE_PYTHON": sys.executable}
    ran = subprocess.run(
        [CARAWARE, *arguments], cwd=built, env=environment, capture_output=True, text=True, timeout=600
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return built / "runs" / name


def test_it_is_simulated_with_trams_and_bicycles_that_sense(built: Path) -> None:
    report = json.loads((simulate(built, "valley", 90) / "report.json").read_text())
    departed = report["traffic"]["departed"]
    assert departed["tram"] == 2 and departed["bicycle"] > 10 and departed["passenger"] > 30, departed
    assert report["traffic"]["teleports"] == 0
    # Mirrors follow SUMO up the hill and over the bridges without being set onto it.
    assert report["dynamics"]["resynchronisations"] == 0, report["dynamics"]


EYES = (
    "camera.vehicles=64",
    "camera.width=16",
    "camera.height=16",
    "camera.horizontal_fov_deg=20",
    "camera.mount=[0.0, 0.0, 1.5, 0.0, -1.5707, 0.0]",
    "camera.period_s=0.5",
    "record.manner=lossless",
    'record.channels=["image"]',
)
"""Cameras that look straight down from 1.5 m above the rear axle."""


def test_under_every_vehicle_is_a_road_on_the_bridge_too(built: Path, net: ET.Element) -> None:
    """The ground has one height at each place: without a deck a vehicle on the bypass saw the streets far below."""
    bypass, heights_m, on_bridge = street(net, "bypass"), [], 0
    for message in open_recording(simulate(built, "eyes", 150, EYES)).messages("image"):
        head = message.section("head")[0]
        depth_m = split_planes(head, message.section("planes").tobytes())["depth_m"]
        assert depth_m is not None
        heights_m.append(float(np.median(depth_m)))
        x, y, z = head["position_m"]
        is_on_bypass = abs(y - np.interp(x, bypass[:, 0], bypass[:, 1])) < 8.0
        over = min(abs(x - crossed) for crossed in (300, 700, 1100)) < 4.0
        on_bridge += int(is_on_bypass and over and abs(z - 1.5 - np.interp(x, bypass[:, 0], bypass[:, 2])) < 1.0)
    assert len(heights_m) > 1000 and on_bridge >= 2, (len(heights_m), on_bridge)
    # The grid of the ground has cells of 5 m, and slopes change between them.
    assert np.percentile(heights_m, [1, 99]) == pytest.approx(1.5, abs=0.4)
    assert max(heights_m) < 3.0, max(heights_m)
