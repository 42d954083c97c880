"""Decodes frames (`docs/fanout.md`).

A frame is a message as it is in the simulator's shared memory: 96 bytes of header, then the payload, little endian.
The types of its parts come from `layout`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caraware_viewer.layout import ALIGNMENT, DIMENSIONS, IMAGE_PLANES, RECORDS, SCHEMA_VERSION, SECTIONS, SENSORS

EVALUATION = 1
"""Bit of `MessageHeader.flags`: the episode is an evaluation."""

CAV, OTHER, PERSON, HERO, TRAILING = 0, 1, 2, 3, 4
"""Values of `VehicleState.kind`."""

BODY_SHIFT = 25
"""First bit of `VehicleState.vehicle` that numbers the trailing bodies of a vehicle, from 1 on."""


def sensor_bit(name: str) -> int:
    """Bit of the sensor called `name`."""
    return next(sensor.bit for sensor in SENSORS if sensor.name == name)


EMPTY_SLOT = 0xFFFF_FFFF
"""`vehicle` of an empty slot."""
VALID = 1
"""Bit of an observation's `flags`: the slot's vehicle has delivered every sensor at least once."""

HEADER = RECORDS["MessageHeader"]
VEHICLE_STATE = RECORDS["VehicleState"]
"""A road user at the end of a tick; the origin is the centre of the rear axle (persons: their centre)."""
VEHICLE_META = RECORDS["VehicleMeta"]
"""Id, type and size of a road user."""
SIGNAL_META = RECORDS["SignalMeta"]
"""State of a traffic light, a letter for each link."""
ROUTE_POINT = RECORDS["RoutePoint"]
"""A point of a hero's route; routes follow one another, each from its point 0."""
NO_SIGNAL = 0xFFFF_FFFF
"""`RoutePoint.signal` where there is no traffic light."""
COLLISION = RECORDS["Collision"]
"""A contact that begins."""
SCAN = RECORDS["Scan"]
"""Pose of a LIDAR at the end of the tick; `axes` 0: x forward, y left, z up; 1: y back, x left, z down."""
LIDAR_POINT = RECORDS["LidarPoint"]
"""One return, in the axes that the sensor had when it fired."""
IMAGE_HEAD = RECORDS["ImageHead"]
"""Pose of a camera at the end of the tick, and the size of its image."""
SEEN_OBJECT = RECORDS["SeenObject"]
"""A road user of which an image shows a pixel: its class, boxes (pixels) and depths (metres)."""
BRIGHTNESS_EVENT = RECORDS["BrightnessEvent"]
"""A pixel became brighter or darker: time since the begin of the tick (µs), column, row, polarity."""
RADAR_SCAN = RECORDS["RadarScan"]
"""Pose of a radar at the end of the tick; x forward, y left, z up."""
RADAR_DETECTION = RECORDS["RadarDetection"]
"""One detection: range (metres), azimuth and elevation (radians), radial velocity (m/s, positive towards it)."""


class FrameError(ValueError):
    """A frame must be refused: it does not hold what its header promises, or has another schema version."""


@dataclass(frozen=True)
class Header:
    """The header of a frame."""

    run_id: int
    flags: int
    episode: int
    tick: int
    sim_time_ns: int
    shape: tuple[int, ...]
    """Sizes of the dimensions of the payload's sections, in the order of `layout.DIMENSIONS`; zeros behind them."""

    @property
    def rows(self) -> int:
        """Number of rows: size of the first dimension."""
        return self.shape[0]


@dataclass(frozen=True)
class World:
    """Road users at the end of a tick."""

    header: Header
    states: NDArray[np.void]
    """`VEHICLE_STATE [count]`: road users, and behind them the trailing bodies of articulated vehicles."""

    @property
    def road_users(self) -> NDArray[np.void]:
        """`VEHICLE_STATE [header.rows]`: road users alone."""
        return self.states[: self.header.rows]


@dataclass(frozen=True)
class Observation:
    """The sensors of every connected vehicle at a tick, one row for each slot (`n` slots, `d` fields)."""

    header: Header
    observation: NDArray[np.float32]
    """`[n, d]`, normalised."""
    truth: NDArray[np.float32]
    """`[n, 4]`: x, y of the rear axle (metres, world frame), yaw (radians), speed (m/s)."""
    gnss_m: NDArray[np.float32]
    """`[n, 3]`: newest raw fix, metres, world frame (east, north, up)."""
    gnss_geodetic: NDArray[np.float64]
    """`[n, 3]`: the same fix, latitude and longitude (degrees), altitude (metres)."""
    gnss_quality: NDArray[np.float32]
    """`[n, 2]`: the receiver's estimate of its horizontal error (metres), satellites in use."""
    imu: NDArray[np.float32]
    """`[n, k, 7]`: samples since the last tick: acceleration (m/s²), angular rate (rad/s), compass (rad)."""
    speed_steering: NDArray[np.float32]
    """`[n, 2]`: wheel speed (m/s), steering-wheel angle (rad)."""
    id_hash: NDArray[np.uint64]
    vehicle: NDArray[np.uint32]
    flags: NDArray[np.uint32]
    sensors: NDArray[np.uint32]
    """Which sensors deliver: bits of `SENSORS`."""
    episode_step: NDArray[np.uint32]
    age_s: NDArray[np.float32]
    """`[n, 4]`: age of the newest sample of each of the first four `SENSORS`, seconds."""

    @property
    def valid(self) -> NDArray[np.bool_]:
        """`[n]`: the slot holds a vehicle whose sensors have all delivered."""
        valid: NDArray[np.bool_] = (self.vehicle != EMPTY_SLOT) & (self.flags & VALID != 0)
        return valid


