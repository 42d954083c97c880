"""The smoother: against filterpy, against least squares over all samples at once, and within its memory."""

from typing import Any

import numpy as np
import pytest
from caraware.baselines import Baselines
from caraware.baselines.ekf import Belief, Ekf, wrapped
from caraware.baselines.motion import YAW
from caraware.baselines.noise import ImuConvention
from caraware.baselines.rts import SmoothedTick, Smoother, cholesky, right_divided
from caraware.baselines.samples import read_samples
from caraware.ipc.arrays import Float64Array
from filterpy.kalman import KalmanFilter
from scipy.stats import chi2
from synthetic_vehicle import GNSS, IMU, SPEED_STEERING, in_slots, observations, sensor_tables, steady_track, town_track
from test_ekf import EXACT, MANY_ERRORS, noise_of, tables_of

DT_S, DRAWN, MEASURED = 0.5, 0.3, 2.0
F = np.array([[1.0, 0.0, 0.0, DT_S], [0.0, 1.0, DT_S, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
Q = np.diag([0.01, 0.02, DRAWN**2, DRAWN**2])
FIRST = np.diag([4.0, 4.0, 1e-2, 1.0])


class Linear:
    """Two positions driven by two velocities, with measured positions: the part of an `Ekf` that the smoother uses."""

    def __init__(self, slots: int) -> None:
        self.belief = Belief(np.zeros((4, slots)), np.repeat(FIRST[:, :, None], slots, 2))
        self.running, self.started = np.ones(slots, bool), np.zeros(slots, bool)

    def step(self, fix_m: np.ndarray) -> None:
        """`fix_m` `[2, n]`."""
        all_slots = np.ones(fix_m.shape[1], bool)
        self.cross = np.einsum("ijn,kj->ikn", self.belief.covariance, F)
        entries: list[tuple[int, int, Float64Array | float]] = [(0, 3, DT_S), (1, 2, DT_S)]
        noise: list[tuple[int, int, Float64Array | float]] = [(i, i, float(Q[i, i])) for i in range(4)]
        self.belief.predict(F @ self.belief.mean, entries, noise)
        self.predicted = Belief(self.belief.mean.copy(), self.belief.covariance.copy())
        for axis in (0, 1):
            innovation = fix_m[axis] - self.belief.mean[axis]
            self.belief.correct([(axis, 1.0)], innovation, MEASURED**2, all_slots)


def linear_case(ticks: int, slots: int) -> tuple[np.ndarray, list[SmoothedTick]]:
    """Fixes `[ticks, 2, n]`, and the smoother's results."""
    fixes = np.cumsum(np.random.default_rng(1).normal(0, 0.5, (ticks, 2, slots)), 0)
    linear = Linear(slots)
    smoother = Smoother(linear, covariances=True)  # type: ignore[arg-type]
    for tick in range(ticks):
        linear.step(fixes[tick])
        assert smoother.push(tick) == []
    return fixes, smoother.finish()


def test_a_linear_case_is_filterpy_s() -> None:
    fixes, smoothed = linear_case(60, 3)
    kf = KalmanFilter(dim_x=4, dim_z=2)
    kf.x, kf.P, kf.F, kf.Q, kf.R = np.zeros(4), FIRST.copy(), F, Q, np.eye(2) * MEASURED**2
    kf.H = np.eye(2, 4)
    means, covariances, _, _ = kf.batch_filter(fixes[:, :, 1])
    means, covariances, _, _ = kf.rts_smoother(means, covariances)
    for tick in smoothed:
        np.testing.assert_allclose(tick.mean[:, 1], means[tick.label], rtol=1e-9, atol=1e-9)
        assert tick.covariance is not None
        np.testing.assert_allclose(tick.covariance[:, :, 1], covariances[tick.label], rtol=1e-9, atol=1e-9)


def test_a_linear_case_is_the_least_squares_of_everything_at_once() -> None:
    """The most likely trajectory given all samples: one system of equations, each weighed by its noise."""
    ticks = 30
    fixes, smoothed = linear_case(ticks, 1)
    rows, values = [], []

    def equation(blocks: dict[int, np.ndarray], value: np.ndarray, covariance: np.ndarray) -> None:
        weight = np.linalg.inv(np.linalg.cholesky(covariance))
        row = np.zeros((len(value), 4 * (ticks + 1)))
        for state, block in blocks.items():
            row[:, 4 * state : 4 * state + 4] = block
        rows.append(weight @ row)
        values.append(weight @ value)

    equation({0: np.eye(4)}, np.zeros(4), FIRST)
    for step in range(ticks):
        equation({step: -F, step + 1: np.eye(4)}, np.zeros(4), Q)
        equation({step + 1: np.eye(2, 4)}, fixes[step, :, 0], np.eye(2) * MEASURED**2)
    states = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)[0].reshape(-1, 4)
    for tick in smoothed:
        np.testing.assert_allclose(tick.mean[:, 0], states[tick.label + 1], rtol=1e-8, atol=1e-8)


def test_dividing_from_the_right() -> None:
    rng = np.random.default_rng(1)
    root, left = rng.normal(size=(5, 5, 20)), rng.normal(size=(3, 5, 20))
    positive = np.einsum("ijn,kjn->ikn", root, root)
    factor = cholesky(positive)
    np.testing.assert_allclose(np.einsum("ijn,kjn->ikn", factor, factor), positive, atol=1e-12)
    np.testing.assert_allclose(np.einsum("ijn,jkn->ikn", right_divided(left, positive), positive), left, atol=1e-8)


def smoothed_errors(
    tables: dict[str, Any], memory_bytes: int | None = None
) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Errors of filter and smoother `[ticks, n]`, and the delay of each smoothed tick, in ticks."""
    noise = noise_of(tables)
    ekf = Ekf(noise)
    smoother = Smoother(ekf, memory_bytes) if memory_bytes else Smoother(ekf)
    truth, own, smoothed, waited = [], [], [], []
    for obs in observations(town_track(150, 20, 1), tables, 2):
        ekf.step(read_samples(obs, noise.convention))
        truth.append(obs.truth[:, :2].numpy())
        own.append(ekf.position_m.copy())
        done = smoother.push(obs.tick)
        smoothed += done
        waited += [obs.tick - tick.label for tick in done]
    smoothed += smoother.finish()
    assert [tick.label for tick in smoothed] == list(range(150))
    errors = np.hypot(*np.moveaxis(np.array(own) - truth, 2, 0))
    return errors, np.hypot(*np.moveaxis(np.array([t.mean[:2].T for t in smoothed]) - truth, 2, 0)), waited


def test_later_samples_make_the_smoother_better() -> None:
    own, smoothed, waited = smoothed_errors(sensor_tables())
    assert waited == []
    assert smoothed.mean() < 0.8 * own.mean()
    np.testing.assert_allclose(smoothed[-1], own[-1])


def test_memory_is_bounded_and_little_is_lost_by_it() -> None:
    """Room for 40 ticks of 20 vehicles with 13 states: every tick waits for 20 others at least."""
    tables = tables_of(**MANY_ERRORS)
    whole = smoothed_errors(tables)[1]
    _, bounded, waited = smoothed_errors(tables, memory_bytes=40 * 8 * 20 * (169 + 26))
    assert (min(waited), max(waited)) == (21, 40)
    assert bounded.mean() < 1.1 * whole.mean()
    assert not np.array_equal(bounded, whole)


def test_errors_are_as_large_as_the_smoothed_covariance_says() -> None:
    tables, vehicles = tables_of(**MANY_ERRORS), 300
    noise = noise_of(tables)
    ekf = Ekf(noise, EXACT)
    smoother, truth = Smoother(ekf, covariances=True), []
    for obs in observations(steady_track(101, vehicles, 3), tables, 4):
        ekf.step(read_samples(obs, noise.convention))
        truth.append(obs.truth.numpy().T)
        smoother.push(obs.tick)
    low, high = chi2.ppf([0.0005, 0.9995], 4 * vehicles) / vehicles
    for tick in smoother.finish()[10::30]:
        error = tick.mean[:4] - truth[tick.label]
        error[YAW] = wrapped(error[YAW])
        assert tick.covariance is not None
        covariance = tick.covariance[:4, :4].transpose(2, 0, 1)
        nees = np.einsum("in,ni->n", error, np.linalg.solve(covariance, error.T[:, :, None])[:, :, 0]).mean()
        assert low < nees < high


@pytest.mark.parametrize("sign", ["terminated", "truncated"])
def test_the_samples_of_the_next_vehicle_in_a_slot_do_not_count(sign: str) -> None:
    """A slot gets another vehicle at tick 40: the ticks before are smoothed as if the stream had ended there."""
    tables = sensor_tables()
    noise = noise_of(tables)
    shown = list(observations(town_track(80, 2, 1), tables, 2))
    shown[40] = type(shown[40])(**(vars(shown[40]) | {sign: np.array([True, False])}))
    smoothed = []
    for ticks in (shown[:40], shown):
        ekf = Ekf(noise)
        smoother = Smoother(ekf)
        for obs in ticks:
            ekf.step(read_samples(obs, ImuConvention.KINEMATIC))
            smoother.push(obs.tick)
        smoothed.append([tick.mean for tick in smoother.finish()[:40]])
    short, long = np.array(smoothed[0]), np.array(smoothed[1])
    np.testing.assert_allclose(long[:, :, 0], short[:, :, 0], atol=1e-12)
    assert np.abs(long[:, :2, 1] - short[:, :2, 1]).max() > 0.05


def test_the_number_of_slots_may_grow_and_slots_may_be_empty() -> None:
    noise = noise_of(sensor_tables())
    dark = np.zeros((60, 2), np.uint32)
    dark[20:40] = GNSS | IMU | SPEED_STEERING
    shown = list(observations(town_track(60, 2, 1), seed=2, dark=dark))
    alone, growing = Baselines(noise), Baselines(noise)
    for obs in shown:
        one_each, _ = alone.add(obs)
        two_each, _ = growing.add(in_slots(obs, [1, 0], 2 if obs.tick < 30 else 5))
        np.testing.assert_array_equal(one_each["ekf"].error_m, two_each["ekf"].error_m[::-1])
        np.testing.assert_array_equal(two_each["ekf"].vehicle, [1, 0])
    for one, two in zip(alone.finish_episode(), growing.finish_episode(), strict=True):
        np.testing.assert_allclose(one.error_m, two.error_m[::-1], rtol=1e-9)
