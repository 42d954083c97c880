"""KITTI's `oxts`: what its GPS/IMU unit writes for a frame, from the true motion of the carrier.

Columns and signs are those of `dataformat.txt` of the raw data's devkit. The unit stands at the origin of the carrier:
the centre of its rear axle on the ground.
"""

from __future__ import annotations

import numpy as np
from pyproj import Proj

from caraware.data.recording import Recording, RecordingError
from caraware.ipc.arrays import Float64Array
from caraware.ipc.pointcloud import rotation

GRAVITY_MPS2 = 9.80665
"""Standard gravity, which the unit's accelerometer measures."""

NO_STATUS = (0.0, 0.0, 4, 0, 0, 0, 0)
"""Accuracies of position and velocity (the truth has no error), `navstat` 4 (initialised), satellites, and modes."""


class Geodesy:
    """Latitude and longitude of places in the world frame of a recording."""

    def __init__(self, recording: Recording) -> None:
        """Raises `RecordingError` for a map whose projection PROJ does not know."""
        self._map = recording.run["map"]
        try:
            self._projection = Proj(str(self._map["projection"]))
        except RuntimeError as error:
            raise RecordingError(f"{recording.path}: the map's projection is unknown: {error}") from error

    def of(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Latitude and longitude (deg) of a place in the world frame."""
        # The offset leads from the projection to the world frame.
        offset_x, offset_y = self._map["net_offset_m"]
        longitude, latitude = self._projection(x_m - offset_x, y_m - offset_y, inverse=True)
        return float(latitude), float(longitude)


def packet(state: np.void, geodesy: Geodesy) -> str:
    """The line of a frame: 30 numbers. North and east are those of the map's grid."""
    latitude, longitude = geodesy.of(float(state["x_m"]), float(state["y_m"]))
    roll, pitch, yaw = (float(state[name]) for name in ("roll_rad", "pitch_rad", "yaw_rad"))
    body = {
        name: state[key].astype(np.float64)
        for name, key in (
            ("velocity", "velocity_body_mps"),
            ("acceleration", "accel_body_mps2"),
            ("rate", "angular_rate_body_radps"),
        )
    }
    world_from_body = rotation(roll, pitch, yaw)
    level_from_body = rotation(0.0, 0.0, yaw).T @ world_from_body
    # An accelerometer at rest shows gravity, upward.
    body["acceleration"] = body["acceleration"] + world_from_body[2] * GRAVITY_MPS2
    east, north, _ = world_from_body @ body["velocity"]
    level: dict[str, Float64Array] = {name: level_from_body @ values for name, values in body.items()}
    numbers = [
        *(latitude, longitude, float(state["z_m"])),
        # Positive with the left side up, with the front down, and counter-clockwise from east.
        *(roll, -pitch, float(np.mod(yaw + np.pi, 2 * np.pi) - np.pi)),
        *(north, east, *level["velocity"]),
        *(*body["acceleration"], *level["acceleration"]),
        *(*body["rate"], *level["rate"]),
    ]
    return " ".join([*(f"{float(value):.14g}" for value in numbers), *(str(value) for value in NO_STATUS)]) + "\n"
