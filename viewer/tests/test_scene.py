"""Draws frames into a recording, and reads the entities back."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import frames
import numpy as np
import pytest
import recordings
import rerun as rr

from caraware_viewer import course, detail, legend, messages, plots, scene, space, static_map, top, wire
from caraware_viewer.documents import RunMap
from caraware_viewer.link import Sample
from caraware_viewer.scene import Scene

TRUTH = np.array([[10.0, 20.0], [30.0, 40.0]], np.float32)
SCENE: dict[str, list[dict[str, Any]]] = {
    "lanes": [
        {"id": "a_0", "kind": "sidewalk", "inside": False, "width_m": 2.0, "right": "none", "left": "none"},
        {"id": "a_1", "kind": "car", "inside": False, "width_m": 3.2, "right": "solid", "left": "dashed"},
        {"id": ":j_0", "kind": "car", "inside": True, "width_m": 3.2, "right": "solid", "left": "solid"},
        {"id": ":j_c0", "kind": "crossing", "inside": True, "width_m": 4.0, "right": "none", "left": "none"},
    ],
    "areas": [
        {"id": "j", "kind": "junction", "points_m": [[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]]},
        {"id": "w", "kind": "walking_area", "points_m": [[0, 0, 0], [2, 0, 0], [2, 2, 0]]},
    ],
    "buildings": [
        {"id": "b", "kind": "building", "points_m": [[50, 50], [60, 50], [60, 60]], "base_m": 1, "height_m": 8},
    ],
    "obstacles": [{"kind": "cone", "center_m": [1, 2, 0], "yaw_rad": 0.5, "size_m": [0.4, 0.4, 0.7]}],
    "signals": [
        {
            "id": "j",
            "id_hash": "0x0000000000000009",
            "links": [
                {"link": 0, "lane": "a_1", "position_m": [48.0, 3.0, 0.0], "yaw_rad": 0.0},
                {"link": 2, "lane": "a_1", "position_m": [48.0, 6.0, 0.0], "yaw_rad": 0.0},
            ],
        }
    ],
}
for lane in SCENE["lanes"]:
    lane["points_m"] = [[0.0, 1.0, 0.5], [20.0, 1.0, 0.5]]
MAP: dict[str, Any] = {
    "run": "a run",
    "run_id": f"{frames.RUN_ID:#018x}",
    "mode": "train",
    "tick_s": 0.1,
    "map": {"bounds_m": [0.0, 0.0, 220.0, 200.0]},
    "scene": SCENE,
}
STATUS = {
    "tick": 2,
    "episode": 1,
    "step": 3,
    "ticks_per_s": 50.0,
    "real_time_factor": 5.0,
    "road_users": {"cav": 4, "other": 1, "person": 0, "hero": 1},
    "training": {
        "updates": 3,
        "policy_std": 0.5,
        "reward": 0.25,
        "best_reward": 0.75,
        "env_steps_per_s": 1234.0,
        "metrics": [{"name": "progress_mps", "label": "progress", "unit": "m/s", "value": 8.25}],
    },
}
COURSE = json.dumps({"updates": [{"env_steps": 8, "tick": 1, "training": {"reward": 0.5}}], "evaluations": []}).encode()

Drawing = tuple[Scene, dict[str, recordings.Entity]]
Drawn = Callable[..., Drawing]


@pytest.fixture
def drawn(tmp_path: Path) -> Drawn:
    """Draws samples into a recording and reads it back."""

    def draw(*samples: tuple[str, bytes], run_map: dict[str, Any] = MAP, **options: Any) -> Drawing:
        recording = rr.RecordingStream("test", recording_id="test")
        path = tmp_path / "run.rrd"
        recording.save(path)
        drawing = Scene(recording, cast(RunMap, run_map), **options)
        for topic, payload in samples:
            drawing.draw(topic, Sample(payload))
        recording.flush()
        recording.disconnect()
        return drawing, recordings.read(path)

    return draw


def near(entity: recordings.Entity, component: str, expected: Any) -> None:
    np.testing.assert_allclose(np.array(entity.newest(component)), np.array(expected), atol=1e-4)


def test_the_static_map_is_drawn_once(drawn: Drawn) -> None:
    _, found = drawn()
    near(found[static_map.ROADS], "LineStrips2D:radii", [1.6, 1.6])
    near(found[static_map.ROADS], "LineStrips2D:strips", [[[0, -1], [20, -1]]] * 2)
    near(found[static_map.WALKS], "LineStrips2D:radii", [1.0])
    assert len(found[static_map.MARKINGS].newest("LineStrips2D:strips")) == 1 + 3  # solid, and three dashes in 20 m
    assert len(found[static_map.CROSSINGS].newest("LineStrips2D:strips")) == 20
    for path in (static_map.JUNCTIONS, static_map.WALKS + "/areas", static_map.BUILDINGS, static_map.BOUNDS):
        assert found[path].newest("LineStrips2D:strips")
    corners = np.array(found[static_map.SPACE_BUILDINGS].newest("Mesh3D:vertex_positions"))
    assert set(corners[:, 2]) == {1.0, 9.0}
    road = np.array(found[static_map.SPACE_ROADS].newest("Mesh3D:vertex_positions"))
    np.testing.assert_allclose([road.min(axis=0), road.max(axis=0)], [[0, -0.6, 0.5], [20, 2.6, 0.5]], atol=1e-6)
    ground = np.array(found[static_map.SPACE_GROUND].newest("Mesh3D:vertex_positions"))
    assert ground[:, 2].max() < 0.5
    assert found[static_map.SCALE + "/length"].newest("Points2D:labels") == ["50 m"]
    near(found[static_map.SPACE_OBSTACLES], "Boxes3D:centers", [[1, 2, 0.35]])
    assert all(at == recordings.ALWAYS for at, _ in found[static_map.ROADS].rows)


def test_a_map_without_a_scene_has_its_bounds(drawn: Drawn) -> None:
    _, found = drawn(run_map={"tick_s": 0.1, "map": MAP["map"]})
    assert static_map.BOUNDS in found
    assert static_map.ROADS not in found


@pytest.mark.parametrize("scene_part", [{"lanes": [{}]}, {"signals": [{"id": "j"}]}, {"buildings": [{"points_m": 3}]}])
def test_a_map_without_a_required_member_is_refused(drawn: Drawn, scene_part: dict[str, Any]) -> None:
    with pytest.raises(wire.FrameError, match="map"):
        drawn(run_map=MAP | {"scene": scene_part})


def test_vehicles_are_a_few_entities_whatever_their_number(drawn: Drawn) -> None:
    _, few = drawn(("world", frames.world(0, 3)))
    _, many = drawn(("world", frames.world(0, 2000)))
    assert few.keys() == many.keys()
    assert len(many[top.OUTLINES].newest("LineStrips2D:strips")) == detail.MAX_SHAPES
    assert len(many[top.MARKS].newest("Points2D:positions")) == 2000
    assert "400 as boxes, the others as dots" in many[scene.HUD].newest("TextDocument:text")[0]


def test_of_a_crowd_the_fixes_of_the_same_vehicles_are_drawn_in_every_tick(drawn: Drawn) -> None:
    truth = np.column_stack([10.0 * np.arange(1000), np.full(1000, 50.0)]).astype(np.float32)
    rows = np.arange(1000)
    drawing: list[tuple[str, bytes]] = []
    for tick, order in ((0, rows), (1, rows[::-1])):
        drawing.append(("world", frames.world(tick, 1000, kind=0, id_hash=7 + 1000 * order, x_m=10.0 * order)))
        ids = np.array(7 + 1000 * order, np.uint64)
        drawing.append(("observation", frames.observation(tick, truth[order], truth[order] + 1, id_hash=ids)))
    _, found = drawn(*drawing)
    shown = [sorted(row["Points2D:positions"]) for _, row in found[top.GNSS].rows if "Points2D:positions" in row]
    assert len(shown[0]) == detail.MAX_POSITIONS
    assert shown[0] == shown[1]


def test_a_region_is_all_that_is_drawn(drawn: Drawn) -> None:
    _, found = drawn(("world", frames.world(0, 100)), region=(95.0, 0.0, 205.0, 100.0))
    assert len(found[top.OUTLINES].newest("LineStrips2D:strips")) == 11


def test_kinds_have_colours_of_their_own(drawn: Drawn) -> None:
    kinds = [wire.CAV, wire.OTHER, wire.PERSON, wire.HERO, 77]
    _, found = drawn(("world", frames.world(0, 5, kind=kinds)))
    assert found[top.OUTLINES].newest("LineStrips2D:colors") == top.KIND_COLORS[[0, 1, 2, 3, 3]].tolist()


def test_few_vehicles_have_names_and_of_many_only_the_followed_ones(drawn: Drawn) -> None:
    names = {100 + i: f"cav {i}" for i in range(100)}
    for count, expected in ((3, ["cav 0", "cav 1", "cav 2"]), (100, ["cav 7"])):
        _, found = drawn(
            ("vehicles", frames.vehicles(0, names)), ("world", frames.world(0, count, kind=0)), wanted=["cav 7"]
        )
        assert found[top.NAMES].newest("Points2D:labels") == expected


def test_signals_of_vehicles_and_lights_are_drawn(drawn: Drawn) -> None:
    _, found = drawn(
        ("world", frames.world(0, 1, signals=1 | 8)),
        ("signals", frames.signals(0, {9: "rGy", 10: "rrr"})),
        ("signals", frames.signals(1, {9: "Gru"})),
    )
    near(found[space.SIGNALS], "Points3D:positions", [[48, 3, 2.5], [48, 6, 2.5]])
    assert len(found[top.BLINKERS].newest("Points2D:positions")) == 2
    assert len(found[top.BRAKES].newest("Points2D:positions")) == 2
    near(found[top.SIGNALS], "Points2D:positions", [[48, -3], [48, -6]])
    assert [row["Points2D:colors"] for _, row in found[top.SIGNALS].rows] == [
        [top.SIGNAL_COLORS["r"], top.SIGNAL_COLORS["y"]],
        [top.SIGNAL_COLORS["G"], top.SIGNAL_COLORS["u"]],
    ]


def test_positions_are_linked_to_their_vehicles(drawn: Drawn) -> None:
    _, found = drawn(
        ("observation", frames.observation(2, TRUTH, TRUTH + np.array([3, 4]))),
        ("prediction", frames.prediction(2, TRUTH + np.array([0, 2]), TRUTH + np.array([1, 0]))),
    )
    for path, offset in ((top.GNSS, [3, 4]), (top.PREDICTIONS, [0, 2]), (top.ESTIMATES, [1, 0])):
        near(found[path], "Points2D:positions", (TRUTH + offset) * [1, -1])
        near(found[path + "/links"], "LineStrips2D:strips", np.stack([TRUTH + offset, TRUTH], axis=1) * [1, -1])
    for path, error in ((plots.GNSS_ERROR, 5), (plots.POLICY_ERROR, 2), (plots.EKF_ERROR, 1)):
        near(found[path], "Scalars:scalars", [error])
        assert found[path].rows[-1][0] == pytest.approx(0.3)


def test_an_estimate_that_is_not_a_number_is_left_out(drawn: Drawn) -> None:
    estimates = np.array([[np.nan, np.nan], [31.0, 40.0]])
    _, found = drawn(
        ("prediction", frames.prediction(2, TRUTH, estimates)),
        ("observation", frames.observation(2, TRUTH, TRUTH)),
    )
    near(found[top.ESTIMATES], "Points2D:positions", [[31, -40]])


def test_a_drivers_actions_are_not_drawn_as_positions(drawn: Drawn) -> None:
    _, found = drawn(
        ("world", frames.world(1, 2, kind=wire.HERO)),
        ("observation", frames.observation(2, TRUTH, TRUTH)),
        ("prediction", frames.prediction(2, TRUTH)),
    )
    assert top.PREDICTIONS not in found
    assert not [row for _, row in found[plots.POLICY_ERROR].rows if "Scalars:scalars" in row]


@pytest.mark.parametrize(("task", "columns"), [("lane", 2), ("messages", 5)])
def test_answers_of_a_task_that_does_not_localise_are_not_drawn_as_positions(
    drawn: Drawn, task: str, columns: int
) -> None:
    _, found = drawn(
        ("world", frames.world(1, 2)),
        ("observation", frames.observation(2, TRUTH, TRUTH)),
        ("prediction", frames.prediction(2, np.ones((2, columns)))),
        run_map=MAP | {"task": task},
    )
    assert top.PREDICTIONS not in found
    assert not [row for _, row in found[plots.POLICY_ERROR].rows if "Scalars:scalars" in row]


def test_the_followed_vehicle_is_the_origin_of_the_3d_view(drawn: Drawn) -> None:
    _, found = drawn(
        ("vehicles", frames.vehicles(0, {101: "cav 1", 100: "cav 0"})),
        ("world", frames.world(0, 3, yaw_rad=np.pi / 2)),
        wanted=["cav 1"],
    )
    turn = np.array(found[space.WORLD].newest("Transform3D:mat3x3")[0]).reshape(3, 3).T
    move = np.array(found[space.WORLD].newest("Transform3D:translation")[0])
    np.testing.assert_allclose(turn @ [10, 50, 0] + move, [0, 0, 0], atol=1e-4)
    np.testing.assert_allclose(turn @ [10, 55, 0] + move, [5, 0, 0], atol=1e-4)
    assert len(found[space.VEHICLES].newest("Boxes3D:centers")) == 3
    ring = np.array(found[top.FOLLOWED].newest("LineStrips2D:strips"))
    np.testing.assert_allclose(ring[0].mean(axis=0), [10, -50], atol=0.2)


def test_a_cloud_is_drawn_in_the_world_with_its_range(drawn: Drawn) -> None:
    points = {"position_m": [[5, 0, 0], [0, 5, 0]], "tag": [4, 0]}
    seen = frames.pointcloud(1, points, position_m=[10.0, 50.0, 2.0], id_hash=101)
    samples = [
        ("vehicles", frames.vehicles(0, {101: "x/y", 100: "other"})),
        ("world", frames.world(0, 3, x_m=10.0)),
        ("pointcloud/x%2Fy", seen),
        ("pointcloud/other", frames.pointcloud(1, points, id_hash=100)),
    ]
    drawing, found = drawn(*samples, wanted=["x/y"])
    assert "pointcloud/x%2Fy" in drawing.sensor_topics()
    near(found[top.CLOUD], "Points2D:positions", [[15, -50]])
    near(found[space.CLOUD], "Points3D:positions", [[15, 50, 2]])
    ring = np.array(found[top.RING].newest("LineStrips2D:strips")[0])
    np.testing.assert_allclose(np.hypot(*(ring - [10, -50]).T), 50, atol=1e-3)
    _, whole = drawn(*samples, wanted=["x/y"], lidar="all")
    assert len(whole[top.CLOUD].newest("Points2D:positions")) == 2
    drawing, _ = drawn(*samples[:2], wanted=["x/y"], lidar="off")
    assert not [topic for topic in drawing.sensor_topics() if "pointcloud" in topic]


def test_contacts_stay_for_a_while(drawn: Drawn) -> None:
    _, found = drawn(
        ("event", frames.event(5, np.array([[1.0, 2.0, 0.0]]))),
        ("world", frames.world(5)),
        ("world", frames.world(54)),
        ("world", frames.world(56)),
    )
    assert [len(row["Points2D:positions"]) for _, row in found[top.CONTACTS].rows] == [1, 1, 0]
    assert [len(row["Points3D:positions"]) for _, row in found[space.CONTACTS].rows] == [1, 1, 0]


def of_the_next_episode(tick: int) -> bytes:
    return frames.header(tick, 3, 0, 0, 3, episode=1) + frames.states(3, tick).tobytes()


def test_contacts_of_an_episode_end_with_it(drawn: Drawn) -> None:
    contact = ("event", frames.event(95, np.array([[1.0, 2.0, 0.0]])))
    _, found = drawn(contact, ("world", frames.world(96)), ("world", of_the_next_episode(97)))
    for entity, positions in ((top.CONTACTS, "Points2D:positions"), (space.CONTACTS, "Points3D:positions")):
        assert [len(row[positions]) for _, row in found[entity].rows] == [1, 0]


@pytest.mark.parametrize("last", [of_the_next_episode(2), frames.world(2, 1)], ids=["episode", "departure"])
def test_points_leave_with_the_vehicle_that_measured_them(last: bytes, drawn: Drawn) -> None:
    points = {"position_m": [[5, 0, 0], [0, 5, 0]], "tag": [4, 0]}
    _, found = drawn(
        ("vehicles", frames.vehicles(0, {101: "x"})),
        ("world", frames.world(0, 3)),
        ("pointcloud/x", frames.pointcloud(1, points, id_hash=101)),
        ("world", last),
        wanted=["x"],
    )
    for entity, what in (
        (top.CLOUD, "Points2D:positions"),
        (top.RING, "LineStrips2D:strips"),
        (space.CLOUD, "Points3D:positions"),
    ):
        assert [bool(row[what]) for _, row in found[entity].rows] == [True, False], entity


def test_routes_of_heroes_and_their_lights_are_drawn_while_they_are_on_the_road(drawn: Drawn) -> None:
    route = [(0.0, 5.0, wire.NO_SIGNAL, 0), (10.0, 5.0, 4, 1), (20.0, 5.0, wire.NO_SIGNAL, 0)]
    _, found = drawn(
        ("signals", frames.signals(0, {9: "rG"}, indices=[4])),
        ("routes", frames.routes(0, {1: route, 2: route[:2]})),
        ("world", frames.world(0, 2, kind=[wire.CAV, wire.HERO])),
        ("world", frames.world(1, 1, kind=wire.CAV)),
    )
    near(found[top.ROUTES], "LineStrips2D:strips", [])
    first = found[top.ROUTES].rows[0][1]["LineStrips2D:strips"]
    np.testing.assert_allclose(first, [[[0, -5], [10, -5], [20, -5]]])
    lights = found[top.ROUTE_SIGNALS].rows[0][1]
    np.testing.assert_allclose(lights["Points2D:positions"], [[10, -5]])
    assert lights["Points2D:colors"] == [top.SIGNAL_COLORS["G"]]
    assert len(found[space.ROUTES].rows[0][1]["LineStrips3D:strips"]) == 1


KNOWN: dict[int, list[tuple[list[float], tuple[int, int, int]]]] = {
    0: [
        # Vehicle 1 itself, measured 0.5 s ago at 4 m/s; a pedestrian that it perceives; a unit beside the road.
        ([12, 50, 4, 0, 0, 4.5, 1.8, 0.5, 0.4, 0.1, 0.01], (101, 101, 1)),
        ([30, 60, 0, 1, 1.5, 0, 0, 1.0, 1.0, 0.2, 0.1], (0, 101, 2)),
        ([80, 80, 0, 0, 0, 0, 0, 2.0, 0.1, 0.0, 0.0], (900, 900, 1)),
    ],
    1: [],
}
RADIO = np.array([[1, 3, 0, 0, 2], [1, 0, 2, 250, 0]])


def test_the_map_of_the_followed_vehicle_and_its_links_are_drawn(drawn: Drawn) -> None:
    scene, found = drawn(
        ("world", frames.world(4, vehicle=np.arange(3), kind=wire.CAV)),
        ("neighbours", frames.neighbours(4, KNOWN, radio=RADIO, channel_load=[0.25, 0.0])),
        ("world", frames.world(5, vehicle=np.arange(3), kind=wire.CAV)),
        messages=True,
    )
    # Boxes stand where the objects are by now: the first corner of an outline is the rear left one.
    outlines = np.array(found[messages.KNOWN].newest("LineStrips2D:strips"))
    assert outlines.shape == (3, 8, 2)
    np.testing.assert_allclose(outlines[0, 0], [12 + 0.5 * 4 - 4.5 / 2, -(50 + 0.9)], atol=1e-5)
    np.testing.assert_allclose(outlines[1].mean(axis=0), [30, -(60 + 1)], atol=0.2)
    assert found[messages.KNOWN].newest("LineStrips2D:colors") == messages.SOURCE_COLORS[[1, 2, 1]].tolist()
    circles = np.array(found[messages.DEVIATIONS].newest("LineStrips2D:strips"))
    np.testing.assert_allclose(np.ptp(circles[:, :, 0], axis=1) / 2, [0.98, 2.45, 0.245], atol=1e-3)
    near(found[messages.KNOWN_IN_SPACE], "Boxes3D:centers", [[14, 50, 0.75], [30, 61, 0.75], [80, 80, 0.75]])
    # Two stations were heard: vehicle 1, where it is, brighter as it is fresher, and the unit, where it says it is.
    middle = [2.25 - 1.0 + 4, -50.0]
    near(found[messages.LINKS], "LineStrips2D:strips", [[[middle[0] + 10, -50], middle], [[80, -80], middle]])
    fresh, old = (int(color) & 0xFF for color in found[messages.LINKS].newest("LineStrips2D:colors"))
    assert fresh > old == 0xFF - 0xC0
    # Vehicle 1 has just sent.
    rings = np.array(found[messages.SENDERS].newest("LineStrips2D:strips"))
    np.testing.assert_allclose(rings.mean(axis=1), [[middle[0] + 10, -50]], atol=0.1)
    text = found["hud"].newest("TextDocument:text")[0]
    assert "| radio | 0 sent (0 B) · 2 received · channel 25 % busy |" in text
    assert "| knows | 3 views of objects · CAM 2 · CPM 1 |" in text
    assert "known by CPM" in found[legend.SIGNS].newest("Points2D:labels")
    assert scene.refused == 0


def test_a_vehicle_with_a_radio_is_followed_where_messages_are_shown(drawn: Drawn) -> None:
    world = frames.world(4, vehicle=np.arange(3), kind=wire.CAV)
    radio = np.array([[0, 0, 0, 0, 0], [1, 0, 0, 0, 0]])
    frame = frames.neighbours(4, {0: [], 1: []}, radio=radio)
    scene, _ = drawn(("world", world), ("neighbours", frame), messages=True)
    assert scene.sensor_topics() == set() and scene.followed == [101]
    scene, _ = drawn(("world", world))
    assert scene.followed == [100]
    scene, _ = drawn(
        ("world", world), ("neighbours", frame), ("vehicles", frames.vehicles(4, {100: "a"})), wanted=["a"]
    )
    assert scene.followed == [100]


def test_links_and_map_go_with_the_vehicle_that_is_followed(drawn: Drawn) -> None:
    world = frames.world(4, vehicle=np.arange(3), kind=wire.CAV)
    names = frames.vehicles(4, {100: "a"})
    samples = [("vehicles", names), ("world", world), ("neighbours", frames.neighbours(4, KNOWN, radio=RADIO))]
    _, found = drawn(*samples, wanted=["a"], messages=True)
    assert len(found[messages.LINKS].newest("LineStrips2D:strips")) == 2
    # It leaves, and no vehicle has a slot any more.
    gone = [("world", frames.world(5, 0)), ("neighbours", frames.neighbours(5, {}))]
    scene, found = drawn(*samples, *gone, wanted=["a"], messages=True)
    assert scene.followed == []
    for path in (messages.LINKS, messages.KNOWN, messages.SENDERS):
        assert not found[path].newest("LineStrips2D:strips"), path


def test_a_radio_of_the_last_episode_is_no_vehicles_of_the_next(drawn: Drawn) -> None:
    world = [frames.world(tick, vehicle=np.arange(3), kind=wire.CAV) for tick in (4, 5)]
    later = frames.header(5, 3, episode=1) + world[1][wire.HEADER.itemsize :]
    _, found = drawn(("world", world[0]), ("neighbours", frames.neighbours(4, KNOWN, radio=RADIO)), ("world", later))
    assert "| radio |" not in found["hud"].newest("TextDocument:text")[0]


def test_without_messages_the_legend_does_not_name_them(drawn: Drawn) -> None:
    _, found = drawn(("world", frames.world(4)))
    assert "known by CPM" not in found[legend.SIGNS].newest("Points2D:labels")


def test_the_status_is_plotted_and_in_the_hud(drawn: Drawn) -> None:
    _, found = drawn(("status", json.dumps(STATUS).encode()), ("world", frames.world(2)))
    for path, value in ((plots.STEPS, 250.0), (plots.REAL_TIME, 5.0), (plots.VEHICLES, 6.0), (plots.PERSONS, 0.0)):
        near(found[path], "Scalars:scalars", [value])
    text = found[scene.HUD].newest("TextDocument:text")[0]
    for part in (
        "a run",
        "train",
        "0.750 best",
        "8.25 m/s in the newest update",
        "1 234 samples/s",
        "5.0 × real time",
        "1 obstacles",
    ):
        assert part in text


def test_a_run_without_a_learner_has_no_policy_plots(drawn: Drawn) -> None:
    _, found = drawn(("status", json.dumps(STATUS | {"training": None}).encode()))
    assert not [row for _, row in found[plots.STEPS].rows if "Scalars:scalars" in row]


def test_every_topic_may_be_missing(drawn: Drawn) -> None:
    _, found = drawn(("world", frames.world(0, 0)))
    assert found[scene.HUD].newest("TextDocument:text")


def test_seeking_is_in_simulated_time_over_episodes(drawn: Drawn) -> None:
    _, found = drawn(*(("world", frames.world(tick)) for tick in (0, 9, 99)))
    assert [at for at, _ in found[top.OUTLINES].rows] == pytest.approx([0.1, 1.0, 10.0])


def test_the_live_picture_replaces_its_frames_and_the_kept_one_has_their_history(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scene, "_REPEATS_KEPT", 100)
    recordings_of = {name: rr.RecordingStream("test", recording_id="test") for name in ("kept", "live")}
    for name, recording in recordings_of.items():
        recording.save(tmp_path / name)
    drawing = Scene(recordings_of["kept"], cast(RunMap, MAP), live=recordings_of["live"])
    drawing.draw("learning/whole", Sample(COURSE))
    for tick in range(40):
        drawing.draw("world", Sample(frames.world(tick, 100)))
        drawing.draw("status", Sample(json.dumps(STATUS | {"tick": tick}).encode()))
    for recording in recordings_of.values():
        recording.flush()
        recording.disconnect()
    kept, live = (recordings.read(tmp_path / name) for name in ("kept", "live"))
    for path in (top.OUTLINES, space.VEHICLES, scene.HUD):
        assert len({at for at, _ in kept[path].rows}) == 40, path
        assert {at for at, _ in live[path].rows} == {recordings.ALWAYS}, path
    assert len({at for at, _ in live[plots.REAL_TIME].rows if at > 0}) == 40
    # The map and the curves are sent again, because rerun's server drops the oldest data.
    assert len(kept[static_map.ROADS].rows) == 1
    assert len(live[static_map.ROADS].rows) > 2
    assert len([at for at, _ in kept[course.REWARD].rows if at > 0]) == 1
    assert len([at for at, _ in live[course.REWARD].rows if at > 0]) > 2
    assert drawing.summary().startswith("drew 40 frames")


def test_frames_of_another_run_are_refused(drawn: Drawn) -> None:
    other = frames.header(0, 0, 0, run_id=8)
    for topic in ("world", "vehicles", "signals", "event", "pointcloud/x"):
        with pytest.raises(scene.AnotherRunError):
            drawn((topic, other))


@pytest.mark.parametrize(
    "payload", [b"", b"{", b"[]", b"null", b'{"tick": null}', b'{"tick": 1, "training": 3}', b"\xff"]
)
def test_an_unreadable_status_is_refused(drawn: Drawn, payload: bytes) -> None:
    with pytest.raises(wire.FrameError):
        drawn(("status", payload))


def test_random_bytes_are_refused_on_every_topic(drawn: Drawn) -> None:
    random = np.random.default_rng(3)
    recording = rr.RecordingStream("test", recording_id="garbage")
    drawing = Scene(recording, cast(RunMap, MAP))
    topics = ("world", "observation", "prediction", "status", "learning", "vehicles", "signals", "routes", "event")
    for topic in (*topics, "neighbours", "pointcloud/a"):
        for size in (0, 1, 95, 96, 500, 4000):
            with pytest.raises(wire.FrameError):
                drawing.draw(topic, Sample(random.bytes(size)))
            with pytest.raises(wire.FrameError):
                drawing.draw(topic, Sample(frames.header(0, 2**32 - 1, 2**32 - 1) + random.bytes(size)))
