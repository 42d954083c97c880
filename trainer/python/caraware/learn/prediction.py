"""Predictions for the ticks of a stream as they come, for viewers and for evaluations."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from torch import Tensor

from caraware.ipc.stream import Observation

if TYPE_CHECKING:
    from caraware.learn.ppo import Ppo

Ticks = Mapping[int, Sequence[Observation]]
"""Waiting ticks, oldest first, by the index of their environment."""


class Predictor(Protocol):
    """What predicts with the policy of the moment."""

    def predict_m(self, ticks: Ticks) -> dict[int, list[Tensor]]:
        """Predicted positions f32 `[n, 2]` (m, world) for each tick.

        Ticks that are not taken may be asked for again, and are then predicted again.
        """


class RowPredictor:
    """Of a policy that sees one moment. Training ticks go through the network together.

    An evaluation tick goes alone and without empty slots: a matrix product rounds as its shape demands, and what an
    evaluation says must not depend on how many ticks happened to wait.
    """

    def __init__(self, ppo: "Ppo", dark_is_nan: bool, evaluations_alone: bool) -> None:
        self._ppo, self._dark_is_nan, self._evaluations_alone = ppo, dark_is_nan, evaluations_alone

    def predict_m(self, ticks: Ticks) -> dict[int, list[Tensor]]:
        """See `Predictor.predict_m`."""
        waiting = [obs for of_one in ticks.values() for obs in of_one]
        together = [visible(obs, self._dark_is_nan) for obs in waiting if not self._is_alone(obs)]
        predicted_m = iter(self._ppo.predict_m(together))
        return {
            index: [self._alone_m(obs) if self._is_alone(obs) else next(predicted_m) for obs in of_one]
            for index, of_one in ticks.items()
        }

    def _is_alone(self, obs: Observation) -> bool:
        return self._evaluations_alone and obs.evaluation

    def _alone_m(self, obs: Observation) -> Tensor:
        rows = torch.from_numpy(np.flatnonzero(obs.valid))
        predicted_m = torch.zeros(len(obs.valid), 2)
        predicted_m[rows] = self._ppo.predict_m([visible(obs, self._dark_is_nan).index_select(0, rows)])[0]
        return predicted_m


def visible(obs: Observation, dark_is_nan: bool) -> Tensor:
    """The observation as the networks take it: in place, unless fields of dark sensors must become numbers."""
    return torch.nan_to_num(obs.observation) if dark_is_nan else obs.observation
