"""Errors of the deterministic policy, of raw GNSS and of the classical baselines, over exactly the same rows."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from caraware.baselines import BaselineErrors, Baselines, SensorNoise
from caraware.ipc.arrays import Float64Array, FloatArray, Int64Array
from caraware.ipc.stream import Observation
from caraware.report.statistics import mean_interval
from caraware.tasks.localisation import errors_m as errors_m
from caraware.tasks.localisation import raw_errors_m as raw_errors_m

CI95_STANDARD_ERRORS = 1.96
"""Half the width of a 95 % confidence interval of a mean of many, in standard errors."""


@dataclass(frozen=True)
class EvaluationResult:
    """One evaluation phase: every valid row of consecutive evaluation episodes, the policy unchanged.

    Confidence intervals are over seeds: Student's t over the means of the episodes, each of which has a seed of its
    own. Standard errors are those of the mean with the vehicles of an episode as clusters, since one vehicle's samples
    are not independent: all that a phase of a single episode can tell.
    """

    env_steps: int
    """Training samples seen before it."""
    policy_version: int
    episodes: int
    samples: int
    ppo_mean_error_m: float
    ppo_standard_error_m: float
    raw_gnss_mean_error_m: float
    raw_gnss_standard_error_m: float
    ekf_mean_error_m: float | None = None
    """Of the extended Kalman filter; None for a run without sensor tables."""
    ekf_standard_error_m: float | None = None
    rts_mean_error_m: float | None = None
    """Of the smoother, which sees the future: a bound, not an estimator."""
    rts_standard_error_m: float | None = None
    environment: int = 0
    """Whose episodes; the first one's index if those of all are pooled."""
    ppo_ci95_m: float | None = None
    """Half the width of the 95 % confidence interval of the mean over seeds; None for a single seed."""
    raw_gnss_ci95_m: float | None = None
    ekf_ci95_m: float | None = None
    rts_ci95_m: float | None = None
    supervised_mean_error_m: float | None = None
    """Of the policy's network taught by regression to the truth; None for a run without it."""
    supervised_standard_error_m: float | None = None
    supervised_ci95_m: float | None = None

    @classmethod
    def restored(cls, values: dict[str, Any]) -> "EvaluationResult":
        """From what `dataclasses.asdict` made of one."""
        return cls(**{known.name: values[known.name] for known in fields(cls) if known.name in values})

    def half_width_m(self, name: str) -> float:
        """Half a 95 % interval of an estimator's mean: over seeds, or over vehicles where there is one seed only."""
        over_seeds: float | None = getattr(self, f"{name}_ci95_m")
        standard_error_m: float = getattr(self, f"{name}_standard_error_m")
        return CI95_STANDARD_ERRORS * standard_error_m if over_seeds is None else over_seeds

    def headline(self) -> dict[str, float | None]:
        """Mean errors, half their confidence intervals and the number of seeds, for the run's report."""
        means = {key: value for key, value in asdict(self).items() if key.endswith(("_mean_error_m", "_ci95_m"))}
        return means | {"evaluation_seeds": self.episodes}

    def __str__(self) -> str:
        means = ", ".join(
            f"{label} {getattr(self, f'{name}_mean_error_m'):.3f} ± {self.half_width_m(name):.3f} m"
            for name, label in ESTIMATORS.items()
            if getattr(self, f"{name}_mean_error_m") is not None
        )
        over = f"{self.episodes} seeds" if self.episodes > 1 else "the vehicles of one seed"
        return f"{means} (95 % over {over}), {self.samples} samples"


ESTIMATORS = {
    "ppo": "policy",
    "raw_gnss": "raw GNSS",
    "supervised": "regression",
    "ekf": "EKF",
    "rts": "RTS smoother (sees the future: a bound)",
}
"""Key of each, as in the run's report, and its name for people; the order of the columns of an evaluation's sums."""

NO_HEADLINE: dict[str, float | None] = {
    **dict.fromkeys(f"{name}_{what}_m" for name in ESTIMATORS for what in ("mean_error", "ci95")),
    "evaluation_seeds": 0,
}
"""The headline of a run that has not been evaluated: every key, without a value."""


class Mean:
    """Mean of what comes bit by bit; the same bits for the same bits in the same order."""

    def __init__(self) -> None:
        self._count, self._sum = 0, 0.0

    def add(self, values: FloatArray) -> None:
        """Add some values."""
        self._count += len(values)
        self._sum += float(values.sum(dtype=np.float64))

    def value(self) -> float:
        """The mean so far; nan without a value."""
        return self._sum / self._count if self._count else math.nan


