"""Foxglove and ROS 2 exports, read by the tools' own readers and compared with the recorded world.

What a reader gives is put into one form (`Read`), so that one comparison holds for both formats.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from caraware import _native
from caraware.data import Recording, RecordingError, open_recording
from caraware.data.export.__main__ import export
from caraware.data.export.streams import GRAVITY_MPS2, right_handed
from caraware.data.names import RoadUsers
from caraware.data.recording import Array
from caraware.ipc.arrays import Float64Array
from caraware.ipc.image import split_planes
from caraware.ipc.layout import SENSOR_BITS
from caraware.ipc.pointcloud import rotation
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoders
from mcap_ros2.decoder import DecoderFactory as Ros2Decoders
from PIL import Image
from pyquaternion import Quaternion
from recorded_run import ASKEW, RecordedFrame, assert_has_card, recorded_run, unseen
from rerun.chunk import McapReader
from rosbags.highlevel import AnyReader

Frames = dict[tuple[int, int], RecordedFrame]


@dataclass
class Read:
    """What a reader gives, by topic or frame and time (ns)."""

    placed: dict[tuple[str, int], tuple[str, Float64Array]] = field(default_factory=dict)
    """Parent, and parent from child f64 [4, 4], by child."""
    boxes: dict[int, dict[str, tuple[Float64Array, Float64Array]]] = field(default_factory=dict)
    """World from box and size, by SUMO's id."""
    truth: dict[tuple[str, int], tuple[Float64Array, Float64Array, Float64Array]] = field(default_factory=dict)
    """World from vehicle, velocity, rate."""
    fixes: dict[tuple[str, int], tuple[float, float, float, float]] = field(default_factory=dict)
    """Latitude, longitude, altitude, variance."""
    imu: dict[tuple[str, int], Float64Array] = field(default_factory=dict)
    """Acceleration, rate."""
    points: dict[tuple[str, int], Array] = field(default_factory=dict)
    """A record array by the names of the fields."""
    images: dict[tuple[str, int], Array] = field(default_factory=dict)
    """u8 [height, width, 3]."""
    cameras: dict[tuple[str, int], Float64Array] = field(default_factory=dict)
    """f64 [3, 4]: the projection."""


def _transform(position: Any, orientation: Any) -> Float64Array:
    """A pose of a message as a matrix, by another library than the export's."""
    turn = Quaternion(orientation.w, orientation.x, orientation.y, orientation.z)
    transform: Float64Array = turn.transformation_matrix
    transform[:3, 3] = position.x, position.y, position.z
    return transform


def _xyz(vector: Any) -> Float64Array:
    return np.array([vector.x, vector.y, vector.z])


def _records(data: bytes, fields: list[tuple[str, int, str]], stride: int) -> Array:
    names, places, formats = zip(*((name, place, scalar) for name, place, scalar in fields), strict=True)
    kind = np.dtype({"names": names, "offsets": places, "formats": formats, "itemsize": stride})
    return np.frombuffer(bytes(data), kind)


def _foxglove(directory: Path) -> Read:
    """By `mcap` and the schemas in the file itself."""
    read = Read()
    with (directory / "episode-00000.foxglove.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[ProtobufDecoders()])
        about = {record.name: record.metadata for record in reader.iter_metadata()}
        assert about["caraware"]["caraware.run"] == "data"
        for schema, channel, message, content in reader.iter_decoded_messages():
            assert schema is not None and schema.encoding == "protobuf" and schema.name.startswith("foxglove.")
            now, topic = message.log_time, channel.topic
            vehicle = topic.split("/")[1]
            kind = schema.name.removeprefix("foxglove.")
            if kind not in ("FrameTransforms", "SceneUpdate"):
                assert content.timestamp.ToNanoseconds() == now
            if kind == "FrameTransforms":
                for one in content.transforms:
                    assert one.timestamp.ToNanoseconds() == now
                    read.placed[one.child_frame_id, now] = (
                        one.parent_frame_id,
                        _transform(one.translation, one.rotation),
                    )
            elif kind == "SceneUpdate":
                read.boxes[now] = {
                    entity.id: (
                        _transform(entity.cubes[0].pose.position, entity.cubes[0].pose.orientation),
                        _xyz(entity.cubes[0].size),
                    )
                    for entity in content.entities
                }
                assert {entity.frame_id for entity in content.entities} == {"map"}
            elif kind == "Odometry":
                pose = _transform(content.pose.position, content.pose.orientation)
                read.truth[vehicle, now] = (pose, _xyz(content.linear_velocity), _xyz(content.angular_velocity))
            elif kind == "LocationFix":
                place = (content.latitude, content.longitude, content.altitude)
                read.fixes[vehicle, now] = (*place, content.position_covariance[0])
            elif kind == "PointCloud":
                scalars = {7: "<f4", 5: "<u4", 3: "<u2"}
                fields = [(one.name, one.offset, scalars[one.type]) for one in content.fields]
                read.points[content.frame_id, now] = _records(content.data, fields, content.point_stride)
            elif kind == "CompressedImage":
                read.images[content.frame_id, now] = np.asarray(Image.open(io.BytesIO(content.data)))
            else:
                assert kind == "CameraCalibration"
                read.cameras[content.frame_id, now] = np.array(content.P).reshape(3, 4)
    return read


def _of_ros(messages: Iterator[tuple[str, str, int, Any]]) -> Read:
    """Messages of ROS 2 as topic, type, time and content."""
    read = Read()

    def stamp_ns(header: Any) -> int:
        return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)

    for topic, kind, now, content in messages:
        vehicle = topic.split("/")[1]
        if kind == "TFMessage":
            for one in content.transforms:
                assert stamp_ns(one.header) == now
                moved = _transform(one.transform.translation, one.transform.rotation)
                read.placed[one.child_frame_id, now] = (one.header.frame_id, moved)
            continue
        if kind == "MarkerArray":
            read.boxes[now] = {
                marker.text: (_transform(marker.pose.position, marker.pose.orientation), _xyz(marker.scale))
                for marker in content.markers
            }
            assert {(marker.header.frame_id, marker.type) for marker in content.markers} == {("map", 1)}
            continue
        assert stamp_ns(content.header) == now
        frame = content.header.frame_id
        if kind == "Odometry":
            pose, twist = content.pose.pose, content.twist.twist
            assert (frame, content.child_frame_id) == ("map", f"{vehicle}/base_link")
            moved = _transform(pose.position, pose.orientation)
            read.truth[vehicle, now] = (moved, _xyz(twist.linear), _xyz(twist.angular))
        elif kind == "NavSatFix":
            place = (content.latitude, content.longitude, content.altitude)
            read.fixes[vehicle, now] = (*place, float(content.position_covariance[0]))
        elif kind == "Imu":
            assert content.orientation_covariance[0] == -1
            values = np.concatenate((_xyz(content.linear_acceleration), _xyz(content.angular_velocity)))
            read.imu[vehicle, now] = values
        elif kind == "PointCloud2":
            scalars = {7: "<f4", 6: "<u4", 4: "<u2"}
            fields = [(one.name, one.offset, scalars[one.datatype]) for one in content.fields]
            read.points[frame, now] = _records(content.data, fields, content.point_step)
            assert content.width * content.height == len(read.points[frame, now])
        elif kind == "CompressedImage":
            read.images[frame, now] = np.asarray(Image.open(io.BytesIO(bytes(content.data))))
        else:
            assert kind == "CameraInfo"
            read.cameras[frame, now] = np.array(content.p).reshape(3, 4)
    return read


