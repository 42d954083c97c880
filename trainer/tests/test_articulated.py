"""A truck with its semi-trailer, an articulated bus and a tram of three parts, in sensors, recordings and exports."""

from __future__ import annotations

import os
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import sumo  # type: ignore[import-untyped]  # the wheel of SUMO has no stubs
from caraware.data import Recording, open_recording
from caraware.data.export.__main__ import export
from caraware.data.export.nuscenes import VERSION
from caraware.data.names import BODY_SHIFT, Kind, RoadUsers, vehicle_class
from caraware.data.recording import Array
from caraware.ipc.image import split_planes
from nuscenes.nuscenes import NuScenes
from recorded_run import in_world_m, recorded_run, unseen

NODES = """<nodes>
    <node id="west" x="0" y="0"/><node id="begin" x="120" y="0"/>
    <node id="end" x="140" y="20"/><node id="north" x="140" y="150"/>
</nodes>"""
EDGES = """<edges>
    <edge id="in" from="west" to="begin" numLanes="2" speed="8"/>
    <edge id="bend" from="begin" to="end" numLanes="2" speed="8" shape="{shape}"/>
    <edge id="out" from="end" to="north" numLanes="2" speed="8"/>
</edges>"""
SHAPE = " ".join(
    f"{120 + 20 * np.sin(turn):.3f},{20 - 20 * np.cos(turn):.3f}" for turn in np.linspace(0, np.pi / 2, 31)
)
"""A quarter of a circle of 20 m."""
ROUTES = """<routes>
    <vType id="semi" vClass="trailer"/>
    <vType id="bendy" vClass="bus" length="18"/>
    <vType id="tram" vClass="tram" length="30"/>
    <vType id="car" vClass="passenger" maxSpeed="7.5"/>
    <route id="bend" edges="in bend out"/>
    <vehicle id="semi" type="semi" depart="0" departLane="0" route="bend"/>
    <vehicle id="car" type="car" depart="0" departLane="1" departPos="10" departSpeed="5" route="bend"/>
    <vehicle id="bendy" type="bendy" depart="6" departLane="0" route="bend"/>
    <vehicle id="tram" type="tram" depart="12" departLane="1" route="bend"/>
</routes>"""
SCENARIO = """<configuration>
    <net-file value="bend.net.xml"/><route-files value="bend.rou.xml"/><end value="44"/><step-length value="0.1"/>
</configuration>"""
SETTINGS = {
    "traffic.cav_share": 1.0,
    "map.origin_latitude_deg": 52.0,
    "map.origin_longitude_deg": 10.0,
    "fanout.enabled": "false",
    "run.real_time_factor": 8,
    "lidar.vehicles": 4,
    "lidar.channels": 32,
    "lidar.points_per_second": 115200,
    "lidar.rolling_shutter": "false",
    "lidar.range_noise_std_m": 0.0,
    "camera.vehicles": 4,
    "record.channels": '["world", "observation", "pointcloud", "image", "traffic-meta"]',
}
CLASSES = {"semi": "trailer", "bendy": "bus", "tram": "tram", "car": "passenger"}
TRAILING = {"semi": 1, "bendy": 1, "tram": 2, "car": 0}
"""Trailing bodies of each vehicle."""


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    directory = tmp_path_factory.mktemp("bend")
    texts = {
        "bend.nod.xml": NODES,
        "bend.edg.xml": EDGES.format(shape=SHAPE),
        "bend.rou.xml": ROUTES,
        "bend.sumocfg": SCENARIO,
    }
    for name, text in texts.items():
        (directory / name).write_text(text)
    netconvert = Path(sumo.SUMO_HOME, "bin", "netconvert")
    files = ["--node-files", "bend.nod.xml", "--edge-files", "bend.edg.xml", "--output-file", "bend.net.xml"]
    environment = os.environ | {"SUMO_HOME": sumo.SUMO_HOME}
    subprocess.run([netconvert, *files], cwd=directory, env=environment, check=True)
    with recorded_run("simulate", SETTINGS, preset=str(directory / "bend.sumocfg"), name="bend") as run:
        yield run


@pytest.fixture(scope="module")
def recording(run_dir: Path) -> Recording:
    return open_recording(run_dir)


@pytest.fixture(scope="module")
def worlds(recording: Recording) -> dict[int, Array]:
    return {message.tick: message.section("states") for message in recording.messages("world")}


def test_a_world_has_every_body_behind_its_road_users(worlds: dict[int, Array], recording: Recording) -> None:
    users, seen = RoadUsers(recording), set()
    for header, (_, states) in zip(recording.headers("world"), sorted(worlds.items()), strict=True):
        road_users, trailing = np.split(states, [int(header["shape"][0])])
        assert int(header["shape"][3]) == len(states)
        assert (road_users["kind"] == Kind.CAV).all() and (trailing["kind"] == Kind.TRAILING).all()
        expected = [
            (int(state["vehicle"]) | place << BODY_SHIFT, int(state["id_hash"]))
            for state in road_users
            for place in range(1, TRAILING[users.of(state["id_hash"]).id] + 1)
        ]
        assert [(int(body["vehicle"]), int(body["id_hash"])) for body in trailing] == expected
        seen |= {users.body_name(state) for state in states}
        assert all(vehicle_class(state) == CLASSES[users.of(state["id_hash"]).id] for state in states)
    assert seen == {"semi", "semi/1", "bendy", "bendy/1", "tram", "tram/1", "tram/2", "car"}


