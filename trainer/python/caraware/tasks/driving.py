"""The driving task: an action is steering and acceleration of a hero, and the world waits for it (docs/driving.md)."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from caraware import _native
from caraware.ipc.arrays import FloatArray
from caraware.ipc.run_file import RunFile, setting
from caraware.ipc.stream import MeasuredTick
from caraware.tasks.contract import ActionSpec, EndKind, EndReason, Sampling, TaskOutcome, TaskStep
from caraware.tasks.fields import Fields
from caraware.tasks.metrics import metrics_of

ARRIVED_WITHIN_M = 5.0
"""A hero whose episode ends this near to the end of its route has arrived (docs/driving.md)."""
FAR_M = 999.0
"""Beyond it `route_left` is at the end of its range and does not tell progress."""


class OutcomeMissingError(ValueError):
    """The driving task rewards what an action did: a step without its outcome has no reward."""


ACTIONS = ActionSpec(names=("steering", "acceleration"), low=-1.0, high=1.0, is_clipped=True)

ENDS = (
    EndReason("collision", EndKind.TERMINATED),
    EndReason("off-road", EndKind.TERMINATED),
    EndReason("arrival", EndKind.TERMINATED),
    EndReason("time limit", EndKind.TRUNCATED),
    EndReason("end of the run's episode", EndKind.TRUNCATED),
)


@dataclass(frozen=True)
class Driving:
    """Actions `[..., 2]` are steering (left is positive) and acceleration, each in −1 … 1 of the vehicle's limits."""

    fields: Fields
    tick_s: float
    name: str = "driving"
    actions: ActionSpec = ACTIONS
    sampling: Sampling = Sampling.EACH_TICK
    is_relative: bool = False
    ends: tuple[EndReason, ...] = ENDS
    metrics: tuple[_native.Metric, ...] = field(default_factory=lambda: metrics_of("driving"))

    @classmethod
    def from_run(cls, run: RunFile) -> "Driving":
        """Read the fields of the observation and the length of a tick."""
        return cls(Fields.from_run(run), setting(run, "run.tick_s", float))

    def answer(self, action: Tensor, observation: Tensor | None = None) -> Tensor:
        """The demands, clipped to their range."""
        return action.clamp(self.actions.low, self.actions.high)

    def network_input(self, observation: Tensor) -> Tensor:
        """The rows themselves."""
        return observation

    def reward(self, step: TaskStep, action: Tensor) -> Tensor:
        """Metres along the route, in tens; less for what is beside it; ±10 for the end.

        A tick of 10 m/s earns 0.1, one 5 m beside the line costs as much. Arrival earns 10, a collision or leaving the
        road costs 10. A time limit is neither: the trajectory is truncated.
        """
        outcome = _outcome(step)
        offset_m = self.fields.si_tensor(outcome.next.observation, "route_offset").abs()
        on_the_way = self._progress_m(step, outcome) / 10 - 0.02 * offset_m
        ended = outcome.terminated | outcome.truncated
        if not ended.any():
            return on_the_way
        of_end = torch.where(outcome.terminated, -10.0, 0.0).double()
        end = torch.where(self.arrived(step.observation, outcome.terminated), 10.0, of_end)
        return torch.where(ended, end, on_the_way)

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
        # Within 10 cm: `route_left` is one of 2²⁴ steps of 1000 m.
        return terminated & (self.fields.si_tensor(observation, "route_left") <= ARRIVED_WITHIN_M + 0.1)

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