_OBSERVED = tuple(Observation.__dataclass_fields__.keys() - {"header"})


@dataclass(frozen=True)
class Prediction:
    """The policy's answers to the observation of the same tick."""

    header: Header
    answer: NDArray[np.float32]
    """`[n, a]`, one row for each slot of the observation: x, y (metres, world frame) where the task is to localise."""
    estimate_m: NDArray[np.float32] | None
    """`[n, 2]`: estimates of the Kalman filter, metres; NaN where it has none. `None` if the filter does not run."""


@dataclass(frozen=True)
class Neighbours:
    """What every connected road user knows of others from messages, one row for each slot of the observation."""

    header: Header
    objects: NDArray[np.float32]
    """`[n, k, 11]`: known objects, the nearest first: x, y (metres, world frame, centre) and velocity x, y (m/s) when
    they were measured, heading (radians), length, width (metres), age of the measurement (seconds), then standard
    deviations: of the position on each axis (metres), of the velocity on each axis (m/s), of the heading (radians)."""
    ids: NDArray[np.uint32]
    """`[n, k, 3]`: station of the object (0: it has no name), station that it was heard from, `NeighbourSource`."""
    radio: NDArray[np.uint32]
    """`[n, 5]`: 1 with a radio, objects known; in the tick before: messages sent, bytes of them, messages received."""
    channel_load: NDArray[np.float32]
    """`[n]`: share of the tick before in which the radio found the channel busy."""
    vehicle: NDArray[np.uint32]

    @property
    def sent(self) -> NDArray[np.uint32]:
        """`[n]`: messages sent in the tick before."""
        sent: NDArray[np.uint32] = self.radio[:, 2]
        return sent

    def slot_of(self, vehicle: int) -> int | None:
        """Slot of a vehicle by its index; `None` if it has none, or no radio."""
        found = np.flatnonzero((self.vehicle == vehicle) & (self.radio[:, 0] != 0))
        return int(found[0]) if len(found) else None

    def known_in(self, slot: int | None) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
        """`objects [m, 11]` and `ids [m, 3]` that a slot's vehicle knows, the nearest first; none without a slot."""
        if slot is None:
            return self.objects[:0].reshape(0, self.objects.shape[-1]), self.ids[:0].reshape(0, self.ids.shape[-1])
        known = self.ids[slot, :, 2] != 0
        return self.objects[slot, known], self.ids[slot, known]


_KNOWN = tuple(name for name in Neighbours.__dataclass_fields__ if name != "header")


@dataclass(frozen=True)
class Table:
    """A frame of `VEHICLE_META`, `SIGNAL_META`, `ROUTE_POINT` or `COLLISION` rows."""

    header: Header
    rows: NDArray[np.void]


@dataclass(frozen=True)
class PointCloud:
    """The returns of one LIDAR during a tick."""

    header: Header
    scan: np.void
    """`SCAN`."""
    points: NDArray[np.void]
    """`LIDAR_POINT [count]`."""


@dataclass(frozen=True)
class CameraImage:
    """One image of a camera (`h` rows, `w` columns)."""

    header: Header
    head: np.void
    """`IMAGE_HEAD`."""
    planes: dict[str, NDArray[Any]]
    """The planes that the frame has, `[h, w]`, `[h, w, 2]` and `[h, w, 3]`, by their names in `IMAGE_PLANES`."""
    objects: NDArray[np.void]
    """`SEEN_OBJECT [count]`."""
    events: NDArray[np.void]
    """`BRIGHTNESS_EVENT [count]`."""


@dataclass(frozen=True)
class RadarDetections:
    """The detections of one radar in a scan."""

    header: Header
    scan: np.void
    """`RADAR_SCAN`."""
    detections: NDArray[np.void]
    """`RADAR_DETECTION [count]`."""


