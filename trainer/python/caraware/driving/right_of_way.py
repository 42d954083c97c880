"""Braking by rule where a hero has to give way or is about to be driven into: what a policy is corrected by.

From the fields of `observation.fields = "driver"` alone. A hero without right of way that would meet another vehicle in
a junction stops at its line, or before the place where they would meet. One with right of way brakes for what cannot
stop any more. Everything else is left to the policy: `caraware.driving.dagger` teaches it both.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from caraware.ipc.run_file import RunFile, setting
from caraware.tasks.fields import Fields, UnknownFieldError
from caraware.tasks.foresight import NEVER_S, NOWHERE_M, ON_THE_WAY_S, STANDS_MPS, USERS

LOOKS_M, JUNCTION_M = 45.0, 35.0
"""A stop line that is farther away is not looked at, nor an encounter that far behind the line."""
HERO_MPS2, HERO_MPS = 2.0, 9.0
"""How a hero may accelerate until it is there, up to this speed."""
OTHER_MPS2, OTHER_MPS = 1.5, 6.0
"""How another may, if it is slower than this."""
CLEARS_M = 7.6
"""From the hero's front to behind its rear, and room."""
GAP_BEFORE_S, GAP_AFTER_S = 1.0, 0.5
"""Room in time before another that comes, and after one that has passed."""
LINE_ROOM_M, PLACE_ROOM_M, COMMITTED_M = 0.7, 1.5, 2.0
"""Where to stop before a line and before an encounter; inside a junction, nearer encounters are driven through."""
LINE_MPS2, PLACE_MPS2, COMFORTABLE_MPS2 = 6.0, 8.0, 1.75
"""Hardest braking for a line and for an encounter; what needs less can wait."""
STOPS_MPS2, STOPS_ROOM_M = 4.0, 1.0
"""Another that would have to brake harder than this does not stop any more."""
DEFENDS_S, DEFENDS_FROM_MPS2, DEFENDS_TO_MPS2 = 3.0, 2.0, 12.0
"""When a hero brakes for it, and how hard at least and at most."""

_USER = ("x", "cos", "forward", "left", "way", "enters", "leaves")
_OWN = ("speed", "junction_1_gap", "junction_1_priority")


@dataclass(frozen=True)
class RightOfWay:
    """Corrects actions of heroes. Raises `UnknownFieldError` for other observations than the preset "driver"."""

    fields: Fields
    max_decel_mps2: float
    """What an acceleration of −1 is."""

    @classmethod
    def from_run(cls, run: RunFile) -> "RightOfWay":
        """Read the fields of the observation and the limits of the vehicle. Raises `ConfigError`."""
        return cls(Fields.from_run(run), setting(run, "vehicle.max_decel_mps2", float))

    def corrected(self, observation: Tensor, action: Tensor) -> Tensor:
        """Actions f32 `[n, 2]` for rows `[n, d]`: steering as it is, and no more acceleration than the rule allows."""
        seen = _Seen.of(self.fields, observation)
        most = torch.minimum(seen.giving_way(self.max_decel_mps2), seen.defending(self.max_decel_mps2))
        return torch.stack([action[:, 0], torch.minimum(action[:, 1], most.to(action.dtype))], 1)


