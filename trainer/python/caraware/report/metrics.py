"""The course of training: TensorBoard events, and a history for the plots."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from torch.utils.tensorboard import SummaryWriter

from caraware import _native
from caraware.report.evaluation import EvaluationResult

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


_EVALUATION_TAGS = {
    "ppo": "",
    "raw_gnss": "raw_gnss_",
    "supervised": "supervised_",
    "ekf": "ekf_",
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


class Metrics:
    """Writes TensorBoard events to `folder` and keeps one point per update and per evaluation."""

    def __init__(self, folder: Path, task_metrics: Sequence[_native.Metric]) -> None:
        """`task_metrics` are those of the task (`Task.metrics`)."""
        self.training: list[TrainingPoint] = []
        self.evaluations: list[EvaluationResult] = []
        self._folder, self._task_metrics = folder, task_metrics
        self._purge_step: int | None = None

    def resume(self, training: list[TrainingPoint], evaluations: list[EvaluationResult], env_steps: int) -> None:
        """Go on after `env_steps`: events that a predecessor recorded beyond are void."""
        self.training, self.evaluations = list(training), list(evaluations)
        self._purge_step = env_steps + 1

    @cached_property
    def _writer(self) -> SummaryWriter:
        return SummaryWriter(str(self._folder), purge_step=self._purge_step)

    def updated(self, point: TrainingPoint, stats: "DataclassInstance", lag_ticks: int = 0) -> None:
        """Record one update, after which the simulation was `lag_ticks` ahead."""
        self.training.append(point)
        for name, value in asdict(stats).items():
            self._writer.add_scalar(f"update/{name}", value, point.env_steps)
        for metric in self._task_metrics:
            if metric.name in point.metrics:
                self._writer.add_scalar(_tag(metric, "training"), point.metrics[metric.name], point.env_steps)
        self._writer.add_scalar("speed/env_steps_per_s", point.env_steps_per_s, point.env_steps)
        self._writer.add_scalar("speed/lag_ticks", lag_ticks, point.env_steps)

    def evaluated(self, result: EvaluationResult) -> None:
        """Record one evaluation phase."""
        self.evaluations.append(result)
        quantity, unit = result.metric.rsplit("_", 1)
        for name, suffix in _EVALUATION_TAGS.items():
            if (mean := result.mean(name)) is not None:
                self._writer.add_scalar(f"{quantity}/evaluation_{suffix}{unit}", mean, result.env_steps)

    def close(self) -> None:
        """Flush everything to disk."""
        self._writer.close()


def _tag(metric: _native.Metric, phase: str) -> str:
    """The tag of a metric in TensorBoard: `error/training_m`, and `error/training_raw_gnss_m` of a reference."""
    of_policy = metric.reference_for or metric.name
    quantity, unit = of_policy.rsplit("_", 1)
    return f"{quantity}/{phase}_{metric.name.removesuffix(of_policy)}{unit}"