def test_joints_hold_in_the_bend(worlds: dict[int, Array], recording: Recording) -> None:
    """The rear of each carriage stays at the front of the next; a trailer keeps its axle 7.9 m behind the kingpin."""
    users, bent, apart_m = RoadUsers(recording), 0.0, []
    for states in worlds.values():
        for body in states[states["kind"] == Kind.TRAILING]:
            ahead = states[states["vehicle"] == int(body["vehicle"]) - (1 << BODY_SHIFT)][0]
            place = np.array([body["x_m"], body["y_m"]])
            front, rear = place + body["wheelbase_m"] * _ahead(body), np.array([ahead["x_m"], ahead["y_m"]])
            turned = float(np.angle(np.exp(1j * (body["yaw_rad"] - ahead["yaw_rad"]))))
            if users.of(body["id_hash"]).id == "semi":
                assert front == pytest.approx(rear + 0.6 * _ahead(ahead), abs=1e-4)
                bent = max(bent, abs(turned))
            elif users.of(body["id_hash"]).id == "tram":
                end = rear - float(ahead["rear_overhang_m"]) * _ahead(ahead)
                begin = place + (float(body["length_m"]) - float(body["rear_overhang_m"])) * _ahead(body)
                apart_m.append(float(np.hypot(*(end - begin))))
    assert bent > 0.3
    # A gap of 0.4 m, and what the ends of two chords of one curve are apart.
    assert max(apart_m) < 0.9 and min(apart_m) > 0.05


def test_lidar_points_lie_on_the_body_that_they_name(worlds: dict[int, Array], recording: Recording) -> None:
    on = dict.fromkeys(range(4), 0)
    for message in recording.messages("pointcloud"):
        scan, points, states = message.section("scan")[0], message.section("points"), worlds[message.tick]
        by_index = {int(state["vehicle"]): state for state in states}
        world = in_world_m(scan, points["position_m"].astype(np.float64))
        for index in np.unique(points["object"]):
            if (state := by_index.get(int(index))) is None:
                continue
            beside_m = _outside_m(state, world[points["object"] == index])
            assert beside_m.max() < 0.02, (message.tick, int(index), beside_m.max())
            on[int(index) >> BODY_SHIFT] += len(beside_m)
    assert min(on[place] for place in range(3)) > 500, on


def test_images_tell_the_bodies_apart(worlds: dict[int, Array], recording: Recording) -> None:
    shown = set()
    for message in recording.messages("image"):
        head, objects = message.section("head")[0], message.section("objects")
        planes = split_planes(head, message.section("planes").tobytes())
        assert (instance := planes["instance"]) is not None
        for seen in objects:
            assert np.count_nonzero(instance == seen["object"]) == int(seen["visible_px"])
        shown |= {int(seen["object"]) >> BODY_SHIFT for seen in objects}
    assert {0, 1} <= shown


def test_exports_name_trailers_and_count_vehicles(run_dir: Path, recording: Recording, tmp_path: Path) -> None:
    for name in ("fcd", "kitti", "foxglove"):
        assert export(run_dir, name, tmp_path / name, 1, unseen) == 1
    steps = ET.parse(next((tmp_path / "fcd").glob("*.xml"))).getroot()
    most = max(len(step) for step in steps)
    assert most == 4
    assert all(len({user.get("id") for user in step}) == len(step) for step in steps)
    kinds = {
        line.split()[0]
        for file in (tmp_path / "kitti").rglob("label_2/*.txt")
        for line in file.read_text().splitlines()
    }
    assert kinds == {"Truck", "Misc", "Tram", "Car"}


def test_nuscenes_has_a_box_and_an_instance_for_each_body(run_dir: Path, tmp_path: Path) -> None:
    assert export(run_dir, "nuscenes", tmp_path, 1, unseen) == 1
    devkit = NuScenes(version=VERSION, dataroot=str(tmp_path), verbose=False)
    categories = {
        instance["token"]: devkit.get("category", instance["category_token"])["name"] for instance in devkit.instance
    }
    assert {"vehicle.trailer", "vehicle.truck", "vehicle.bus.bendy", "vehicle.car"} <= set(categories.values())
    for sample in devkit.sample:
        tokens = [devkit.get("sample_annotation", token)["instance_token"] for token in sample["anns"]]
        assert len(tokens) == len(set(tokens))


def _ahead(state: np.void) -> Array:
    return np.array([np.cos(state["yaw_rad"]), np.sin(state["yaw_rad"])])


def _outside_m(state: np.void, world_m: Array) -> Array:
    """How far points are from the surface of a body, in the horizontal plane, if they are outside of it or inside."""
    ahead, off = _ahead(state), world_m[:, :2] - [state["x_m"], state["y_m"]]
    along, left = off @ ahead, off @ np.array([-ahead[1], ahead[0]])
    rear, front, half = -state["rear_overhang_m"], state["length_m"] - state["rear_overhang_m"], state["width_m"] / 2
    outside: Array = np.max([along - front, rear - along, np.abs(left) - half], axis=0)
    # Points on a roof are inside of the outline.
    is_roof = world_m[:, 2] > state["z_m"] + state["height_m"] - 0.02
    result: Array = np.where(is_roof, np.maximum(outside, 0), np.abs(outside))
    return result