@dataclass(frozen=True)
class _Seen:
    """What heroes see: each tensor f64 `[n, users]`, or `[n, 1]` of the hero itself."""

    speed_mps: Tensor
    line_m: Tensor
    has_priority: Tensor
    way_m: Tensor
    enters_s: Tensor
    leaves_s: Tensor
    other_mps: Tensor
    is_behind: Tensor

    @classmethod
    def of(cls, fields: Fields, observation: Tensor) -> "_Seen":
        names = [f"user_{number}_{column}" for column in _USER for number in range(1, USERS + 1)]
        missing = [name for name in [*names, *_OWN] if not fields.has(name)]
        if missing:
            raise UnknownFieldError(f'no field {missing[0]!r}: set observation.fields = "driver"')
        columns = fields.si_columns(observation, [*names, *_OWN])
        x, cos, forward, left, way, enters, leaves = columns[:, : len(names)].view(-1, len(_USER), USERS).unbind(1)
        speed, line, priority = columns[:, len(names) :, None].unbind(1)
        return cls(
            speed_mps=speed.clamp_min(0),
            line_m=line,
            has_priority=priority > 0.5,
            way_m=way,
            enters_s=enters,
            leaves_s=leaves,
            other_mps=torch.hypot(forward, left),
            is_behind=(x < 0) & (cos > 0.5),
        )

    def _meets(self) -> Tensor:
        """bool: it comes across the hero's way, and is neither there yet nor a follower."""
        comes = (self.enters_s > ON_THE_WAY_S) & (self.enters_s < NEVER_S) & (self.other_mps > STANDS_MPS)
        return comes & (self.way_m < NOWHERE_M) & ~self.is_behind

    def _soonest_s(self) -> Tensor:
        """When the hero is there, if it accelerates or keeps its speed."""
        keeps = self.way_m / self.speed_mps.clamp_min(0.1)
        return torch.minimum(arrives_s(self.way_m, self.speed_mps, HERO_MPS2), keeps)

    def _clears_s(self) -> Tensor:
        return arrives_s(self.way_m + CLEARS_M, self.speed_mps, HERO_MPS2)

    def giving_way(self, max_decel_mps2: float) -> Tensor:
        """f64 `[n]`: the most acceleration, −1 to 1, of a hero that has to give way; 1 where it has not."""
        other_m = self.enters_s * self.other_mps
        starts_s = arrives_s(other_m, self.other_mps, OTHER_MPS2)
        comes_s = torch.where(self.other_mps < OTHER_MPS, starts_s, self.enters_s)
        is_short = (comes_s < self._clears_s() + GAP_BEFORE_S) & (self.leaves_s > self._soonest_s() - GAP_AFTER_S)
        is_beyond = (self.way_m >= self.line_m - 1.0) & (self.way_m < self.line_m + JUNCTION_M)
        is_open = (self.line_m > 0) | (self.way_m > COMMITTED_M)
        conflict = self._meets() & is_short & is_beyond & is_open
        # Where to stop: at the line if that is still possible, else before the first encounter.
        speed, line = self.speed_mps[:, 0], self.line_m[:, 0]
        line_stop = line - LINE_ROOM_M
        place_stop = _least(self.way_m - PLACE_ROOM_M, conflict)
        at_line = (line > 0) & (_braking(speed, line_stop) < LINE_MPS2)
        at_place = (place_stop > 0.05) & (_braking(speed, place_stop) < PLACE_MPS2)
        stop_m = torch.where(at_line, line_stop, place_stop).clamp_min(0.05)
        brakes = conflict.any(1) & (line < LOOKS_M) & ~self.has_priority[:, 0] & (at_line | at_place)
        needs = _braking(speed, stop_m)
        decel = torch.where(stop_m < 0.8, (1.1 * needs).clamp_min(3.0), 1.1 * needs)
        coasts = torch.where(speed < 3.0, 0.1, 0.0)
        most = torch.where(needs > COMFORTABLE_MPS2, -(decel / max_decel_mps2).clamp(0, 1), coasts)
        most = torch.where(stop_m < 0.4, -0.4, most)
        return torch.where(brakes, most, 1.0)

    def defending(self, max_decel_mps2: float) -> Tensor:
        """f64 `[n]`: the same of a hero, with or without right of way, that another is about to drive into."""
        other_m = self.enters_s * self.other_mps
        cannot_stop = other_m < self.other_mps.square() / (2 * STOPS_MPS2) + STOPS_ROOM_M
        soonest_s = self._soonest_s()
        at_once = (self.enters_s < self._clears_s() + 0.3) & (self.leaves_s > soonest_s - 0.2)
        hits = self._meets() & cannot_stop & at_once & (self.way_m > 0.5) & (soonest_s < DEFENDS_S)
        needs = _braking(self.speed_mps[:, 0], _least(self.way_m - 1.0, hits).clamp_min(0.3))
        brakes = hits.any(1) & (needs > DEFENDS_FROM_MPS2) & (needs < DEFENDS_TO_MPS2)
        return torch.where(brakes, -(1.1 * needs / max_decel_mps2).clamp(0, 1), 1.0)


def arrives_s(way_m: Tensor, speed_mps: Tensor, accel_mps2: float) -> Tensor:
    """Seconds for a way from a speed on, with this acceleration up to `HERO_MPS`; a faster one keeps its speed."""
    top_mps = speed_mps.clamp_min(HERO_MPS)
    ends_s = (top_mps - speed_mps) / accel_mps2
    ends_m = (top_mps + speed_mps) / 2 * ends_s
    within_s = (-speed_mps + (speed_mps.square() + 2 * accel_mps2 * way_m.clamp_min(0)).sqrt()) / accel_mps2
    return torch.where(way_m <= ends_m, within_s, ends_s + (way_m - ends_m) / top_mps)


def _braking(speed_mps: Tensor, stop_m: Tensor) -> Tensor:
    """Deceleration that stops within a distance of 5 cm at least."""
    return speed_mps.square() / (2 * stop_m.clamp_min(0.05))


def _least(values: Tensor, where: Tensor) -> Tensor:
    """f64 `[n]`: the least of `[n, users]` where it holds, else far away."""
    return torch.where(where, values, 99.0).amin(1)
