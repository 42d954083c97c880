"""Errors of the deterministic policy and of raw GNSS, over exactly the same rows."""

import math
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from caraware.rewards import distance_m
from caraware.stream import Observation


@dataclass(frozen=True)
class EvaluationResult:
    """One evaluation phase: every valid row of consecutive evaluation episodes, the policy unchanged."""

    env_steps: int
    """Training samples seen before it."""
    policy_version: int
    episodes: int
    samples: int
    ppo_mean_error_m: float
    ppo_standard_error_m: float
    """Of the mean, with the vehicles of an episode as clusters: one vehicle's samples are not independent."""
    raw_gnss_mean_error_m: float
    raw_gnss_standard_error_m: float


class ErrorMeter:
    """Running mean errors of policy and raw GNSS, in metres; cheap enough for every training tick."""

    def __init__(self) -> None:
        self.samples = 0
        self._policy_sum_m = 0.0
        self._raw_sum_m = 0.0

    def add(self, policy_m: np.ndarray, raw_m: np.ndarray) -> None:
        """Add the errors `[v]` of valid rows."""
        self.samples += len(policy_m)
        self._policy_sum_m += float(policy_m.sum(dtype=np.float64))
        self._raw_sum_m += float(raw_m.sum(dtype=np.float64))

    def means_m(self) -> tuple[float, float]:
        """Mean error of the policy and of raw GNSS; nan without samples."""
        if self.samples == 0:
            return math.nan, math.nan
        return self._policy_sum_m / self.samples, self._raw_sum_m / self.samples


class Evaluation:
    """Collects one evaluation phase. Vehicles are told apart within an episode."""

    def __init__(self) -> None:
        self._finished: list[np.ndarray] = []
        self._episode: int | None = None
        self._sums = np.zeros((0, 3))
        """f64 `[vehicle, 3]` of the current episode: samples, sum of the policy's errors, sum of raw GNSS's."""

    def add(self, obs: Observation, policy_m: np.ndarray, raw_m: np.ndarray) -> None:
        """Add the errors `[v]` of the valid rows of one evaluation tick."""
        if obs.episode != self._episode:
            self._finished.append(self._sums)
            self._episode, self._sums = obs.episode, np.zeros((0, 3))
        vehicle = obs.vehicle[obs.valid].astype(np.int64)
        if len(vehicle) == 0:
            return
        if (missing := int(vehicle.max()) + 1 - len(self._sums)) > 0:
            self._sums = np.pad(self._sums, ((0, missing), (0, 0)))
        self._sums[vehicle] += np.column_stack((np.ones(len(vehicle)), policy_m, raw_m))

    def result(self, env_steps: int, policy_version: int) -> EvaluationResult | None:
        """The phase so far; None without a sample."""
        episodes = [sums[sums[:, 0] > 0] for sums in (*self._finished, self._sums)]
        sums = np.concatenate(episodes)
        if len(sums) == 0:
            return None
        count = sums[:, 0]
        means = sums[:, 1:].sum(0) / count.sum()
        # Ratio estimator over clusters (Cochran, Sampling Techniques, section 6.3).
        errors = np.sqrt(np.square(sums[:, 1:] - count[:, None] * means).sum(0)) / count.sum()
        return EvaluationResult(
            env_steps=env_steps,
            policy_version=policy_version,
            episodes=sum(len(episode) > 0 for episode in episodes),
            samples=int(count.sum()),
            ppo_mean_error_m=float(means[0]),
            ppo_standard_error_m=float(errors[0]),
            raw_gnss_mean_error_m=float(means[1]),
            raw_gnss_standard_error_m=float(errors[1]),
        )


def errors_m(obs: Observation, predictions_m: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Distances to the truth `[v]` of predictions `[n, 2]` and of raw GNSS, on the valid rows of a tick."""
    valid = obs.valid
    policy = distance_m(predictions_m, obs.truth).numpy()[valid]
    return policy, distance_m(obs.gnss_m, obs.truth).numpy()[valid]
