"""Tuning of the filters from the sensor configuration."""

import math

import pytest
from caraware.baselines.noise import METRES_PER_DEGREE, SensorNoise
from synthetic import run_file
from synthetic_vehicle import sensor_tables


def noise_of(**changes: object) -> SensorNoise:
    noise = SensorNoise.from_run({"config": sensor_tables(**changes)})
    assert noise is not None
    return noise


def test_the_preset_s_fix_has_the_paper_s_noise() -> None:
    noise = noise_of()
    assert noise.fix_std_m == pytest.approx((5.57, 5.57), abs=0.005)
    assert (noise.fix_bias_std_m, noise.fix_slow_std_m) == ((0, 0), (0, 0))
    assert (noise.gyro_std_radps, noise.accel_std_mps2, noise.wheel_std_mps) == (0.001, 0.001, 0.0028)


def test_degrees_are_latitude_and_longitude_and_metres_east_and_north() -> None:
    noise = noise_of(gnss__noise_std_deg=[1e-5, 3e-5], gnss__noise_std_m=[4.0, 5.0, 6.0])
    expected = (math.hypot(3e-5 * METRES_PER_DEGREE, 4.0), math.hypot(1e-5 * METRES_PER_DEGREE, 5.0))
    assert noise.fix_std_m == pytest.approx(expected)
    biased = noise_of(gnss__bias_deg=[0.0, 1e-5], gnss__bias_m=[-0.5, -2.0, 0.0])
    assert biased.fix_bias_std_m == pytest.approx((1e-5 * METRES_PER_DEGREE - 0.5, 2.0))


def test_a_density_becomes_the_noise_of_a_sample() -> None:
    noise = noise_of(
        imu__period_s=0.01,
        imu__gyro_noise_std_radps=[0.0, 0.0, 0.003],
        imu__gyro_noise_density=[9.0, 9.0, 4e-4],
        imu__gyro_resolution_radps=[9.0, 9.0, 0.012],
    )
    assert noise.gyro_std_radps == pytest.approx(math.sqrt(0.003**2 + (4e-4) ** 2 / 0.01 + 0.012**2 / 12))


def test_one_number_stands_for_all_axes() -> None:
    assert noise_of(gnss__noise_std_deg=5e-5, imu__gyro_bias_radps=0.02).gyro_bias_std_radps == 0.02


def test_an_accelerometer_that_feels_gravity_takes_slopes_for_acceleration() -> None:
    kinematic, felt = noise_of(), noise_of(imu__convention="specific_force")
    assert kinematic.accel_bias_std_mps2 < 0.01
    assert felt.accel_bias_std_mps2 == pytest.approx(9.80665 * 0.03, rel=1e-3)


def test_perfect_sensors_keep_a_little_noise() -> None:
    noise = noise_of(gnss__noise_std_deg=0.0, speed_steering__speed_noise_std_mps=0.0)
    assert min(*noise.fix_std_m, noise.wheel_std_mps, noise.compass_std_rad, noise.gyro_bias_walk) > 0


def test_a_run_without_sensor_tables_has_no_noise() -> None:
    assert SensorNoise.from_run(run_file("x")) is None
