"""Frames: what the sensors of one carrier, a vehicle or a mast beside the road, delivered at one tick."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from caraware.data.export.scans import OPTICAL, forward_m, inverse, pose, require_channels, rotated
from caraware.data.recording import Array, Episode, Message, Recording
from caraware.ipc.arrays import Float64Array
from caraware.ipc.image import split_planes
from caraware.ipc.layout import IMAGE_PLANES
from caraware.ipc.mounts import ROADSIDE, MountedSensor, SensorNames, sensor_number

CHANNELS = {"pointcloud": "lidar", "image": "camera", "radar": "radar"}
"""Channels with a message for each sensor and sample, and the kinds of these sensors."""

MAIN_CAMERAS = ("image_2", "CAM_FRONT")
"""Names of cameras of ready-made suites that are the main ones of their carriers; of other suites it is the first."""

MAIN_LIDARS = ("velodyne", "LIDAR_TOP")
"""Names of LIDARs that are the main ones of their carriers; of other carriers it is the first."""

MOST_TICKS_APART = 256
"""A message that waits for another one of its tick is dropped after so many ticks."""

SensorKey = tuple[str, int]
"""Kind of a sensor, and its number among those of the kind."""


@dataclass(frozen=True)
class SensorMessage:
    """A message of a mounted sensor."""

    SECTION: ClassVar[str] = "scan"
    """The section of the sensor."""

    mounted: MountedSensor
    message: Message

    @property
    def head(self) -> np.void:
        """The sensor (`Scan`, `ImageHead` or `RadarScan`)."""
        head: np.void = self.message.section(self.SECTION)[0]
        return head

    @property
    def key(self) -> SensorKey:
        """Kind and number of the sensor."""
        return CHANNELS[self.message.channel], sensor_number(self.head)

    @property
    def world_from_sensor(self) -> Float64Array:
        """f64 [4, 4]: from x forward (of a camera along its optical axis), y left, z up."""
        return pose(self.head["position_m"], self.head["attitude_rad"])


@dataclass(frozen=True)
class LidarScan(SensorMessage):
    """A scan of a LIDAR."""

    @property
    def points(self) -> Array:
        """`LidarPoint [count]`."""
        return self.message.section("points")

    @property
    def forward_m(self) -> Array:
        """f32 [count, 3]: points (m) with x forward, y left and z up, whatever `lidar.axes` is."""
        return forward_m(self.head, self.points)


@dataclass(frozen=True)
class CameraImage(SensorMessage):
    """An image of a camera."""

    SECTION: ClassVar[str] = "head"

    @property
    def rgb(self) -> Array | None:
        """u8 [height, width, 3]; None if colours are not recorded."""
        return split_planes(self.head, self.message.section("planes").tobytes())["rgb"]

    @property
    def planes(self) -> tuple[str, ...]:
        """Names of the planes that it has."""
        return tuple(name for name, bit, *_ in IMAGE_PLANES if int(self.head["planes"]) & bit)

    @property
    def world_from_optical(self) -> Float64Array:
        """f64 [4, 4]: from x right, y down, z forward."""
        return self.world_from_sensor @ rotated(OPTICAL.T)

    @property
    def seen(self) -> dict[int, np.void]:
        """`SeenObject` by number: the road users of which the image shows a pixel."""
        return {int(user["object"]): user for user in self.message.section("objects")}


@dataclass(frozen=True)
class RadarSample(SensorMessage):
    """The detections of a radar in a scan."""

    @property
    def detections(self) -> Array:
        """`RadarDetection [count]`, nearest first."""
        return self.message.section("detections")

    @property
    def position_m(self) -> Float64Array:
        """f64 [count, 3]: places of the detections in the radar's frame, x forward, y left, z up."""
        range_m, azimuth_rad, elevation_rad = (
            self.detections[name].astype(np.float64) for name in ("distance_m", "azimuth_rad", "elevation_rad")
        )
        level_m = range_m * np.cos(elevation_rad)
        return np.stack(
            (level_m * np.cos(azimuth_rad), level_m * np.sin(azimuth_rad), range_m * np.sin(elevation_rad)), 1
        )


MESSAGES: Mapping[str, type[SensorMessage]] = {
    "pointcloud": LidarScan,
    "image": CameraImage,
    "radar": RadarSample,
}
"""What reads a message of a channel."""


