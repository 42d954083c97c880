"""An episode as a stream of robot messages, in the order of ticks: what the ROS 2 and the Foxglove export share.

Frames are those of REP 105 and REP 103: `map` is the world (x east, y north, z up); `vehicle_N/base_link` is the rear
axle's centre on the ground (x forward, y left, z up), with the sensors below it; optical frames have z forward. `N` is
the dense index of a vehicle in its episode. Carriers beside the road are `roadside_K/base_link`, whose frames are
static. Times are simulated, since the start of the run.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from heapq import merge
from typing import Protocol

import numpy as np
from PIL import Image

from caraware import _native
from caraware.data.export.frames import (
    CameraImage,
    DeliveredSensors,
    Frame,
    LidarScan,
    RadarSample,
    SensorMessage,
    delivered_sensors,
    frames,
)
from caraware.data.export.scans import box_middle, inverse, require_channels, upright_pose, vehicle_pose
from caraware.data.export.sensors import Omission, SensorLabels, carrier_name, lack_colours
from caraware.data.names import Kind, RoadUsers
from caraware.data.recording import Array, Episode, Message, Recording
from caraware.ipc.arrays import Float64Array
from caraware.ipc.layout import SENSOR_BITS
from caraware.ipc.mounts import OWN_SENSOR
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
    Kind.TRAILING: (0.45, 0.45, 0.5),
}
"""Red, green and blue of the boxes, 0 … 1."""

POINT = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "intensity")),
        *(("object", "<u4"), ("age_us", "<u4"), ("ring", "<u2")),
    ]
)
"""A point of a LIDAR: `object` is what it is on, `age_us` the time before the scan's, `ring` that of its laser."""

DETECTION = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "distance_m", "azimuth_rad", "elevation_rad")),
        *((name, "<f4") for name in ("radial_velocity_mps", "rcs_dbsm", "snr_db", "existence_probability")),
        ("object_id", "<u4"),
    ]
)
"""A detection of a radar: its place, and the values of `RadarDetection` with their names and signs."""

RESERVED = ("base_link", "truth", "gnss", "imu", "camera_optical", "camera_info", "camera_calibration")
"""Names below a vehicle that no sensor of a suite gets."""


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
    """SUMO's id; of a trailing body with a slash and its place."""
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
class SensorTopic:
    """Where the messages of a sensor go."""

    frame: str
    """Name of its frame."""
    topic: str
    """Topic of its points, detections or images."""
    calibration: str
    """Of a camera: begin of the topic of its calibration, which a format completes."""


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

    def transforms(self, time_ns: int, placed: list[Placed], *, are_static: bool = False) -> None:
        """Frames at a time; static ones hold from then on."""

    def boxes(self, time_ns: int, boxes: list[Box]) -> None:
        """Every road user, in the world frame."""

    def odometry(self, time_ns: int, vehicle: str, motion: Odometry) -> None:
        """The true motion of a vehicle."""

    def fix(self, time_ns: int, vehicle: str, fix: Fix) -> None:
        """A fix of a vehicle."""

    def imu(self, time_ns: int, vehicle: str, accel_mps2: Array, rate_radps: Array) -> None:
        """A sample of a vehicle's accelerometer, gravity included, and of its gyroscope: f32 [3] each."""

    def points(self, time_ns: int, place: SensorTopic, points: Array) -> None:
        """The points of a LIDAR (`POINT [count]`) or the detections of a radar (`DETECTION [count]`) in its frame."""

    def image(self, time_ns: int, place: SensorTopic, png: bytes, head: np.void) -> None:
        """An image in an optical frame, and its camera (`ImageHead`)."""


def play(recording: Recording, episode: Episode, sink: Sink) -> None:
    """Write an episode. Raises `RecordingError` without `world`."""
    require_channels(recording, "world")
    users, tick_ns = RoadUsers(recording), round(recording.tick_s * 1e9)
    convention = str(recording.run["config"]["imu"]["convention"])
    sensors = _Sensors(recording, sink)
    messages = (
        message
        for message in recording.messages("world", "observation")
        if int(message.header["episode"]) == episode.number
    )
    sensed = frames(recording, episode, delivered_sensors(recording, episode))
    # A channel may be some ticks ahead of another, so the order is nearly that of ticks.
    ordered: Iterator[Message | Frame] = merge(messages, sensed, key=lambda item: item.tick)
    states: dict[int, Array] = {}
    waiting: dict[int, Message] = {}
    for item in ordered:
        if isinstance(item, Frame):
            sensors.play(item, item.tick * tick_ns)
        elif item.channel == "world":
            states[item.tick] = item.section("states")
            sink.boxes(item.tick * tick_ns, [_box(state, users) for state in states[item.tick]])
        else:
            waiting[item.tick] = item
        for tick in [tick for tick in waiting if tick in states]:
            _observed(waiting.pop(tick), states[tick], convention, tick_ns, sink)
            for old in [old for old in states if old < tick]:
                del states[old]


