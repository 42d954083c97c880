"""The motion model: each Jacobian against finite differences, variances against simulated processes."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from caraware.baselines.ekf import Belief, Ekf
from caraware.baselines.motion import (
    ACCEL_BIAS,
    GYRO_BIAS,
    SPEED,
    YAW,
    Motion,
    MotionModel,
    StateLayout,
    X,
    Y,
    forgotten,
    process_noise,
    propagate_columns,
    propagate_rows,
    transition,
)
from caraware.baselines.noise import ImuConvention, SensorNoise
from caraware.baselines.samples import read_samples
from synthetic_vehicle import observations, sensor_tables, town_track

ALL_ERRORS = {
    "gnss__correlated_std_m": [2.0, 3.0, 0.0],
    "gnss__bias_m": [1.0, -2.0, 0.0],
    "imu__compass_bias_rad": 0.05,
    "speed_steering__speed_scale_std": 0.02,
}


def everything() -> tuple[SensorNoise, StateLayout]:
    noise = SensorNoise.from_run({"config": sensor_tables(**ALL_ERRORS)})
    assert noise is not None
    return noise, StateLayout.of(noise)


def dense(entries: list[Any], size: int, slots: int) -> np.ndarray:
    """F `[d, d, n]`."""
    matrix = np.repeat(np.eye(size)[:, :, None], slots, axis=2)
    for row, column, value in entries:
        matrix[row, column] += value
    return matrix


def motion_of(rng: np.random.Generator, slots: int) -> Motion:
    return Motion(
        dt_s=0.3,
        yaw_rate_radps=rng.normal(0, 0.5, slots),
        accel_mps2=rng.normal(0, 2, slots),
        yaw_rate_trust=rng.uniform(0.2, 1, slots),
        accel_trust=rng.uniform(0.2, 1, slots),
        yaw_variance=rng.uniform(0, 0.1, slots),
        speed_variance=0.2,
    )


def test_only_errors_that_are_configured_have_a_row() -> None:
    noise = SensorNoise.from_run({"config": sensor_tables()})
    assert noise is not None and StateLayout.of(noise) == StateLayout()
    assert everything()[1] == StateLayout(slow=(7, 8), bias=(9, 10), scale=11, compass=12, size=13)


def test_the_transition_s_jacobian_is_its_derivative() -> None:
    _, layout = everything()
    rng = np.random.default_rng(1)
    mean, motion = rng.normal(0, 3, (layout.size, 50)), motion_of(rng, 50)
    _, entries = transition(mean, motion, layout, 0.9)
    jacobian, step = dense(entries, layout.size, 50), 1e-6
    for column in range(layout.size):
        nudge = np.zeros_like(mean)
        nudge[column] = step
        ahead, behind = (transition(mean + s * nudge, motion, layout, 0.9)[0] for s in (1, -1))
        np.testing.assert_allclose(jacobian[:, column], (ahead - behind) / (2 * step), atol=1e-8)


def test_propagating_by_entries_is_multiplying_by_the_jacobian() -> None:
    noise, layout = everything()
    rng = np.random.default_rng(2)
    mean, motion, slots = rng.normal(0, 3, (layout.size, 7)), motion_of(rng, 7), 7
    root = rng.normal(size=(layout.size, layout.size, slots))
    covariance = np.einsum("ijn,kjn->ikn", root, root)
    moved, entries = transition(mean, motion, layout, 0.9)
    added = process_noise(mean, covariance, motion, noise, MotionModel(), layout, 0.9)
    jacobian = dense(entries, layout.size, slots)
    extra = np.zeros_like(covariance)
    for row, column, value in added:
        extra[row, column] += value
        extra[column, row] += value if row != column else 0.0
    belief = Belief(mean.copy(), covariance.copy())
    belief.predict(moved, entries, added)
    expected = np.einsum("ijn,jkn,lkn->iln", jacobian, covariance, jacobian) + extra
    np.testing.assert_allclose(belief.covariance, expected, rtol=1e-12, atol=1e-12)
    assert (belief.covariance == belief.covariance.transpose(1, 0, 2)).all()
    rows, columns = covariance.copy(), covariance.copy()
    propagate_rows(rows, entries)
    propagate_columns(columns, entries)
    np.testing.assert_allclose(rows, np.einsum("ijn,jkn->ikn", jacobian, covariance), atol=1e-12)
    np.testing.assert_allclose(columns, np.einsum("ijn,kjn->ikn", covariance, jacobian), atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1])
def test_the_jacobian_of_an_old_fix_is_its_derivative(axis: int) -> None:
    noise, layout = everything()
    ekf, rng = Ekf(noise), np.random.default_rng(3)
    ekf._motion = Motion(0.1, *rng.normal(0, 1, (2, 20)))
    mean, age_s = rng.normal(0, 3, (layout.size, 20)), np.linspace(0, 2, 20)

    def expected(at: np.ndarray) -> np.ndarray:
        ekf.belief.mean = at
        return ekf._fix_row(axis, age_s)[1]

    ekf.belief.mean = mean
    row = dict(ekf._fix_row(axis, age_s)[0])
    for column in set(range(layout.size)) - {GYRO_BIAS, ACCEL_BIAS}:
        nudge = np.zeros_like(mean)
        nudge[column] = 1e-6
        derivative = (expected(mean + nudge) - expected(mean - nudge)) / 2e-6
        np.testing.assert_allclose(np.broadcast_to(row.get(column, 0.0), 20), derivative, atol=1e-8)


def test_the_jacobian_of_wheel_speed_and_compass_is_the_derivative_of_what_is_expected() -> None:
    """Seen from outside: innovation and row that `correct` is given, over small changes of the state."""
    noise, layout = everything()
    samples = read_samples(
        next(observations(town_track(2, 5, 1), sensor_tables(**ALL_ERRORS))), ImuConvention.KINEMATIC
    )
    samples = replace(samples, yaw_rad=np.full((1, 5), 0.3))
    mean = np.random.default_rng(4).normal(0, 0.3, (layout.size, 5))
    mean[SPEED] = [0.0, 1e-4, 3e-3, 0.1, 20.0]

    class Recorded(Belief):
        def correct(self, row: list[Any], innovation: np.ndarray, variance: object, use: np.ndarray) -> None:
            seen.append((dict(row), innovation))

    def given(at: np.ndarray, name: str) -> tuple[dict[int, float], np.ndarray]:
        seen.clear()
        ekf = Ekf(noise)
        ekf.belief, ekf._held = Recorded(at, np.zeros((layout.size, layout.size, 5))), np.zeros((2, 5))
        ekf._yaw_at_sample, ekf._motion = at[YAW][None], Motion(0.1, *np.zeros((2, 5)))
        getattr(ekf, name)(samples, np.ones(5, bool))
        return seen[0]

    seen: list[tuple[dict[int, float], np.ndarray]] = []
    for name in ("_correct_wheel_speed", "_correct_compass"):
        row, _ = given(mean, name)
        for column in range(layout.size):
            nudge = np.zeros_like(mean)
            nudge[column] = 1e-7
            derivative = (given(mean - nudge, name)[1] - given(mean + nudge, name)[1]) / 2e-7
            if column != ACCEL_BIAS:  # it enters by the age of the sample alone, which is 0
                np.testing.assert_allclose(np.broadcast_to(row.get(column, 0.0), 5), derivative, atol=1e-6)


def test_arcs_are_driven_to_second_order() -> None:
    """A quarter of a circle of 20 m in steps of 0.1 s ends where the circle does, within (ω dt)²/24 of its length."""
    mean = np.zeros((7, 1))
    mean[SPEED] = 10.0
    motion = Motion(0.1, np.full(1, 0.5), np.zeros(1))
    steps = round(math.pi / 2 / 0.5 / 0.1)
    for _ in range(steps):
        mean, _ = transition(mean, motion, StateLayout(), 1.0)
    turned = 0.05 * steps
    exact = np.array([20 * math.sin(turned), 20 * (1 - math.cos(turned))])
    assert np.abs(mean[[X, Y], 0] - exact).max() < 1.1 * 20 * turned * 0.05**2 / 24


@pytest.mark.parametrize("age_s", [0.05, 0.5, 3.0, 30.0])
def test_what_a_process_does_after_it_was_known_has_the_stated_variance(age_s: float) -> None:
    std, time_s, runs, steps = 1.5, 2.0, 20_000, 300
    rng, dt_s = np.random.default_rng(5), age_s / 300
    kept = math.exp(-dt_s / time_s)
    value, integral = np.zeros(runs), np.zeros(runs)
    for _ in range(steps):
        after = kept * value + std * math.sqrt(1 - kept**2) * rng.normal(size=runs)
        integral += 0.5 * dt_s * (value + after)
        value = after
    # Five standard errors of a variance, √(2/N), and what the trapezoids leave out.
    assert forgotten(age_s, std, time_s) == pytest.approx(integral.var(), rel=5 * math.sqrt(2 / runs) + 0.01)


def test_the_series_meets_the_formula() -> None:
    at = 0.01 * 2.0
    assert forgotten(at * (1 - 1e-9), 1.0, 2.0) == pytest.approx(float(forgotten(at * (1 + 1e-9), 1.0, 2.0)), rel=1e-3)


def test_noise_along_and_across_the_heading() -> None:
    noise, _ = everything()
    mean = np.zeros((13, 2))
    mean[SPEED] = 10.0
    covariance = np.zeros((13, 13, 2))
    covariance[YAW, YAW], covariance[SPEED, SPEED] = [0.0, 0.2], [0.0, 4.0]
    motion = Motion(0.1, np.array([0.0, 0.4]), np.zeros(2))
    entries = {
        (i, j): v for i, j, v in process_noise(mean, covariance, motion, noise, MotionModel(), StateLayout(), 1.0)
    }
    across = np.broadcast_to(entries[Y, Y], 2)
    assert across[0] == pytest.approx(1e-5)
    slip_mps = 0.01 * (10.0 * 0.4 / 9.80665) * 10.0
    assert across[1] - across[0] == pytest.approx(2 * 2.0 * 0.1 * slip_mps**2 + 2 * 5.0 * 0.1 * 4.0 * 0.2)
    # Along it: variance of 1 − cos δ, V²/2, for as long as an error of the heading lasts.
    along = np.broadcast_to(entries[X, X], 2)
    assert along == pytest.approx([1e-5, 1e-5 + 2 * 5.0 * 0.1 * (10.0**2 + 4.0) * 0.2**2 / 2])
    assert entries[GYRO_BIAS, GYRO_BIAS] > 0
