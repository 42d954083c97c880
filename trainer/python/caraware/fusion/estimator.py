"""The learned estimator: its own previous estimate by dead reckoning, pulled by fixes and by the map as a network says.

    e⁻ = e + step
    e  = e⁻ + R(ψ) [g · pull + r · (pull of lanes) + m · (way to the lane) + n · (way to the lane of this heading) + a]

A GRU sees what is known, in the vehicle's frame, and gives the gains g, r, m, n and the free correction a. Its last
layer starts at zero, which means g = r = 1, m = n = a = 0: the Kalman filter, with its map. So training starts there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from caraware.baselines.lanes import ENDS, LaneMap, Match, Pieces
from caraware.fusion.carrier import Carried

NEAR_M_PER_RAD, TURNING_M_PER_RAD = 4.0, 25.0
"""How much a difference in heading counts against distance: for the next lane, and for the place in a bend that has
this heading."""
NOSE_M = 3.7
"""From the rear axle to the front of a car: the point that drivers keep on the lane."""
END_SCALE = torch.tensor([0.1, 0.1, 1.0, 1.0, 1.0, 1.0])
"""Of the columns of a lane's end: speeds of 10 m/s, and shares."""
FREE_M = 0.5
"""The unit of the free correction."""
GAINS = 10
"""Outputs: g, m, n, a and r, each along and across."""
TO_END_M = (0.0, 1.0, 2.0, 3.5, 5.0, 7.0, 9.0, 12.0, 16.0, 22.0, 30.0)
FROM_START_M = (0.0, 2.0, 5.0, 9.0, 14.0, 20.0)
"""Ways to the end of a lane and from its start, nose of the vehicle: the network sees which of them is near. Vehicles
stop in front of a junction's edge and behind each other there, brake towards it, and speed up behind it."""
SLOW_MPS = (0.2, 1.0, 4.0)
"""Speeds at which a network is to see a difference: standing, creeping, turning."""
OWN, GIVEN, LANE = 6, 15 + len(SLOW_MPS), 6
"""Inputs that depend on the own estimate, that do not, and of each of the four lanes looked up."""
PLACE = len(TO_END_M) + len(FROM_START_M) + ENDS
"""Inputs of the place on each of the two lanes at the nose, and of their ends."""
INPUTS = OWN + GIVEN + 4 * LANE + 2 * PLACE


@dataclass(frozen=True)
class State:
    """What the estimator remembers of `n` slots."""

    offset_m: Tensor
    """f32 `[n, 2]`: its estimate less the Kalman filter's, which keeps its precision however large the map is."""
    hidden: Tensor
    """f32 `[n, h]`."""

    def detached(self) -> "State":
        """The same without a past to differentiate."""
        return State(self.offset_m.detach(), self.hidden.detach())


@dataclass(frozen=True)
class Prepared:
    """What does not depend on the own estimate, in the vehicle's frame; f32 `[..., n, k]`."""

    given: Tensor
    cos: Tensor
    sin: Tensor
    yaw_rad: Tensor
    """`[..., n]`."""
    pull_m: Tensor
    lane_m: Tensor
    gain: Tensor
    innovation_m: Tensor
    has_innovation: Tensor
    predicted_m: Tensor
    """World: the filter's estimate before fix and lanes, with the map's centre added."""
    goes_on: Tensor

    def at(self, t: int) -> "Prepared":
        """One tick of several."""
        return Prepared(**{name: column[t] for name, column in vars(self).items()})


class FusionNetwork(nn.Module):
    """Inputs in the vehicle's frame, a GRU, gains."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.entry = nn.Linear(INPUTS, hidden)
        self.memory = nn.GRUCell(hidden, hidden)
        self.exit = nn.Linear(hidden, hidden)
        self.gains = nn.Linear(2 * hidden, GAINS)
        nn.init.zeros_(self.gains.weight)
        nn.init.zeros_(self.gains.bias)

    def forward(self, inputs: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Gains `[n, GAINS]` before their ranges, and the next hidden state, from inputs `[n, INPUTS]`."""
        entry = functional.silu(self.entry(inputs))
        hidden = self.memory(entry, hidden)
        leaving = functional.silu(self.exit(hidden) + entry)
        return self.gains(torch.cat((leaving, hidden), 1)), hidden