def lacks(delivered: DeliveredSensors, carrier: int) -> list[Omission]:
    """Every sensor has topics; images have colours alone."""
    return lack_colours(delivered, carrier)


def packed_points(scan: LidarScan) -> Array:
    """`POINT [count]`, without gaps."""
    packed, forward_m = np.zeros(len(scan.points), POINT), scan.forward_m
    for place, name in enumerate("xyz"):
        packed[name] = forward_m[:, place]
    for name in ("intensity", "object", "age_us"):
        packed[name] = scan.points[name]
    packed["ring"] = scan.points["channel"]
    return packed


def packed_detections(radar: RadarSample) -> Array:
    """`DETECTION [count]`, without gaps."""
    packed, position_m = np.zeros(len(radar.detections), DETECTION), radar.position_m
    for place, name in enumerate("xyz"):
        packed[name] = position_m[:, place]
    for name in (DETECTION.names or ())[3:]:
        packed[name] = radar.detections[name]
    return packed


def covariance(error_m: float) -> list[float]:
    """A covariance [9] of the same standard deviation in each direction (m²)."""
    return [float(value) for value in (np.eye(3) * error_m**2).ravel()]


def _box(state: np.void, users: RoadUsers) -> Box:
    middle = np.eye(4)
    middle[:3, 3] = box_middle(state)[:3] + np.array([0, 0, float(state["height_m"]) / 2])
    return Box(
        users.body_name(state),
        int(state["vehicle"]),
        Kind(int(state["kind"])),
        upright_pose(state) @ middle,
        (float(state["length_m"]), float(state["width_m"]), float(state["height_m"])),
        state["velocity_body_mps"].astype(np.float64),
    )


class _Sensors:
    """Plays frames: where the sensors are on their carrier, and what they delivered."""

    def __init__(self, recording: Recording, sink: Sink) -> None:
        self._labels = SensorLabels(recording.run, _label, RESERVED)
        self._sink = sink
        # Vehicles are placed with their observations, where these are recorded.
        self._places_vehicles = "observation" not in recording.channels
        self._standing: dict[str, Placed] = {}

    def play(self, frame: Frame, time_ns: int) -> None:
        """Play a frame."""
        base = f"{carrier_name(frame.carrier)}/base_link"
        world_from_base = vehicle_pose(frame.own)
        placed = []
        if frame.is_roadside or self._places_vehicles:
            placed.append(Placed(WORLD, base, world_from_base))
        for sensor in frame.sensors:
            world_from = sensor.world_from_optical if isinstance(sensor, CameraImage) else sensor.world_from_sensor
            placed.append(Placed(base, self._topic(frame, sensor).frame, inverse(world_from_base) @ world_from))
        if not frame.is_roadside:
            self._sink.transforms(time_ns, placed)
        elif any(one.child not in self._standing for one in placed):
            # A message has all static frames so far: a late subscriber may get the last message alone.
            self._standing = {one.child: one for one in placed} | self._standing
            self._sink.transforms(time_ns, list(self._standing.values()), are_static=True)
        for scan in frame.scans:
            self._sink.points(time_ns, self._topic(frame, scan), packed_points(scan))
        for radar in frame.radars:
            self._sink.points(time_ns, self._topic(frame, radar), packed_detections(radar))
        for image in frame.images:
            if (rgb := image.rgb) is not None:
                png = io.BytesIO()
                Image.fromarray(rgb).save(png, "png")
                self._sink.image(time_ns, self._topic(frame, image), png.getvalue(), image.head)

    def _topic(self, frame: Frame, sensor: SensorMessage) -> SensorTopic:
        """`CARRIER/lidar` of the sensor of a section; a sensor of a suite has topics below its own name."""
        carrier, (kind, number) = carrier_name(frame.carrier), sensor.key
        label = self._labels.of(sensor.key)
        optical = f"{carrier}/{label}_optical" if kind == "camera" else f"{carrier}/{label}"
        if number == OWN_SENSOR:
            return SensorTopic(optical, f"/{carrier}/{label}", f"/{carrier}/{label}_")
        leaf = {"lidar": "points", "camera": "image", "radar": "detections"}[kind]
        return SensorTopic(optical, f"/{carrier}/{label}/{leaf}", f"/{carrier}/{label}/camera_")


def _label(kind: str, name: str) -> str:
    """A name as ROS allows it: letters, digits and underscores, no digit first."""
    label = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return label if label[:1].isalpha() else f"{kind}_{label}"


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
        state, vehicle = by_vehicle[int(number)], carrier_name(int(number))
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
