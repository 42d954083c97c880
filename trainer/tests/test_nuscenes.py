"""nuScenes exports, opened by nuScenes' devkit and compared with the recorded world."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from caraware.data import Recording, RecordingError, open_recording
from caraware.data.export.__main__ import export
from caraware.data.export.nuscenes import VERSION
from caraware.data.export.scans import quaternion
from caraware.data.names import RoadUsers, vehicle_class
from caraware.data.recording import Array
from caraware.ipc.arrays import Float64Array
from caraware.ipc.pointcloud import rotation
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.data_classes import LidarPointCloud
from nuscenes.utils.geometry_utils import points_in_box, view_points
from nuscenes.utils.splits import get_scenes_of_custom_split
from PIL import Image
from pyquaternion import Quaternion
from recorded_run import ASKEW, RecordedFrame, assert_has_card, recorded_run, unseen

Frames = dict[tuple[int, int], RecordedFrame]


@pytest.fixture(scope="module")
def recording(askew_run: Path) -> Recording:
    return open_recording(askew_run)


@pytest.fixture(scope="module")
def devkit(askew_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    directory = tmp_path_factory.mktemp("nuscenes")
    assert export(askew_run, "nuscenes", directory, 1, unseen) == 1
    assert_has_card(directory, askew_run)
    yield NuScenes(version=VERSION, dataroot=str(directory), verbose=False)


def _files(devkit: Any, scene: dict[str, Any], channel: str) -> list[dict[str, Any]]:
    """The chain of files of a sensor in a scene: its key frames and its sweeps."""
    row = devkit.get("sample_data", devkit.get("sample", scene["first_sample_token"])["data"][channel])
    while row["prev"]:
        row = devkit.get("sample_data", row["prev"])
    rows = [row]
    while row["next"]:
        row = devkit.get("sample_data", row["next"])
        rows.append(row)
    return rows


def _samples(devkit: Any, scene: dict[str, Any]) -> list[dict[str, Any]]:
    samples = [devkit.get("sample", scene["first_sample_token"])]
    while samples[-1]["next"]:
        samples.append(devkit.get("sample", samples[-1]["next"]))
    assert samples[-1]["token"] == scene["last_sample_token"] and len(samples) == scene["nbr_samples"]
    return samples


def _world_m(devkit: Any, row: dict[str, Any]) -> Float64Array:
    """f64 [count, 3]: the points of a file in the world, by the steps of the devkit's tutorial."""
    points = LidarPointCloud.from_file(devkit.get_sample_data_path(row["token"]))
    # The devkit computes in the type of the file, whose place in the world is good to millimetres only.
    points.points = points.points.astype(np.float64)
    for table in ("calibrated_sensor", "ego_pose"):
        placed = devkit.get(table, row[f"{table}_token"])
        points.rotate(Quaternion(placed["rotation"]).rotation_matrix)
        points.translate(np.array(placed["translation"]))
    world: Float64Array = points.points[:3].T
    return world


def _yaw_rad(orientation: Any) -> float:
    """The heading: where x points to."""
    ahead = orientation.rotation_matrix[:, 0]
    return float(np.arctan2(ahead[1], ahead[0]))


def _middle_m(states: Array, id_hash: int) -> Float64Array:
    """f64 [2]: x and y of the middle of a road user."""
    state = states[states["id_hash"] == id_hash][0]
    ahead_m = 0 if state["kind"] == 2 else state["length_m"] / 2 - state["rear_overhang_m"]
    return np.array(
        [state["x_m"] + ahead_m * np.cos(state["yaw_rad"]), state["y_m"] + ahead_m * np.sin(state["yaw_rad"])]
    )


def _of_scene(scene: dict[str, Any]) -> int:
    return int(str(scene["name"]).rsplit("-", 1)[1])


def _tick(row: dict[str, Any], recording: Recording) -> int:
    return round(float(row["timestamp"]) * 1e-6 / recording.tick_s)


def test_a_quaternion_is_the_rotation() -> None:
    for attitude_rad in ((0.05, -0.11, 2.2), (0, 0, np.pi), (np.pi, 0, 0), (0, 0, 0), (-2, 1.2, -3)):
        turn = rotation(*attitude_rad)
        assert Quaternion(quaternion(turn)).rotation_matrix == pytest.approx(turn, abs=1e-12)


