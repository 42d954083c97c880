"""Evaluation phases of a run: ticks of evaluation episodes, environment by environment, until training continues."""

import logging
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from caraware import _native
from caraware.ipc.arrays import Float32Array, FloatArray
from caraware.ipc.stream import Observation
from caraware.learn.prediction import visible
from caraware.learn.regression import Regression
from caraware.learn.rewards import distance_m
from caraware.learn.supervised import Supervised
from caraware.report.evaluation import Evaluation, EvaluationResult
from caraware.run.config import RunConfig
from caraware.run.followed import FollowedTicks
from caraware.run.stream_position import StreamProgress
from caraware.tasks.contract import Sampling
from caraware.tasks.localisation import Localisation
from caraware.tasks.metrics import reference_names

log = logging.getLogger("caraware.run.loop")


class EvaluationPhase:
    """The open evaluation phase of one environment, if there is one."""

    def __init__(self, config: RunConfig, number: int) -> None:
        """`number` is the index of the environment among those of all ranks."""
        self._config, self._number = config, number
        self._headline = config.task.metrics[0]
        self._evaluation: Evaluation | None = None
        self._followed = FollowedTicks(config.task) if config.task.sampling is Sampling.EACH_TICK else None
        self._newest_tick = -1

    def add(
        self,
        progress: StreamProgress,
        obs: Observation,
        predicted_m: Tensor,
        references: Mapping[str, FloatArray],
        supervised: Supervised | Regression | None,
    ) -> None:
        """Count one tick, unless a predecessor has evaluated it; `references` are the reference metrics by name."""
        if obs.tick <= progress.evaluated_tick:
            return
        if self._followed is not None:
            if self._evaluation is None:
                self._evaluation = Evaluation(self._headline.name)
            if (past := self._followed.add(obs)) is not None:
                self._evaluation.add(past, {"ppo": past.metrics[self._headline.name]})
                for name, of_policy in past.metrics.items():
                    if name != self._headline.name:
                        self._evaluation.add_further(name, {"ppo": of_policy})
            self._newest_tick = obs.tick
            return
        if self._evaluation is None:
            # The filters estimate positions, so they are compared by a position's error alone.
            filters = isinstance(self._config.task, Localisation)
            self._evaluation = Evaluation(
                self._headline.name,
                self._config.sensors if filters else None,
                lanes=self._config.lanes() if filters else None,
                supervised=supervised is not None,
            )
        values = {"ppo": self._config.task.measure_answers(obs, predicted_m)}
        if isinstance(supervised, Regression):
            answers = supervised.answers(obs, self._config.dark_is_nan)
            values["supervised"] = self._config.task.measure_answers(obs, answers)
        elif supervised is not None:
            values["supervised"] = {self._headline.name: self._supervised_errors_m(obs, supervised)}
        for metric in self._config.task.metrics:
            if metric.reference_for is None:
                of_metric = {name: measured[metric.name] for name, measured in values.items()}
                of_metric |= {name: references[of] for name, of in reference_names(metric).items()}
                self._add(metric, obs, of_metric)
        self._newest_tick = obs.tick

    def _add(self, metric: _native.Metric, obs: Observation, values: Mapping[str, FloatArray]) -> None:
        """Add the values of one metric by estimator."""
        assert self._evaluation is not None
        if metric.name == self._headline.name:
            self._evaluation.add(obs, values)
        else:
            self._evaluation.add_further(metric.name, values)

    def finish(self, progress: StreamProgress, env_steps: int, updates: int) -> EvaluationResult | None:
        """Close the phase after so many samples and updates; None if none was open."""
        evaluation, self._evaluation = self._evaluation, None
        result = evaluation.result(env_steps, updates, self._number) if evaluation else None
        if result is not None:
            progress.evaluated_tick = self._newest_tick
            log.info("evaluation at %d env steps: %s", result.env_steps, result)
        return result

    def _supervised_errors_m(self, obs: Observation, supervised: Supervised) -> FloatArray:
        """Errors of the baseline that learns positions beside the policy, on the valid rows."""
        rows = torch.from_numpy(np.flatnonzero(obs.valid))
        observation = visible(obs, self._config.dark_is_nan)
        predicted_m = supervised.predict_m(observation.index_select(0, rows))
        errors_m: Float32Array = distance_m(predicted_m, obs.truth.index_select(0, rows)).numpy()
        return errors_m
