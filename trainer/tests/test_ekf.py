"""The filter: its errors against chi-square, and its handling of sensors."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from caraware.baselines.ekf import GATE_PATIENCE, NO_HEADING_VARIANCE, Ekf, wrapped
from caraware.baselines.motion import SPEED, YAW, MotionModel, StateLayout
from caraware.baselines.noise import METRES_PER_DEGREE, ImuConvention, SensorNoise
from caraware.baselines.samples import read_samples
from scipy.stats import chi2
from synthetic_vehicle import (
    GNSS,
    IMU,
    SPEED_STEERING,
    Track,
    VehicleObservation,
    in_slots,
    observations,
    sensor_tables,
    standing_track,
    steady_track,
    town_track,
)

EVERYTHING = GNSS | IMU | SPEED_STEERING
FEW_ERRORS = {
    "imu__gyro_noise_std_radps": 0.02,
    "imu__compass_noise_std_rad": 0.05,
    "speed_steering__speed_noise_std_mps": 0.05,
}
MANY_ERRORS = {
    "gnss__correlated_std_m": [2.0, 3.0, 0.0],
    "gnss__correlation_time_s": 20.0,
    "gnss__bias_m": [1.0, 0.5, 0.0],
    "imu__gyro_noise_std_radps": 0.02,
    "imu__gyro_bias_radps": 0.02,
    "imu__accel_noise_std_mps2": 0.2,
    "imu__accel_bias_mps2": 0.3,
    "imu__compass_noise_std_rad": 0.05,
    "imu__compass_bias_rad": 0.03,
    "speed_steering__speed_noise_std_mps": 0.1,
    "speed_steering__speed_scale_std": 0.02,
}


def tables_of(**changes: object) -> dict[str, Any]:
    """Tables with one number for all three axes where the changes give one."""
    changes = {
        key: [value] * 3 if key.startswith(("imu__gyro", "imu__accel")) and isinstance(value, float) else value
        for key, value in changes.items()
    }
    return sensor_tables(**changes)


def noise_of(tables: dict[str, Any]) -> SensorNoise:
    noise = SensorNoise.from_run({"config": tables})
    assert noise is not None
    return noise


def filtered(
    obs: Iterator[VehicleObservation], tables: dict[str, Any], model: MotionModel | None = None
) -> Iterator[tuple[VehicleObservation, Ekf]]:
    """The filter after every tick."""
    noise = noise_of(tables)
    ekf = Ekf(noise, model)
    for tick in obs:
        ekf.step(read_samples(tick, noise.convention))
        yield tick, ekf


def errors_m(obs: VehicleObservation, ekf: Ekf) -> np.ndarray:
    east, north = (ekf.position_m - obs.truth[:, :2].numpy()).T
    distance_m: np.ndarray = np.hypot(east, north)
    return distance_m


def raw_errors_m(obs: VehicleObservation) -> np.ndarray:
    distance_m: np.ndarray = (obs.gnss_m[:, :2] - obs.truth[:, :2]).norm(dim=1).numpy()
    return distance_m


def position_std_m(ekf: Ekf) -> np.ndarray:
    std_m: np.ndarray = np.sqrt(ekf.belief.covariance[0, 0] + ekf.belief.covariance[1, 1])
    return std_m


def squared_errors(obs: VehicleObservation, ekf: Ekf, states: int) -> np.ndarray:
    """Normalised estimation error squared `[n]` of the first `states` states (Bar-Shalom, section 5.4)."""
    error = ekf.belief.mean[:states] - obs.truth[:, :states].numpy().T
    error[YAW:3] = wrapped(error[YAW:3])
    covariance = ekf.belief.covariance[:states, :states].transpose(2, 0, 1)
    nees: np.ndarray = np.einsum("in,ni->n", error, np.linalg.solve(covariance, error.T[:, :, None])[:, :, 0])
    return nees


EXACT = MotionModel(1e-4, 1e4, 1e-5, 1e4, slip_noise_rad_per_g=0.0, heading_time_s=0.5, position_walk_m=1e-3)
"""A model for vehicles that move exactly as their IMU measures, such as those of `steady_track`."""


@pytest.mark.parametrize(
    "changes",
    [
        FEW_ERRORS,
        MANY_ERRORS,
        MANY_ERRORS | {"imu__period_s": 0.02, "gnss__period_s": 1.0, "speed_steering__period_s": 0.2},
        {"imu__period_s": 0.5, "imu__gyro_noise_std_radps": 0.03, "imu__compass_noise_std_rad": 0.1},
    ],
    ids=["few errors", "every error", "other rates", "slow IMU"],
)
def test_errors_are_as_large_as_the_covariance_says(changes: dict[str, Any]) -> None:
    """Mean NEES of 400 vehicles with own seeds within the 99.9 % bounds of chi-square, at many times."""
    tables, vehicles = tables_of(**changes), 400
    low, high = chi2.ppf([0.0005, 0.9995], 4 * vehicles) / vehicles
    seen = []
    for obs, ekf in filtered(observations(steady_track(201, vehicles, 3), tables, 4), tables, EXACT):
        if obs.tick % 40 == 39:
            seen.append(squared_errors(obs, ekf, 4).mean())
    assert all(low < nees < high for nees in seen), (seen, low, high)


def test_with_the_default_model_covariances_are_honest_in_town() -> None:
    """The model allows for slip and for motion between samples: errors are no larger than its covariance."""
    tables, vehicles = tables_of(**MANY_ERRORS), 200
    nees = [
        squared_errors(obs, ekf, 4).mean()
        for obs, ekf in filtered(observations(town_track(300, vehicles, 6), tables, 7), tables)
        if obs.tick % 50 == 49
    ]
    assert max(nees) < chi2.ppf(0.999, 4 * vehicles) / vehicles
    assert min(nees) > 1.5, "far too cautious"


@pytest.mark.parametrize("track", [steady_track, town_track, standing_track])
def test_it_beats_raw_fixes_by_a_wide_margin(track: Callable[[int, int, int], Track]) -> None:
    """After 10 s there are 100 fixes: √100 times better without unknown motion."""
    raw, own = [], []
    for obs, ekf in filtered(observations(track(200, 100, 8), seed=9), sensor_tables()):
        if obs.tick >= 100:
            raw.append(raw_errors_m(obs).mean())
            own.append(errors_m(obs, ekf).mean())
    assert np.mean(raw) == pytest.approx(5e-5 * METRES_PER_DEGREE * math.sqrt(math.pi / 2), rel=0.02)
    assert np.mean(own) < np.mean(raw) / 10


def test_an_outage_makes_the_covariance_grow_and_it_recovers() -> None:
    tables = tables_of(imu__gyro_noise_std_radps=0.02, imu__compass_noise_std_rad=0.1)
    dark = np.zeros((300, 60), np.uint32)
    dark[100:200] = GNSS | SPEED_STEERING
    std, error = [], []
    for obs, ekf in filtered(observations(town_track(300, 60, 1), tables, 2, dark), tables):
        std.append(position_std_m(ekf))
        error.append(errors_m(obs, ekf))
    assert (np.diff(np.array(std)[99:200], axis=0) > 0).all()
    assert (std[199] > 1.3 * std[99]).all()
    assert np.mean(std[299]) < 1.3 * np.mean(std[99])
    assert np.mean(error[299]) < 2 * np.mean(error[99])
    # Errors within five standard deviations, all the time.
    assert (np.array(error) < 5 * np.array(std)).all()


@pytest.mark.parametrize("bits", [IMU, GNSS | IMU, IMU | SPEED_STEERING, EVERYTHING])
def test_covariances_stay_honest_without_a_heading(bits: int) -> None:
    """Ten seconds without IMU, and five after it: a linear filter alone is wrong by hundreds of its variances then."""
    dark = np.zeros((251, 100), np.uint32)
    dark[100:200] = bits
    for obs, ekf in filtered(observations(town_track(251, 100, 1), seed=2, dark=dark), sensor_tables()):
        if obs.tick in (150, 199, 205, 250):
            assert 0.3 < squared_errors(obs, ekf, 2).mean() < 3.0, obs.tick


def test_without_any_sensor_nothing_diverges_and_fixes_restore_it() -> None:
    """All sensors dark for two minutes: finite, positive definite, and back within a few fixes."""
    ticks, lit = 1350, 1250
    track = steady_track(2, 8, 3)
    long = Track(*(np.repeat(column[:1], (ticks - 1) * 10 + 1, 0) for column in vars(track).values()))
    nothing = 0 * long.speed_mps
    still = replace(long, speed_mps=nothing, yaw_rate_radps=nothing, felt_mps2=nothing)
    dark = np.zeros((ticks, 8), np.uint32)
    dark[50:lit] = EVERYTHING
    for obs, ekf in filtered(observations(still, seed=2, dark=dark), sensor_tables()):
        if obs.tick in (lit - 1, lit + 20):
            assert np.isfinite(ekf.belief.mean).all()
            assert np.linalg.eigvalsh(ekf.belief.covariance.transpose(2, 0, 1)).min() > 0
    assert errors_m(obs, ekf).max() < 5.0


def test_a_held_sample_counts_once() -> None:
    """Fixes every second between ticks of 0.1 s: the covariance of ten times as many fixes would be far smaller."""
    tables = tables_of(gnss__period_s=1.0)
    std = [position_std_m(ekf)[0] for _, ekf in filtered(observations(standing_track(101, 1, 1), tables), tables)]
    assert std[100] == pytest.approx(std[0] / math.sqrt(11), rel=0.02)
    assert (np.diff(std[1:10]) >= 0).all()


def test_an_old_fix_corrects_the_place_where_it_was_taken() -> None:
    """Perfect fixes that arrive half a second, 5 m, late leave no lag but some of the slip over that time."""
    tables = tables_of(gnss__noise_std_deg=[1e-8, 1e-8])
    track = steady_track(100, 20, 5)
    noise = noise_of(tables)
    ekf = Ekf(noise)
    shown = list(observations(track, tables, 1))
    for tick, obs in enumerate(shown):
        late = shown[max(0, tick - 5)]
        age = np.array(obs.age_s)
        age[:, 0] = 0.1 * min(tick, 5)
        ekf.step(read_samples(replace(obs, gnss_m=late.gnss_m, age_s=age), ImuConvention.KINEMATIC))
    assert errors_m(shown[-1], ekf).max() < 0.1
    assert raw_errors_m(shown[-6]).max() < 0.1


def test_dark_fixes_are_not_fused() -> None:
    """The receiver repeats a fix 100 m away with its bit cleared, its age even 0."""
    track = standing_track(60, 4, 2)
    *_, (obs, ekf) = filtered(poisoned(track), sensor_tables())
    assert errors_m(obs, ekf).max() < 10


def poisoned(track: Track) -> Iterator[VehicleObservation]:
    dark = np.zeros((60, 4), np.uint32)
    dark[30:] = GNSS
    for obs in observations(track, seed=1, dark=dark):
        if obs.tick >= 30:
            obs = replace(obs, gnss_m=obs.gnss_m + 100, age_s=np.zeros_like(obs.age_s))
        yield obs


@pytest.mark.parametrize("convention", ["kinematic", "specific_force", "carla"])
def test_the_convention_of_the_imu_changes_nothing(convention: str) -> None:
    """Without a compass, which would hide a wrong sign: it would turn every vehicle the wrong way."""
    tables = tables_of(imu__convention=convention, imu__compass_noise_std_rad=1.0)
    errors = [
        np.abs(wrapped(ekf.belief.mean[YAW] - obs.truth[:, 2].numpy())).max()
        for obs, ekf in filtered(observations(steady_track(200, 20, 1), tables, 3), tables)
    ]
    assert errors[-1] < 0.6


def test_pedestrians_without_wheels_are_followed() -> None:
    dark = np.full((200, 40), SPEED_STEERING, np.uint32)
    track = steady_track(200, 40, 1, speed_mps=1.3)
    raw, own = [], []
    for obs, ekf in filtered(observations(track, seed=2, dark=dark), sensor_tables()):
        if obs.tick >= 100:
            raw.append(raw_errors_m(obs).mean())
            own.append(errors_m(obs, ekf).mean())
    assert np.mean(own) < np.mean(raw) / 3


def test_every_compass_sample_of_a_tick_counts() -> None:
    """One sample at the start and ten in the next tick, from a gyro that relates them to each other."""
    tables = tables_of(imu__period_s=0.01, imu__compass_noise_std_rad=0.1)
    *_, (_, ekf) = filtered(observations(standing_track(2, 1, 1), tables), tables, EXACT)
    assert ekf.belief.covariance[YAW, YAW, 0] == pytest.approx(0.1**2 / 11, rel=1e-3)


def test_a_filter_without_a_heading_starts_again_with_the_next_fix() -> None:
    """A heading that may be anything says nothing about where a moving vehicle went."""
    dark = np.zeros((302, 6), np.uint32)
    dark[20:300] = EVERYTHING
    for obs, ekf in filtered(observations(steady_track(302, 6, 1), seed=1, dark=dark), sensor_tables()):
        if obs.tick > 0:
            assert ekf.started.all() == ekf.started.any() == (obs.tick == 300)
    assert ekf.belief.covariance[YAW, YAW].max() < 0.01


def test_an_imu_slower_than_the_tick_is_held() -> None:
    tables = tables_of(imu__period_s=0.5)
    own = [errors_m(obs, ekf).mean() for obs, ekf in filtered(observations(town_track(200, 50, 1), tables), tables)]
    assert np.mean(own[100:]) < 1.5


def test_a_constant_gyro_bias_is_found() -> None:
    tables = tables_of(imu__gyro_bias_radps=0.05, imu__compass_noise_std_rad=0.05)
    *_, (_, ekf) = filtered(observations(steady_track(300, 50, 1), tables, 3), tables)
    found_std = np.sqrt(ekf.belief.covariance[4, 4])
    assert found_std.max() < 0.01
    assert ekf.belief.mean[4].std() > 0.03


def test_the_quality_that_the_receiver_reports_counts() -> None:
    """Fixes with ten times the error, which the receiver reports: they correct less."""
    quality = np.full((1, 2), 10 * math.hypot(5.57, 5.57), np.float32)
    good, bad = (
        [ekf for _, ekf in filtered(ticks, sensor_tables())][-1]
        for ticks in (
            observations(standing_track(30, 1, 1)),
            observations(standing_track(30, 1, 1), gnss_quality=quality),
        )
    )
    assert position_std_m(bad)[0] == pytest.approx(10 * position_std_m(good)[0], rel=0.02)


def test_a_gate_refuses_reflections_but_not_for_ever() -> None:
    def reflected() -> Iterator[VehicleObservation]:
        for obs in observations(standing_track(120, 10, 1), seed=1):
            off = 80.0 if obs.tick in (40, 50) or obs.tick >= 80 else 0.0
            yield replace(obs, gnss_m=obs.gnss_m + off)

    error = {}
    for gated in (True, False):
        ticks = filtered(reflected(), sensor_tables(gnss__sky_view=gated))
        error[gated] = [errors_m(obs, ekf).mean() for obs, ekf in ticks]
    assert error[True][50] < error[False][50] / 2
    assert error[True][80 + GATE_PATIENCE - 1] < 3
    assert error[True][119] > 10, "the fixes were right and the filter wrong: it gives in"


def test_a_slot_with_a_new_vehicle_starts_again() -> None:
    """The next vehicle is 150 m away, by any of the signs that a slot gives."""
    signs = (
        {"terminated": np.array([True])},
        {"truncated": np.array([True])},
        {"episode_step": np.array([0], np.uint32)},
        {"vehicle": np.array([7], np.uint32)},
    )
    for sign in signs:
        noise = noise_of(sensor_tables())
        ekf = Ekf(noise)
        for obs in observations(standing_track(50, 1, 1)):
            if obs.tick >= 30:
                moved = obs.truth.clone()
                moved[:, 0] += 150
                lasting = "vehicle" in sign or obs.tick == 30
                obs = replace(obs, gnss_m=obs.gnss_m + 150, truth=moved, **(sign if lasting else {}))
            ekf.step(read_samples(obs, ImuConvention.KINEMATIC))
            assert ekf.started[0] == (obs.tick in (0, 30))
            if obs.tick == 30:
                np.testing.assert_allclose(ekf.position_m[0], obs.gnss_m[0, :2].numpy(), atol=1e-4)
                assert position_std_m(ekf)[0] == pytest.approx(math.hypot(*noise.fix_std_m), rel=1e-3)


def test_another_episode_starts_again() -> None:
    ekf = Ekf(noise_of(sensor_tables()))
    first, second = (list(observations(standing_track(20, 3, seed), seed=seed)) for seed in (1, 2))
    second = second[5:]  # whose beginning was not seen
    for obs in (*first, *second):
        ekf.step(read_samples(obs, ImuConvention.KINEMATIC))
    alone = Ekf(ekf.noise)
    for obs in second:
        alone.step(read_samples(obs, ImuConvention.KINEMATIC))
    np.testing.assert_array_equal(ekf.belief.mean, alone.belief.mean)


def test_other_slots_change_nothing() -> None:
    """Three vehicles in three slots, and the same in five of seven whose memory holds no numbers."""
    tables = tables_of(**MANY_ERRORS)
    shown = list(observations(town_track(60, 3, 1), tables, 2))
    few, many = Ekf(noise_of(tables)), Ekf(noise_of(tables))
    for obs in shown:
        few.step(read_samples(obs, ImuConvention.KINEMATIC))
        with np.errstate(all="raise"):
            many.step(read_samples(in_slots(obs, [5, 0, 3], 4 if obs.tick < 0 else 7), ImuConvention.KINEMATIC))
    np.testing.assert_array_equal(many.belief.mean[:, [5, 0, 3]], few.belief.mean)
    np.testing.assert_array_equal(many.belief.covariance[:, :, [5, 0, 3]], few.belief.covariance)
    assert np.isfinite(many.belief.covariance).all()


def test_the_number_of_slots_may_grow() -> None:
    shown = list(observations(town_track(40, 2, 1), seed=2))
    alone, growing = Ekf(noise_of(sensor_tables())), Ekf(noise_of(sensor_tables()))
    for obs in shown:
        alone.step(read_samples(obs, ImuConvention.KINEMATIC))
        growing.step(read_samples(in_slots(obs, [0, 1], 2 if obs.tick < 20 else 6), ImuConvention.KINEMATIC))
    np.testing.assert_array_equal(growing.belief.mean[:, :2], alone.belief.mean)


def test_the_first_covariance_has_the_correlations_of_one_measurement() -> None:
    """Draw truths and sensors many times: errors of first estimates have the covariance that filters begin with."""
    tables, vehicles = tables_of(**MANY_ERRORS), 4000
    ((obs, ekf),) = filtered(observations(steady_track(1, vehicles, 1), tables, 2), tables)
    assert StateLayout.of(ekf.noise).size == 13
    nees = squared_errors(obs, ekf, 4).mean()
    low, high = chi2.ppf([0.0005, 0.9995], 4 * vehicles) / vehicles
    assert low < nees < high


def test_without_a_compass_nothing_is_known_of_the_heading_at_first() -> None:
    dark = np.full((100, 20), IMU, np.uint32)
    ticks = filtered(observations(steady_track(100, 20, 1), seed=1, dark=dark), sensor_tables())
    _, ekf = next(ticks)
    assert ekf.belief.covariance[YAW, YAW] == pytest.approx(np.full(20, NO_HEADING_VARIANCE))
    *_, (obs, ekf) = ticks
    assert np.median(errors_m(obs, ekf)) < np.median(raw_errors_m(obs))
    assert (ekf.belief.mean[SPEED] > 5).all()
