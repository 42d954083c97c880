"""A Kalman filter over the positions and slow fix errors of several vehicles at once, and its smoother.

Both axes have the same errors, so one covariance serves both: a mean is `[2 m, 2]` for m vehicles, its rows position
and slow error in turn, its columns east and north. Motion between two ticks is given by each vehicle's own filter.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from caraware.ipc.arrays import Float64Array


@dataclass(frozen=True)
class JointNoise:
    """Standard deviations, each on one axis."""

    fix_std_m: float
    """White error of a fix."""
    slow_std_m: float
    """Slow error of a fix, a first-order Gauss–Markov process."""
    slow_time_s: float
    view_std_m: float
    """Position of one vehicle as another perceives it, relative to itself."""
    moved_std_m: float = 0.02
    """Motion between two ticks of a vehicle whose sensors are known."""
    heard_std_m: float = 0.1
    """Motion between two ticks of a vehicle that is known from messages."""


@dataclass(frozen=True)
class _Step:
    """A tick as the smoother needs it."""

    keys: tuple[int, ...]
    mean: Float64Array
    covariance: Float64Array
    predicted_mean: Float64Array
    predicted_covariance: Float64Array
    """Before the corrections of this tick, of the vehicles that were known before: the first of `keys`."""
    kept: float
    """Factor of the slow errors since the tick before."""
    survivors: tuple[int, ...]


class JointFilter:
    """Vehicles are named by numbers; they may come and go."""

    def __init__(self, noise: JointNoise, *, remembers: bool = False) -> None:
        self.noise, self._remembers = noise, remembers
        self.place: dict[int, int] = {}
        """Of each vehicle among the pairs of rows."""
        self.mean = np.zeros((0, 2))
        self.covariance = np.zeros((0, 0))
        self._steps: list[_Step] = []
        self._predicted: tuple[Float64Array, Float64Array, float, tuple[int, ...]] | None = None

    def __contains__(self, key: int) -> bool:
        """Whether the vehicle is known."""
        return key in self.place

    def position_m(self, key: int) -> Float64Array:
        """f64 `[2]`: east and north."""
        position: Float64Array = self.mean[2 * self.place[key]]
        return position

    def variance_m2(self, key: int) -> float:
        """Of the position on one axis."""
        return float(self.covariance[2 * self.place[key], 2 * self.place[key]])

    def add(self, key: int, position_m: Float64Array, variance_m2: float, *, has_fix: bool) -> None:
        """A vehicle whose position is known by `variance_m2`. One that is only perceived has no slow error."""
        size = len(self.mean)
        self.place[key] = size // 2
        self.mean = np.vstack((self.mean, [position_m, np.zeros(2)]))
        covariance = np.zeros((size + 2, size + 2))
        covariance[:size, :size] = self.covariance
        covariance[size, size] = variance_m2
        covariance[size + 1, size + 1] = self.noise.slow_std_m**2 if has_fix else 0.0
        self.covariance = covariance

    def add_at_fix(self, key: int, fix_m: Float64Array) -> None:
        """A vehicle that starts from a fix: `p = z − e` has the error of `e`."""
        self.add(key, fix_m, self.noise.fix_std_m**2 + self.noise.slow_std_m**2, has_fix=True)
        row = 2 * self.place[key]
        self.covariance[row, row + 1] = self.covariance[row + 1, row] = -(self.noise.slow_std_m**2)

    def keep(self, keys: set[int]) -> None:
        """Forget all others."""
        gone = [key for key in self.place if key not in keys]
        if not gone:
            return
        rows = [row for key in gone for row in (2 * self.place[key], 2 * self.place[key] + 1)]
        self.mean = np.delete(self.mean, rows, 0)
        self.covariance = np.delete(np.delete(self.covariance, rows, 0), rows, 1)
        left = [key for key in self.place if key in keys]
        self.place = {key: place for place, key in enumerate(left)}

    def predict(self, moved_m: Mapping[int, Float64Array], dt_s: float, exact: set[int]) -> None:
        """Move each vehicle by `moved_m` (0 without); those in `exact` are known by their own sensors."""
        kept = math.exp(-dt_s / self.noise.slow_time_s)
        self.mean[1::2] *= kept
        self.covariance[1::2] *= kept
        self.covariance[:, 1::2] *= kept
        for key, place in self.place.items():
            row = 2 * place
            if key in moved_m:
                self.mean[row] += moved_m[key]
            std_m = self.noise.moved_std_m if key in exact else self.noise.heard_std_m
            self.covariance[row, row] += std_m**2
            if self.covariance[row + 1, row + 1] > 0.0:
                self.covariance[row + 1, row + 1] += self.noise.slow_std_m**2 * (1.0 - kept**2)
        if self._remembers:
            self._predicted = (self.mean.copy(), self.covariance.copy(), kept, tuple(self.place))

    def fix(self, key: int, fix_m: Float64Array, variance_m2: float) -> None:
        """`z = p + e + n`."""
        row = 2 * self.place[key]
        self._correct([(row, 1.0), (row + 1, 1.0)], fix_m - self.mean[row] - self.mean[row + 1], variance_m2)

    def see(self, observer: int, seen: int, offset_m: Float64Array, variance_m2: float) -> None:
        """`z = p_seen − p_observer + n`."""
        a, b = 2 * self.place[observer], 2 * self.place[seen]
        self._correct([(b, 1.0), (a, -1.0)], offset_m - self.mean[b] + self.mean[a], variance_m2)

    def pull(self, key: int, position_m: Float64Array, variance_m2: float) -> None:
        """`z = p + n`."""
        row = 2 * self.place[key]
        self._correct([(row, 1.0)], position_m - self.mean[row], variance_m2)

    def _correct(self, row: list[tuple[int, float]], innovation: Float64Array, variance_m2: float) -> None:
        toward: Float64Array = sum(coefficient * self.covariance[:, index] for index, coefficient in row)  # type: ignore[assignment]  # no empty row
        spread = sum(coefficient * toward[index] for index, coefficient in row) + variance_m2
        gain = toward / spread
        self.mean += gain[:, None] * innovation
        self.covariance -= gain[:, None] * toward

    def remember(self) -> None:
        """End a tick: the smoother will go back over it."""
        nothing: tuple[int, ...] = ()
        before = self._predicted or (self.mean[:0], self.covariance[:0, :0], 1.0, nothing)
        mean, covariance, kept, survivors = before
        keys = tuple(self.place)
        self._steps.append(_Step(keys, self.mean.copy(), self.covariance.copy(), mean, covariance, kept, survivors))
        self._predicted = None

    def smoothed_m(self) -> list[dict[int, Float64Array]]:
        """Positions of every remembered tick with all that came later (H. Rauch, F. Tung, C. Striebel, 1965)."""
        smoothed: list[dict[int, Float64Array]] = []
        after: tuple[_Step, Float64Array] | None = None
        for step in reversed(self._steps):
            mean = step.mean
            if after is not None:
                mean = mean + _from_later(step, *after)
            smoothed.append({key: mean[2 * place] for place, key in enumerate(step.keys)})
            after = (step, mean)
        return smoothed[::-1]


def _from_later(step: _Step, later: _Step, later_mean: Float64Array) -> Float64Array:
    """What the tick after says about this one: `C (xˢ⁺ − x⁻)` with `C = P Fᵀ P⁻¹`."""
    survivors = later.survivors
    if not survivors:
        return np.zeros_like(step.mean)
    here = [row for key in survivors for row in _rows(step.keys, key)]
    there = [row for key in survivors for row in _rows(later.keys, key)]
    factor = np.ones(len(here))
    factor[1::2] = later.kept
    cross = step.covariance[:, here] * factor
    # A vehicle that is only perceived has no slow error, and its row no variance.
    known = np.diagonal(later.predicted_covariance) > 0.0
    surprise = (later_mean[there] - later.predicted_mean)[known]
    solved = np.linalg.solve(later.predicted_covariance[np.ix_(known, known)], surprise)
    moved: Float64Array = cross[:, known] @ solved
    return moved


def _rows(keys: tuple[int, ...], key: int) -> tuple[int, int]:
    place = keys.index(key)
    return 2 * place, 2 * place + 1
