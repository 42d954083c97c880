"""Confidence intervals of means over few independent runs or seeds (Student's t)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Interval:
    """A mean and half the width of its confidence interval, in the unit of the values."""

    mean: float
    half_width: float
    """nan for a single value, which has no spread."""
    count: int

    @property
    def low(self) -> float:
        """Lower end."""
        return self.mean - self.half_width

    @property
    def high(self) -> float:
        """Upper end."""
        return self.mean + self.half_width

    def __str__(self) -> str:
        return f"{self.mean:.3f} ± {self.half_width:.3f}"


def mean_interval(values: Sequence[float], confidence: float = 0.95) -> Interval:
    """Mean of independent values with its two-sided confidence interval, `t s/√n`. Raises `ValueError` on none."""
    count = len(values)
    if count == 0:
        raise ValueError("a mean of no values")
    mean = math.fsum(values) / count
    if count == 1:
        return Interval(mean, math.nan, 1)
    variance = math.fsum((value - mean) ** 2 for value in values) / (count - 1)
    return Interval(mean, student_t(confidence, count - 1) * math.sqrt(variance / count), count)


def student_t(confidence: float, degrees: int) -> float:
    """The t with `P(|T| ≤ t) = confidence` for `degrees` of freedom. Raises `ValueError` outside 0 < confidence < 1."""
    if not 0 < confidence < 1 or degrees < 1:
        raise ValueError(f"confidence {confidence} with {degrees} degrees of freedom")
    low, high = 0.0, math.pi / 2
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _within(middle, degrees) < confidence else (low, middle)
    return math.sqrt(degrees) * math.tan(low)


def _within(angle_rad: float, degrees: int) -> float:
    """`P(|T| ≤ √ν tan θ)`, the finite sums of Abramowitz and Stegun, 26.7.3 and 26.7.4."""
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    odd = degrees % 2 == 1
    term, total = (cosine, 0.0) if odd else (1.0, 0.0)
    for power in range(1 if odd else 0, degrees - 1, 2):
        total += term
        term *= cosine**2 * (power + 1) / (power + 2)
    return 2 / math.pi * (angle_rad + sine * total) if odd else sine * total
