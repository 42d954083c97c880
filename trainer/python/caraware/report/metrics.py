"""The course of training: TensorBoard events, a file of JSON lines, and a history for the plots."""

import json
import logging
import math
import os
import re
from array import array
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, overload

import numpy as np
from torch.utils.tensorboard import SummaryWriter

from caraware import _native
from caraware.ipc.arrays import Float64Array
from caraware.report.evaluation import EvaluationResult

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


log = logging.getLogger("caraware.run.loop")

_EVALUATION_TAGS = {
    "ppo": "",
    "raw_gnss": "raw_gnss_",
    "supervised": "supervised_",
    "ekf": "ekf_",
    "map_ekf": "map_ekf_",
    "rts": "rts_sees_the_future_",
}
"""What stands before the unit in the tag of an estimator."""

COURSE = "learning.jsonl"
"""File of a run: a line for each update and each evaluation. `fanout` sends it to viewers (`docs/fanout.md`)."""


@dataclass(frozen=True)
class TrainingPoint:
    """Training as it stood after one update."""

    env_steps: int
    sigma: float
    reward: float
    metrics: dict[str, float]
    """Mean of each metric of the task by name, of the deterministic policy on the horizon's samples, before it learned
    from them, and of the references on the same samples."""
    env_steps_per_s: float

    def row(self, names: Sequence[str]) -> list[float]:
        """The numbers of this point, with the metrics `names` in their order."""
        return [self.env_steps, self.sigma, self.reward, *(self.metrics[name] for name in names), self.env_steps_per_s]

    @classmethod
    def of_row(cls, row: Sequence[float], names: Sequence[str]) -> "TrainingPoint":
        """The point whose `row(names)` this is."""
        env_steps, sigma, reward, *values, rate = row
        return cls(int(env_steps), sigma, reward, dict(zip(names, values, strict=True)), rate)


class TrainingPoints(Sequence[TrainingPoint]):
    """The points of a training, each as the numbers of its row: a learner that runs for days has millions of them."""

    def __init__(self, points: Iterable[TrainingPoint] = ()) -> None:
        self._names: tuple[str, ...] | None = None
        self._width = 0
        self._numbers = array("d")
        for point in points:
            self.append(point)

    @classmethod
    def of(cls, points: Iterable[TrainingPoint]) -> "TrainingPoints":
        """The points, which are not copied if they are `TrainingPoints` already."""
        return points if isinstance(points, cls) else cls(points)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the metrics, in the order of the rows."""
        return self._names or ()

    def rows(self) -> Float64Array:
        """f64 [n, 4 + metrics]: `TrainingPoint.row` of every point; a copy."""
        return np.array(self._numbers).reshape(-1, self._width) if self._width else np.empty((0, 0))

    def append(self, point: TrainingPoint) -> None:
        """Add a point, which has the metrics of the first one."""
        if self._names is None:
            self._names = tuple(point.metrics)
        row = point.row(self._names)
        self._width = len(row)
        self._numbers.extend(row)

    def __len__(self) -> int:
        """Number of points."""
        return len(self._numbers) // self._width if self._width else 0

    def __repr__(self) -> str:
        """All points."""
        return f"TrainingPoints({list(self)!r})"

    @overload
    def __getitem__(self, place: int) -> TrainingPoint: ...
    @overload
    def __getitem__(self, place: slice) -> list[TrainingPoint]: ...
    def __getitem__(self, place: int | slice) -> TrainingPoint | list[TrainingPoint]:
        """The point at a place, made anew, or those of a slice."""
        if isinstance(place, slice):
            return [self[number] for number in range(*place.indices(len(self)))]
        number = range(len(self))[place]
        row = self._numbers[number * self._width : (number + 1) * self._width]
        return TrainingPoint.of_row(row, self.names)


class DroppedOutput:
    """What could not be written though the run does not need it: reported once in the log, and in the run's report."""

    def __init__(self) -> None:
        self._reasons: dict[str, str] = {}

    def drop(self, what: str, error: OSError) -> None:
        """`error` prevented that `what` was written."""
        if what not in self._reasons:
            log.warning("%s cannot be written (%s): the run continues without a part of it", what, error)
            self._reasons[what] = str(error)

    def report(self) -> dict[str, str]:
        """The first reason for each output."""
        return dict(self._reasons)


class Course:
    """Writes the lines of `learning.jsonl`; a learner that continues from a checkpoint drops the lines after it."""

    def __init__(self, file: Path, dropped: DroppedOutput) -> None:
        self._file, self._dropped = file, dropped
        self._kept_env_steps = -1
        self._begun = False

    def resume(self, env_steps: int) -> None:
        """Keep the lines up to `env_steps`."""
        self._kept_env_steps = env_steps

    def add(self, line: Mapping[str, object]) -> None:
        """Append a line; what a full disk does not take is dropped."""
        try:
            if not self._begun:
                self._begin()
            with self._file.open("a", encoding="utf-8") as output:
                output.write(json.dumps(line, separators=(",", ":"), allow_nan=False) + "\n")
        except OSError as error:
            self._dropped.drop(COURSE, error)

    def _begin(self) -> None:
        """Replace the file by the lines that still count, in one step, so that a reader never sees a part of them."""
        kept = []
        if self._kept_env_steps >= 0 and self._file.exists():
            kept = [line for line in self._file.read_text(encoding="utf-8").splitlines() if self._counts(line)]
        self._file.parent.mkdir(parents=True, exist_ok=True)
        beside = self._file.with_suffix(".new")
        beside.write_text("".join(line + "\n" for line in kept), encoding="utf-8")
        os.replace(beside, self._file)
        self._begun = True

    def _counts(self, line: str) -> bool:
        """False for a line of an abandoned future, or one that was cut off when its process was killed."""
        try:
            return int(json.loads(line)["env_steps"]) <= self._kept_env_steps
        except (ValueError, KeyError, TypeError):
            return False


