"""Rauch–Tung–Striebel smoother over the filters' beliefs. It sees the future: a bound, not an estimator.

What it says of a tick uses samples that came later; no vehicle can know it at that tick. It shows how much better
than the filter an estimator could be with the same sensors, the same model of motion, and unlimited delay.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from caraware.baselines.ekf import Belief, Ekf, wrapped
from caraware.baselines.motion import YAW
from caraware.ipc.arrays import Float64Array

MEMORY_BYTES = 512 * 2**20
"""Largest memory of a smoother. An episode that fits is smoothed as a whole: 300 ticks of 3 500 vehicles."""


@dataclass(frozen=True)
class SmoothedTick:
    """A tick with everything that came after it, or as much of it as memory allows."""

    label: Any
    """What the tick was pushed with."""
    mean: Float64Array
    """f64 `[d, n]`."""
    covariance: Float64Array | None = None
    """f64 `[d, d, n]`, where the smoother keeps covariances."""


@dataclass
class _Remembered:
    label: Any
    filtered: Belief
    predicted: Belief | None = None
    """Of the tick after."""
    gain: Float64Array = field(default_factory=lambda: np.zeros((0, 0, 0)))
    """`C = P Fᵀ P⁻¹` to the tick after `[d, d, m]`; 0 where no trajectory continues."""

    def bytes(self) -> int:
        """Memory of the arrays, gain and prediction included."""
        d, n = self.filtered.mean.shape
        return int(8 * n * (d * d + 2 * d + (2 * d * d if self.filtered.covariance.size else 0)))


class Smoother:
    """Remembers an episode of an `Ekf` and goes back over it.

    When memory is full, the older half of the ticks is given out, each with at least the newer half as its future;
    so memory is bounded and so is the lag. `finish` gives out the rest.
    """

    def __init__(self, ekf: Ekf, memory_bytes: int = MEMORY_BYTES, *, covariances: bool = False) -> None:
        ekf.keep_prediction = True
        self._ekf, self._memory_bytes, self._covariances = ekf, memory_bytes, covariances
        self._ticks: list[_Remembered] = []
        self._bytes = 0

    def push(self, label: Any) -> list[SmoothedTick]:
        """Take the tick that the filter has just stepped to. Gives out what memory has no room for, oldest first."""
        if self._ticks:
            self._link(self._ticks[-1])
        belief = self._ekf.belief
        covariance = belief.covariance.copy() if self._covariances else np.zeros((0, 0, 0))
        self._ticks.append(_Remembered(label, Belief(belief.mean.copy(), covariance)))
        self._bytes += self._ticks[-1].bytes()
        if self._bytes <= self._memory_bytes or len(self._ticks) < 2:
            return []
        return self._give_out(len(self._ticks) // 2)

    def finish(self) -> list[SmoothedTick]:
        """Everything that is left; what comes next is another episode."""
        return self._give_out(len(self._ticks))

    def _link(self, before: _Remembered) -> None:
        """The gain from the tick before to the new one (H. Rauch, F. Tung, C. Striebel, 1965, equation 3.30)."""
        ekf, slots = self._ekf, before.filtered.mean.shape[1]
        predicted, cross = ekf.predicted, ekf.cross
        gain = right_divided(cross[:, :, :slots], predicted.covariance[:, :, :slots])
        goes_on = (ekf.running & ~ekf.started)[:slots]
        before.gain = gain * goes_on
        covariance = predicted.covariance if self._covariances else np.zeros((0, 0, 0))
        before.predicted = Belief(predicted.mean, covariance)

    def _give_out(self, count: int) -> list[SmoothedTick]:
        smoothed: list[SmoothedTick] = []
        after: SmoothedTick | None = None
        for i in reversed(range(len(self._ticks))):
            after = self._smoothed(self._ticks[i], after)
            if i < count:
                smoothed.append(after)
        self._bytes -= sum(tick.bytes() for tick in self._ticks[:count])
        del self._ticks[:count]
        return smoothed[::-1]

    def _smoothed(self, tick: _Remembered, after: SmoothedTick | None) -> SmoothedTick:
        """`x + C (xˢ⁺ − x⁻)`, `P + C (Pˢ⁺ − P⁻) Cᵀ` (equations 3.28 and 3.31)."""
        filtered, predicted = tick.filtered, tick.predicted
        kept = filtered.covariance if self._covariances else None
        if after is None or predicted is None:
            return SmoothedTick(tick.label, filtered.mean, kept)
        slots = filtered.mean.shape[1]
        surprise = (after.mean - predicted.mean)[:, :slots]
        surprise[YAW] = wrapped(surprise[YAW])
        mean = filtered.mean + np.einsum("ijn,jn->in", tick.gain, surprise)
        mean[YAW] = wrapped(mean[YAW])
        if kept is not None and after.covariance is not None:
            surprise = (after.covariance - predicted.covariance)[:, :, :slots]
            kept = kept + np.einsum("ijn,jkn,lkn->iln", tick.gain, surprise, tick.gain, optimize=True)
        return SmoothedTick(tick.label, mean, kept)


def right_divided(left: Float64Array, positive: Float64Array) -> Float64Array:
    """`A B⁻¹` for `A` `[m, d, n]` and symmetric positive definite `B` `[d, d, n]`, by Cholesky factors of all slots."""
    factor = cholesky(positive)
    size = len(factor)
    solved = np.ascontiguousarray(left.transpose(1, 0, 2))
    for i in range(size):
        for j in range(i):
            solved[i] -= factor[i, j] * solved[j]
        solved[i] /= factor[i, i]
    for i in reversed(range(size)):
        for j in range(i + 1, size):
            solved[i] -= factor[j, i] * solved[j]
        solved[i] /= factor[i, i]
    return solved.transpose(1, 0, 2)


def cholesky(positive: Float64Array) -> Float64Array:
    """Lower factor `L` `[d, d, n]` of `L Lᵀ`, column by column (G. Golub, C. Van Loan, Matrix Computations, 4.2)."""
    size = len(positive)
    factor = np.zeros_like(positive)
    for j in range(size):
        column = positive[j:, j].copy()
        for k in range(j):
            column -= factor[j:, k] * factor[j, k]
        factor[j:, j] = column / np.sqrt(column[0])
    return factor