def decode_header(frame: bytes) -> Header:
    """The header of a frame; refuses a frame that is too short or has another schema version."""
    if len(frame) < HEADER.itemsize:
        raise FrameError(f"a frame of {len(frame)} bytes is shorter than its {HEADER.itemsize} bytes of header")
    row = np.frombuffer(frame, HEADER, count=1)[0]
    if row["schema_version"] != SCHEMA_VERSION:
        raise FrameError(
            f"the run has schema version {row['schema_version']}, and this viewer knows {SCHEMA_VERSION}: "
            "install the viewer of the run's version"
        )
    numbers = {name: int(row[name]) for name in Header.__dataclass_fields__ if name != "shape"}
    return Header(**numbers, shape=tuple(int(size) for size in row["shape"]))


def decode_world(frame: bytes) -> World:
    """A `world` frame, which has neither sub-steps nor views of heroes."""
    header = decode_header(frame)
    sections = _sections(frame, "world", header)
    return World(header, sections["states"])


def decode_table(frame: bytes, row: np.dtype[np.void]) -> Table:
    """A frame of `vehicles`, `signals`, `routes` or `event`."""
    header = decode_header(frame)
    return Table(header, _array(frame, 0, row, (header.rows,)))


def decode_observation(frame: bytes) -> Observation:
    """An `observation` frame."""
    header = decode_header(frame)
    sections = _sections(frame, "observation", header)
    # The viewer skips sections that it does not show, such as that of a newer sensor.
    return Observation(header, **{name: sections[name] for name in _OBSERVED})


def decode_prediction(frame: bytes) -> Prediction:
    """A `prediction` frame."""
    header = decode_header(frame)
    _, _, estimated_slots, *_ = header.shape
    sections = _sections(frame, "prediction", header)
    return Prediction(header, sections["prediction"], sections["estimate_m"] if estimated_slots else None)


def decode_neighbours(frame: bytes) -> Neighbours:
    """A `neighbours` frame."""
    header = decode_header(frame)
    sections = _sections(frame, "neighbours", header)
    return Neighbours(header, **{name: sections[name] for name in _KNOWN})


def decode_cloud(frame: bytes) -> PointCloud:
    """A `pointcloud/<id>` frame."""
    header = decode_header(frame)
    sections = _sections(frame, "pointcloud", header)
    if len(sections["scan"]) != 1:
        raise FrameError(f"a point cloud has one scan, but this one has {len(sections['scan'])}")
    return PointCloud(header, sections["scan"][0], sections["points"])


def decode_image(frame: bytes) -> CameraImage:
    """An `image/<id>` frame."""
    header = decode_header(frame)
    sections = _sections(frame, "image", header)
    if len(sections["head"]) != 1:
        raise FrameError(f"an image has one head, but this one has {len(sections['head'])}")
    head = sections["head"][0]
    size = (int(head["height"]), int(head["width"]))
    content = sections["planes"].tobytes()
    planes: dict[str, NDArray[Any]] = {}
    offset = 0
    for name, bit, scalar, shape in IMAGE_PLANES:
        if int(head["planes"]) & bit == 0:
            continue
        count = math.prod((*size, *shape))
        length = count * np.dtype(scalar).itemsize
        if offset + length > len(content):
            raise FrameError(f"the planes of an image of {size[1]} x {size[0]} pixels have {len(content)} bytes")
        planes[name] = np.frombuffer(content, scalar, count, offset).reshape((*size, *shape))
        offset += length
    return CameraImage(header, head, planes, sections["objects"], sections["events"])


def decode_detections(frame: bytes) -> RadarDetections:
    """A `radar/<id>` frame."""
    header = decode_header(frame)
    sections = _sections(frame, "radar", header)
    if len(sections["scan"]) != 1:
        raise FrameError(f"a radar's frame has one scan, but this one has {len(sections['scan'])}")
    return RadarDetections(header, sections["scan"][0], sections["detections"])


def decode_text(field: np.void, length: int) -> str:
    """UTF-8 text in a field of fixed size."""
    return field.tobytes()[:length].decode(errors="replace")


def _sections(frame: bytes, payload: str, header: Header) -> dict[str, NDArray[Any]]:
    """The sections of a payload by name; each starts at a multiple of `ALIGNMENT`."""
    sizes = dict(zip(DIMENSIONS[payload], header.shape, strict=False))
    arrays, offset = {}, 0
    for section in SECTIONS[payload]:
        array = _array(frame, offset, section.element, section.sized(sizes))
        arrays[section.name] = array
        offset = -(-(offset + array.nbytes) // ALIGNMENT) * ALIGNMENT
    return arrays


def _array(frame: bytes, offset: int, element: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """The elements that begin `offset` bytes into the payload."""
    count = math.prod(shape)
    if count == 0:
        return np.empty(shape, element)
    if HEADER.itemsize + offset + count * element.itemsize > len(frame):
        raise FrameError(
            f"a frame of {len(frame)} bytes does not hold {shape} elements at byte {offset} of its payload"
        )
    return np.frombuffer(frame, element, count=count, offset=HEADER.itemsize + offset).reshape(shape)
