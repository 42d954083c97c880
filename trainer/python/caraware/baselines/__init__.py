"""Classical estimators beside the learner, from the same samples: an EKF, one with a map, an RTS smoother as a bound.

The smoother sees the future: a bound, not an estimator. Model, equations and tuning: docs/baselines.md.
"""

from dataclasses import dataclass

import numpy as np

from caraware.baselines.ekf import Ekf
from caraware.baselines.lanes import LaneMap
from caraware.baselines.map_ekf import MapEkf
from caraware.baselines.motion import MotionModel
from caraware.baselines.noise import SensorNoise
from caraware.baselines.rts import SmoothedTick, Smoother
from caraware.baselines.samples import read_samples
from caraware.ipc.arrays import Float64Array, Int64Array
from caraware.ipc.stream import Observation

__all__ = ["BaselineErrors", "Baselines", "Ekf", "MapEkf", "MotionModel", "SensorNoise", "Smoother"]


@dataclass(frozen=True)
class BaselineErrors:
    """Errors of the valid rows of one tick of an episode; `[v]` each."""

    vehicle: Int64Array
    """i64: dense index within the episode."""
    error_m: Float64Array


class Baselines:
    """EKFs and smoother over the evaluation episodes of one phase. It copies what it needs of an observation."""

    def __init__(self, noise: SensorNoise, lanes: LaneMap | None = None) -> None:
        """Without `lanes` there is no filter with a map."""
        self._noise, self._lanes = noise, lanes
        self._begin()

    def add(self, obs: Observation) -> tuple[dict[str, BaselineErrors], list[BaselineErrors]]:
        """Errors of `ekf` and `map_ekf` at this tick, and of the smoother at ticks that are done, if any."""
        samples = read_samples(obs, self._noise.convention)
        rows = np.flatnonzero(obs.valid)
        vehicle = obs.vehicle[rows].astype(np.int64)
        truth_m = np.asarray(obs.truth)[rows, :2].astype(np.float64)
        filters = {"ekf": self._ekf} | ({"map_ekf": self._map_ekf} if self._map_ekf else {})
        for each in filters.values():
            each.step(samples)
        filtered = {
            name: BaselineErrors(vehicle, _distance_m(each.position_m[rows], truth_m)) for name, each in filters.items()
        }
        return filtered, [_errors(tick) for tick in self._smoother.push((rows, vehicle, truth_m))]

    def finish_episode(self) -> list[BaselineErrors]:
        """Errors of the smoother at the ticks that waited for the end of the episode; the next one starts again."""
        left = [_errors(tick) for tick in self._smoother.finish()]
        self._begin()
        return left

    def _begin(self) -> None:
        self._ekf = Ekf(self._noise)
        self._map_ekf = MapEkf(self._noise, self._lanes) if self._lanes else None
        self._smoother = Smoother(self._ekf)


def _errors(tick: SmoothedTick) -> BaselineErrors:
    rows, vehicle, truth_m = tick.label
    return BaselineErrors(vehicle, _distance_m(tick.mean[:2, rows].T, truth_m))


def _distance_m(estimate_m: Float64Array, truth_m: Float64Array) -> Float64Array:
    east, north = (estimate_m - truth_m).T
    distance_m: Float64Array = np.hypot(east, north)
    return distance_m
