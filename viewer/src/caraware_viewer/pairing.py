"""Pairs observation and prediction of one tick, which arrive separately, and measures their errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from caraware_viewer.wire import Observation, Prediction

TickFrame = TypeVar("TickFrame", Observation, Prediction)

_MAX_WAITING = 8
"""Most frames that wait for a counterpart: the simulator is at most a window of eight ticks ahead of the learner."""


class Pairing:
    """Keeps the newest observations and predictions until both of a tick have arrived."""

    def __init__(self) -> None:
        self._observations: dict[tuple[int, int], Observation] = {}
        self._predictions: dict[tuple[int, int], Prediction] = {}

    def observation(self, frame: Observation) -> tuple[Observation, Prediction] | None:
        """Adds an observation; returns the pair if its prediction has arrived."""
        _keep(self._observations, frame)
        return self._pair(frame)

    def prediction(self, frame: Prediction) -> tuple[Observation, Prediction] | None:
        """Adds a prediction; returns the pair if its observation has arrived."""
        _keep(self._predictions, frame)
        return self._pair(frame)

    def _pair(self, frame: Observation | Prediction) -> tuple[Observation, Prediction] | None:
        key = _key(frame)
        if key not in self._observations or key not in self._predictions:
            return None
        return self._observations.pop(key), self._predictions.pop(key)


def _key(frame: Observation | Prediction) -> tuple[int, int]:
    return frame.header.run_id, frame.header.tick


def _keep(frames: dict[tuple[int, int], TickFrame], frame: TickFrame) -> None:
    frames[_key(frame)] = frame
    while len(frames) > _MAX_WAITING:
        frames.pop(next(iter(frames)))


@dataclass(frozen=True)
class Distances:
    """Euclidean distances from the truth at one tick, `[n]` by slot, metres; NaN where there is nothing to compare."""

    raw_gnss: NDArray[np.float32]
    policy: NDArray[np.float32] | None = None
    ekf: NDArray[np.float32] | None = None


def distances(observation: Observation, prediction: Prediction | None, *, has_positions: bool = True) -> Distances:
    """Errors of an observation's fixes and of its prediction, whose answers are positions or actions."""
    raw_gnss = distance_m(observation, observation.gnss_m[:, :2])
    policy = distance_m(observation, prediction.answer) if prediction is not None and has_positions else None
    estimate_m = None if prediction is None else prediction.estimate_m
    return Distances(raw_gnss, policy, None if estimate_m is None else distance_m(observation, estimate_m))


def distance_m(observation: Observation, points_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Distance `[n]` of `points_m` `[≤ n, 2]` from the truth; NaN where a slot is not valid or the point not finite."""
    result = np.full(observation.header.rows, np.nan, np.float32)
    n = min(observation.header.rows, len(points_m))
    result[:n] = np.linalg.norm(points_m[:n] - observation.truth[:n, :2], axis=1)
    result[~observation.valid] = np.nan
    result[~np.isfinite(result)] = np.nan
    return result


def mean_m(distance: NDArray[np.float32] | None) -> float:
    """Mean over the slots that are not NaN; NaN without any."""
    if distance is None or np.isnan(distance).all():
        return float("nan")
    return float(np.nanmean(distance))
