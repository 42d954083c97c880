"""ROS 2: a bag of each episode (rosbag2, MCAP) with the messages that its tools know.

Frames, topics and times are those of `caraware.data.export.streams`. `ros2 bag play`, RViz, Foxglove and rerun open it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

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

BAG_VERSION: Literal[9] = 9
"""Version of rosbag2's metadata: that of ROS 2 Jazzy."""

UNLIMITED = QosTime(9223372036, 854775807)
KEPT = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    UNLIMITED,
    UNLIMITED,
    QosLiveliness.AUTOMATIC,
    UNLIMITED,
    avoid_ros_namespace_conventions=False,
)
"""Quality of service of `/tf_static`: a late subscriber gets the newest message."""


class Ros2Sink:
    """Writes the messages of an episode to a bag."""

    def __init__(self, writer: Writer, tick_ns: int) -> None:
        self._writer, self._tick_ns = writer, tick_ns
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._connections: dict[str, Any] = {}

    def _make(self, name: str, /, **fields: Any) -> Any:
        """A message of the type `PACKAGE/NAME`."""
        package, _, short = name.partition("/")
        return self._types.types[f"{package}/msg/{short}"](**fields)

    def _write(self, topic: str, time_ns: int, message: Any, *, is_kept: bool = False) -> None:
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._types, offered_qos_profiles=[KEPT] if is_kept else ()
            )
        self._writer.write(self._connections[topic], time_ns, self._types.serialize_cdr(message, kind))

    def _header(self, time_ns: int, frame: str) -> Any:
        stamp = self._make("builtin_interfaces/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        return self._make("std_msgs/Header", stamp=stamp, frame_id=frame)

    def _vector(self, values: Array) -> Any:
        x, y, z = (float(value) for value in values)
        return self._make("geometry_msgs/Vector3", x=x, y=y, z=z)

    def _quaternion(self, transform: Float64Array) -> Any:
        w, x, y, z = quaternion(transform[:3, :3])
        return self._make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)

    def _pose(self, transform: Float64Array) -> Any:
        x, y, z = (float(value) for value in transform[:3, 3])
        position = self._make("geometry_msgs/Point", x=x, y=y, z=z)
        return self._make("geometry_msgs/Pose", position=position, orientation=self._quaternion(transform))

    def transforms(self, time_ns: int, placed: list[Placed], *, are_static: bool = False) -> None:
        """`/tf`: `tf2_msgs/TFMessage`; `/tf_static`, once for each frame and kept for late subscribers."""
        stamped = [
            self._make(
                "geometry_msgs/TransformStamped",
                header=self._header(time_ns, one.parent),
                child_frame_id=one.child,
                transform=self._make(
                    "geometry_msgs/Transform",
                    translation=self._vector(one.parent_from_child[:3, 3]),
                    rotation=self._quaternion(one.parent_from_child),
                ),
            )
            for one in placed
        ]
        topic = "/tf_static" if are_static else "/tf"
        self._write(topic, time_ns, self._make("tf2_msgs/TFMessage", transforms=stamped), is_kept=are_static)

    def boxes(self, time_ns: int, boxes: list[Box]) -> None:
        """`/road_users`: `visualization_msgs/MarkerArray`, a cube for each, which ends with the tick."""
        lifetime = self._make("builtin_interfaces/Duration", sec=self._tick_ns // 10**9, nanosec=self._tick_ns % 10**9)
        no_bytes = np.zeros(0, np.uint8)
        markers = []
        for box in boxes:
            red, green, blue = COLOURS[box.kind]
            header = self._header(time_ns, WORLD)
            marker = self._make(
                "visualization_msgs/Marker",
                header=header,
                ns=box.kind.name.lower(),
                id=box.vehicle,
                type=1,  # CUBE
                action=0,  # ADD
                pose=self._pose(box.world_from_box),
                scale=self._vector(np.array(box.size_m)),
                color=self._make("std_msgs/ColorRGBA", r=red, g=green, b=blue, a=0.6),
                lifetime=lifetime,
                frame_locked=False,
                points=[],
                colors=[],
                texture_resource="",
                texture=self._make("sensor_msgs/CompressedImage", header=header, format="", data=no_bytes),
                uv_coordinates=[],
                text=box.id,
                mesh_resource="",
                mesh_file=self._make("visualization_msgs/MeshFile", filename="", data=no_bytes),
                mesh_use_embedded_materials=False,
            )
            markers.append(marker)
        self._write("/road_users", time_ns, self._make("visualization_msgs/MarkerArray", markers=markers))

    def odometry(self, time_ns: int, vehicle: str, motion: Odometry) -> None:
        """`/vehicle_N/truth`: `nav_msgs/Odometry`."""
        exact = np.zeros(36)
        pose = self._pose(motion.placed.parent_from_child)
        twist = self._make(
            "geometry_msgs/Twist", linear=self._vector(motion.velocity_mps), angular=self._vector(motion.rate_radps)
        )
        message = self._make(
            "nav_msgs/Odometry",
            header=self._header(time_ns, motion.placed.parent),
            child_frame_id=motion.placed.child,
            pose=self._make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=exact),
            twist=self._make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=exact),
        )
        self._write(f"/{vehicle}/truth", time_ns, message)

    def fix(self, time_ns: int, vehicle: str, fix: Fix) -> None:
        """`/vehicle_N/gnss`: `sensor_msgs/NavSatFix`."""
        message = self._make(
            "sensor_msgs/NavSatFix",
            header=self._header(time_ns, f"{vehicle}/base_link"),
            status=self._make("sensor_msgs/NavSatStatus", status=0, service=1),  # FIX, GPS
            latitude=fix.latitude_deg,
            longitude=fix.longitude_deg,
            altitude=fix.altitude_m,
            position_covariance=np.array(covariance(fix.error_m)),
            position_covariance_type=1,  # APPROXIMATED
        )
        self._write(f"/{vehicle}/gnss", time_ns, message)

    def imu(self, time_ns: int, vehicle: str, accel_mps2: Array, rate_radps: Array) -> None:
        """`/vehicle_N/imu`: `sensor_msgs/Imu`, whose orientation is not known."""
        unknown = np.zeros(9)
        no_orientation = np.array([-1.0, 0, 0, 0, 0, 0, 0, 0, 0])
        message = self._make(
            "sensor_msgs/Imu",
            header=self._header(time_ns, f"{vehicle}/base_link"),
            orientation=self._quaternion(np.eye(4)),
            orientation_covariance=no_orientation,
            angular_velocity=self._vector(rate_radps),
            angular_velocity_covariance=unknown,
            linear_acceleration=self._vector(accel_mps2),
            linear_acceleration_covariance=unknown,
        )
        self._write(f"/{vehicle}/imu", time_ns, message)

    def points(self, time_ns: int, place: SensorTopic, points: Array) -> None:
        """The topic of a LIDAR or a radar: `sensor_msgs/PointCloud2`."""
        types = {"<f4": 7, "<u4": 6, "<u2": 4}  # PointField.FLOAT32, UINT32, UINT16
        fields = [
            self._make("sensor_msgs/PointField", name=name, offset=offset, datatype=types[scalar.str], count=1)
            for name, (scalar, offset, *_) in (points.dtype.fields or {}).items()
        ]
        message = self._make(
            "sensor_msgs/PointCloud2",
            header=self._header(time_ns, place.frame),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=False,
            point_step=points.itemsize,
            row_step=points.nbytes,
            data=np.frombuffer(points.tobytes(), np.uint8),
            is_dense=True,
        )
        self._write(place.topic, time_ns, message)

    def image(self, time_ns: int, place: SensorTopic, png: bytes, head: np.void) -> None:
        """The topic of a camera below `/compressed`: `sensor_msgs/CompressedImage`; that of its `CameraInfo`."""
        header, matrix = self._header(time_ns, place.frame), projection(head)
        whole = self._make("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        image = self._make(
            "sensor_msgs/CompressedImage",
            header=header,
            format="rgb8; png compressed",
            data=np.frombuffer(png, np.uint8),
        )
        info = self._make(
            "sensor_msgs/CameraInfo",
            header=header,
            height=int(head["height"]),
            width=int(head["width"]),
            distortion_model="plumb_bob",
            d=np.array(distortion(head)),
            k=matrix[:, :3].ravel(),
            r=np.eye(3).ravel(),
            p=matrix.ravel(),
            binning_x=0,
            binning_y=0,
            roi=whole,
        )
        self._write(f"{place.topic}/compressed", time_ns, image)
        self._write(f"{place.calibration}info", time_ns, info)


def write_ros2(recording: Recording, episode: Episode, path: Path) -> None:
    """Write one episode. Raises `RecordingError` if the recording has no `world`."""
    # The bag's file is called by its directory, so it is written into one that has its final name.
    bag = path / f"episode-{episode.number:05}"
    writer = Writer(bag, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    for key, value in source(recording, episode).items():
        writer.set_custom_data(key, value)
    with writer:
        play(recording, episode, Ros2Sink(writer, round(recording.tick_s * 1e9)))
    for file in list(bag.iterdir()):
        file.rename(path / file.name)
    bag.rmdir()