class Evaluation:
    """Collects one evaluation phase. A vehicle keeps its index within an episode.

    With the errors of sensors, filter and smoother run beside the policy, over the same rows; without, they have no
    results.
    """

    def __init__(self, noise: SensorNoise | None = None, *, supervised: bool = False) -> None:
        """`supervised`: the errors of that baseline will be added too."""
        self._baselines = Baselines(noise) if noise else None
        missing = ("ekf", "rts")[: 0 if noise else 2] + ("supervised",)[: 0 if supervised else 1]
        self._known = [name for name in ESTIMATORS if name not in missing]
        self._finished: list[Float64Array] = []
        self._episode: int | None = None
        self._sums = np.zeros((0, 1 + len(ESTIMATORS)))
        """f64 `[vehicle, 6]` of the current episode: samples, and the sum of the errors of each estimator."""

    def add(
        self, obs: Observation, policy_m: FloatArray, raw_m: FloatArray, supervised_m: FloatArray | None = None
    ) -> None:
        """Add the errors `[v]` of the valid rows of one evaluation tick."""
        if obs.episode != self._episode:
            self._finish_episode()
            self._episode = obs.episode
        vehicle = obs.vehicle[obs.valid].astype(np.int64)
        self._make_room(vehicle)
        self._sums[vehicle, :3] += np.column_stack((np.ones(len(vehicle)), policy_m, raw_m))
        if supervised_m is not None:
            self._sums[vehicle, 3] += supervised_m
        if self._baselines:
            filtered, smoothed = self._baselines.add(obs)
            self._sums[filtered.vehicle, 4] += filtered.error_m
            self._add_smoothed(smoothed)

    def _add_smoothed(self, ticks: Iterable[BaselineErrors]) -> None:
        for tick in ticks:
            self._sums[tick.vehicle, 5] += tick.error_m

    def _make_room(self, vehicle: Int64Array) -> None:
        missing = int(vehicle.max(initial=-1)) + 1 - len(self._sums)
        if missing > 0:
            self._sums = np.pad(self._sums, ((0, missing), (0, 0)))

    def _finish_episode(self) -> None:
        """The smoother has waited for the end; from here on vehicles are others."""
        if self._baselines:
            self._add_smoothed(self._baselines.finish_episode())
        self._finished.append(self._sums[self._sums[:, 0] > 0])
        self._sums = np.zeros((0, self._sums.shape[1]))

    def seeds_m(self) -> list[dict[str, float]]:
        """Mean errors by estimator of every episode that is finished, each of which has a seed of its own."""
        means = [episode[:, 1:].sum(0) / episode[:, 0].sum() for episode in self._finished if len(episode)]
        every = [dict(zip(ESTIMATORS, map(float, mean), strict=True)) for mean in means]
        return [{name: mean[name] for name in self._known} for mean in every]

    def result(self, env_steps: int, policy_version: int, environment: int = 0) -> EvaluationResult | None:
        """The phase, which ends here; None without a sample."""
        self._finish_episode()
        sums = np.concatenate(self._finished)
        if len(sums) == 0:
            return None
        count = sums[:, 0]
        means = sums[:, 1:].sum(0) / count.sum()
        # Ratio estimator over clusters (Cochran, Sampling Techniques, section 6.3).
        errors = np.sqrt(np.square(sums[:, 1:] - count[:, None] * means).sum(0)) / count.sum()
        results: dict[str, Any] = {}
        seeds = [episode[:, 1:].sum(0) / episode[:, 0].sum() for episode in self._finished if len(episode)]
        for column, name in enumerate(ESTIMATORS):
            if name not in self._known:
                continue
            over_seeds = mean_interval([float(seed[column]) for seed in seeds])
            results |= {
                f"{name}_mean_error_m": float(means[column]),
                f"{name}_standard_error_m": float(errors[column]),
                f"{name}_ci95_m": over_seeds.half_width if over_seeds.count > 1 else None,
            }
        return EvaluationResult(
            env_steps=env_steps,
            policy_version=policy_version,
            episodes=len(seeds),
            samples=int(count.sum()),
            environment=environment,
            **results,
        )


def pooled(results: Sequence[EvaluationResult]) -> list[EvaluationResult]:
    """Phase by phase the evaluations of all environments as one; phases that not every environment has finished wait.

    Environments share no vehicle, so the mean is that over all samples and its variance the sum of theirs.
    """
    by_environment: dict[int, list[EvaluationResult]] = {}
    for result in results:
        by_environment.setdefault(result.environment, []).append(result)
    return [_pool(phase) for phase in zip(*by_environment.values(), strict=False)]


def _pool(phase: Sequence[EvaluationResult]) -> EvaluationResult:
    if len(phase) == 1:
        return phase[0]
    samples = sum(result.samples for result in phase)
    shares = [result.samples / samples for result in phase]
    values: dict[str, Any] = {}
    for name in ESTIMATORS:
        means_m = [getattr(result, f"{name}_mean_error_m") for result in phase]
        if None in means_m:
            continue
        errors_m = [getattr(result, f"{name}_standard_error_m") for result in phase]
        values[f"{name}_mean_error_m"] = sum(share * mean for share, mean in zip(shares, means_m, strict=True))
        values[f"{name}_standard_error_m"] = math.hypot(*(s * e for s, e in zip(shares, errors_m, strict=True)))
        halves_m = [getattr(result, f"{name}_ci95_m") for result in phase]
        if None in halves_m:
            # One episode each: what differs between seeds is what differs between environments.
            values[f"{name}_ci95_m"] = mean_interval(means_m).half_width
        else:
            values[f"{name}_ci95_m"] = math.hypot(*(s * h for s, h in zip(shares, halves_m, strict=True)))
    return replace(phase[0], samples=samples, episodes=sum(result.episodes for result in phase), **values)
