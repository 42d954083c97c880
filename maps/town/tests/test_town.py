"""The town builds without a warning, is connected, and has room for 60 vehicles and 30 pedestrians for ten minutes."""

import random
import re
import subprocess
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyproj
import pytest
import sumo  # type: ignore[import-untyped]  # the wheel of SUMO has no stubs
from matplotlib.path import Path as Outline

Points = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Successors = dict[str, list[str]]

TOWN = Path(__file__).parents[1]
BIN = Path(sumo.SUMO_HOME) / "bin"
SIZE_M, CENTRE_M = (258.0, 252.0), (129.0, 126.0)
VEHICLE_TYPES = ("car_small", "car_sedan", "van", "truck", "bus")


def attribute(element: ET.Element | None, name: str) -> str:
    """An attribute that the element must have."""
    assert element is not None
    return element.attrib[name]


def points(element: ET.Element) -> Points:
    """Corners [n, 2] of the shape of an element, metres."""
    corners = attribute(element, "shape").split()
    return np.array([[float(c) for c in corner.split(",")[:2]] for corner in corners])


def build(net_path: Path) -> subprocess.CompletedProcess[str]:
    command: list[str | Path] = [BIN / "netconvert", "-c", TOWN / "town.netccfg", "-o", net_path]
    return subprocess.run(command, capture_output=True, text=True, check=True)


@pytest.fixture(scope="module")
def net_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("town") / "town.net.xml"
    built = build(path)
    assert "Warning" not in built.stderr + built.stdout, built.stderr
    return path


@pytest.fixture(scope="module")
def net(net_path: Path) -> ET.Element:
    return ET.parse(net_path).getroot()


@pytest.fixture(scope="module")
def successors(net: ET.Element) -> Successors:
    """The normal edges that a vehicle can take next, for each normal edge."""
    normal = [attribute(e, "id") for e in net.findall("edge") if e.get("function") is None]
    after: dict[str, set[str]] = {edge: set() for edge in normal}
    for link in net.findall("connection"):
        start, end = attribute(link, "from"), attribute(link, "to")
        if start in after and end in after and link.get("fromLane") == "1":
            after[start].add(end)
    return {edge: sorted(nexts) for edge, nexts in after.items()}


def simulate(
    net_path: Path,
    folder: Path,
    demand: str,
    end_s: int,
    additional: Sequence[Path] = (),
    options: Sequence[str | Path] = (),
) -> ET.Element:
    """Runs `demand` (the body of a route file) at 0.1 s a step, and returns SUMO's statistics."""
    (folder / "demand.rou.xml").write_text(f"<routes>{demand}</routes>")
    command: list[str | Path] = [BIN / "sumo", "-n", net_path, "-r", folder / "demand.rou.xml"]
    files = [TOWN / "town.vtypes.add.xml", TOWN / "town.poly.xml", *additional]
    command += ["-a", ",".join(map(str, files)), "--end", str(end_s)]
    command += ["--step-length", "0.1", "--seed", "7", "--collision.check-junctions", "true"]
    command += ["--collision.action", "warn", "--statistic-output", folder / "statistics.xml"]
    command += ["--no-step-log", "true", *options]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    return ET.parse(folder / "statistics.xml").getroot()


