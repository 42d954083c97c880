"""Points of a LIDAR in the world. Each was fired before the end of its tick, from where the sensor was then."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

PAPER_AXES = 1
"""Value of `Scan.axes`: y backward, x left, z down."""

INTEREST = (4, 5, 6, 12)
"""Tags of points on vehicles, two-wheelers, pedestrians and lost loads, which `--lidar interest` shows."""

TAG_COLORS = np.array(
    [
        0x5A5F6BFF,  # ground
        0x9A8C7AFF,  # building
        0x8A8578FF,  # wall
        0x8A8578FF,  # structure
        0x4FC3FFFF,  # vehicle
        0x7FE3D0FF,  # two-wheeler
        0xFFC04EFF,  # person
        0xFF7F50FF,  # barrier
        0xB58AFFFF,  # furniture
        0xC8C8C8FF,  # pole
        0x5FBF6AFF,  # vegetation
        0x7F9FBFFF,  # parked vehicle
        0xFF5A5AFF,  # load
        0x9A8C7AFF,  # mesh
        0xFFFFFFFF,  # a tag of a later version
    ],
    dtype=np.uint32,
)
"""RGBA by `LidarPoint.tag`."""


def points_of_interest(points: NDArray[np.void]) -> NDArray[np.void]:
    """The points on vehicles, two-wheelers, pedestrians and lost loads."""
    chosen: NDArray[np.void] = points[np.isin(points["tag"], INTEREST)]
    return chosen


def colors(points: NDArray[np.void]) -> NDArray[np.uint32]:
    """Colours of points by their tags, RGBA `[n]`."""
    by_tag: NDArray[np.uint32] = TAG_COLORS[np.minimum(points["tag"], len(TAG_COLORS) - 1)]
    return by_tag


def in_world_m(
    scan: np.void, points: NDArray[np.void], velocity_mps: NDArray[np.floating], yaw_rate_radps: float
) -> NDArray[np.float32]:
    """World positions `[n, 3]` of points. The sensor moved with `velocity_mps` (world) and turned meanwhile."""
    # Into the axes x forward, y left, z up.
    age_s = points["age_us"].astype(np.float64) * 1e-6
    forward = points["position_m"].astype(np.float64)
    if scan["axes"] == PAPER_AXES:
        forward = np.column_stack([-forward[:, 1], forward[:, 0], -forward[:, 2]])
    # Level them by the attitude of the sensor.
    roll, pitch, yaw = (float(angle) for angle in scan["attitude_rad"])
    level = forward @ level_from_sensor(roll, pitch).T
    # Turn and move each to where the sensor was when it fired.
    heading = yaw - yaw_rate_radps * age_s
    cos, sin = np.cos(heading), np.sin(heading)
    turned = np.column_stack(
        [cos * level[:, 0] - sin * level[:, 1], sin * level[:, 0] + cos * level[:, 1], level[:, 2]]
    )
    moved = scan["position_m"] - age_s[:, None] * np.asarray(velocity_mps, np.float64)
    world_m: NDArray[np.float64] = turned + moved
    return world_m.astype(np.float32)


def level_from_sensor(roll_rad: float, pitch_rad: float) -> NDArray[np.float64]:
    """The rotation `[3, 3]` that levels what a sensor saw that leaned by these angles (pitch positive nose up)."""
    return _pitched(pitch_rad) @ _rolled(roll_rad)


def _rolled(roll_rad: float) -> NDArray[np.float64]:
    """Vehicle from rolled axes: positive to the right side down."""
    cos, sin = np.cos(roll_rad), np.sin(roll_rad)
    return np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])


def _pitched(pitch_rad: float) -> NDArray[np.float64]:
    """Vehicle from pitched axes: positive nose up."""
    cos, sin = np.cos(pitch_rad), np.sin(pitch_rad)
    return np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])
