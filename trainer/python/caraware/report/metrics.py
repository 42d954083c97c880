"""The course of training: TensorBoard events, and a history for the plots."""

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from torch.utils.tensorboard import SummaryWriter

from caraware import _native
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


class Metrics:
    """Writes TensorBoard events to `folder` and keeps one point per update and per evaluation."""

    def __init__(self, folder: Path, task_metrics: Sequence[_native.Metric]) -> None:
        """`task_metrics` are those of the task (`Task.metrics`)."""
        self.training: list[TrainingPoint] = []
        self.evaluations: list[EvaluationResult] = []
        self._folder, self._task_metrics = folder, task_metrics
        self._purge_step: int | None = None
        self.dropped = DroppedOutput()
        self._writer: SummaryWriter | None = None

    def resume(self, training: list[TrainingPoint], evaluations: list[EvaluationResult], env_steps: int) -> None:
        """Go on after `env_steps`: events that a predecessor recorded beyond are void."""
        self.training, self.evaluations = list(training), list(evaluations)
        self._purge_step = env_steps + 1

    def updated(self, point: TrainingPoint, stats: "DataclassInstance", lag_ticks: int = 0) -> None:
        """Record one update, after which the simulation was `lag_ticks` ahead."""
        self.training.append(point)
        values = {f"update/{name}": value for name, value in asdict(stats).items()}
        for metric in self._task_metrics:
            if metric.name in point.metrics:
                values[_tag(metric, "training")] = point.metrics[metric.name]
        values |= {"speed/env_steps_per_s": point.env_steps_per_s, "speed/lag_ticks": lag_ticks}
        self._write(values, point.env_steps)

    def evaluated(self, result: EvaluationResult) -> None:
        """Record one evaluation phase."""
        self.evaluations.append(result)
        quantity, unit = result.metric.rsplit("_", 1)
        means = {suffix: result.mean(name) for name, suffix in _EVALUATION_TAGS.items()}
        values = {f"{quantity}/evaluation_{suffix}{unit}": mean for suffix, mean in means.items() if mean is not None}
        self._write(values, result.env_steps)

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


def _tag(metric: _native.Metric, phase: str) -> str:
    """The tag of a metric in TensorBoard: `error/training_m`, and `error/training_raw_gnss_m` of a reference."""
    of_policy = metric.reference_for or metric.name
    quantity, unit = of_policy.rsplit("_", 1)
    return f"{quantity}/{phase}_{metric.name.removesuffix(of_policy)}{unit}"
