"""The messages task: an action is which perceived objects a vehicle tells others of (docs/messages.md).

A policy sees what its station knows: the objects that its sensors perceive, what it told of them last, what it has
heard of them, and the load of the channel. What others newly know from its message, less its bytes, is the reward.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from caraware import _native
from caraware.ipc.arrays import FloatArray
from caraware.ipc.run_file import RunFile, setting
from caraware.ipc.stream import MeasuredTick
from caraware.tasks.contract import ActionSpec, EndReason, OutcomeMissingError, Sampling, TaskOutcome, TaskStep
from caraware.tasks.localisation import ENDS
from caraware.tasks.metrics import metrics_of

TOLD_S, CPM_BYTES, KNOWN, IN_RANGE = range(4)
"""Columns of `truth` in this task: `achieved` of the tick (`ipc_schema::neighbours`)."""
KILOBYTE = 1000.0
BITS = 8.0


def speech_width(candidates: int) -> int:
    """Numbers of a row that a policy sees."""
    return _native.SPEAKER_COLUMNS + candidates * _native.CANDIDATE_COLUMNS


@dataclass(frozen=True)
class Messages:
    """Actions `[..., c]`: a candidate whose number is above 0 is listed in the station's next message."""

    tick_s: float
    cost_s_per_kb: float
    """What 1000 bytes cost, in seconds for which another station newly knows an object."""
    actions: ActionSpec
    name: str = "messages"
    sampling: Sampling = Sampling.EACH_TICK
    ends: tuple[EndReason, ...] = ENDS
    is_relative: bool = False
    metrics: tuple[_native.Metric, ...] = field(default_factory=lambda: metrics_of("messages"))

    @classmethod
    def from_run(cls, run: RunFile) -> "Messages":
        """Read the number of candidates and the price of bytes. Raises `ConfigError`."""
        candidates = setting(run, "v2x.candidates", int)
        names = tuple(f"candidate_{number}" for number in range(1, candidates + 1))
        actions = ActionSpec(names=names, low=-1.0, high=1.0, is_clipped=True)
        return cls(setting(run, "run.tick_s", float), setting(run, "task.message_cost", float), actions)

    def answer(self, action: Tensor, observation: Tensor | None = None) -> Tensor:
        """The numbers, clipped to their range."""
        return action.clamp(self.actions.low, self.actions.high)

    def network_input(self, observation: Tensor) -> Tensor:
        """The rows themselves."""
        return observation

    def reward(self, step: TaskStep, action: Tensor) -> Tensor:
        """Seconds for which others newly know what was told, less the price of its bytes; 0 where the vehicle left."""
        outcome = _outcome(step)
        after = outcome.next.truth
        paid = after[:, TOLD_S] - after[:, CPM_BYTES] * (self.cost_s_per_kb / KILOBYTE)
        return torch.where(outcome.terminated | outcome.truncated, 0.0, paid)

    def measure(self, step: TaskStep, action: Tensor) -> dict[str, Tensor]:
        """`awareness_percent`: of the road users in range that the station knows after the action, 100 without any;
        `message_kbitps`: its collective perception messages."""
        after = _outcome(step).next.truth
        return {
            "awareness_percent": torch.where(
                after[:, IN_RANGE] > 0, 100.0 * after[:, KNOWN] / after[:, IN_RANGE].clamp_min(1.0), 100.0
            ),
            "message_kbitps": after[:, CPM_BYTES] * (BITS / KILOBYTE / self.tick_s),
        }

    def measure_answers(self, tick: MeasuredTick, answers: Tensor) -> dict[str, FloatArray]:
        """None: every metric measures what follows an action."""
        return {}

    def measure_references(self, ticks: Sequence[MeasuredTick]) -> dict[str, list[FloatArray]]:
        """None: what other rules would achieve is another run (`v2x.inclusion`)."""
        return {}


def _outcome(step: TaskStep) -> TaskOutcome:
    if step.outcome is None:
        raise OutcomeMissingError("the messages task rewards what an action achieved: give the step its outcome")
    return step.outcome
