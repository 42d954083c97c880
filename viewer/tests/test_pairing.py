"""Errors are measured between the prediction and the truth of the same tick and slot."""

from __future__ import annotations

import frames
import numpy as np

from caraware_viewer import wire
from caraware_viewer.pairing import Pairing, gnss_error_m, policy_errors

TRUTH = np.array([[0, 0], [10, 0], [20, 0]], np.float32)


def observation(tick: int, valid: list[int]) -> wire.Observation:
    return wire.decode_observation(frames.observation(tick, TRUTH, TRUTH + np.array([6, 8]), np.array(valid)))


def test_errors_are_means_of_euclidean_distances_over_valid_slots() -> None:
    seen = observation(0, [1, 1, 0])
    predicted = wire.decode_prediction(frames.prediction(0, TRUTH + [3, 4] * np.array([[1], [2], [100]])))
    errors = policy_errors(seen, predicted)
    assert errors.policy_m == 7.5
    assert gnss_error_m(seen) == 10.0
    np.testing.assert_array_equal(errors.truth_m, TRUTH[:2])


def test_without_valid_slots_there_is_no_error() -> None:
    seen = observation(0, [0, 0, 0])
    assert np.isnan(gnss_error_m(seen))
    assert np.isnan(policy_errors(seen, wire.decode_prediction(frames.prediction(0, TRUTH))).policy_m)


def test_what_is_not_finite_or_has_no_counterpart_is_left_out() -> None:
    predicted = wire.decode_prediction(frames.prediction(0, np.array([[np.nan, 0], [13, 4]])))
    assert policy_errors(observation(0, [1, 1, 1]), predicted).policy_m == 5.0


def test_only_the_same_tick_pairs_in_either_order() -> None:
    pairing = Pairing()
    late = wire.decode_prediction(frames.prediction(5, TRUTH))
    assert pairing.prediction(late) is None
    assert pairing.observation(observation(4, [1, 1, 1])) is None
    pair = pairing.observation(observation(5, [1, 1, 1]))
    assert pair is not None
    assert pair[0].header.tick == pair[1].header.tick == 5
    pair = pairing.prediction(wire.decode_prediction(frames.prediction(4, TRUTH)))
    assert pair is not None


def test_what_never_pairs_is_forgotten() -> None:
    pairing = Pairing()
    for tick in range(100):
        assert pairing.observation(observation(tick, [1, 1, 1])) is None
    assert pairing.prediction(wire.decode_prediction(frames.prediction(0, TRUTH))) is None
    assert pairing.prediction(wire.decode_prediction(frames.prediction(99, TRUTH))) is not None
