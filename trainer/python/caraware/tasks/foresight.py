"""When a hero will touch somebody if all move on as they do, for rewards of driving (docs/driving.md).

The hero keeps its speed and yaw rate, vehicles keep their velocity, persons theirs across the route. Bodies are rows of
circles, as in Ziegler and Stiller, "Fast collision checking for intelligent vehicle motion planning", 2010.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from caraware.tasks.fields import Fields

HORIZON_S = 2.5
"""Later contacts are not foreseen."""
TIMES = 10
"""Times within the horizon at which bodies are looked at."""
HERO_M, HERO_WIDTH_M, HERO_MIDDLE_M = 4.6, 1.85, 1.3
"""A passenger car: length, width, and its middle before the rear axle. A row does not tell those of its hero."""
CIRCLES = 5
"""Of a body, along it."""
STRAIGHT_RADPS = 1e-3
"""A hero that turns slower than this drives straight on."""
PERSON_M = 0.5
"""Room of a person to each side, metres."""
USERS, PERSONS = 8, 2
GAP_S, NEAR_S = 1.2, 4.0
"""A gap from here on is long enough, and an encounter from here on is too far ahead to count."""
STARTS_MPS, STARTS_MPS2 = 4.0, 2.0
"""Below this speed a hero counts as one that accelerates by this."""
OTHER_STARTS_MPS, OTHER_STARTS_MPS2, STANDS_MPS = 5.0, 1.5, 0.3
"""The same of others, unless they are slower than the last: those stand."""
CLEARS_M, CLEARS_MPS = 6.5, 3.0
"""A hero has left the way of another this far on, and gets there at this speed at least."""
NEVER_S, ON_THE_WAY_S, NOWHERE_M = 9.9, 0.2, 49.0
"""Of `user_N_enters`: from the first on there is no encounter, below the second the other is at its place already; and
from the third on, of `user_N_way`, there is none."""


@dataclass(frozen=True)
class Around:
    """Rows of the preset "driver" with what moves in them."""

    fields: Fields
    observation: Tensor
    """f32 `[n, d]`."""
    speed_mps: Tensor
    """f64 `[n]`: of the hero."""
    yaw_rate_radps: Tensor
    """f64 `[n]`: of the hero, to the left."""

    def contact_s(self) -> Tensor:
        """f64 `[n]`: seconds until the first contact; infinite beyond `HORIZON_S`, and for what rows do not show."""
        return torch.minimum(self._vehicle_s(), self._person_s())

    def short_gap(self) -> Tensor:
        """f64 `[n]`, 0 to 1: how much too short the gap is in which the hero meets others, and how near that is.

        1: both are there now, at the same time. 0: the one has left the place `GAP_S` before the other comes, or the
        hero comes there in `NEAR_S` or later, or rows do not show it. What stands on the hero's way is no encounter.
        """
        users = self._members("user", USERS, ("reaches", "enters", "leaves", "way", "forward", "left"))
        if users is None:
            return torch.zeros_like(self.speed_mps)
        reaches, enters, leaves, way, forward, left = users.double().unbind(2)
        speed, other = self.speed_mps[:, None], torch.hypot(forward, left)
        starts = (-speed + (speed.square() + 2 * STARTS_MPS2 * way).sqrt()) / STARTS_MPS2
        reaches = torch.where(speed < STARTS_MPS, torch.minimum(reaches, starts), reaches)
        clears = reaches + CLEARS_M / speed.clamp_min(CLEARS_MPS)
        sooner = (-other + (other.square() + 2 * OTHER_STARTS_MPS2 * enters * other).sqrt()) / OTHER_STARTS_MPS2
        comes = torch.where((other > STANDS_MPS) & (other < OTHER_STARTS_MPS), sooner, enters)
        gap = torch.maximum(comes - clears, reaches - leaves).clamp_min(0)
        meets = (way < NOWHERE_M) & (enters > ON_THE_WAY_S) & (enters < NEVER_S)
        short = (1 - gap / GAP_S).clamp_min(0) * (1 - reaches / NEAR_S).clamp_min(0)
        return (short * meets).amax(1)

    def _members(self, group: str, members: int, columns: tuple[str, ...]) -> Tensor | None:
        """f32 `[n, members, columns]` in SI units, or None without them."""
        names = [f"{group}_{number}_{column}" for number in range(1, members + 1) for column in columns]
        if not all(map(self.fields.has, names)):
            return None
        values = [self.fields.si_tensor(self.observation, name).float() for name in names]
        return torch.stack(values, 1).view(-1, members, len(columns))

    def _never(self) -> Tensor:
        return torch.full_like(self.speed_mps, torch.inf)

    def _vehicle_s(self) -> Tensor:
        users = self._members("user", USERS, ("x", "y", "cos", "sin", "forward", "left", "length", "width"))
        if users is None:
            return self._never()
        x, y, cos, sin, forward, left, length, width = (users[..., column, None] for column in range(8))
        times = torch.linspace(HORIZON_S / TIMES, HORIZON_S, TIMES, device=users.device)
        hero_x, hero_y, turned = self._hero_at(times)
        along = torch.linspace(-1, 1, CIRCLES, device=users.device)
        # Middles of circles, [n, times, circles] of the hero and [n, users, times, circles] of the others.
        own = HERO_MIDDLE_M + along * (HERO_M - HERO_WIDTH_M) / 2
        own_x, own_y = (
            hero_x[..., None] + own * turned.cos()[..., None],
            hero_y[..., None] + own * turned.sin()[..., None],
        )
        reach = (along * (length - width).clamp_min(0) / 2)[:, :, None, :]
        other_x = (x + times * forward)[..., None] + reach * cos[..., None]
        other_y = (y + times * left)[..., None] + reach * sin[..., None]
        apart_x = other_x.unsqueeze(-1) - own_x[:, None, :, None, :]
        apart_y = other_y.unsqueeze(-1) - own_y[:, None, :, None, :]
        nearest = (apart_x.square() + apart_y.square()).flatten(-2).amin(-1)
        touches = (nearest < ((width + HERO_WIDTH_M) / 2).square()) & (length > 0)
        return torch.where(touches.any(1), times, torch.inf).amin(1).double()

    def _hero_at(self, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Its rear axle and heading `[n, times]`, in its frame of now."""
        speed, rate = self.speed_mps.float()[:, None], self.yaw_rate_radps.float()[:, None]
        turned = rate * times
        is_straight = rate.abs() < STRAIGHT_RADPS
        radius = speed / torch.where(is_straight, 1.0, rate)
        x = torch.where(is_straight, speed * times, radius * turned.sin())
        y = torch.where(is_straight, 0.0, radius * (1 - turned.cos()))
        return x, y, turned

    def _person_s(self) -> Tensor:
        persons = self._members("person", PERSONS, ("ahead", "left", "speed"))
        if persons is None:
            return self._never()
        ahead_m, left_m, speed_mps = persons.unbind(2)
        reached_s = ahead_m / self.speed_mps.float()[:, None].clamp_min(0.01)
        beside_m = left_m + speed_mps * reached_s
        touches = (beside_m.abs() < HERO_WIDTH_M / 2 + PERSON_M) & (reached_s < HORIZON_S)
        return torch.where(touches, reached_s, torch.inf).amin(1).double()
