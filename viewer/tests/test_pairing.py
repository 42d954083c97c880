"""Errors are distances between a position and the truth of the same tick and slot."""

from __future__ import annotations

import frames
import numpy as np
from numpy.typing import NDArray

from caraware_viewer import wire
from caraware_viewer.pairing import Pairing, distances, mean_m

TRUTH = np.array([[0, 0], [10, 0], [20, 0]], np.float32)


def observation(tick: int, valid: list[int]) -> wire.Observation:
    return wire.decode_observation(frames.observation(tick, TRUTH, TRUTH + np.array([6, 8]), np.array(valid)))


def prediction(
    tick: int, points: NDArray[np.floating], estimates: NDArray[np.floating] | None = None
) -> wire.Prediction:
    return wire.decode_prediction(frames.prediction(tick, points, estimates))


def test_errors_are_euclidean_distances_over_valid_slots() -> None:
    guessed = TRUTH + np.array([3, 4]) * np.array([[1], [2], [100]])
    found = distances(observation(0, [1, 1, 0]), prediction(0, guessed, TRUTH + np.array([0, 1])))
    np.testing.assert_array_equal(found.policy, [5, 10, np.nan])
    np.testing.assert_array_equal(found.ekf, [1, 1, np.nan])
    np.testing.assert_array_equal(found.raw_gnss, [10, 10, np.nan])
    assert (mean_m(found.policy), mean_m(found.ekf), mean_m(found.raw_gnss)) == (7.5, 1.0, 10.0)


def test_without_valid_slots_or_a_policy_there_is_no_error() -> None:
    assert np.isnan(mean_m(distances(observation(0, [0, 0, 0]), None).raw_gnss))
    found = distances(observation(0, [1, 1, 1]), None)
    assert found.policy is None
    assert np.isnan(mean_m(found.policy))


def test_actions_are_not_positions() -> None:
    found = distances(observation(0, [1, 1, 1]), prediction(0, TRUTH, TRUTH), has_positions=False)
    assert found.policy is None
    assert mean_m(found.ekf) == 0.0


def test_what_is_not_finite_or_has_no_counterpart_is_left_out() -> None:
    found = distances(observation(0, [1, 1, 1]), prediction(0, np.array([[np.nan, 0], [13, 4]])))
    np.testing.assert_array_equal(found.policy, [np.nan, 5, np.nan])


def test_only_the_same_tick_pairs_in_either_order() -> None:
    pairing = Pairing()
    assert pairing.prediction(prediction(5, TRUTH)) is None
    assert pairing.observation(observation(4, [1, 1, 1])) is None
    pair = pairing.observation(observation(5, [1, 1, 1]))
    assert pair is not None
    assert pair[0].header.tick == pair[1].header.tick == 5
    assert pairing.prediction(prediction(4, TRUTH)) is not None


def test_what_never_pairs_is_forgotten() -> None:
    pairing = Pairing()
    for tick in range(100):
        assert pairing.observation(observation(tick, [1, 1, 1])) is None
    assert pairing.prediction(prediction(0, TRUTH)) is None
    assert pairing.prediction(prediction(99, TRUTH)) is not None
