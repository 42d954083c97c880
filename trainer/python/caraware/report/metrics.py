"""The course of training: TensorBoard events, and a history for the plots."""

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from torch.utils.tensorboard import SummaryWriter

from caraware.report.evaluation import EvaluationResult

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


@dataclass(frozen=True)
class TrainingPoint:
    """Training as it stood after one update."""

    env_steps: int
    sigma: float
    reward: float
    error_m: float
    """Mean error of the deterministic policy on the horizon's samples, before the policy learned from them."""
    raw_gnss_error_m: float
    env_steps_per_s: float


class Metrics:
    """Writes TensorBoard events to `folder` and keeps one point per update and per evaluation."""

    def __init__(self, folder: Path) -> None:
        self.training: list[TrainingPoint] = []
        self.evaluations: list[EvaluationResult] = []
        self._folder = folder
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
        self._writer.add_scalar("error/training_m", point.error_m, point.env_steps)
        self._writer.add_scalar("error/training_raw_gnss_m", point.raw_gnss_error_m, point.env_steps)
        self._writer.add_scalar("speed/env_steps_per_s", point.env_steps_per_s, point.env_steps)
        self._writer.add_scalar("speed/lag_ticks", lag_ticks, point.env_steps)

    def evaluated(self, result: EvaluationResult) -> None:
        """Record one evaluation phase."""
        self.evaluations.append(result)
        for tag, error_m in (
            ("error/evaluation_m", result.ppo_mean_error_m),
            ("error/evaluation_raw_gnss_m", result.raw_gnss_mean_error_m),
            ("error/evaluation_supervised_m", result.supervised_mean_error_m),
            ("error/evaluation_ekf_m", result.ekf_mean_error_m),
            ("error/evaluation_rts_sees_the_future_m", result.rts_mean_error_m),
        ):
            if error_m is not None:
                self._writer.add_scalar(tag, error_m, result.env_steps)

    def close(self) -> None:
        """Flush everything to disk."""
        self._writer.close()
