"""The curriculum: which stage of training a lesson belongs to, decided by what was learned (docs/decisions/0010)."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

from caraware import _native
from caraware.ipc.run_file import RunFile, config_table, setting


@dataclass(frozen=True)
class Stage:
    """The gate of one stage: passed with any of what it names; without a gate it lasts to the end of training."""

    until_std: float | None = None
    """Standard deviation of the policy, in units of half the map."""
    until_metric: str | None = None
    """Name of a metric of the policy, whose mean in the samples of the newest update reaches `until_value`."""
    until_value: float | None = None
    """In the unit of that metric."""
    until_lessons: int | None = None

    @classmethod
    def from_run(cls, run: RunFile) -> "tuple[Stage, ...]":
        """The stages that the trainer decides on; none without a curriculum.

        None either where several learn, or one in several environments: each environment counts its own lessons then.
        """
        alone = setting(run, "run.envs", int) == 1 and setting(run, "trainer.ranks", int) <= 1
        stages = config_table(run, "curriculum")["stages"] if alone else ()
        return tuple(cls(**{name: stage.get(name) for name in cls.__dataclass_fields__}) for stage in stages)

    def passed(self, policy_std: float, metrics: Mapping[str, float], lessons: int) -> bool:
        """Whether the gate opens; a measure that is not known is nan or missing, and opens nothing."""
        return (
            (self.until_std is not None and policy_std <= self.until_std)
            or self._reached(metrics)
            or (self.until_lessons is not None and lessons >= self.until_lessons)
        )

    def _reached(self, metrics: Mapping[str, float]) -> bool:
        """Whether the metric is as good as `until_value`, or better."""
        if self.until_metric is None or self.until_value is None:
            return False
        value = metrics.get(self.until_metric, math.nan)
        metric = next(metric for metric in _native.METRICS if metric.name == self.until_metric)
        return value >= self.until_value if metric.higher_is_better else value <= self.until_value


@dataclass(frozen=True)
class Passed:
    """How training stood when a gate opened."""

    stage: int
    """Counted from 1."""
    tick: int
    lessons: int
    """Of the whole run."""
    env_steps: int
    policy_std: float
    metrics: dict[str, float] = field(default_factory=dict)
    """Mean of each metric of the task in the samples of the newest update, by name; empty before the first."""


@dataclass
class Standing:
    """How far a curriculum has come; part of a checkpoint."""

    lessons: int = 0
    """Lessons that have ended."""
    stage: int = 0
    """Of the lesson that follows, counted from 0."""
    since: int = 0
    """The first lesson of that stage."""
    decided_tick: int = -1
    """Last tick of the newest lesson that has ended: what is delivered again up to there is not decided again."""
    passed: list[Passed] = field(default_factory=list)

    @classmethod
    def restored(cls, values: dict[str, Any]) -> "Standing":
        """From what `dataclasses.asdict` made of one."""
        return cls(**values | {"passed": [Passed(**gate) for gate in values.get("passed", [])]})


class Decided(Protocol):
    """Where decisions go: `caraware.ipc.channel.Channel`."""

    def decided(self, lessons: int, since: int, stage: int) -> None:
        """All lessons below `lessons` have a stage; those from `since` on have `stage`, counted from 0."""


class Ended(Protocol):
    """The last tick of a lesson."""

    @property
    def tick(self) -> int:
        """Number of the tick in the run."""

    @property
    def stage(self) -> int:
        """Stage of the lesson, counted from 1."""


class Curriculum:
    """Decides at the end of every lesson which stage the next belongs to. Without stages it does nothing."""

    def __init__(self, stages: tuple[Stage, ...], channel: Decided) -> None:
        self._stages, self._channel = stages, channel
        self.standing = Standing()

    def begin(self, standing: dict[str, Any] | None = None) -> None:
        """Publish the stage of the next lesson: at the beginning of the run, or as a checkpoint says."""
        if standing:
            self.standing = Standing.restored(standing)
        self._publish()

    def lesson_ended(
        self, obs: Ended, env_steps: int, policy_std: float = math.nan, metrics: Mapping[str, float] | None = None
    ) -> None:
        """Look at the gate, once for each lesson. Measures that a learner does not have open no gate."""
        now = self.standing
        if obs.tick <= now.decided_tick:
            return
        now.lessons, now.decided_tick = now.lessons + 1, obs.tick
        if obs.stage - 1 > now.stage:
            # A predecessor with other settings led the simulation here.
            now.stage, now.since = obs.stage - 1, now.lessons - 1
        known = {name: value for name, value in (metrics or {}).items() if not math.isnan(value)}
        if self._stages[now.stage].passed(policy_std, known, now.lessons - now.since):
            now.passed.append(Passed(now.stage + 1, obs.tick, now.lessons, env_steps, policy_std, known))
            now.stage, now.since = now.stage + 1, now.lessons
        self._publish()

    def share(self, lessons: int) -> float:
        """Share of at most `lessons` that is behind."""
        return min(1.0, self.standing.lessons / lessons)

    def report(self) -> dict[str, Any] | None:
        """For the run's report; None without a curriculum."""
        if not self._stages:
            return None
        passed = [asdict(gate) for gate in self.standing.passed]
        return {"stages": len(self._stages), "lessons": self.standing.lessons, "passed": passed}

    def saved(self) -> dict[str, Any]:
        """For a checkpoint."""
        return asdict(self.standing)

    def __bool__(self) -> bool:
        return bool(self._stages)

    def _publish(self) -> None:
        if self._stages:
            now = self.standing
            self._channel.decided(now.lessons + 1, now.since, now.stage)