def test_every_scan_is_a_file_whose_points_lie_where_they_were_recorded(
    devkit: Any, recording: Recording, askew_frames: Frames
) -> None:
    assert len(devkit.scene) == 3
    assert get_scenes_of_custom_split("training", devkit) == [scene["name"] for scene in devkit.scene]
    left = dict(askew_frames)
    for scene in devkit.scene:
        rows = _files(devkit, scene, "LIDAR_TOP")
        for row in rows:
            frame = left.pop((_of_scene(scene), _tick(row, recording)))
            assert row["timestamp"] == round(_tick(row, recording) * recording.tick_s * 1e6)
            # Checked for every fifth: the rest are alike.
            if _tick(row, recording) % 5:
                continue
            assert np.allclose(_world_m(devkit, row), frame.world_m, rtol=0, atol=1e-4)
            raw = np.fromfile(devkit.get_sample_data_path(row["token"]), "<f4").reshape(-1, 5)
            # To the right and ahead, in the LIDAR's own frame.
            assert np.allclose(raw[:, :2], frame.forward_m[:, [1, 0]] * [-1, 1], rtol=0, atol=1e-5)
            assert np.allclose(raw[:, 3], frame.points["intensity"] * 255, rtol=0, atol=1e-3)
            assert np.array_equal(raw[:, 4], frame.points["channel"])
            ego = devkit.get("ego_pose", row["ego_pose_token"])
            assert ego["translation"] == pytest.approx([frame.own[name] for name in ("x_m", "y_m", "z_m")])
            assert _yaw_rad(Quaternion(ego["rotation"])) == pytest.approx(frame.own["yaw_rad"], abs=1e-6)
        # The mounting of the configuration: 0.8 m ahead, 0.3 m to the left, 1.9 m up, turned by 0.4 to the left.
        mounted = devkit.get("calibrated_sensor", rows[0]["calibrated_sensor_token"])
        assert mounted["translation"] == pytest.approx([0.8, 0.3, 1.9], abs=1e-3)
        ahead = Quaternion(mounted["rotation"]).rotation_matrix @ [0, 1, 0]
        assert np.arctan2(ahead[1], ahead[0]) == pytest.approx(0.4, abs=1e-3)
    assert left == {}


def test_key_frames_are_half_a_second_apart_and_sweeps_belong_to_the_next(devkit: Any, recording: Recording) -> None:
    for scene in devkit.scene:
        samples = _samples(devkit, scene)
        assert len(samples) > 5
        apart = [after["timestamp"] - before["timestamp"] for before, after in pairwise(samples)]
        # Of a carrier with a camera, images are missed.
        assert min(apart) >= 500_000
        with_camera = "CAM_FRONT" in samples[0]["data"]
        assert with_camera or set(apart) == {500_000}
        last = samples[-1]["timestamp"]
        for row in _files(devkit, scene, "LIDAR_TOP"):
            sample = devkit.get("sample", row["sample_token"])
            assert row["timestamp"] <= sample["timestamp"] or sample["timestamp"] == last
            assert row["is_key_frame"] == (row["timestamp"] == sample["timestamp"])
            before = devkit.get("sample", sample["prev"]) if sample["prev"] else None
            assert before is None or row["timestamp"] > before["timestamp"]
    cameras = {scene["name"]: "CAM_FRONT" in _samples(devkit, scene)[-1]["data"] for scene in devkit.scene}
    assert sorted(cameras.values()) == [False, True, True]


