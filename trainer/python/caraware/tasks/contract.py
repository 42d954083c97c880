"""The contract of a task, which our learner, the environment faces and the reports share (decision 22).

A task is an immutable object made from the run file. It works on rows: a face passes the slots of one tick, a learner
the samples of a horizon, and the task does not know which.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from torch import Tensor

from caraware import _native
from caraware.ipc.arrays import FloatArray
from caraware.ipc.stream import MeasuredTick


class Sampling(Enum):
    """When actions are drawn: a fact about the world, not a choice of the learner."""

    WHEN_FULL = "when the horizon is full"
    """The world does not depend on actions. A learner draws them for a whole horizon, from its own random numbers;
    so they depend on the seed and the data, never on how ticks arrived together."""
    EACH_TICK = "for each tick"
    """The simulation waits for the action of every tick. A learner draws it when the tick comes, and keeps its
    log-probability with it: the parameters may be others when the horizon is full."""


@dataclass(frozen=True)
class ActionSpec:
    """The numbers of one action."""

    names: tuple[str, ...]
    low: float
    """Lower end of the range that each number is meant to lie in."""
    high: float
    is_clipped: bool
    """Values beyond the range are clipped before they are published; else they are published as they are."""
    spread: tuple[float, ...] = ()
    """Factor on `trainer.initial_std` for each number; empty: 1 for all."""

    @property
    def size(self) -> int:
        """Numbers in an action."""
        return len(self.names)


class EndKind(Enum):
    """How a trajectory ends; the two are never merged."""

    TERMINATED = "terminated"
    """Nothing follows: the value of what would follow is 0."""
    TRUNCATED = "truncated"
    """It would have gone on: bootstrap from the value of its last observation."""


@dataclass(frozen=True)
class EndReason:
    """A reason for which the simulation ends a trajectory."""

    name: str
    kind: EndKind


@dataclass(frozen=True)
class TaskRows:
    """Rows of any ticks, one vehicle each."""

    observation: Tensor
    """f32 `[n, d]`, normalised."""
    truth: Tensor
    """f32 `[n, 4]`: x and y of the rear axle (m, world), yaw (rad), speed (m/s).

    In the messages task: what the messages of the tick before have achieved (`caraware.tasks.messages`)."""


@dataclass(frozen=True)
class TaskOutcome:
    """What followed rows."""

    next: TaskRows
    """A tick later; of trajectories that ended, the same tick again."""
    terminated: Tensor
    """bool `[n]`: the trajectory ended with the tick."""
    truncated: Tensor
    """bool `[n]`: it was cut after the tick."""
    ended_by: Tensor | None = None
    """i64 `[n]`: bits `ENDED_…` of `caraware._native` that say why it ended; None where it is not known."""


@dataclass(frozen=True)
class TaskStep(TaskRows):
    """Rows that actions answered, and what followed."""

    outcome: TaskOutcome | None = None
    """None for a task that samples `WHEN_FULL`: what follows does not depend on its actions."""


class OutcomeMissingError(ValueError):
    """The task rewards what an action did: a step without its outcome has no reward."""


class Task(Protocol):
    """A task of one run."""

    @property
    def name(self) -> str:
        """Its `task.kind` in the configuration."""
        ...

    @property
    def actions(self) -> ActionSpec:
        """What an action is made of."""
        ...

    @property
    def sampling(self) -> Sampling:
        """When actions are drawn."""
        ...

    @property
    def ends(self) -> tuple[EndReason, ...]:
        """Why trajectories end. The simulation ends them; flags tell terminated from truncated."""
        ...

    @property
    def metrics(self) -> tuple[_native.Metric, ...]:
        """What is measured: rows of `METRICS`. The first is the headline."""
        ...

    @property
    def is_relative(self) -> bool:
        """Whether actions are relative to what a row holds, so that `answer` needs the rows."""
        ...

    def answer(self, action: Tensor, observation: Tensor | None = None) -> Tensor:
        """What is published for actions `[..., a]` on rows `[n, d]`, in the units that the simulation and viewers take.

        Only an action that corrects what a sensor says needs the rows.
        """
        ...

    def network_input(self, observation: Tensor) -> Tensor:
        """Rows `[n, d]` as the networks take them: the same tensor, unless an action is relative to a row."""
        ...

    def reward(self, step: TaskStep, action: Tensor) -> Tensor:
        """Rewards `[n]` of actions `[n, a]`; `[n, k]` of `[n, k, a]`, where every row has k actions."""
        ...

    def measure(self, step: TaskStep, action: Tensor) -> dict[str, Tensor]:
        """Each metric of the policy that can be measured, by name: values `[n]` for actions `[n, a]`."""
        ...

    def measure_answers(self, tick: MeasuredTick, answers: Tensor) -> dict[str, FloatArray]:
        """Each metric of the policy that needs no outcome, by name: values `[v]` of `answers` `[n, a]` to a tick.

        They are those of its valid rows; none depends on the rows beside it.
        """
        ...

    def measure_references(self, ticks: Sequence[MeasuredTick]) -> dict[str, list[FloatArray]]:
        """Each metric that is a reference, by name: values `[v]` on the valid rows of each tick.

        The same numbers, bit for bit, whichever ticks come together.
        """
        ...