class FusionEstimator:
    """Network, map and one step in time."""

    def __init__(self, network: FusionNetwork, pieces: Pieces, centre_m: tuple[float, float]) -> None:
        self.network = network
        self.centre_m = torch.tensor(centre_m, dtype=torch.float32)
        self._lanes = LaneMap(pieces, (NEAR_M_PER_RAD, NEAR_M_PER_RAD, TURNING_M_PER_RAD, TURNING_M_PER_RAD))
        self._ahead_m = torch.tensor([0.0, NOSE_M, 0.0, NOSE_M])[:, None]
        self._to_end, self._from_start = _Near(TO_END_M), _Near(FROM_START_M)

    def begin(self, slots: int) -> State:
        """Nothing known."""
        weight = self.network.memory.weight_hh
        return State(weight.new_zeros(slots, 2), weight.new_zeros(slots, weight.shape[1]))

    def unroll(self, table: Tensor, state: State) -> tuple[Tensor, State]:
        """Offsets `[T, n, 2]` (m, world) from the filter's estimates through the ticks of `table` `[T, n, COLUMNS]`."""
        prepared, offsets = self.prepare(Carried.of(table)), []
        for t in range(len(table)):
            state = self.step(prepared.at(t), state)
            offsets.append(state.offset_m)
        return torch.stack(offsets), state

    def prepare(self, c: Carried) -> Prepared:
        """Everything that can be said before the own estimate is known, for any number of ticks at once."""
        cos, sin = c.yaw_rad.cos(), c.yaw_rad.sin()
        given = torch.cat(
            (
                c.gain * 5.0,
                _body(c.lane_m, cos, sin),
                _log_spreads(c.spread_m2, cos, sin),
                c.speed_mps / 10.0,
                c.yaw_rate_radps / 0.3,
                c.accel_mps2 / 3.0,
                torch.log1p(c.fix_age_s.clamp(0.0, 100.0)),
                torch.log1p(c.since_start_s) / 3.0,
                c.has_fix,
                c.has_imu,
                c.has_wheel,
                c.begins,
                *(torch.exp(-c.speed_mps / slow_mps) for slow_mps in SLOW_MPS),
            ),
            -1,
        )
        return Prepared(
            given=given,
            cos=cos,
            sin=sin,
            yaw_rad=c.yaw_rad[..., 0],
            pull_m=_body(c.pull_m, cos, sin),
            lane_m=_body(c.lane_m, cos, sin),
            gain=c.gain,
            innovation_m=_body(c.innovation_m, cos, sin),
            has_innovation=(c.innovation_m != 0).any(-1, keepdim=True).to(c.gain.dtype),
            predicted_m=c.filter_m - c.pull_m - c.lane_m + self.centre_m,
            goes_on=1.0 - c.begins,
        )

    def step(self, p: Prepared, state: State) -> State:
        """One tick of `n` slots; the estimate is the filter's and `offset_m`."""
        before_m = state.offset_m * p.goes_on
        before = _body(before_m, p.cos, p.sin)
        with torch.no_grad():
            inputs, near, turning = self._look(p, before_m.detach(), before.detach())
        raw, hidden = self.network(inputs, state.hidden * p.goes_on)
        # What the fix moved the filter by, it would move the own estimate by less the gain on their difference.
        pull = p.pull_m - p.gain * before
        g, r, lane = 2.0 * torch.sigmoid(raw[:, 0:2]), 2.0 * torch.sigmoid(raw[:, 8:10]), torch.tanh(raw[:, 2:6])
        moved = g * pull - p.pull_m + (r - 1.0) * p.lane_m
        moved = moved + lane[:, :2] * near + lane[:, 2:] * turning + FREE_M * raw[:, 6:8]
        return State(before_m + _world(moved, p.cos, p.sin), hidden)

    def _look(self, p: Prepared, offset_m: Tensor, offset: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What the network sees `[n, INPUTS]`, and the ways from the nose to two lanes `[n, 2]`, along and across."""
        place_m = p.predicted_m + offset_m
        x_m = place_m[:, 0] + self._ahead_m * p.cos[:, 0]
        y_m = place_m[:, 1] + self._ahead_m * p.sin[:, 0]
        match = self._lanes.match(x_m, y_m, p.yaw_rad.expand_as(x_m))
        own = torch.cat(
            (
                offset / 4.0,
                (p.pull_m - p.gain * offset) / 0.5,
                (p.innovation_m - p.has_innovation * offset) / 8.0,
            ),
            1,
        )
        inputs = (
            torch.cat((own, p.given, _seen(match), self._places(match)), 1)
            .nan_to_num_(0.0, 0.0, 0.0)
            .clamp_(-10.0, 10.0)
        )
        ways = torch.stack((match.ahead_m, match.left_m), -1)
        return inputs, ways[1], ways[3]

    def _places(self, match: Match) -> Tensor:
        """Where on its lane the nose is by both measures, and what is at the end `[n, 2 * PLACE]`."""
        found = match.found[1::2, :, None]
        seen = torch.cat(
            (
                self._to_end(match.to_end_m[1::2]) * found,
                self._from_start(match.from_start_m[1::2]) * found,
                match.end[1::2] * END_SCALE,
            ),
            -1,
        )
        return seen.transpose(0, 1).flatten(1)


class _Near:
    """How near a way is to each of some ways: bells, the wider the longer the way."""

    def __init__(self, middles_m: Sequence[float]) -> None:
        self._middles_m = torch.tensor(middles_m)
        self._widths_m = (0.35 * (self._middles_m + 1.0)).clamp(0.6, 4.0)

    def __call__(self, way_m: Tensor) -> Tensor:
        """`[..., k]` from 0 to 1."""
        return torch.exp(-(((way_m[..., None] - self._middles_m) / self._widths_m) ** 2))


def distance_loss(error_m: Tensor, valid: Tensor) -> Tensor:
    """Mean distance (m) over the valid of `[..., 2]` errors, smooth within a few centimetres of 0."""
    distance = torch.sqrt(error_m.square().sum(-1) + 0.03**2)
    return (distance * valid).sum() / valid.sum().clamp_min(1)


def _body(world: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """World vectors `[..., 2]` as along and across (left) the heading."""
    x, y = world[..., :1], world[..., 1:]
    return torch.cat((x * cos + y * sin, y * cos - x * sin), -1)


def _world(body: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    along, left = body[..., :1], body[..., 1:]
    return torch.cat((along * cos - left * sin, along * sin + left * cos), -1)


def _log_spreads(spread_m2: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Logarithm of the filter's standard deviations along and across `[..., 2]`, halved: 0 at 1 m."""
    ee, en, nn_ = spread_m2.split(1, -1)
    along = ee * cos**2 + 2 * en * cos * sin + nn_ * sin**2
    left = ee * sin**2 - 2 * en * cos * sin + nn_ * cos**2
    return torch.cat((along, left), -1).clamp_min(1e-6).log() / 4.0


def _seen(match: Match) -> Tensor:
    """What a network sees of the lanes of four questions `[n, 4 * LANE]`."""
    columns = (
        match.ahead_m / 3.0,
        match.left_m / 3.0,
        match.turned_rad / 0.5,
        torch.exp(-match.to_end_m / 10.0) * match.found,
        match.speed_limit_mps / 15.0,
        match.found,
    )
    return torch.stack(columns, -1).transpose(0, 1).flatten(1)
