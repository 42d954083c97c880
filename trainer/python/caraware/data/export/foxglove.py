"""Foxglove: an MCAP file of each episode with messages in Foxglove's schemas (protobuf).

Frames, topics and times are those of `caraware.data.export.streams`. Foxglove has no schema for an IMU.
Foxglove, Lichtblick and rerun open it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry as OdometryMessage
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.duration_pb2 import Duration
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.writer import Writer

from caraware.data.export.card import source
from caraware.data.export.scans import distortion, projection, quaternion
from caraware.data.export.streams import (
    COLOURS,
    WORLD,
    Box,
    Fix,
    Odometry,
    Placed,
    SensorTopic,
    covariance,
    play,
)
from caraware.data.recording import Array, Episode, Recording
from caraware.ipc.arrays import Float64Array

NUMERIC_TYPES = {"<f4": PackedElementField.FLOAT32, "<u4": PackedElementField.UINT32, "<u2": PackedElementField.UINT16}
"""Foxglove's types of the fields of points."""


def _timestamp(time_ns: int) -> Timestamp:
    return Timestamp(seconds=time_ns // 10**9, nanos=time_ns % 10**9)


def _vector(values: Float64Array) -> Vector3:
    return Vector3(x=float(values[0]), y=float(values[1]), z=float(values[2]))


def _quaternion(transform: Float64Array) -> Quaternion:
    w, x, y, z = quaternion(transform[:3, :3])
    return Quaternion(x=x, y=y, z=z, w=w)


def _pose(transform: Float64Array) -> Pose:
    return Pose(position=_vector(transform[:3, 3]), orientation=_quaternion(transform))


class FoxgloveSink:
    """Writes the messages of an episode to an MCAP file."""

    def __init__(self, writer: Writer, tick_ns: int) -> None:
        self._writer, self._tick_ns = writer, tick_ns

    def _write(self, topic: str, time_ns: int, message: Message) -> None:
        self._writer.write_message(topic, message, log_time=time_ns, publish_time=time_ns)

    def transforms(self, time_ns: int, placed: list[Placed], *, are_static: bool = False) -> None:
        """`/tf`; `/tf_static`, once for each frame."""
        transforms = [
            FrameTransform(
                timestamp=_timestamp(time_ns),
                parent_frame_id=one.parent,
                child_frame_id=one.child,
                translation=_vector(one.parent_from_child[:3, 3]),
                rotation=_quaternion(one.parent_from_child),
            )
            for one in placed
        ]
        self._write("/tf_static" if are_static else "/tf", time_ns, FrameTransforms(transforms=transforms))

    def boxes(self, time_ns: int, boxes: list[Box]) -> None:
        """`/road_users`: an entity for each, which ends with the tick."""
        entities = []
        for box in boxes:
            red, green, blue = COLOURS[box.kind]
            cube = CubePrimitive(
                pose=_pose(box.world_from_box),
                size=Vector3(x=box.size_m[0], y=box.size_m[1], z=box.size_m[2]),
                color=Color(r=red, g=green, b=blue, a=0.6),
            )
            speed_mps = float(np.hypot(*box.velocity_mps[:2]))
            about = {"kind": box.kind.name.lower(), "vehicle": str(box.vehicle), "speed_mps": f"{speed_mps:.3f}"}
            entities.append(
                SceneEntity(
                    timestamp=_timestamp(time_ns),
                    frame_id=WORLD,
                    id=box.id,
                    lifetime=Duration(seconds=self._tick_ns // 10**9, nanos=self._tick_ns % 10**9),
                    metadata=[KeyValuePair(key=key, value=value) for key, value in about.items()],
                    cubes=[cube],
                )
            )
        self._write("/road_users", time_ns, SceneUpdate(entities=entities))

    def odometry(self, time_ns: int, vehicle: str, motion: Odometry) -> None:
        """`/vehicle_N/truth`."""
        message = OdometryMessage(
            timestamp=_timestamp(time_ns),
            frame_id=motion.placed.parent,
            body_frame_id=motion.placed.child,
            pose=_pose(motion.placed.parent_from_child),
            linear_velocity=_vector(motion.velocity_mps),
            angular_velocity=_vector(motion.rate_radps),
        )
        self._write(f"/{vehicle}/truth", time_ns, message)

    def fix(self, time_ns: int, vehicle: str, fix: Fix) -> None:
        """`/vehicle_N/gnss`."""
        message = LocationFix(
            timestamp=_timestamp(time_ns),
            frame_id=f"{vehicle}/base_link",
            latitude=fix.latitude_deg,
            longitude=fix.longitude_deg,
            altitude=fix.altitude_m,
            position_covariance=covariance(fix.error_m),
            position_covariance_type=LocationFix.APPROXIMATED,
        )
        self._write(f"/{vehicle}/gnss", time_ns, message)

    def imu(self, time_ns: int, vehicle: str, accel_mps2: Array, rate_radps: Array) -> None:
        """Nothing: Foxglove has no schema for it."""

    def points(self, time_ns: int, place: SensorTopic, points: Array) -> None:
        """The topic of a LIDAR or a radar."""
        fields = [
            PackedElementField(name=name, offset=offset, type=NUMERIC_TYPES[scalar.str])
            for name, (scalar, offset, *_) in (points.dtype.fields or {}).items()
        ]
        message = PointCloud(
            timestamp=_timestamp(time_ns),
            frame_id=place.frame,
            pose=_pose(np.eye(4)),
            point_stride=points.itemsize,
            fields=fields,
            data=points.tobytes(),
        )
        self._write(place.topic, time_ns, message)

    def image(self, time_ns: int, place: SensorTopic, png: bytes, head: np.void) -> None:
        """The topic of a camera, and that of its calibration."""
        stamp, frame, matrix = _timestamp(time_ns), place.frame, projection(head)
        image = CompressedImage(timestamp=stamp, frame_id=frame, data=png, format="png")
        calibration = CameraCalibration(
            timestamp=stamp,
            frame_id=frame,
            width=int(head["width"]),
            height=int(head["height"]),
            distortion_model="plumb_bob",
            D=distortion(head),
            K=matrix[:, :3].ravel().tolist(),
            R=np.eye(3).ravel().tolist(),
            P=matrix.ravel().tolist(),
        )
        self._write(place.topic, time_ns, image)
        self._write(f"{place.calibration}calibration", time_ns, calibration)


def write_foxglove(recording: Recording, episode: Episode, path: Path) -> None:
    """Write one episode. Raises `RecordingError` if the recording has no `world`."""
    with path.open("wb") as file, Writer(file) as writer:
        writer.add_metadata("caraware", source(recording, episode))
        play(recording, episode, FoxgloveSink(writer, round(recording.tick_s * 1e9)))
