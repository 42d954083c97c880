"""The estimator on a stream of ticks, in training, in evaluations and in `caraware play`."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from caraware.fusion.carrier import Carried, Carrier
from caraware.fusion.learner import FusionLearner
from caraware.ipc.stream import Observation
from caraware.learn.prediction import Predictor, Ticks


class Estimating:
    """The estimator on a stream: causal, tick by tick."""

    def __init__(self, learner: FusionLearner, carrier: Carrier) -> None:
        self._learner, self._carrier = learner, carrier
        self._episode: int | None = None

    @torch.no_grad()
    def step(self, obs: Observation) -> tuple[Tensor, Tensor]:
        """Estimates `[n, 2]` (m, world), and the carrier's rows `[n, COLUMNS]`; of slots with no filter, the fix."""
        estimator = self._learner.estimator
        if obs.episode != self._episode:
            self._carrier.reset()
            self._state, self._episode = estimator.begin(0), obs.episode
        table = self._carrier.step(obs)
        missing = len(table) - len(self._state.hidden)
        if missing > 0:
            fresh = estimator.begin(missing)
            self._state = replace(
                self._state,
                offset_m=torch.cat((self._state.offset_m, fresh.offset_m)),
                hidden=torch.cat((self._state.hidden, fresh.hidden)),
            )
        carried = Carried.of(table)
        self._state = estimator.step(estimator.prepare(carried), self._state)
        estimate_m = carried.filter_m + self._state.offset_m + estimator.centre_m
        fix_m = torch.from_numpy(np.nan_to_num(np.asarray(obs.gnss_m)[:, :2].astype(np.float32)))
        return torch.where(carried.running > 0, estimate_m, fix_m), table


class FusionPlayer:
    """A trained estimator in `caraware play`: the filter and the memory start again with every episode."""

    def __init__(self, learner: FusionLearner, carrier: Carrier) -> None:
        self._learner, self._estimating = learner, Estimating(learner, carrier)

    @property
    def updates(self) -> int:
        """Updates that the estimator has learned from."""
        return self._learner.updates

    def sigma(self) -> float:
        """An estimate is not sampled: 0."""
        return 0.0

    def predictor(self, dark_is_nan: bool, evaluations_alone: bool = True) -> Predictor:
        """See `PlayedPolicy.predictor`. It reads the raw samples, so dark sensors need no care."""
        return self

    def predict_m(self, ticks: Ticks) -> dict[int, list[Tensor]]:
        """See `Predictor.predict_m`, but every tick is asked for once, in order."""
        return {index: self._of_one(waiting) for index, waiting in ticks.items()}

    def _of_one(self, ticks: Sequence[Observation]) -> list[Tensor]:
        return [self._estimating.step(obs)[0] for obs in ticks]