def test_building_twice_gives_the_same_net(net_path: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.net.xml"
    build(again)

    def without_header(path: Path) -> str:  # the leading comment holds the date and the output's name
        return path.read_text().split("-->", 1)[1]

    assert without_header(again) == without_header(net_path)


def test_every_edge_reaches_every_other(successors: Successors) -> None:
    for start in successors:
        seen, frontier = {start}, [start]
        while frontier:
            new = set(successors[frontier.pop()]) - seen
            seen |= new
            frontier += new
        assert seen == set(successors), f"from {start}"


def test_no_street_is_a_dead_end(successors: Successors) -> None:
    for edge, nexts in successors.items():
        back = edge[1:] if edge.startswith("-") else "-" + edge
        assert nexts and back not in nexts


def test_projection_puts_the_origin_at_the_centre_of_town(net: ET.Element) -> None:
    location = net.find("location")
    project = pyproj.Proj(attribute(location, "projParameter"))
    offset_x, offset_y = map(float, attribute(location, "netOffset").split(","))
    assert project(CENTRE_M[0] - offset_x, CENTRE_M[1] - offset_y, inverse=True) == pytest.approx(
        (10.52, 52.26), abs=1e-9
    )
    low_lon, low_lat, high_lon, high_lat = map(float, attribute(location, "origBoundary").split(","))
    assert project(low_lon, low_lat) == pytest.approx((-offset_x, -offset_y), abs=0.1)
    assert project(high_lon, high_lat) == pytest.approx((SIZE_M[0] - offset_x, SIZE_M[1] - offset_y), abs=0.1)


def test_every_arm_of_every_junction_has_a_crossing(net: ET.Element) -> None:
    arms = Counter(attribute(e, "from") for e in net.findall("edge") if e.get("function") is None)
    crossings = Counter(attribute(e, "id")[1:].rsplit("_", 1)[0] for e in net.findall("edge[@function='crossing']"))
    assert crossings == arms


def test_buildings_stand_clear_of_streets_and_of_each_other(net: ET.Element) -> None:
    """On a raster of 0.5 m, no point of a street or sidewalk lies under a building, and no point under two."""
    xs, ys = np.meshgrid(np.arange(0, SIZE_M[0], 0.5), np.arange(0, SIZE_M[1], 0.5))
    spots = np.c_[xs.ravel(), ys.ravel()]
    taken = np.zeros(len(spots), dtype=bool)
    for junction in net.findall("junction"):
        if junction.get("type") != "internal":
            taken |= inside(spots, points(junction))
    for edge in net.findall("edge"):
        for lane in edge.findall("lane"):
            corners = points(lane)
            if edge.get("function") == "walkingarea":
                taken |= inside(spots, corners)
            elif edge.get("function") is None:
                for a, b in pairwise(corners):
                    taken |= near(spots, a, b, float(attribute(lane, "width")) / 2)
    for poly in ET.parse(TOWN / "town.poly.xml").getroot().findall("poly"):
        covered = inside(spots, points(poly))
        assert covered.any() and not (covered & taken).any(), poly.get("id")
        taken |= covered
        if poly.get("type") == "building":
            assert float(attribute(poly.find("param[@key='height']"), "value")) > 2.0


def inside(spots: Points, outline: Points) -> Mask:
    """True for each of `spots` [N, 2] inside a polygon; only those within its bounding box are tested exactly."""
    answer: Mask = np.all((spots >= outline.min(axis=0)) & (spots <= outline.max(axis=0)), axis=1)
    answer[answer] = Outline(outline).contains_points(spots[answer])
    return answer


def near(spots: Points, a: Points, b: Points, reach_m: float) -> Mask:
    """True for each of `spots` [N, 2] that is closer than `reach_m` to the line from `a` to `b`."""
    along = np.clip((spots - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    close: Mask = np.sum((spots - a - along[:, None] * (b - a)) ** 2, axis=1) < reach_m**2
    return close


@pytest.mark.parametrize("vehicle_type", VEHICLE_TYPES)
def test_a_vehicle_can_start_on_any_edge(
    vehicle_type: str, net_path: Path, successors: Successors, tmp_path: Path
) -> None:
    demand = "".join(
        f'<vehicle id="{edge}" type="{vehicle_type}" depart="0"><route edges="{edge} {nexts[0]}"/></vehicle>'
        for edge, nexts in successors.items()
    )
    statistics = simulate(net_path, tmp_path, demand, 2)
    assert int(attribute(statistics.find("vehicles"), "inserted")) == len(successors)


def busy_town(successors: Successors, seed: int) -> str:
    """A demand: 60 vehicles drive at random for longer than the run, and 30 pedestrians walk between streets."""
    rng = random.Random(seed)
    edges = sorted(successors)
    demand = []
    for i, start in enumerate(rng.sample(edges, 52) + rng.sample(edges, 8)):
        route = [start]
        while len(route) < 250:
            route.append(rng.choice(successors[route[-1]]))
        demand.append(
            f'<vehicle id="vehicle_{i}" type="town_traffic" depart="{i // 52 * 5}" departPos="random_free">'
            f'<route edges="{" ".join(route)}"/></vehicle>'
        )
    for i in range(30):
        stops = [rng.choice(edges)]
        while len(stops) < 12:
            stops.append(rng.choice([e for e in edges if e != stops[-1]]))
        walks = "".join(f'<walk from="{a}" to="{b}"/>' for a, b in pairwise(stops))
        demand.append(f'<person id="walker_{i}" type="pedestrian" depart="5">{walks}</person>')
    return "".join(demand)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_ten_minutes_of_dense_traffic(seed: int, net_path: Path, successors: Successors, tmp_path: Path) -> None:
    """Three demands without teleport and collision; README.md has the figures of forty, of which a few have some."""
    fcd, tls = tmp_path / "fcd.xml", tmp_path / "tls.add.xml"
    signals = [attribute(t, "id") for t in ET.parse(net_path).getroot().findall("tlLogic")]
    tls.write_text(
        "<additional>"
        + "".join(f'<timedEvent type="SaveTLSStates" source="{s}" dest="{tmp_path}/tls.xml"/>' for s in signals)
        + "</additional>"
    )
    options: list[str | Path] = ["--fcd-output", fcd, "--device.fcd.period", "1"]
    statistics = simulate(net_path, tmp_path, busy_town(successors, seed), 600, [tls], options)

    assert int(attribute(statistics.find("vehicles"), "inserted")) == 60
    assert int(attribute(statistics.find("teleports"), "total")) == 0
    assert int(attribute(statistics.find("safety"), "collisions")) == 0

    speeds: list[float] = []
    on_crossing: set[str] = set()
    for step in ET.parse(fcd).getroot():
        speeds += [float(attribute(v, "speed")) for v in step.findall("vehicle")]
        on_crossing |= {
            attribute(p, "id") for p in step.findall("person") if re.fullmatch(r":.*_c\d+", attribute(p, "edge"))
        }
    assert np.mean(speeds) > 3.0
    assert len(on_crossing) == 30

    states: dict[str, list[str]] = {}
    for state in ET.parse(tmp_path / "tls.xml").getroot():
        states.setdefault(attribute(state, "id"), []).append(attribute(state, "state"))
    assert set(states) == set(signals)
    for signal, seen in states.items():
        changes = sum(a != b for a, b in pairwise(seen))
        assert changes > 30, f"{signal} changed {changes} times"
