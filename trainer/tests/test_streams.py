"""Foxglove and ROS 2 exports, read by the tools' own readers and compared with the recorded world.

What a reader gives is put into one form (`ReadStream`), so that one comparison holds for both formats.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from caraware import _native
from caraware.data import Recording, RecordingError, open_recording
from caraware.data.export.__main__ import export
from caraware.data.export.streams import GRAVITY_MPS2, right_handed
from caraware.data.names import RoadUsers
from caraware.ipc.image import split_planes
from caraware.ipc.layout import SENSOR_BITS
from caraware.ipc.pointcloud import rotation
from mcap.reader import make_reader
from recorded_run import ASKEW, RecordedFrame, assert_has_card, recorded_run, unseen
from rerun.chunk import McapReader
from stream_readers import ReadStream, by_mcap, by_rosbags, read_foxglove, read_ros

Frames = dict[tuple[int, int], RecordedFrame]


@pytest.fixture(scope="module")
def exports(askew_run: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    directories = {name: tmp_path_factory.mktemp(name) for name in ("foxglove", "ros2")}
    for name, directory in directories.items():
        assert export(askew_run, name, directory, 1, unseen) == 1
        assert_has_card(directory, askew_run)
    return directories


@pytest.fixture(scope="module", params=["foxglove", "rosbags", "mcap-ros2"])
def read(request: pytest.FixtureRequest, exports: dict[str, Path]) -> ReadStream:
    if request.param == "foxglove":
        return read_foxglove(exports["foxglove"])
    return read_ros(by_rosbags(exports["ros2"]) if request.param == "rosbags" else by_mcap(exports["ros2"]))


@pytest.fixture(scope="module")
def recording(askew_run: Path) -> Recording:
    return open_recording(askew_run)


def _time_ns(tick: int, recording: Recording) -> int:
    return round(tick * recording.tick_s * 1e9)


def test_every_road_user_is_a_box_in_the_world_at_its_time(read: ReadStream, recording: Recording) -> None:
    users = RoadUsers(recording)
    messages = list(recording.messages("world"))
    assert sorted(read.boxes) == [_time_ns(message.tick, recording) for message in messages]
    for message in messages[::7]:
        boxes, states = read.boxes[_time_ns(message.tick, recording)], message.section("states")
        assert len(boxes) == len(states)
        for state in states:
            pose, size_m = boxes[users.of(state["id_hash"]).id]
            assert size_m == pytest.approx([state["length_m"], state["width_m"], state["height_m"]])
            heading = [np.cos(state["yaw_rad"]), np.sin(state["yaw_rad"]), 0]
            assert np.allclose(pose[:3, 0], heading, atol=1e-9) and np.allclose(pose[:3, 2], [0, 0, 1])
            # The rear axle is half a length less the overhang behind the middle; persons are their middle.
            ahead_m = 0 if state["kind"] == 2 else state["length_m"] / 2 - state["rear_overhang_m"]
            axle_m = pose[:3, 3] - pose[:3, 0] * ahead_m - [0, 0, state["height_m"] / 2]
            assert np.allclose(axle_m, [state["x_m"], state["y_m"], state["z_m"]], atol=1e-5)


def test_points_lie_in_the_world_through_the_frames_and_on_their_boxes(
    read: ReadStream, recording: Recording, askew_frames: Frames
) -> None:
    assert {key[0] for key in read.points} == {f"vehicle_{vehicle}/lidar" for vehicle, _ in askew_frames}
    assert len(read.points) == len(askew_frames)
    users, on_boxes = RoadUsers(recording), 0
    for (vehicle, tick), frame in list(askew_frames.items())[::9]:
        now = _time_ns(tick, recording)
        points = read.points[f"vehicle_{vehicle}/lidar", now]
        parent, base_from_lidar = read.placed[f"vehicle_{vehicle}/lidar", now]
        assert parent == f"vehicle_{vehicle}/base_link"
        world, world_from_base = read.placed[parent, now]
        assert world == "map"
        in_lidar = np.stack([points[name].astype(np.float64) for name in "xyz"], 1)
        transform = world_from_base @ base_from_lidar
        in_world = in_lidar @ transform[:3, :3].T + transform[:3, 3]
        assert np.allclose(in_world, frame.world_m, rtol=0, atol=1e-4)
        for name, recorded in (("intensity", "intensity"), ("object", "object"), ("ring", "channel")):
            assert np.array_equal(points[name], frame.points[recorded])
        for state in frame.labelled():
            pose, size_m = read.boxes[now][users.of(state["id_hash"]).id]
            on_it = in_world[points["object"] == state["vehicle"]]
            assert np.all(np.abs((on_it - pose[:3, 3]) @ pose[:3, :3]) <= size_m / 2 + 1e-3)
            on_boxes += len(on_it)
    assert on_boxes > 300
    # The mounting of the configuration at the first tick, when no car leans.
    mounted = read.placed["vehicle_0/lidar", 0][1]
    assert mounted[:3, 3] == pytest.approx([0.8, 0.3, 1.9], abs=1e-3)
    assert np.arctan2(mounted[1, 0], mounted[0, 0]) == pytest.approx(0.4, abs=1e-3)


def test_images_show_the_points_through_the_frames(
    read: ReadStream, recording: Recording, askew_frames: Frames
) -> None:
    filmed = {key: frame for key, frame in askew_frames.items() if frame.image is not None}
    assert len(read.images) == len(read.cameras) == len(filmed) > 40
    hits = []
    for (vehicle, tick), frame in filmed.items():
        now, name = _time_ns(tick, recording), f"vehicle_{vehicle}/camera_optical"
        assert frame.image is not None
        planes = split_planes(frame.image.section("head")[0], frame.image.section("planes").tobytes())
        instance, rgb = planes["instance"], planes["rgb"]
        assert instance is not None and rgb is not None and np.array_equal(read.images[name, now], rgb)
        base_from_lidar, base_from_camera = (read.placed[child, now][1] for child in (f"vehicle_{vehicle}/lidar", name))
        camera_from_lidar = np.linalg.inv(base_from_camera) @ base_from_lidar
        in_camera = frame.forward_m @ camera_from_lidar[:3, :3].T + camera_from_lidar[:3, 3]
        ahead = (in_camera[:, 2] > 1) & (frame.points["object"] < 1 << 31)
        projection = read.cameras[name, now]
        homogeneous = in_camera[ahead] @ projection[:, :3].T + projection[:, 3]
        columns, rows = np.round(homogeneous[:, :2] / homogeneous[:, 2:]).astype(int).T
        inside = (columns >= 0) & (columns < instance.shape[1]) & (rows >= 0) & (rows < instance.shape[0])
        hits.append(instance[rows[inside], columns[inside]] == frame.points["object"][ahead][inside])
    # The camera sees cars with a bonnet and a cabin, and some points are hidden from it.
    assert len(np.concatenate(hits)) > 100 and np.concatenate(hits).mean() > 0.75


def test_truth_fixes_and_imu_are_the_recorded_rows(
    read: ReadStream, recording: Recording, request: pytest.FixtureRequest
) -> None:
    worlds = {message.tick: message.section("states") for message in recording.messages("world")}
    fixes = samples = 0
    for message in recording.messages("observation"):
        now, sections = _time_ns(message.tick, recording), message.section
        for slot, vehicle in enumerate(sections("vehicle")):
            if vehicle == _native.EMPTY_SLOT:
                continue
            name, sensors = f"vehicle_{vehicle}", int(sections("sensors")[slot])
            delivers = bool(sensors & SENSOR_BITS["gnss"])
            assert ((name, now) in read.fixes) == delivers
            fixes += delivers
            if message.tick % 5:
                continue
            state = worlds[message.tick][worlds[message.tick]["vehicle"] == vehicle][0]
            pose, velocity, rate = read.truth[name, now]
            assert pose[:3, 3] == pytest.approx([state["x_m"], state["y_m"], state["z_m"]])
            attitude = rotation(state["roll_rad"], state["pitch_rad"], state["yaw_rad"])
            assert np.allclose(pose[:3, :3], attitude, atol=1e-9)
            assert velocity == pytest.approx(state["velocity_body_mps"])
            assert rate == pytest.approx(state["angular_rate_body_radps"])
            if delivers:
                *geodetic, variance = read.fixes[name, now]
                assert geodetic == pytest.approx(sections("gnss_geodetic")[slot])
                assert variance == pytest.approx(float(sections("gnss_quality")[slot][0]) ** 2)
            if (name, now) in read.imu:
                # The configuration has the kinematic convention, which measures no gravity.
                recorded = sections("imu")[slot, -1]
                assert read.imu[name, now][3:] == pytest.approx(recorded[3:6])
                gravity = read.imu[name, now][:3] - recorded[:3]
                assert np.allclose(gravity, attitude.T @ [0, 0, GRAVITY_MPS2], atol=1e-6)
                samples += 1
    assert len(read.fixes) == fixes > 1000
    # Foxglove has no schema for an IMU.
    assert (samples > 300) == ("foxglove" not in request.node.name)


def test_an_imu_of_any_convention_becomes_a_right_handed_one_with_gravity() -> None:
    state = np.zeros((), [(name, "<f4") for name in ("roll_rad", "pitch_rad", "yaw_rad")]).reshape(1)[0]
    state["roll_rad"], state["pitch_rad"], state["yaw_rad"] = 0.1, 0.2, 2.0
    sample = np.array([[1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 4.0]], np.float32)
    assert right_handed(sample, "specific_force", state)[0] == pytest.approx([1, 2, 3, 0.1, 0.2, 0.3])
    assert right_handed(sample, "carla", state)[0] == pytest.approx([1, -2, 3, -0.1, 0.2, -0.3])
    # As docs/sensor-models.md has it: g (sin θ, cos θ sin φ, cos θ cos φ).
    gravity = GRAVITY_MPS2 * np.array([np.sin(0.2), np.cos(0.2) * np.sin(0.1), np.cos(0.2) * np.cos(0.1)])
    lifted = right_handed(sample, "kinematic", state)[0]
    assert lifted == pytest.approx([*(gravity + np.array([1, 2, 3])), 0.1, 0.2, 0.3], abs=1e-6)


@pytest.mark.parametrize("name", ["foxglove", "ros2"])
def test_reruns_importer_has_points_frames_and_images_at_their_times(
    name: str, exports: dict[str, Path], recording: Recording, askew_frames: Frames
) -> None:
    (path,) = exports[name].rglob("*.mcap")
    positions: dict[int, Any] = {}
    drawn: dict[str, int] = {}
    for chunk in McapReader(path, include_topic_regex=["^/tf$", "^/vehicle_0/"]).stream():
        batch = chunk.to_record_batch()
        for component in set(batch.schema.names) & {
            "Transform3D:translation",
            "Points3D:positions",
            "EncodedImage:blob",
            "Pinhole:image_from_camera",
        }:
            drawn[component] = drawn.get(component, 0) + batch.num_rows
        if "Points3D:positions" in batch.schema.names:
            times = batch.column("message_log_time").cast("int64").to_pylist()
            positions |= zip(times, batch.column("Points3D:positions"), strict=True)
    own = {tick: frame for (vehicle, tick), frame in askew_frames.items() if vehicle == 0}
    assert sorted(positions) == [_time_ns(tick, recording) for tick in sorted(own)]
    for tick in list(own)[::20]:
        found = positions[_time_ns(tick, recording)].as_py()
        assert np.allclose(found, own[tick].forward_m, rtol=0, atol=1e-5)
    images = sum(frame.image is not None for frame in own.values())
    assert drawn["EncodedImage:blob"] == drawn["Pinhole:image_from_camera"] == images > 20
    assert drawn["Transform3D:translation"] > len(askew_frames)


def test_a_recording_without_a_world_is_refused(tmp_path: Path) -> None:
    settings = ASKEW | {"run.real_time_factor": 0, "record.channels": '["observation"]'}
    with recorded_run("simulate", settings) as run_dir:
        for name in ("foxglove", "ros2"):
            with pytest.raises(RecordingError, match="world"):
                export(run_dir, name, tmp_path / name, 1, unseen)
        # Its vehicles carry sensors whose channels it lacks.
        lines: list[str] = []
        export(run_dir, "csv", tmp_path / "csv", 1, unseen, lines.append)
        assert lines == [
            f"left out: {kind} of the section `{section}`: not recorded, for `record.channels` lacks `{channel}`"
            for kind, section, channel in (("LIDAR", "lidar", "pointcloud"), ("camera", "camera", "image"))
        ]


def test_a_bag_is_compressed_in_chunks(exports: dict[str, Path]) -> None:
    (path,) = exports["ros2"].rglob("*.mcap")
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
