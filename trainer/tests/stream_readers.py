"""Readers of Foxglove and ROS 2 exports: what the tools' own readers give, in one form for both formats."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from caraware.data.recording import Array
from caraware.ipc.arrays import Float64Array
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoders
from mcap_ros2.decoder import DecoderFactory as Ros2Decoders
from PIL import Image
from pyquaternion import Quaternion
from rosbags.highlevel import AnyReader


@dataclass
class ReadStream:
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


def read_foxglove(directory: Path) -> ReadStream:
    """By `mcap` and the schemas in the file itself."""
    read = ReadStream()
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


def read_ros(messages: Iterator[tuple[str, str, int, Any]]) -> ReadStream:
    """Messages of ROS 2 as topic, type, time and content."""
    read = ReadStream()

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


def by_rosbags(directory: Path) -> Iterator[tuple[str, str, int, Any]]:
    with AnyReader([directory / "episode-00000.ros2"]) as reader:
        for connection, now, data in reader.messages():
            content = reader.deserialize(data, connection.msgtype)
            yield connection.topic, connection.msgtype.split("/")[-1], now, content


def by_mcap(directory: Path) -> Iterator[tuple[str, str, int, Any]]:
    (path,) = (directory / "episode-00000.ros2").glob("*.mcap")
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[Ros2Decoders()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, message, content in reader.iter_decoded_messages():
            assert schema is not None
            yield channel.topic, schema.name.split("/")[-1], message.log_time, content
