"""What carries an estimate from tick to tick: dead reckoning and the pull of the fixes, from a Kalman filter.

The filter is the one with a map (`caraware.baselines.map_ekf`), or without lanes the plain one. It says how every
vehicle moved, how far the newest fix pulls, how much that counts, and how far the lanes pull. The learned estimator
moves its own previous estimate by the first, and decides about the rest.
"""

from dataclasses import dataclass
from itertools import accumulate

import numpy as np
import torch
from torch import Tensor

from caraware.baselines.ekf import Ekf
from caraware.baselines.lanes import LaneMap
from caraware.baselines.map_ekf import MapEkf
from caraware.baselines.motion import SPEED, YAW, X, Y
from caraware.baselines.noise import SensorNoise
from caraware.baselines.samples import Samples, read_samples
from caraware.ipc.arrays import Float32Array, Float64Array
from caraware.ipc.stream import Observation

SMALLEST_VARIANCE_M2 = 1e-4

_COLUMNS = {
    "filter_m": 2,
    "step_m": 2,
    "pull_m": 2,
    "lane_m": 2,
    "gain": 2,
    "innovation_m": 2,
    "spread_m2": 3,
    "yaw_rad": 1,
    "speed_mps": 1,
    "yaw_rate_radps": 1,
    "accel_mps2": 1,
    "fix_age_s": 1,
    "since_start_s": 1,
    "has_fix": 1,
    "has_imu": 1,
    "has_wheel": 1,
    "begins": 1,
    "running": 1,
}


@dataclass(frozen=True)
class Carried:
    """What the filters say of some ticks; f32 `[..., k]` by `_COLUMNS`, world frame, places from the map's centre."""

    filter_m: Tensor
    """The filter's own estimate: east, north."""
    step_m: Tensor
    """How the vehicle moved since the tick before, by dead reckoning."""
    pull_m: Tensor
    """How far the fix moved the filter's estimate."""
    lane_m: Tensor
    """How far the lanes moved it after that; 0 without a map."""
    gain: Tensor
    """How much of a distance to the fix that was, along and across the heading: 0, or less than 1."""
    innovation_m: Tensor
    """A new fix less the filter's prediction; 0 without a new fix."""
    spread_m2: Tensor
    """The filter's covariance: east, east-north, north."""
    yaw_rad: Tensor
    speed_mps: Tensor
    yaw_rate_radps: Tensor
    accel_mps2: Tensor
    fix_age_s: Tensor
    since_start_s: Tensor
    has_fix: Tensor
    """1 where the sensor delivers."""
    has_imu: Tensor
    has_wheel: Tensor
    begins: Tensor
    """1 where the filter started at this tick: nothing is to be carried on."""
    running: Tensor
    """1 where there is a filter."""

    @classmethod
    def of(cls, table: Tensor) -> "Carried":
        """Views of a table `[..., COLUMNS]`."""
        ends = list(accumulate(_COLUMNS.values()))
        starts = [0, *ends[:-1]]
        return cls(**{name: table[..., a:b] for name, a, b in zip(_COLUMNS, starts, ends, strict=True)})


COLUMNS = sum(_COLUMNS.values())


class Carrier:
    """The filters of all slots. Feed it every tick in order."""

    def __init__(self, noise: SensorNoise, centre_m: tuple[float, float], lanes: LaneMap | None = None) -> None:
        """With `lanes` the filter has a map."""
        self._noise, self._centre_m, self._lanes = noise, np.array(centre_m)[:, None], lanes
        self.reset()

    def reset(self) -> None:
        """Forget everything: what comes next is another episode."""
        self._ekf = MapEkf(self._noise, self._lanes) if self._lanes else Ekf(self._noise)
        self._ekf.keep_prediction = True
        self._since_s = np.zeros(0)
        self._time_s: float | None = None

    def step(self, obs: Observation) -> Tensor:
        """One tick: f32 `[n, COLUMNS]`, zeros in slots without a filter."""
        samples = read_samples(obs, self._noise.convention)
        before = self._padded(self._ekf.belief.mean[:2], len(samples.vehicle))
        self._ekf.step(samples)
        self._count_seconds(samples)
        return torch.from_numpy(self._table(samples, before))

    def _count_seconds(self, samples: Samples) -> None:
        since_s = self._padded(self._since_s[None], len(samples.vehicle))[0]
        passed_s = samples.time_s - self._time_s if self._time_s is not None else 0.0
        self._since_s = np.where(self._ekf.started | ~self._ekf.running, 0.0, since_s + passed_s)
        self._time_s = samples.time_s

    def _table(self, samples: Samples, before: Float64Array) -> Float32Array:
        ekf = self._ekf
        mean, predicted = ekf.belief.mean, ekf.predicted.mean
        fixed = ekf.before_map if isinstance(ekf, MapEkf) else ekf.belief
        covariance, prior = ekf.belief.covariance, ekf.predicted.covariance
        goes_on = ekf.running & ~ekf.started
        pull_m = fixed.mean[:2] - predicted[:2]
        left = _spreads(fixed.covariance, mean[YAW]) / np.maximum(_spreads(prior, mean[YAW]), SMALLEST_VARIANCE_M2)
        used = goes_on & samples.fix_on & (samples.fix_age_s < 0.5 * self._noise.tick_s)
        innovation_m = np.where(used, samples.fix_m - predicted[:2], 0.0)
        rows = (
            *(mean[:2] - self._centre_m),
            *np.where(goes_on, predicted[:2] - before, 0.0),
            *np.where(goes_on, pull_m, 0.0),
            *np.where(goes_on, mean[:2] - fixed.mean[:2], 0.0),
            *np.where(goes_on, np.clip(1.0 - left, 0.0, 1.0), 1.0),
            *innovation_m,
            covariance[X, X],
            covariance[X, Y],
            covariance[Y, Y],
            mean[YAW],
            mean[SPEED],
            np.where(samples.imu_on, samples.yaw_rate_radps[-1], 0.0),
            np.where(samples.imu_on, samples.accel_mps2[-1], 0.0),
            samples.fix_age_s,
            self._since_s,
            samples.fix_on,
            samples.imu_on,
            samples.wheel_on,
            ekf.started,
            ekf.running,
        )
        table = np.stack([np.asarray(row, np.float32) for row in rows], axis=1)
        return np.where(ekf.running[:, None], table, np.float32(0.0))

    @staticmethod
    def _padded(rows: Float64Array, slots: int) -> Float64Array:
        return np.pad(rows, ((0, 0), (0, slots - rows.shape[1])))


def _spreads(covariance: Float64Array, yaw_rad: Float64Array) -> Float64Array:
    """Variances along and across the heading `[2, n]`."""
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    ee, en, nn = covariance[X, X], covariance[X, Y], covariance[Y, Y]
    turned = 2.0 * en * cos * sin
    return np.stack((ee * cos**2 + turned + nn * sin**2, ee * sin**2 - turned + nn * cos**2))
