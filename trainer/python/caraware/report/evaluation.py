"""A metric of the deterministic policy, of its references and of the classical baselines, over the same rows."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from caraware import _native
from caraware.baselines import BaselineErrors, Baselines, SensorNoise
from caraware.baselines.lanes import LaneMap
from caraware.ipc.arrays import BoolArray, Float64Array, FloatArray, Int64Array, UInt32Array
from caraware.ipc.stream import Observation
from caraware.report.statistics import mean_interval
from caraware.tasks.metrics import interval_key, mean_key

CI95_STANDARD_ERRORS = 1.96
"""Half the width of a 95 % confidence interval of a mean of many, in standard errors."""


ESTIMATORS = {
    "ppo": "policy",
    "raw_gnss": "raw GNSS",
    "supervised": "regression",
    "ekf": "EKF",
    "map_ekf": "EKF with a map",
    "rts": "RTS smoother (sees the future: a bound)",
}
"""Key of each, as in the run's report, and its name for people; the order of the columns of an evaluation's sums."""


_COLUMN = {name: column for column, name in enumerate(ESTIMATORS, start=1)}
"""Of an evaluation's sums; column 0 counts samples."""


@dataclass(frozen=True)
class Estimate:
    """What one estimator reached in a phase: the mean of the task's metric over all samples."""

    mean: float
    standard_error: float
    """With the vehicles of an episode as clusters, since one vehicle's samples are not independent."""
    ci95: float | None = None
    """Half the width of the 95 % confidence interval of the mean over seeds; None for a single seed."""

    def half_width(self) -> float:
        """Half a 95 % interval: over seeds, or over vehicles where there is one seed only."""
        return CI95_STANDARD_ERRORS * self.standard_error if self.ci95 is None else self.ci95


@dataclass(frozen=True)
class EvaluationResult:
    """One evaluation phase: every valid row of consecutive evaluation episodes, the policy unchanged.

    Confidence intervals are over seeds: Student's t over the means of the episodes, each of which has a seed of its
    own. Standard errors are all that a phase of a single episode can have.
    """

    env_steps: int
    """Training samples seen before it."""
    policy_version: int
    episodes: int
    samples: int
    estimates: Mapping[str, Estimate]
    """By the keys of `ESTIMATORS`; a run without sensor tables has no filter and no smoother."""
    environment: int = 0
    """Whose episodes; the first one's index if those of all are pooled."""
    metric: str = field(kw_only=True)
    """Name of the task's metric that the estimators are compared by."""
    further: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    """Means of the task's other metrics over all samples, by keys such as `ppo_mean_wrong_lane_percent`."""

    def mean(self, estimator: str) -> float | None:
        """Mean of the metric, None without that estimator."""
        return self.estimates[estimator].mean if estimator in self.estimates else None

    def report(self) -> dict[str, Any]:
        """For reports and checkpoints: every key of every estimator, such as `ppo_mean_error_m`, None without it."""
        entries = {key: getattr(self, key) for key in _PHASE_KEYS}
        for estimator in ESTIMATORS:
            found = self.estimates.get(estimator)
            values = (found.mean, found.standard_error, found.ci95) if found else (None, None, None)
            entries |= zip(_keys(estimator, self.metric), values, strict=True)
        return entries | dict(self.further)

    @classmethod
    def restored(cls, entries: Mapping[str, Any]) -> "EvaluationResult":
        """The phase whose `report()` this is."""
        metric = next(known.name for known in _native.METRICS if mean_key("ppo", known.name) in entries)
        estimates: dict[str, Estimate] = {}
        for name in ESTIMATORS:
            mean, standard_error, ci95 = (entries.get(key) for key in _keys(name, metric))
            if mean is not None and standard_error is not None:
                estimates[name] = Estimate(mean, standard_error, ci95)
        others = [other.name for other in _native.METRICS if other.name != metric]
        keys = [mean_key(estimator, other) for other in others for estimator in ESTIMATORS]
        further = {key: float(entries[key]) for key in keys if entries.get(key) is not None}
        phase = {key: entries[key] for key in _PHASE_KEYS}
        return cls(**phase, estimates=estimates, metric=metric, further=further)

    def headline(self) -> dict[str, float | None]:
        """Means, half their confidence intervals and the number of seeds, for the run's report."""
        entries = self.report() | {"evaluation_seeds": self.episodes}
        return {key: entries[key] for key in no_headline(self.metric)} | dict(self.further)

    def __str__(self) -> str:
        unit = self.metric.rsplit("_", 1)[1]
        compared = ", ".join(
            f"{label} {self.estimates[name].mean:.3f} ± {self.estimates[name].half_width():.3f} {unit}"
            for name, label in ESTIMATORS.items()
            if name in self.estimates
        )
        over = f"{self.episodes} seeds" if self.episodes > 1 else "the vehicles of one seed"
        further = "".join(f", {key} {value:.2f}" for key, value in self.further.items())
        return f"{compared} (95 % over {over}), {self.samples} samples{further}"


_PHASE_KEYS = ("env_steps", "policy_version", "episodes", "samples", "environment")


