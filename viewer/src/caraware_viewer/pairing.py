"""Observation and prediction of one tick belong together, but travel apart: this joins them again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caraware_viewer.wire import Observation, Prediction

_KEPT = 8
"""Ticks to wait for a counterpart: the simulator is at most a window of eight ticks ahead of the learner."""


class Pairing:
    """Keeps the last few of each until both of a tick are there."""

    def __init__(self) -> None:
        self._observations: dict[tuple[int, int], Observation] = {}
        self._predictions: dict[tuple[int, int], Prediction] = {}

    def observation(self, frame: Observation) -> tuple[Observation, Prediction] | None:
        """Adds an observation; the pair, if its prediction is there."""
        _keep(self._observations, frame)
        return self._pair(frame)

    def prediction(self, frame: Prediction) -> tuple[Observation, Prediction] | None:
        """Adds a prediction; the pair, if its observation is there."""
        _keep(self._predictions, frame)
        return self._pair(frame)

    def _pair(self, frame: Observation | Prediction) -> tuple[Observation, Prediction] | None:
        key = _key(frame)
        if key not in self._observations or key not in self._predictions:
            return None
        return self._observations.pop(key), self._predictions.pop(key)


def _key(frame: Observation | Prediction) -> tuple[int, int]:
    return frame.header.run_id, frame.header.tick


def _keep(frames: dict[tuple[int, int], Observation] | dict[tuple[int, int], Prediction], frame) -> None:
    frames[_key(frame)] = frame
    while len(frames) > _KEPT:
        frames.pop(next(iter(frames)))


@dataclass(frozen=True)
class Errors:
    """Euclidean distances from the truth at one tick, for the slots that predict and are valid."""

    truth_m: NDArray[np.float32]
    """`[k, 2]`."""
    predicted_m: NDArray[np.float32]
    """`[k, 2]`."""
    policy_m: float
    """Mean over the slots, metres; NaN if there are none."""


def policy_errors(observation: Observation, prediction: Prediction) -> Errors:
    """Predictions beside their truths, without the slots that are not valid or hold no finite prediction."""
    n = min(observation.header.count, prediction.header.count)
    predicted = prediction.position_m[:n]
    chosen = observation.valid[:n] & np.isfinite(predicted).all(axis=1)
    truth, predicted = observation.truth[:n, :2][chosen], predicted[chosen]
    return Errors(truth, predicted, mean_distance_m(truth, predicted))


def gnss_error_m(observation: Observation) -> float:
    """Mean distance of the raw GNSS fixes from the truth over the valid slots, metres; NaN if there are none."""
    valid = observation.valid
    return mean_distance_m(observation.truth[valid, :2], observation.gnss_m[valid, :2])


def mean_distance_m(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """Mean Euclidean distance between the rows of `a` and `b`; NaN without rows."""
    return float(np.linalg.norm(a - b, axis=1).mean()) if len(a) else float("nan")
