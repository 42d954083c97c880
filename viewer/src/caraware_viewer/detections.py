"""Detections of radars in the world, coloured by their radial velocities."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from caraware_viewer import wire
from caraware_viewer.cloud import level_from_sensor

FULL_COLOR_MPS = 10.0
"""Radial velocity at which a colour is full."""
APPROACHING = (70, 150, 255)
STILL = (235, 235, 235)
RECEDING = (255, 80, 60)


def in_world_m(seen: wire.RadarDetections) -> NDArray[np.float32]:
    """World positions `[n, 3]` of detections."""
    rows = seen.detections
    distance_m, azimuth, elevation = (
        rows[name].astype(np.float64) for name in ("distance_m", "azimuth_rad", "elevation_rad")
    )
    ahead = np.cos(elevation)
    forward = np.column_stack([ahead * np.cos(azimuth), ahead * np.sin(azimuth), np.sin(elevation)])
    roll, pitch, yaw = (float(angle) for angle in seen.scan["attitude_rad"])
    level = forward * distance_m[:, None] @ level_from_sensor(roll, pitch).T
    cos, sin = np.cos(yaw), np.sin(yaw)
    turned = level @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    world_m: NDArray[np.float64] = turned + seen.scan["position_m"]
    return world_m.astype(np.float32)


def colors(radial_velocity_mps: NDArray[np.floating]) -> NDArray[np.uint32]:
    """Colours `[n]`, RGBA, of radial velocities as measured: blue towards the radar, white at rest, red away."""
    share = np.clip(np.nan_to_num(radial_velocity_mps / FULL_COLOR_MPS), -1.0, 1.0)[:, None]
    full = np.where(share > 0, np.array(APPROACHING), np.array(RECEDING))
    mixed = np.round(np.array(STILL) + np.abs(share) * (full - np.array(STILL))).astype(np.uint32)
    rgba: NDArray[np.uint32] = mixed[:, 0] << 24 | mixed[:, 1] << 16 | mixed[:, 2] << 8 | 0xFF
    return rgba.astype(np.uint32)
