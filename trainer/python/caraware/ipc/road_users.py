"""States and boxes of all road users at a tick, connected or not, as `sim-core` has moved them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caraware import _native
from caraware.ipc.arrays import Float64Array
from caraware.ipc.layout import record

VEHICLE_STATE = record("VehicleState")
"""`VehicleState`: pose of the rear axle's centre on the ground (m, rad; world), velocity, acceleration and angular rate
(body frame), the size of the box (m), `vehicle`, `id_hash` and `kind`."""


@dataclass(frozen=True)
class RoadUserStates:
    """All road users at a tick; a copy, valid for ever. For labels, rewards and errors: no policy of a car sees it."""

    tick: int
    sim_time_ns: int
    states: NDArray[np.void]
    """`VEHICLE_STATE [count]`, read-only: road users by ascending `vehicle`, which is that of the observation, and
    behind them the trailing bodies of articulated vehicles, whose `kind` is 4."""

    @classmethod
    def of(cls, native: _native.SightMessage) -> RoadUserStates:
        """From a message."""
        (state_bytes,) = native.sections
        return cls(native.tick, native.sim_time_ns, np.frombuffer(state_bytes, VEHICLE_STATE))

    @property
    def boxes_m(self) -> Float64Array:
        """f64 [count, 7]: middle of each box (x, y, z; m, world), length, width, height (m) and yaw (rad, world).

        The boxes stand upright, as LIDARs and cameras see them.
        """
        states = self.states
        ahead_m = states["length_m"].astype(np.float64) / 2 - states["rear_overhang_m"]
        columns = (
            states["x_m"] + ahead_m * np.cos(states["yaw_rad"]),
            states["y_m"] + ahead_m * np.sin(states["yaw_rad"]),
            states["z_m"] + states["height_m"].astype(np.float64) / 2,
            *(states[name] for name in ("length_m", "width_m", "height_m", "yaw_rad")),
        )
        return np.stack([column.astype(np.float64) for column in columns], 1)
