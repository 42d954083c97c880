"""LIDAR scans: points in the sensor's axes, the pose of the sensor, and the way from one to the other."""

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from caraware import _native
from caraware.ipc.arrays import Float64Array
from caraware.ipc.layout import record
from caraware.ipc.mounts import MountedSensor, SensorNames

POINT = record("LidarPoint")
"""`LidarPoint`: position in the sensor's axes at the time the point was fired (m), intensity 0 ... 1, object, cosine of
the incidence angle, tag, channel (0 is the lowest), age at the end of the tick (µs)."""

SCAN = record("Scan")
"""`Scan`: the sensor at the end of the tick in the world (m; roll, pitch, heading in rad), and how it was set up."""

STATIC_OBJECT = 1 << 31
"""Bit of `object`: a building, prop or mesh; the rest is its number."""
GROUND = 0xFFFF_FFFF
"""`object` of a point on the ground."""


class Tag(IntEnum):
    """What a point lies on."""

    GROUND = 0
    BUILDING = 1
    WALL = 2
    STRUCTURE = 3
    VEHICLE = 4
    TWO_WHEELER = 5
    PERSON = 6
    BARRIER = 7
    FURNITURE = 8
    POLE = 9
    VEGETATION = 10
    PARKED_VEHICLE = 11
    LOAD = 12
    MESH = 13


@dataclass(frozen=True)
class PointCloud:
    """What one LIDAR has seen during a tick; a copy, valid for ever."""

    tick: int
    sim_time_ns: int
    vehicle: int
    """Dense index of the vehicle within its episode, as in `Observation.vehicle`; beside the road `mounts.ROADSIDE` and
    a number."""
    mounted: MountedSensor
    """The carrier and the sensor, by name."""
    scan: np.void
    """`SCAN`."""
    points: NDArray[np.void]
    """`POINT [count]`, read-only."""

    @classmethod
    def of(cls, native: _native.PointCloud, names: SensorNames) -> "PointCloud":
        """From a message."""
        scan = np.frombuffer(native.scan, SCAN)[0]
        return cls(
            tick=native.tick,
            sim_time_ns=native.sim_time_ns,
            vehicle=native.vehicle,
            mounted=names.of("lidar", scan),
            scan=scan,
            points=np.frombuffer(native.points, POINT),
        )

    @cached_property
    def world_m(self) -> Float64Array:
        """f64 [count, 3]: the points in the world frame, with the pose of the sensor at the end of the tick.

        With a rolling shutter a point was fired up to a tick earlier, when the sensor was up to `speed * age` behind:
        so far what stands still is drawn out of place, as a LIDAR without motion compensation has it.
        """
        points: Float64Array = self.points["position_m"].astype(np.float64)
        if self.scan["axes"] == 1:  # the paper's: y backward, x left, z down
            points = np.stack((-points[:, 1], points[:, 0], -points[:, 2]), 1)
        world_m: Float64Array = points @ rotation(*self.scan["attitude_rad"]).T + self.scan["position_m"]
        return world_m


def rotation(roll: float, pitch: float, yaw: float) -> Float64Array:
    """World from sensor, f64 [3, 3]: heading counter-clockwise, then pitch with the nose up, then roll to the right."""
    (sr, cr), (sp, cp), (sy, cy) = ((np.sin(angle), np.cos(angle)) for angle in (roll, -pitch, yaw))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
