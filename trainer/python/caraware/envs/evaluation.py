"""The evaluation episodes of a run that a face answers: means of the task's headline metric for the run's report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caraware.envs.transition import Rows
from caraware.ipc.arrays import BoolArray, Float32Array, FloatArray
from caraware.tasks.contract import Task
from caraware.tasks.metrics import mean_key, reference_names


@dataclass(frozen=True)
class _EvaluatedTick:
    """A tick as metrics take it, with fixes of float64, in which faces measure."""

    truth: Tensor
    gnss_m: Tensor
    valid: BoolArray


class EvaluationMeans:
    """Means over one phase of evaluation episodes, of the policy and of its references on the same rows.

    A task whose metrics need the outcome of an action has none.
    """

    def __init__(self, task: Task) -> None:
        self._task, self._metric = task, task.metrics[0]
        self.episode: int | None = None
        """Number of the newest episode; None before the first."""
        self._count = 0
        self._sums: dict[str, float] = {}

    def add(self, episode: int, rows: Rows, mask: BoolArray, action: Float32Array) -> None:
        """Add a tick of an episode and the actions `[N, a]` that answer it."""
        tick = _EvaluatedTick(torch.from_numpy(rows.truth), torch.from_numpy(rows.gnss_m.astype(np.float64)), mask)
        answers = self._task.answer(torch.from_numpy(action.astype(np.float64)), torch.from_numpy(rows.observation))
        of_policy = self._task.measure_answers(tick, answers)
        if self._metric.name in of_policy:
            references = self._task.measure_references([tick])
            self._add("ppo", of_policy[self._metric.name])
            for estimator, name in reference_names(self._metric).items():
                self._add(estimator, references[name][0])
            self._count += int(np.count_nonzero(mask))
        self.episode = episode

    def report(self) -> dict[str, float]:
        """Means by the keys of a run's report; empty before the first row."""
        if not self._count:
            return {}
        return {mean_key(name, self._metric.name): value / self._count for name, value in self._sums.items()}

    def _add(self, estimator: str, values: FloatArray) -> None:
        self._sums[estimator] = self._sums.get(estimator, 0.0) + float(values.sum())
