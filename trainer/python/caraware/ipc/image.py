"""Images of cameras: depths, objects, classes, colours, temperatures, optical flow, events, and road users in them."""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caraware import _native
from caraware.ipc.arrays import Float32Array
from caraware.ipc.layout import IMAGE_PLANES, record
from caraware.ipc.mounts import MountedSensor, SensorNames
from caraware.ipc.run_file import RunFile

IMAGE = record("ImageHead")
"""`ImageHead`: the camera in the world at the end of the tick (m; roll, pitch, heading in rad), and its setup."""

SEEN = record("SeenObject")
"""`SeenObject`: a road user of which an image shows a pixel, its visible and its full box (pixels), its depths (m)."""

EVENT = record("BrightnessEvent")
"""`BrightnessEvent`: a pixel became brighter or darker: time since the begin of the tick (µs), column, row, sign."""

SKY = 0xFFFF_FFFE
"""`instance` of a pixel that sees the sky."""


class Label(IntEnum):
    """Class of a pixel: CityScapes' label ids, and from 40 on classes that it counts as road."""

    STATIC = 4
    DYNAMIC = 5
    ROAD = 7
    SIDEWALK = 8
    RAIL_TRACK = 10
    BUILDING = 11
    WALL = 12
    BARRIER = 14
    BRIDGE = 15
    POLE = 17
    VEGETATION = 21
    TERRAIN = 22
    SKY = 23
    PERSON = 24
    CAR = 26
    TRUCK = 27
    BUS = 28
    TRAIN = 31
    MOTORCYCLE = 32
    BICYCLE = 33
    LANE_MARKING = 40
    STOP_LINE = 41
    CROSSING = 42


@dataclass(frozen=True)
class ImageShape:
    """The images in observations (`camera.observed`)."""

    plane: str
    """Name of the plane: "semantic", "rgb" or "binary"."""
    channels: int
    """3 of "rgb", else 1."""
    height: int
    width: int

    @classmethod
    def from_run(cls, run: RunFile) -> "ImageShape | None":
        """Of the observations of a run; None where they hold no images."""
        camera = run["config"].get("camera") or {}
        plane = str(camera.get("observed", "none"))
        if plane == "none" or int(camera["vehicles"]) == 0:
            return None
        shape = next(shape for name, _, _, shape in IMAGE_PLANES if name == plane)
        return cls(plane, math.prod(shape), int(camera["height"]), int(camera["width"]))

    @property
    def size(self) -> tuple[int, int, int]:
        """Channels, height, width."""
        return self.channels, self.height, self.width


@dataclass(frozen=True)
class Image:
    """What one camera has seen at a tick; a copy, valid for ever. A plane that the configuration leaves out is None."""

    tick: int
    sim_time_ns: int
    vehicle: int
    """Dense index of the vehicle within its episode, as in `Observation.vehicle`; beside the road `mounts.ROADSIDE` and
    a number."""
    mounted: MountedSensor
    """The carrier and the sensor, by name."""
    head: np.void
    """`IMAGE`."""
    objects: NDArray[np.void]
    """`SEEN [count]`, read-only: the road users in the image."""
    depth_m: Float32Array | None
    """f32 [height, width]: distance along the optical axis, m; `head["range_m"]` where the camera sees the sky."""
    instance: NDArray[np.uint32] | None
    """u32 [height, width]: dense index of the road user; `STATIC_OBJECT` and a number; `GROUND`; or `SKY`."""
    semantic: NDArray[np.uint8] | None
    """u8 [height, width]: a `Label`."""
    rgb: NDArray[np.uint8] | None
    """u8 [height, width, 3]."""
    binary: NDArray[np.uint8] | None
    """u8 [height, width]: 255 on road users and props of interest, else 0."""
    infrared: NDArray[np.uint16] | None
    """u16 [height, width]: apparent temperature in the thermal infrared, 0.01 K."""
    flow_px: Float32Array | None
    """f32 [height, width, 2]: how far what the pixel shows has moved right and down within `camera.period_s`, pixels;
    not a number where it was not in front of the camera then, and in the first image of an episode."""
    events: NDArray[np.void]
    """`EVENT [count]`, read-only: the events of the tick in the order of time; empty without `camera.events`."""

    @classmethod
    def of(cls, native: _native.SightMessage, names: SensorNames) -> "Image":
        """From a message. Raises ValueError for planes that do not fit the image's size."""
        head_bytes, plane_bytes, object_bytes, event_bytes = native.sections
        head = np.frombuffer(head_bytes, IMAGE)[0]
        planes = split_planes(head, plane_bytes)
        return cls(
            tick=native.tick,
            sim_time_ns=native.sim_time_ns,
            vehicle=int(head["vehicle"]),
            mounted=names.of("camera", head),
            head=head,
            objects=np.frombuffer(object_bytes, SEEN),
            depth_m=planes["depth_m"],
            instance=planes["instance"],
            semantic=planes["semantic"],
            rgb=planes["rgb"],
            binary=planes["binary"],
            infrared=planes["infrared"],
            flow_px=planes["flow_px"],
            events=np.frombuffer(event_bytes, EVENT),
        )


def split_planes(head: np.void, planes: bytes) -> dict[str, NDArray[Any] | None]:
    """The planes of an image by name, each [height, width, ...]; None for those that it lacks."""
    height, width = int(head["height"]), int(head["width"])
    found: dict[str, NDArray[Any] | None] = {}
    at = 0
    for name, bit, scalar, shape in IMAGE_PLANES:
        found[name] = None
        if int(head["planes"]) & bit:
            count = height * width * math.prod(shape)
            plane = np.frombuffer(planes, np.dtype(scalar), count, at)
            found[name] = plane.reshape(height, width, *shape)
            at += plane.nbytes
    return found