def _by_rosbags(directory: Path) -> Iterator[tuple[str, str, int, Any]]:
    with AnyReader([directory / "episode-00000.ros2"]) as reader:
        for connection, now, data in reader.messages():
            content = reader.deserialize(data, connection.msgtype)
            yield connection.topic, connection.msgtype.split("/")[-1], now, content


def _by_mcap(directory: Path) -> Iterator[tuple[str, str, int, Any]]:
    (path,) = (directory / "episode-00000.ros2").glob("*.mcap")
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[Ros2Decoders()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, message, content in reader.iter_decoded_messages():
            assert schema is not None
            yield channel.topic, schema.name.split("/")[-1], message.log_time, content


@pytest.fixture(scope="module")
def exports(askew_run: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    directories = {name: tmp_path_factory.mktemp(name) for name in ("foxglove", "ros2")}
    for name, directory in directories.items():
        assert export(askew_run, name, directory, 1, unseen) == 1
        assert_has_card(directory, askew_run)
    return directories


@pytest.fixture(scope="module", params=["foxglove", "rosbags", "mcap-ros2"])
def read(request: pytest.FixtureRequest, exports: dict[str, Path]) -> Read:
    if request.param == "foxglove":
        return _foxglove(exports["foxglove"])
    return _of_ros(_by_rosbags(exports["ros2"]) if request.param == "rosbags" else _by_mcap(exports["ros2"]))


@pytest.fixture(scope="module")
def recording(askew_run: Path) -> Recording:
    return open_recording(askew_run)


def _time_ns(tick: int, recording: Recording) -> int:
    return round(tick * recording.tick_s * 1e9)


def test_every_road_user_is_a_box_in_the_world_at_its_time(read: Read, recording: Recording) -> None:
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
    read: Read, recording: Recording, askew_frames: Frames
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


def test_images_show_the_points_through_the_frames(read: Read, recording: Recording, askew_frames: Frames) -> None:
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
    read: Read, recording: Recording, request: pytest.FixtureRequest
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
            positions |= zip(times, batch.column("Points3D:positions").to_pylist(), strict=True)
    own = {tick: frame for (vehicle, tick), frame in askew_frames.items() if vehicle == 0}
    assert sorted(positions) == [_time_ns(tick, recording) for tick in sorted(own)]
    for tick in list(own)[::20]:
        assert np.allclose(positions[_time_ns(tick, recording)], own[tick].forward_m, rtol=0, atol=1e-5)
    images = sum(frame.image is not None for frame in own.values())
    assert drawn["EncodedImage:blob"] == drawn["Pinhole:image_from_camera"] == images > 20
    assert drawn["Transform3D:translation"] > len(askew_frames)


def test_a_recording_without_a_world_is_refused(tmp_path: Path) -> None:
    settings = ASKEW | {"run.real_time_factor": 0, "record.channels": '["observation"]'}
    with recorded_run("simulate", settings) as run_dir:
        for name in ("foxglove", "ros2"):
            with pytest.raises(RecordingError, match="world"):
                export(run_dir, name, tmp_path / name, 1, unseen)


def test_a_bag_is_compressed_in_chunks(exports: dict[str, Path]) -> None:
    (path,) = exports["ros2"].rglob("*.mcap")
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