def test_boxes_are_the_road_users_and_hold_their_points(
    devkit: Any, recording: Recording, askew_frames: Frames
) -> None:
    users, on_boxes, names, moved = RoadUsers(recording), 0, set(), 0
    for scene in devkit.scene:
        for sample in _samples(devkit, scene):
            frame = askew_frames[_of_scene(scene), _tick(sample, recording)]
            world_m = frame.world_m
            states = frame.labelled()
            assert len(states) == len(sample["anns"])
            for state, annotation in zip(states, sample["anns"], strict=True):
                row, box = devkit.get("sample_annotation", annotation), devkit.get_box(annotation)
                on_it = frame.points["object"] == state["vehicle"]
                assert row["num_lidar_pts"] == on_it.sum()
                # The edges are given to float32: 0.1 mm more on a metre.
                assert points_in_box(box, world_m[on_it].T, wlh_factor=1.0001).all()
                assert box.wlh == pytest.approx([state["width_m"], state["length_m"], state["height_m"]])
                assert _yaw_rad(box.orientation) == pytest.approx(state["yaw_rad"], abs=1e-6)
                on_boxes += int(on_it.sum())
                attribute = devkit.get("attribute", row["attribute_tokens"][0])["name"]
                assert attribute.startswith(box.name.split(".")[0].replace("human", "pedestrian"))
                names.add((box.name, users.of(state["id_hash"]).vehicle_class))
                assert vehicle_class(state) == users.of(state["id_hash"]).vehicle_class
                velocity = devkit.box_velocity(annotation)
                if not np.isnan(velocity).any():
                    # The mean from the key frame before to the one behind, at their simulated times.
                    ends = [devkit.get("sample_annotation", row[side] or annotation) for side in ("prev", "next")]
                    ticks = [_tick(devkit.get("sample", end["sample_token"]), recording) for end in ends]
                    earlier, later = (
                        _middle_m(askew_frames[_of_scene(scene), tick].states, state["id_hash"]) for tick in ticks
                    )
                    apart_s = (ticks[1] - ticks[0]) * recording.tick_s
                    assert velocity[:2] == pytest.approx((later - earlier) / apart_s, abs=1e-3)
                    moved += 1
    assert on_boxes > 500 and moved > 10
    assert names == {
        ("vehicle.car", "passenger"),
        ("vehicle.car", "delivery"),
        ("human.pedestrian.adult", "pedestrian"),
    }
    assert sum(instance["nbr_annotations"] for instance in devkit.instance) == len(devkit.sample_annotation)
    for instance in devkit.instance:
        chain = [devkit.get("sample_annotation", instance["first_annotation_token"])]
        while chain[-1]["next"]:
            chain.append(devkit.get("sample_annotation", chain[-1]["next"]))
        assert chain[-1]["token"] == instance["last_annotation_token"]
        assert len(chain) == instance["nbr_annotations"]


def test_boxes_between_key_frames_are_where_the_road_users_were(
    devkit: Any, recording: Recording, askew_frames: Frames
) -> None:
    """The devkit interpolates them from the times of samples and sweeps."""
    distances_m = []
    for scene in devkit.scene:
        for row in _files(devkit, scene, "LIDAR_TOP"):
            sample = devkit.get("sample", row["sample_token"])
            if row["is_key_frame"] or not sample["prev"] or row["timestamp"] > sample["timestamp"]:
                continue
            frame = askew_frames[_of_scene(scene), _tick(row, recording)]
            places = np.array([[state["x_m"], state["y_m"]] for state in frame.states])
            for box in devkit.get_boxes(row["token"]):
                # The middle of a box is half a length before the rear axle, less the overhang.
                distances_m.append(np.hypot(*(places - box.center[:2]).T).min())
    assert len(distances_m) > 200 and np.percentile(distances_m, 90) < 2.0


def test_the_image_shows_the_boxes(devkit: Any, recording: Recording, askew_frames: Frames) -> None:
    compared = 0
    for scene in devkit.scene:
        for sample in _samples(devkit, scene):
            if "CAM_FRONT" not in sample["data"]:
                continue
            path, boxes, intrinsic = devkit.get_sample_data(sample["data"]["CAM_FRONT"])
            frame = askew_frames[_of_scene(scene), _tick(sample, recording)]
            assert frame.image is not None
            head = frame.image.section("head")[0]
            assert Image.open(path).size == (head["width"], head["height"])
            seen = {int(user["object"]): user for user in frame.image.section("objects")}
            by_token = dict(zip(sample["anns"], frame.labelled(), strict=True))
            for box in boxes:
                state = by_token[box.token]
                corners = box.corners()
                if int(state["vehicle"]) not in seen or corners[2].min() < 3:
                    continue
                pixels = view_points(corners, intrinsic, normalize=True)[:2]
                full = seen[int(state["vehicle"])]["full_box_px"] - 0.5
                assert [*pixels.min(1), *pixels.max(1)] == pytest.approx(full, abs=1.5)
                compared += 1
    assert compared > 10


def test_an_export_that_continues_makes_the_same_tables(askew_run: Path, tmp_path: Path) -> None:
    assert export(askew_run, "nuscenes", tmp_path, 1, unseen) == 1
    tables = {path.name: path.read_bytes() for path in (tmp_path / VERSION).iterdir()}
    assert export(askew_run, "nuscenes", tmp_path, 1, unseen) == 0
    assert {path.name: path.read_bytes() for path in (tmp_path / VERSION).iterdir()} == tables


def test_a_recording_without_points_is_refused(tmp_path: Path) -> None:
    settings = ASKEW | {"lidar.vehicles": 0, "run.real_time_factor": 0}
    with recorded_run("simulate", settings) as run_dir, pytest.raises(RecordingError, match=r"lidar\.vehicles"):
        export(run_dir, "nuscenes", tmp_path / "out", 1, unseen)