@dataclass(frozen=True)
class Frame:
    """What the sensors of one carrier delivered at one tick."""

    carrier: int
    """Number of the vehicle within its episode, or `ROADSIDE` and the place of a carrier beside the road."""
    tick: int
    states: Array
    """All road users (`VehicleState`), and behind them the trailing bodies of articulated vehicles."""
    own: np.void
    """The state of the carrier (`VehicleState`); beside the road it has a place and a heading, and is at rest."""
    main: LidarScan | None
    """The scan of its main LIDAR: the one called as in `MAIN_LIDARS`, else the one with the lowest number."""
    other_scans: tuple[LidarScan, ...]
    """The scans of its other LIDARs, in the order of their numbers."""
    images: tuple[CameraImage, ...]
    """One of each of its cameras, in the order of their numbers; the first is the main one, if that has delivered."""
    radars: tuple[RadarSample, ...]
    """One of each of its radars, in the order of their numbers."""

    @property
    def is_roadside(self) -> bool:
        """True if the carrier stands beside the road."""
        return bool(self.carrier & ROADSIDE)

    @property
    def scans(self) -> tuple[LidarScan, ...]:
        """The scans of all LIDARs, the main one's first."""
        return (() if self.main is None else (self.main,)) + self.other_scans

    @property
    def sensors(self) -> tuple[SensorMessage, ...]:
        """All messages."""
        return (*self.scans, *self.images, *self.radars)

    def labelled(self) -> list[np.void]:
        """The states of all other bodies of road users that a LIDAR, a camera or a radar of this frame shows."""
        shown: set[int] = set().union(*(image.seen for image in self.images))
        for scan in self.scans:
            shown.update(np.unique(scan.points["object"]).tolist())
        for radar in self.radars:
            shown.update(radar.detections["object_id"].tolist())
        return [s for s in self.states if int(s["vehicle"]) != self.carrier and int(s["vehicle"]) in shown]


@dataclass(frozen=True)
class SensorFacts:
    """What is known of a sensor of a carrier from its first message."""

    mounted: MountedSensor
    planes: tuple[str, ...]
    """Of a camera: the planes of its images."""


@dataclass
class DeliveredSensors:
    """Which sensors have recorded messages in an episode."""

    at: dict[tuple[int, int], set[SensorKey]] = field(default_factory=dict)
    """By carrier and tick."""
    of: dict[int, dict[SensorKey, SensorFacts]] = field(default_factory=dict)
    """By carrier."""
    combinations: dict[int, Counter[frozenset[SensorKey]]] = field(default_factory=dict)
    """Of each carrier: ticks by the sensors that have delivered, as far as `settle` has counted them."""

    def main_lidar(self, carrier: int) -> SensorKey | None:
        """The main LIDAR of a carrier; None if it has none."""
        lidars = [key for key in self.of[carrier] if key[0] == "lidar"]
        named = [key for key in lidars if self.of[carrier][key].mounted.sensor in MAIN_LIDARS]
        return min(named or lidars, default=None)

    def cameras(self, carrier: int) -> list[SensorKey]:
        """The cameras of a carrier by number, the main one first."""
        cameras = sorted(key for key in self.of[carrier] if key[0] == "camera")
        return sorted(cameras, key=lambda key: self.of[carrier][key].mounted.sensor not in MAIN_CAMERAS)

    def settle(self) -> None:
        """Count the ticks, and forget them one by one."""
        for (carrier, _), keys in self.at.items():
            self.combinations.setdefault(carrier, Counter())[frozenset(keys)] += 1
        self.at.clear()

    def ticks_with(self, carrier: int, keys: Iterable[SensorKey]) -> int:
        """Settled ticks in which all these sensors of a carrier have delivered."""
        wanted = frozenset(keys)
        return sum(count for found, count in self.combinations[carrier].items() if wanted <= found)

    def add(self, sensor: SensorMessage) -> None:
        """Note a message."""
        carrier, key = int(sensor.head["vehicle"]), sensor.key
        self.at.setdefault((carrier, sensor.message.tick), set()).add(key)
        if key not in self.of.setdefault(carrier, {}):
            planes = sensor.planes if isinstance(sensor, CameraImage) else ()
            self.of[carrier][key] = SensorFacts(sensor.mounted, planes)


def sensor_messages(recording: Recording, *others: str) -> Iterator[tuple[SensorMessage | None, Message]]:
    """The messages of sensors and of the channels `others`, in the order of recording; those of sensors come read."""
    names = SensorNames(recording.run)
    channels = [channel for channel in (*CHANNELS, *others) if channel in recording.channels]
    for message in recording.messages(*channels) if channels else ():
        kind = MESSAGES.get(message.channel)
        if kind is None:
            yield None, message
        else:
            head = message.section(kind.SECTION)[0]
            yield kind(names.of(CHANNELS[message.channel], head), message), message