class Metrics:
    """Writes TensorBoard events to `folder`, JSON lines beside it, and keeps a point per update and per evaluation."""

    def __init__(self, folder: Path, task_metrics: Sequence[_native.Metric]) -> None:
        """`task_metrics` are those of the task (`Task.metrics`)."""
        self.training = TrainingPoints()
        self.evaluations: list[EvaluationResult] = []
        self._folder, self._task_metrics = folder, task_metrics
        self._purge_step: int | None = None
        self.dropped = DroppedOutput()
        self._writer: SummaryWriter | None = None
        self._course = Course(folder.parent / COURSE, self.dropped)
        self._tick = 0

    def resume(self, training: Iterable[TrainingPoint], evaluations: list[EvaluationResult], env_steps: int) -> None:
        """Go on after `env_steps`: events that a predecessor recorded beyond are void."""
        self.training, self.evaluations = TrainingPoints(training), list(evaluations)
        self._purge_step = env_steps + 1
        self._course.resume(env_steps)

    def updated(
        self,
        point: TrainingPoint,
        stats: "DataclassInstance",
        lag_ticks: int = 0,
        tick: int = 0,
        ends: Mapping[str, int] | None = None,
    ) -> None:
        """Record one update on the ticks up to `tick`, after which the simulation was `lag_ticks` ahead.

        `ends` are the trips that ended since the update before, by the name of their end.
        """
        self.training.append(point)
        self._tick = tick
        figures = {"sigma": point.sigma, "reward": point.reward, **point.metrics}
        line = {"env_steps": point.env_steps, "tick": tick, "update": len(self.training), "training": _finite(figures)}
        self._course.add(line | ({"ends": dict(ends)} if ends else {}))
        values = {f"update/{name}": value for name, value in asdict(stats).items()}
        for metric in self._task_metrics:
            if metric.name in point.metrics:
                values[_tag(metric, "training")] = point.metrics[metric.name]
        if ends:
            # TensorBoard's tags have no blanks.
            values |= {
                f"trips/{re.sub(r'[^a-z]+', '_', end)}_percent": 100 * count / sum(ends.values())
                for end, count in ends.items()
            }
        values |= {"speed/env_steps_per_s": point.env_steps_per_s, "speed/lag_ticks": lag_ticks}
        self._write(values, point.env_steps)

    def evaluated(self, result: EvaluationResult) -> None:
        """Record one evaluation phase."""
        self.evaluations.append(result)
        quantity, unit = result.metric.rsplit("_", 1)
        means = {suffix: result.mean(name) for name, suffix in _EVALUATION_TAGS.items()}
        values = {f"{quantity}/evaluation_{suffix}{unit}": mean for suffix, mean in means.items() if mean is not None}
        self._write(values, result.env_steps)
        figures = {name: mean for name in _EVALUATION_TAGS if (mean := result.mean(name)) is not None}
        line = {"env_steps": result.env_steps, "tick": self._tick, "metric": result.metric}
        self._course.add(line | {"evaluation": _finite(figures)})

    def _write(self, values: Mapping[str, float], env_steps: int) -> None:
        """Add events; those that a full disk does not take are dropped, and later ones go to a new file."""
        try:
            if self._writer is None:
                self._writer = SummaryWriter(str(self._folder), purge_step=self._purge_step)
            for tag, value in values.items():
                self._writer.add_scalar(tag, value, env_steps)
        except OSError as error:
            self._abandon(error)

    def _abandon(self, error: OSError) -> None:
        self.dropped.drop("tensorboard", error)
        writer, self._writer = self._writer, None
        # Events since then are in a new file, which does not declare earlier ones void.
        self._purge_step = None
        if writer is not None:
            with suppress(OSError):
                writer.close()

    def close(self) -> None:
        """Flush everything to disk."""
        try:
            if self._writer is not None:
                self._writer.close()
        except OSError as error:
            self._writer = None
            self.dropped.drop("tensorboard", error)


def _finite(figures: Mapping[str, float]) -> dict[str, float]:
    """The figures that JSON can hold."""
    return {name: float(value) for name, value in figures.items() if math.isfinite(value)}


def _tag(metric: _native.Metric, phase: str) -> str:
    """The tag of a metric in TensorBoard: `error/training_m`, and `error/training_raw_gnss_m` of a reference."""
    of_policy = metric.reference_for or metric.name
    quantity, unit = of_policy.rsplit("_", 1)
    return f"{quantity}/{phase}_{metric.name.removesuffix(of_policy)}{unit}"
