"""The driving task: an action is steering and acceleration of a hero, and the world waits for it (docs/driving.md)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module

import torch
from torch import Tensor

from caraware import _native
from caraware.ipc.arrays import FloatArray
from caraware.ipc.run_file import ConfigError, RunFile, config_table, setting
from caraware.ipc.stream import MeasuredTick
from caraware.tasks import ends
from caraware.tasks.contract import (
    ActionSpec,
    EndKind,
    EndReason,
    OutcomeMissingError,
    Sampling,
    TaskOutcome,
    TaskStep,
)
from caraware.tasks.fields import Fields
from caraware.tasks.foresight import HORIZON_S, Around
from caraware.tasks.metrics import metrics_of

ARRIVED_WITHIN_M = 5.0
"""A hero whose episode ends this near to the end of its route has arrived (docs/driving.md)."""
FAR_M = 999.0
"""Beyond it `route_left` is at the end of its range and does not tell progress."""
END_REWARD = 10.0
"""Of an arrival; any other end of its own costs as much: 100 m of progress."""
FORESEEN_COST = 0.5
"""Of a contact that is about to happen at 10 m/s, in each tick before it."""
WAITING_COST, WAITS_MPS = 0.02, 1.0
"""Of a tick slower than that: as much as 20 cm of progress."""
CAREFUL_END_COST = 15.0
"""Of an end of its own other than an arrival, by `careful_reward`."""
YIELDING_END_COST, YIELDING_COST = 20.0, 0.6
"""The same by `yielding_reward`, and its cost of a contact that is about to happen at 10 m/s."""
PRIORITY_SHARE, PRIORITY_WITHIN_M = 0.7, 10.0
"""Of that cost for a hero with right of way at a junction that is this near."""
RED_COST, RED_BRAKING_MPS2, RED_HARDEST_MPS2 = 0.3, 3.0, 7.0
"""Of a tick before a red light that only the last braking still stops at; none at the first."""
GAP_COST, GAP_WITHIN_M = 0.5, 25.0
"""At most, of a tick in which a hero that has to wait comes to an encounter; at a junction that is this near."""
RED_GREEN = 0.02
"""A light below this is red: yellow ends at 0.05."""


ACTIONS = ActionSpec(
    names=("steering", "acceleration"),
    low=-1.0,
    high=1.0,
    is_clipped=True,
    # Noise that tries out braking leaves the road within seconds if it steers.
    spread=(0.25, 1.0),
)

ENDS = (
    EndReason("collision", EndKind.TERMINATED),
    EndReason("off-road", EndKind.TERMINATED),
    EndReason("red light", EndKind.TERMINATED),
    EndReason("against traffic", EndKind.TERMINATED),
    EndReason("blocked", EndKind.TERMINATED),
    EndReason("arrival", EndKind.TERMINATED),
    EndReason("time limit", EndKind.TRUNCATED),
    EndReason("end of the run's episode", EndKind.TRUNCATED),
)


@dataclass(frozen=True)
class DrivenStep:
    """What heroes did in a tick, for rewards. Each tensor is f64 `[n]` or bool `[n]`."""

    progress_m: Tensor
    """Along the route."""
    offset_m: Tensor
    """Distance beside the route after the tick, not negative; 0 without the field `route_offset`."""
    speed_mps: Tensor
    """After the tick."""
    speed_limit_mps: Tensor
    """Infinite without the field `speed_limit`."""
    accel_mps2: Tensor
    """Forward, mean over the tick."""
    lateral_accel_mps2: Tensor
    """To the left, mean over the tick."""
    arrived: Tensor
    failed: Tensor
    """Ended by a collision, beside the road, at a red light, against the traffic, or because it stood too long."""
    ended: Tensor
    """Its last tick, for any reason: the action was not used."""
    ended_by: Tensor
    """i64 `[n]`: bits of `caraware.tasks.ends`."""
    action: Tensor
    """f `[n, 2]`: steering and acceleration as the policy chose them."""
    around: Around | None = None
    """What they see after the tick, for `contact_s` and `seen`."""

    @cached_property
    def contact_s(self) -> Tensor:
        """Seconds until they touch somebody if all move on as they do; infinite beyond 2.5 s.

        Only the fields of `observation.fields = "driver"` show it: infinite without them.
        """
        return torch.full_like(self.progress_m, torch.inf) if self.around is None else self.around.contact_s()

    @cached_property
    def short_gap(self) -> Tensor:
        """0 to 1: how much too short the gap is in which the hero meets others; see `Around.short_gap`."""
        return torch.zeros_like(self.progress_m) if self.around is None else self.around.short_gap()

    def seen(self, field: str, without: float) -> Tensor:
        """f64 `[n]`: a field of the observation after the tick in SI units, or `without` where it lacks the field."""
        if self.around is None or not self.around.fields.has(field):
            return torch.full_like(self.progress_m, without)
        return self.around.fields.si_tensor(self.around.observation, field)


DrivingReward = Callable[[DrivenStep], Tensor]
"""Rewards `[n]` of a step."""


def progress_reward(step: DrivenStep) -> Tensor:
    """Progress along the route in tens of metres, times factors of lane, speed limit and comfort; ±10 for the end.

    The form is that of CaRL (Jaeger et al., arXiv 2504.17838): one term that pays, factors from 0 to 1 that multiply
    it, and hard infractions that end the episode. The numbers are this project's.
    """
    lane = 1 - 0.5 * (step.offset_m / 2).clamp(0, 1)
    legal = 1 - ((step.speed_mps - step.speed_limit_mps - 1) / 5).clamp(0, 1)
    felt_mps2 = torch.maximum(step.accel_mps2.abs(), step.lateral_accel_mps2.abs())
    comfort = 1 - 0.5 * ((felt_mps2 - 3) / 3).clamp(0, 1)
    progress = step.progress_m / 10
    paid = torch.where(progress > 0, progress * lane * legal * comfort, progress)
    end = torch.where(step.arrived, END_REWARD, torch.where(step.failed, -END_REWARD, 0.0))
    return torch.where(step.ended, end, paid)


def careful_reward(step: DrivenStep) -> Tensor:
    """`progress_reward`, less costs of every contact that is foreseen and of standing; a failure costs 15.

    A collision is rare and late: the first cost says in each tick before it what leads there. It grows with the speed
    and with the square of how near the contact is. As it is nothing for what stands, standing has a small one itself:
    without it a policy learns to wait for ever, and so do those behind it.
    """
    near = (1 - step.contact_s / HORIZON_S).clamp(0, 1)
    cost = FORESEEN_COST * (step.speed_mps / 10) * near.square() + WAITING_COST * (step.speed_mps < WAITS_MPS)
    return torch.where(step.ended & step.failed, -CAREFUL_END_COST, progress_reward(step) - cost * ~step.ended)


def yielding_reward(step: DrivenStep) -> Tensor:
    """`careful_reward` with costs by right of way and of late braking for red; a failure costs 20.

    A foreseen contact costs half as much at 3 m/s as at 10 m/s, because heroes that creep into a junction are hit
    there. A hero with right of way pays a part of it. A red light costs where a stop needs more than 3 m/s².
    """
    near = (1 - step.contact_s / HORIZON_S).clamp(0, 1)
    pace = (step.speed_mps / 3).clamp(0, 1) * (0.3 + 0.07 * step.speed_mps)
    has_priority = (step.seen("junction_1_gap", torch.inf) < PRIORITY_WITHIN_M) & (
        step.seen("junction_1_priority", 0.0) > 0.5
    )
    cost = YIELDING_COST * torch.where(has_priority, PRIORITY_SHARE, 1.0) * pace * near.square()
    stop_m = step.seen("light_1_gap", torch.inf)
    braking_mps2 = step.speed_mps.square() / (2 * (stop_m - 0.5).clamp_min(0.3))
    late = ((braking_mps2 - RED_BRAKING_MPS2) / (RED_HARDEST_MPS2 - RED_BRAKING_MPS2)).clamp(0, 1)
    cost = cost + RED_COST * late * (step.seen("light_1_green", 1.0) < RED_GREEN)
    cost = cost + WAITING_COST * (step.speed_mps < WAITS_MPS)
    return torch.where(step.ended & step.failed, -YIELDING_END_COST, progress_reward(step) - cost * ~step.ended)


def gap_reward(step: DrivenStep) -> Tensor:
    """`yielding_reward`, less a cost of coming to a junction without right of way while the gap is too short.

    `DrivenStep.contact_s` looks straight ahead: this cost follows the ways of both through the junction.
    """
    yields = (step.seen("junction_1_priority", 1.0) < 0.5) & (step.seen("junction_1_gap", torch.inf) < GAP_WITHIN_M)
    cost = GAP_COST * step.short_gap * (step.speed_mps / 3).clamp(0, 1) * yields
    return yielding_reward(step) - cost * ~step.ended


@dataclass(frozen=True)
class Driving:
    """Actions `[..., 2]` are steering (left is positive) and acceleration, each in −1 … 1 of the vehicle's limits."""

    fields: Fields
    tick_s: float
    reward_of_step: DrivingReward = progress_reward
    name: str = "driving"
    actions: ActionSpec = ACTIONS
    sampling: Sampling = Sampling.EACH_TICK
    is_relative: bool = False
    ends: tuple[EndReason, ...] = ENDS
    metrics: tuple[_native.Metric, ...] = field(default_factory=lambda: metrics_of("driving"))

    @classmethod
    def from_run(cls, run: RunFile) -> "Driving":
        """Read the fields of the observation, the length of a tick, and the reward. Raises `ConfigError`."""
        reward = _named(str(config_table(run, "task").get("reward", "")))
        return cls(Fields.from_run(run), setting(run, "run.tick_s", float), reward)

    def answer(self, action: Tensor, observation: Tensor | None = None) -> Tensor:
        """The demands, clipped to their range."""
        return action.clamp(self.actions.low, self.actions.high)

    def network_input(self, observation: Tensor) -> Tensor:
        """The rows themselves."""
        return observation

    def reward(self, step: TaskStep, action: Tensor) -> Tensor:
        """The reward of the run: `progress_reward`, or the function that `task.reward` names."""
        return self.reward_of_step(self.driven(step, action))

    def driven(self, step: TaskStep, action: Tensor) -> DrivenStep:
        """What the heroes did, from their fields and their true motion."""
        outcome = _outcome(step)
        before, after = step.truth.double(), outcome.next.truth.double()
        turned = after[:, 2] - before[:, 2]
        yaw_rate = torch.atan2(turned.sin(), turned.cos()) / self.tick_s
        why = outcome.ended_by
        if why is None:
            why = torch.where(self._at_the_end(step.observation), ends.ARRIVAL, ends.COLLISION)
            why = torch.where(outcome.terminated, why, 0)
        arrived = outcome.terminated & ((why & ends.ARRIVAL) != 0)
        failed = outcome.terminated & ((why & ends.FAILURES) != 0)
        return DrivenStep(
            progress_m=self._progress_m(step, outcome),
            offset_m=self._field(outcome.next.observation, "route_offset", 0.0).abs(),
            speed_mps=after[:, 3],
            speed_limit_mps=self._field(outcome.next.observation, "speed_limit", torch.inf),
            accel_mps2=(after[:, 3] - before[:, 3]) / self.tick_s,
            lateral_accel_mps2=after[:, 3] * yaw_rate,
            arrived=arrived & ~failed,
            failed=failed,
            ended=outcome.terminated | outcome.truncated,
            ended_by=why,
            action=action,
            around=Around(self.fields, outcome.next.observation, after[:, 3], yaw_rate),
        )

    def measure(self, step: TaskStep, action: Tensor) -> dict[str, Tensor]:
        """`progress_mps`: speed along the route; `route_offset_m`: distance beside it, both after the action.

        A metric is left out where the observation lacks its field.
        """
        outcome, values = _outcome(step), {}
        if self.fields.has("route_left"):
            values["progress_mps"] = self._progress_m(step, outcome) / self.tick_s
        if self.fields.has("route_offset"):
            values["route_offset_m"] = self.fields.si_tensor(outcome.next.observation, "route_offset").abs()
        return values

    def measure_answers(self, tick: MeasuredTick, answers: Tensor) -> dict[str, FloatArray]:
        """None: every metric of driving measures what follows an action."""
        return {}

    def measure_references(self, ticks: Sequence[MeasuredTick]) -> dict[str, list[FloatArray]]:
        """None: nothing drives beside the policy."""
        return {}

    def arrived(self, observation: Tensor, terminated: Tensor) -> Tensor:
        """bool `[n]`: the episode ended at the end of the route, and not by a collision or beside the road."""
        return terminated & self._at_the_end(observation)

    def _at_the_end(self, observation: Tensor) -> Tensor:
        # Within 10 cm: `route_left` is one of 2²⁴ steps of 1000 m.
        return self.fields.si_tensor(observation, "route_left") <= ARRIVED_WITHIN_M + 0.1

    def _field(self, observation: Tensor, name: str, without: float) -> Tensor:
        """f64 `[n]`: a field in SI units, or `without` where the observation lacks it."""
        if self.fields.has(name):
            return self.fields.si_tensor(observation, name)
        return torch.full(observation.shape[:1], without, dtype=torch.float64, device=observation.device)

    def _progress_m(self, step: TaskStep, outcome: TaskOutcome) -> Tensor:
        """f64 `[n]`: metres along the route in the tick."""
        before = self.fields.si_tensor(step.observation, "route_left")
        after = self.fields.si_tensor(outcome.next.observation, "route_left")
        far = (before > FAR_M) | (after > FAR_M)
        return torch.where(far, (outcome.next.truth[:, 3] * self.tick_s).double(), before - after)


def _outcome(step: TaskStep) -> TaskOutcome:
    if step.outcome is None:
        raise OutcomeMissingError("the driving task rewards what an action did: give the step its outcome")
    return step.outcome


def _named(reward: str) -> DrivingReward:
    """The reward that `task.reward` names. Raises `ConfigError`."""
    if not reward:
        return progress_reward
    module, _, name = reward.partition(":")
    try:
        function: DrivingReward = getattr(import_module(module), name)
        return function
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"`task.reward` is '{reward}': {error}",
            "write `package.module:function`, a function of a `DrivenStep`; the module must be in PYTHONPATH",
        ) from error