def delivered_sensors(recording: Recording, episode: Episode) -> DeliveredSensors:
    """Which sensors have recorded messages in an episode."""
    delivered = DeliveredSensors()
    for sensor, message in sensor_messages(recording):
        if sensor is not None and int(message.header["episode"]) == episode.number:
            delivered.add(sensor)
    return delivered


def roadside_state(sensor: SensorMessage, states: Array) -> np.void:
    """The carrier of a sensor beside the road as a road user at rest: its foot and its heading, without a size."""
    mount = np.array(sensor.mounted.mount or np.zeros(6))
    world_from_carrier = sensor.world_from_sensor @ inverse(pose(mount[:3], mount[3:]))
    state = np.zeros(1, states.dtype)
    state["vehicle"], state["id_hash"] = sensor.head["vehicle"], sensor.head["id_hash"]
    for name, value in zip(("x_m", "y_m", "z_m"), world_from_carrier[:3, 3], strict=True):
        state[name] = value
    state["yaw_rad"] = np.arctan2(world_from_carrier[1, 0], world_from_carrier[0, 0])
    own: np.void = state[0]
    return own


class _Assembly:
    """Puts the messages of an episode together."""

    def __init__(self, delivered: DeliveredSensors) -> None:
        self._delivered = delivered
        self._states: dict[int, Array] = {}
        self._waiting: dict[tuple[int, int], dict[SensorKey, SensorMessage]] = {}
        # Frames of a carrier come in the order of ticks, though an image may be recorded after the next scan.
        self._expected: dict[int, deque[int]] = {}
        for carrier, tick in sorted(delivered.at):
            self._expected.setdefault(carrier, deque()).append(tick)

    def add(self, sensor: SensorMessage | None, message: Message) -> list[Frame]:
        """The frames that are complete with this message."""
        if sensor is None:
            self._states[message.tick] = message.section("states")
            carriers = list(self._expected)
        else:
            carrier = int(sensor.head["vehicle"])
            self._waiting.setdefault((carrier, message.tick), {})[sensor.key] = sensor
            carriers = [carrier]
        found = [frame for carrier in carriers for frame in self._of(carrier, message.tick - MOST_TICKS_APART)]
        for old in [tick for tick in self._states if tick < message.tick - MOST_TICKS_APART]:
            del self._states[old]
        return found

    def rest(self) -> list[Frame]:
        """The frames behind one that lacks the states of its tick."""
        return [frame for carrier in self._expected for frame in self._of(carrier, 1 << 62)]

    def _of(self, carrier: int, oldest: int) -> Iterator[Frame]:
        """The complete frames of a carrier; an incomplete one before tick `oldest` is dropped."""
        expected = self._expected[carrier]
        while expected:
            key = carrier, expected[0]
            messages = self._waiting.get(key, {})
            is_complete = key[1] in self._states and messages.keys() == self._delivered.at[key]
            if not is_complete and key[1] >= oldest:
                return
            expected.popleft()
            self._waiting.pop(key, None)
            if is_complete and (frame := self._frame(carrier, key[1], messages)) is not None:
                yield frame

    def _frame(self, carrier: int, tick: int, messages: dict[SensorKey, SensorMessage]) -> Frame | None:
        states = self._states[tick]
        if carrier & ROADSIDE:
            own = roadside_state(next(iter(messages.values())), states)
        else:
            rows = states[states["vehicle"] == carrier]
            if len(rows) == 0:
                return None
            own = rows[0]
        in_order = [messages[key] for key in sorted(messages)]
        main = self._delivered.main_lidar(carrier)
        scans = [sensor for sensor in in_order if isinstance(sensor, LidarScan)]
        cameras = [messages.get(key) for key in self._delivered.cameras(carrier)]
        return Frame(
            carrier,
            tick,
            states,
            own,
            next((scan for scan in scans if scan.key == main), None),
            tuple(scan for scan in scans if scan.key != main),
            tuple(image for image in cameras if isinstance(image, CameraImage)),
            tuple(sensor for sensor in in_order if isinstance(sensor, RadarSample)),
        )


def frames(recording: Recording, episode: Episode, delivered: DeliveredSensors) -> Iterator[Frame]:
    """The frames of one episode, each as soon as its messages are there; of one carrier in the order of ticks.

    A frame has every message of its carrier and tick. Raises `RecordingError` without `world`.
    """
    require_channels(recording, "world")
    assembly = _Assembly(delivered)
    for sensor, message in sensor_messages(recording, "world"):
        if int(message.header["episode"]) == episode.number:
            yield from assembly.add(sensor, message)
    yield from assembly.rest()
