"""An episode as a stream of robot messages, in the order of ticks: what the ROS 2 and the Foxglove export share.

Frames are those of REP 105 and REP 103: `map` is the world (x east, y north, z up); `vehicle_N/base_link` is the rear
axle's centre on the ground (x forward, y left, z up), with the sensors below it; optical frames have z forward. `N` is
the dense index of a vehicle in its episode. Times are simulated, since the start of the run.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from heapq import merge
from typing import Protocol

import numpy as np
from PIL import Image

from caraware import _native
from caraware.data.export.scans import (
    OPTICAL,
    Frame,
    box_middle,
    forward_m,
    frames,
    inverse,
    require_channels,
    rotated,
    upright_pose,
    vehicle_pose,
)
from caraware.data.names import Kind, RoadUsers
from caraware.data.recording import Array, Episode, Message, Recording
from caraware.ipc.arrays import Float32Array, Float64Array
from caraware.ipc.layout import SENSOR_BITS
from caraware.ipc.pointcloud import rotation

WORLD = "map"
"""Name of the world frame."""

GRAVITY_MPS2 = 9.80665
"""Standard gravity."""

COLOURS = {
    Kind.CAV: (0.34, 0.71, 0.91),
    Kind.OTHER: (0.6, 0.6, 0.6),
    Kind.PERSON: (0.9, 0.62, 0.0),
    Kind.HERO: (0.8, 0.47, 0.65),
}
"""Red, green and blue of the boxes, 0 … 1."""

POINT_FIELDS = {
    "x": ("<f4", 0),
    "y": ("<f4", 4),
    "z": ("<f4", 8),
    "intensity": ("<f4", 12),
    "object": ("<u4", 16),
    "age_us": ("<u4", 20),
    "ring": ("<u2", 24),
}
"""Scalar and place (bytes) of the fields of a point: `object` is what it is on, `age_us` the time before the scan's."""


@dataclass(frozen=True)
class Placed:
    """A frame in another one."""

    parent: str
    child: str
    parent_from_child: Float64Array
    """f64 [4, 4]."""


@dataclass(frozen=True)
class Box:
    """The box of a road user."""

    id: str
    """SUMO's id."""
    vehicle: int
    kind: Kind
    world_from_box: Float64Array
    """f64 [4, 4]: from the middle of the box."""
    size_m: tuple[float, float, float]
    """Length, width, height: along x, y and z."""
    velocity_mps: Float64Array
    """f64 [3]: along the axes of the box."""


@dataclass(frozen=True)
class Odometry:
    """The true motion of a vehicle with sensors."""

    placed: Placed
    velocity_mps: Float64Array
    """f64 [3]: along the axes of the vehicle."""
    rate_radps: Float64Array
    """f64 [3]: about them."""


@dataclass(frozen=True)
class Fix:
    """A GNSS fix."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    error_m: float
    """Standard deviation in each direction, as the receiver reports it."""


class Sink(Protocol):
    """What writes the messages. Times are in nanoseconds; topics and frames begin with the name of the vehicle."""

    def transforms(self, time_ns: int, placed: list[Placed]) -> None:
        """Frames at a time."""

    def boxes(self, time_ns: int, boxes: list[Box]) -> None:
        """Every road user, in the world frame."""

    def odometry(self, time_ns: int, vehicle: str, motion: Odometry) -> None:
        """The true motion of a vehicle."""

    def fix(self, time_ns: int, vehicle: str, fix: Fix) -> None:
        """A fix of a vehicle."""

    def imu(self, time_ns: int, vehicle: str, accel_mps2: Array, rate_radps: Array) -> None:
        """A sample of a vehicle's accelerometer, gravity included, and of its gyroscope: f32 [3] each."""

    def points(self, time_ns: int, vehicle: str, position_m: Float32Array, points: Array) -> None:
        """A scan in `VEHICLE/lidar`: f32 [count, 3], and the recorded points (`LidarPoint`)."""

    def image(self, time_ns: int, vehicle: str, png: bytes, head: np.void) -> None:
        """An image in `VEHICLE/camera_optical`, and its camera (`ImageHead`)."""


def play(recording: Recording, episode: Episode, sink: Sink) -> None:
    """Write an episode. Raises `RecordingError` without `world`."""
    require_channels(recording, "world")
    users, tick_ns = RoadUsers(recording), round(recording.tick_s * 1e9)
    convention = str(recording.run["config"]["imu"]["convention"])
    scans: Iterator[Frame] = iter(())
    if "pointcloud" in recording.channels:
        scans = frames(recording, episode, every_scan=True)
    messages = (
        message
        for message in recording.messages("world", "observation")
        if int(message.header["episode"]) == episode.number
    )
    # A channel may be some ticks ahead of another, so the order is nearly that of ticks.
    ordered: Iterator[Message | Frame] = merge(messages, scans, key=_tick)
    states: dict[int, Array] = {}
    waiting: dict[int, Message] = {}
    for item in ordered:
        if isinstance(item, Frame):
            _sensed(item, item.scan.tick * tick_ns, sink)
        elif item.channel == "world":
            states[item.tick] = item.section("states")
            sink.boxes(item.tick * tick_ns, [_box(state, users) for state in states[item.tick]])
        else:
            waiting[item.tick] = item
        for tick in [tick for tick in waiting if tick in states]:
            _observed(waiting.pop(tick), states[tick], convention, tick_ns, sink)
            for old in [old for old in states if old < tick]:
                del states[old]


