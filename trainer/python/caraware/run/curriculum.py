"""The curriculum: which step of training a lesson belongs to, decided by what was learned (docs/decisions/0010)."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

from caraware.ipc.run_file import RunFile


@dataclass(frozen=True)
class Step:
    """The gate of one step: passed with any of what it names; without a gate it lasts to the end of training."""

    until_std: float | None = None
    """Standard deviation of the policy, in units of half the map."""
    until_error_m: float | None = None
    """Mean error of the policy in the samples of the newest update."""
    until_lessons: int | None = None

    @classmethod
    def from_run(cls, run: RunFile) -> "tuple[Step, ...]":
        """The steps of a run file's configuration; none without a curriculum."""
        steps = run.get("config", {}).get("curriculum", {}).get("steps", [])
        return tuple(cls(**{name: step.get(name) for name in cls.__dataclass_fields__}) for step in steps)

    def passed(self, policy_std: float, error_m: float, lessons: int) -> bool:
        """Whether the gate opens; a measure that nobody has is nan, and opens nothing."""
        return (
            (self.until_std is not None and policy_std <= self.until_std)
            or (self.until_error_m is not None and error_m <= self.until_error_m)
            or (self.until_lessons is not None and lessons >= self.until_lessons)
        )


@dataclass(frozen=True)
class Passed:
    """How training stood when a gate opened."""

    step: int
    """Counted from 1."""
    tick: int
    lessons: int
    """Of the whole run."""
    env_steps: int
    policy_std: float
    error_m: float | None
    """None before the first update."""


@dataclass
class Standing:
    """How far a curriculum has come; part of a checkpoint."""

    lessons: int = 0
    """Lessons that have ended."""
    step: int = 0
    """Of the lesson that follows, counted from 0."""
    since: int = 0
    """The first lesson of that step."""
    decided_tick: int = -1
    """Last tick of the newest lesson that has ended: what is delivered again up to there is not decided again."""
    passed: list[Passed] = field(default_factory=list)

    @classmethod
    def restored(cls, values: dict[str, Any]) -> "Standing":
        """From what `dataclasses.asdict` made of one."""
        return cls(**values | {"passed": [Passed(**gate) for gate in values.get("passed", [])]})


class Decided(Protocol):
    """Where decisions go: `caraware.ipc.channel.Channel`."""

    def decided(self, lessons: int, since: int, step: int) -> None:
        """All lessons below `lessons` have a step; those from `since` on have `step`, counted from 0."""


class Ended(Protocol):
    """The last tick of a lesson."""

    @property
    def tick(self) -> int:
        """Number of the tick in the run."""

    @property
    def step(self) -> int:
        """Step of the lesson, counted from 1."""


class Curriculum:
    """Decides at the end of every lesson which step the next belongs to. Without steps it does nothing."""

    def __init__(self, steps: tuple[Step, ...], channel: Decided) -> None:
        self._steps, self._channel = steps, channel
        self.standing = Standing()

    def begin(self, standing: dict[str, Any] | None = None) -> None:
        """Tell the simulation where a run stands: at its beginning, or as a checkpoint says."""
        if standing:
            self.standing = Standing.restored(standing)
        self._tell()

    def lesson_ended(self, obs: Ended, env_steps: int, policy_std: float = math.nan, error_m: float = math.nan) -> None:
        """Look at the gate, once for each lesson. Measures that a learner does not have open no gate."""
        now = self.standing
        if obs.tick <= now.decided_tick:
            return
        now.lessons, now.decided_tick = now.lessons + 1, obs.tick
        if obs.step - 1 > now.step:
            # A predecessor with other settings led the simulation here.
            now.step, now.since = obs.step - 1, now.lessons - 1
        if self._steps[now.step].passed(policy_std, error_m, now.lessons - now.since):
            error = None if math.isnan(error_m) else error_m
            now.passed.append(Passed(now.step + 1, obs.tick, now.lessons, env_steps, policy_std, error))
            now.step, now.since = now.step + 1, now.lessons
        self._tell()

    def share(self, lessons: int) -> float:
        """Share of at most `lessons` that is behind."""
        return min(1.0, self.standing.lessons / lessons)

    def report(self) -> dict[str, Any] | None:
        """For the run's report; None without a curriculum."""
        if not self._steps:
            return None
        passed = [asdict(gate) for gate in self.standing.passed]
        return {"steps": len(self._steps), "lessons": self.standing.lessons, "passed": passed}

    def saved(self) -> dict[str, Any]:
        """For a checkpoint."""
        return asdict(self.standing)

    def __bool__(self) -> bool:
        return bool(self._steps)

    def _tell(self) -> None:
        if self._steps:
            now = self.standing
            self._channel.decided(now.lessons + 1, now.since, now.step)
