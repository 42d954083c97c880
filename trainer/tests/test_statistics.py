"""Student's t and intervals of means."""

import math

import numpy as np
import pytest
from caraware.report.statistics import mean_interval, student_t


@pytest.mark.parametrize(
    ("confidence", "degrees", "expected"),
    [
        (0.95, 1, 12.7062),
        (0.95, 2, 4.30265),
        (0.95, 3, 3.18245),
        (0.95, 4, 2.77645),
        (0.95, 9, 2.26216),
        (0.95, 30, 2.04227),
        (0.99, 4, 4.60409),
        (0.99, 5, 4.03214),
        (0.5, 7, 0.711142),
    ],
)
def test_quantiles_are_those_of_printed_tables(confidence: float, degrees: int, expected: float) -> None:
    assert student_t(confidence, degrees) == pytest.approx(expected, rel=2e-6)


def test_the_interval_of_five_values_by_hand() -> None:
    interval = mean_interval([1.0, 2.0, 3.0, 4.0, 5.0])
    assert interval.mean == 3.0
    assert interval.half_width == pytest.approx(2.77645 * math.sqrt(2.5 / 5), rel=1e-5)
    assert (interval.low, interval.high) == (3.0 - interval.half_width, 3.0 + interval.half_width)


def test_intervals_cover_the_mean_with_their_confidence() -> None:
    rng = np.random.default_rng(1)
    covered = [
        abs((i := mean_interval(rng.normal(7.0, 2.0, 5).tolist())).mean - 7.0) <= i.half_width for _ in range(4000)
    ]
    # Binomial: 5 standard deviations are 0.017.
    assert np.mean(covered) == pytest.approx(0.95, abs=0.017)


def test_one_value_has_no_interval_and_none_no_mean() -> None:
    assert math.isnan(mean_interval([1.0]).half_width)
    with pytest.raises(ValueError, match="no values"):
        mean_interval([])
    with pytest.raises(ValueError, match="confidence 1"):
        student_t(1.0, 4)