def _tick(item: Message | Frame) -> int:
    return item.tick if isinstance(item, Message) else item.scan.tick


def name_of(vehicle: int) -> str:
    """Name of a vehicle in topics and frames."""
    return f"vehicle_{vehicle}"


def packed_points(position_m: Float32Array, points: Array) -> Array:
    """[count] of `POINT_FIELDS`, without gaps."""
    packed = np.zeros(len(points), [(name, scalar) for name, (scalar, _) in POINT_FIELDS.items()])
    for place, name in enumerate("xyz"):
        packed[name] = position_m[:, place]
    for name in ("intensity", "object", "age_us"):
        packed[name] = points[name]
    packed["ring"] = points["channel"]
    return packed


def covariance(error_m: float) -> list[float]:
    """A covariance [9] of the same standard deviation in each direction (m²)."""
    return [float(value) for value in (np.eye(3) * error_m**2).ravel()]


def _box(state: np.void, users: RoadUsers) -> Box:
    middle = np.eye(4)
    middle[:3, 3] = box_middle(state)[:3] + np.array([0, 0, float(state["height_m"]) / 2])
    return Box(
        users.of(state["id_hash"]).id,
        int(state["vehicle"]),
        Kind(int(state["kind"])),
        upright_pose(state) @ middle,
        (float(state["length_m"]), float(state["width_m"]), float(state["height_m"])),
        state["velocity_body_mps"].astype(np.float64),
    )


def _sensed(frame: Frame, time_ns: int, sink: Sink) -> None:
    """The scan of the first LIDAR, the image of the main camera, and where both are on their carrier."""
    vehicle = name_of(frame.carrier)
    base, vehicle_from_world = f"{vehicle}/base_link", inverse(vehicle_pose(frame.own))
    placed = [Placed(base, f"{vehicle}/lidar", vehicle_from_world @ frame.world_from_lidar)]
    image = frame.images[0] if frame.images else None
    if image is not None:
        optical = image.world_from_camera @ rotated(OPTICAL.T)
        placed.append(Placed(base, f"{vehicle}/camera_optical", vehicle_from_world @ optical))
    sink.transforms(time_ns, placed)
    sink.points(time_ns, vehicle, forward_m(frame.head, frame.points).astype(np.float32), frame.points)
    if image is not None and (rgb := image.rgb) is not None:
        png = io.BytesIO()
        Image.fromarray(rgb).save(png, "png")
        sink.image(time_ns, vehicle, png.getvalue(), image.head)


def _observed(message: Message, states: Array, convention: str, tick_ns: int, sink: Sink) -> None:
    """The truth of every vehicle with sensors, and what its GNSS receiver and its IMU delivered in the tick."""
    by_vehicle = {int(state["vehicle"]): state for state in states}
    time_ns = message.tick * tick_ns
    placed = []
    rows = zip(
        *(message.section(name) for name in ("vehicle", "sensors", "gnss_geodetic", "gnss_quality", "imu")), strict=True
    )
    for number, sensors, geodetic, quality, imu in rows:
        if int(number) == _native.EMPTY_SLOT or int(number) not in by_vehicle:
            continue
        state, vehicle = by_vehicle[int(number)], name_of(int(number))
        here = Placed(WORLD, f"{vehicle}/base_link", vehicle_pose(state))
        placed.append(here)
        velocity, rate = (state[name].astype(np.float64) for name in ("velocity_body_mps", "angular_rate_body_radps"))
        sink.odometry(time_ns, vehicle, Odometry(here, velocity, rate))
        if sensors & SENSOR_BITS["gnss"]:
            latitude, longitude, altitude = (float(value) for value in geodetic)
            sink.fix(time_ns, vehicle, Fix(latitude, longitude, altitude, float(quality[0])))
        if sensors & SENSOR_BITS["imu"]:
            # The samples of a tick are as far apart from each other; the newest is that of its end.
            times = time_ns - (tick_ns * np.arange(len(imu))[::-1]) // len(imu)
            for at_ns, sample in zip(times.tolist(), right_handed(imu, convention, state), strict=True):
                # Both file formats count time from 0; the first tick's older samples lie before it.
                if at_ns >= 0:
                    sink.imu(at_ns, vehicle, sample[:3], sample[3:6])
    sink.transforms(time_ns, placed)


def right_handed(imu: Array, convention: str, state: np.void) -> Float64Array:
    """f64 [k, 6]: samples with x forward, y left, z up and with gravity (REP 145), whatever `imu.convention` is.

    A `kinematic` IMU measures no gravity, so it is added for the true attitude of the vehicle.
    """
    samples = imu[:, :6].astype(np.float64)
    if convention == "carla":
        samples *= np.array([1, -1, 1, -1, 1, -1])
    if convention == "kinematic":
        world_from_vehicle = rotation(float(state["roll_rad"]), float(state["pitch_rad"]), float(state["yaw_rad"]))
        samples[:, :3] += world_from_vehicle[2] * GRAVITY_MPS2
    return samples