def _keys(estimator: str, metric: str) -> tuple[str, str, str]:
    """Keys of an estimator's mean, standard error and half 95 % interval in reports."""
    unit = metric.rsplit("_", 1)[1]
    return mean_key(estimator, metric), f"{estimator}_standard_error_{unit}", interval_key(estimator, metric)


def no_headline(metric: str) -> dict[str, float | None]:
    """The headline of a run that has not been evaluated by its task's metric: every key, without a value."""
    keys = [key(estimator, metric) for estimator in ESTIMATORS for key in (mean_key, interval_key)]
    return {**dict.fromkeys(keys), "evaluation_seeds": 0}


@dataclass(frozen=True)
class EvaluatedRows:
    """Rows of a tick that an evaluation measures without sensors."""

    episode: int
    vehicle: UInt32Array
    """u32 `[n]`."""
    valid: BoolArray
    """bool `[n]`."""


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
    results. Both estimate positions, so they need a task whose metric is a position's error.
    """

    def __init__(
        self,
        metric: str,
        noise: SensorNoise | None = None,
        *,
        lanes: LaneMap | None = None,
        supervised: bool = False,
    ) -> None:
        """`metric` names what is compared. With `lanes` there is a filter with a map; `supervised`: its values come."""
        self._metric = metric
        self._baselines = Baselines(noise, lanes) if noise else None
        has_reference = any(other.reference_for == metric for other in _native.METRICS)
        present = {
            "raw_gnss": has_reference,
            "ekf": noise,
            "rts": noise,
            "map_ekf": noise and lanes,
            "supervised": supervised,
        }
        missing = [name for name, given in present.items() if not given]
        self._known = [name for name in ESTIMATORS if name not in missing]
        self._further: dict[str, Mean] = {}
        self._finished: list[Float64Array] = []
        self._episode: int | None = None
        self._sums = np.zeros((0, 1 + len(ESTIMATORS)))
        """f64 `[vehicle, 7]` of the current episode: samples, and the sum of the metric of each estimator."""

    def add(self, obs: Observation | EvaluatedRows, values: Mapping[str, FloatArray]) -> None:
        """Add the metric's values `[v]` on the valid rows of one evaluation tick, by estimator."""
        if obs.episode != self._episode:
            self._finish_episode()
            self._episode = obs.episode
        vehicle = obs.vehicle[obs.valid].astype(np.int64)
        self._make_room(vehicle)
        self._sums[vehicle, 0] += 1.0
        for name, column in _COLUMN.items():
            if name in values:
                self._sums[vehicle, column] += values[name]
        if self._baselines:
            assert not isinstance(obs, EvaluatedRows)
            filtered, smoothed = self._baselines.add(obs)
            for name, errors in filtered.items():
                self._sums[errors.vehicle, _COLUMN[name]] += errors.error_m
            self._add_smoothed(smoothed)

    def add_further(self, metric: str, values: Mapping[str, FloatArray]) -> None:
        """Add another metric's values `[v]` on the valid rows of the same tick, by estimator."""
        for name, of_rows in values.items():
            self._further.setdefault(mean_key(name, metric), Mean()).add(of_rows)

    def _add_smoothed(self, ticks: Iterable[BaselineErrors]) -> None:
        for tick in ticks:
            self._sums[tick.vehicle, _COLUMN["rts"]] += tick.error_m

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

    def seed_means(self) -> list[dict[str, float]]:
        """Means by estimator of every episode that is finished, each of which has a seed of its own."""
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
        estimates: dict[str, Estimate] = {}
        seeds = [episode[:, 1:].sum(0) / episode[:, 0].sum() for episode in self._finished if len(episode)]
        for column, name in enumerate(ESTIMATORS):
            if name not in self._known:
                continue
            over_seeds = mean_interval([float(seed[column]) for seed in seeds])
            interval = over_seeds.half_width if over_seeds.count > 1 else None
            estimates[name] = Estimate(float(means[column]), float(errors[column]), interval)
        return EvaluationResult(
            env_steps=env_steps,
            policy_version=policy_version,
            episodes=len(seeds),
            samples=int(count.sum()),
            estimates=estimates,
            environment=environment,
            metric=self._metric,
            further={key: mean.value() for key, mean in self._further.items()},
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
    estimates: dict[str, Estimate] = {}
    for name in phase[0].estimates:
        each = [result.estimates[name] for result in phase if name in result.estimates]
        if len(each) < len(phase):
            continue
        intervals = [estimate.ci95 for estimate in each]
        estimates[name] = Estimate(
            mean=sum(share * estimate.mean for share, estimate in zip(shares, each, strict=True)),
            standard_error=math.hypot(*(s * e.standard_error for s, e in zip(shares, each, strict=True))),
            # One episode each: what differs between seeds is what differs between environments.
            ci95=mean_interval([estimate.mean for estimate in each]).half_width
            if None in intervals
            else math.hypot(*(s * half for s, half in zip(shares, intervals, strict=True) if half is not None)),
        )
    shared = [key for key in phase[0].further if all(key in result.further for result in phase)]
    further = {
        key: sum(part * result.further[key] for part, result in zip(shares, phase, strict=True)) for key in shared
    }
    episodes = sum(result.episodes for result in phase)
    return replace(phase[0], samples=samples, episodes=episodes, estimates=estimates, further=further)
