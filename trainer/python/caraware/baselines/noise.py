"""What the sensor configuration says about errors, as the standard deviations that a filter is tuned with.

Nothing here is fitted to results: every number is a key of the configuration (ipc-schema/src/config/sensors.rs) in the
filter's units, or a constant that stands at the top with its reason. Formulas and sources: docs/baselines.md.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from caraware.ipc.run_file import ConfigTable, RunFile, setting

METRES_PER_DEGREE = math.radians(1.0) * 6_378_137.0
"""Metres on the ground in a degree of arc, on WGS 84's equator; elsewhere within 0.6 % of it."""

GRAVITY_MPS2 = 9.80665

SLOPE_STD_RAD = 0.03
"""Slope of roads, standard deviation: 3 %. An accelerometer that feels gravity takes it for acceleration."""

SLOPE_TIME_S = 10.0
"""How long a slope lasts: 100 m at 10 m/s."""

SMALLEST_FIX_STD_M = 0.01
SMALLEST_COMPASS_STD_RAD = 1e-4
SMALLEST_WHEEL_STD_MPS = 1e-3
SMALLEST_ACCEL_BIAS_STD_MPS2 = 1e-3
SMALLEST_ACCEL_BIAS_WALK = 1e-4
SMALLEST_GYRO_BIAS_STD_RADPS = 1e-4
SMALLEST_GYRO_BIAS_WALK = 1e-6
"""A perfect sensor would make the covariance of a filter singular: perfect sensors get these instead."""


class ImuConvention(StrEnum):
    """Frame and gravity of what an IMU delivers: values of `imu.convention`."""

    KINEMATIC = "kinematic"
    SPECIFIC_FORCE = "specific_force"
    CARLA = "carla"


@dataclass(frozen=True)
class SensorNoise:
    """Errors of the sensors of a run, SI units. Standard deviations are 1σ of one sample; pairs are east, north."""

    tick_s: float
    fix_period_s: float
    fix_std_m: tuple[float, float]
    """White error of a fix."""
    fix_slow_std_m: tuple[float, float]
    """Stationary standard deviation of the first-order Gauss–Markov error; 0 = there is none."""
    fix_slow_time_s: float
    fix_bias_std_m: tuple[float, float]
    """How large a constant error may be; the filter knows neither its sign nor its value."""
    fix_outliers: bool
    """Reflections: a fix may be far off, so innovations are gated."""
    imu_period_s: float
    convention: ImuConvention
    accel_std_mps2: float
    """Of the axis forward."""
    accel_bias_std_mps2: float
    accel_bias_walk: float
    """m/s³/√Hz."""
    gyro_std_radps: float
    """Of the vertical axis."""
    gyro_bias_std_radps: float
    gyro_bias_walk: float
    """rad/s²/√Hz."""
    compass_std_rad: float
    compass_bias_std_rad: float
    wheel_period_s: float
    wheel_std_mps: float
    wheel_scale_std: float

    @classmethod
    def from_run(cls, run: RunFile) -> "SensorNoise | None":
        """Read `run["config"]`, which `caraware` has validated; None for a run without sensor tables."""
        config = run["config"]
        if not all(table in config for table in ("gnss", "imu", "speed_steering")):
            return None
        return cls(
            tick_s=setting(run, "run.tick_s", float),
            convention=setting(run, "imu.convention", ImuConvention),
            **_of_gnss(config["gnss"]),
            **_of_imu(config["imu"]),
            **_of_wheels(config["speed_steering"]),
        )


def _of_gnss(gnss: ConfigTable) -> dict[str, Any]:
    """Degrees come as latitude, longitude; metres as east, north, up."""
    north_deg, east_deg = _axes(gnss["noise_std_deg"], 2)
    bias_north_deg, bias_east_deg = _axes(gnss["bias_deg"], 2)
    east_m, north_m, _ = _axes(gnss["noise_std_m"], 3)
    bias_east_m, bias_north_m, _ = _axes(gnss["bias_m"], 3)
    slow_east_m, slow_north_m, _ = _axes(gnss["correlated_std_m"], 3)
    return {
        "fix_period_s": float(gnss["period_s"]),
        "fix_std_m": (
            max(math.hypot(east_deg * METRES_PER_DEGREE, east_m), SMALLEST_FIX_STD_M),
            max(math.hypot(north_deg * METRES_PER_DEGREE, north_m), SMALLEST_FIX_STD_M),
        ),
        "fix_bias_std_m": (
            abs(bias_east_deg * METRES_PER_DEGREE + bias_east_m),
            abs(bias_north_deg * METRES_PER_DEGREE + bias_north_m),
        ),
        "fix_slow_std_m": (slow_east_m, slow_north_m),
        "fix_slow_time_s": float(gnss["correlation_time_s"]),
        "fix_outliers": bool(gnss["sky_view"]),
    }


def _of_imu(imu: ConfigTable) -> dict[str, Any]:
    """Forward is axis 0, up is axis 2."""
    period_s = float(imu["period_s"])
    slope_mps2 = 0.0 if imu["convention"] == ImuConvention.KINEMATIC else GRAVITY_MPS2 * SLOPE_STD_RAD
    forward = {key: _axes(imu[f"accel_{key}"], 3)[0] for key in ("bias_mps2", "bias_walk")}
    up = {key: _axes(imu[f"gyro_{key}"], 3)[2] for key in ("bias_radps", "bias_walk")}
    return {
        "imu_period_s": period_s,
        "accel_std_mps2": _sample_std(imu, "accel", "mps2", 0, period_s),
        "accel_bias_std_mps2": max(math.hypot(forward["bias_mps2"], slope_mps2), SMALLEST_ACCEL_BIAS_STD_MPS2),
        # A slope is a Gauss–Markov process; over less than its time it walks by σ √(2/τ) per √s.
        "accel_bias_walk": max(
            math.hypot(forward["bias_walk"], slope_mps2 * math.sqrt(2.0 / SLOPE_TIME_S)), SMALLEST_ACCEL_BIAS_WALK
        ),
        "gyro_std_radps": _sample_std(imu, "gyro", "radps", 2, period_s),
        "gyro_bias_std_radps": max(abs(up["bias_radps"]), SMALLEST_GYRO_BIAS_STD_RADPS),
        "gyro_bias_walk": max(up["bias_walk"], SMALLEST_GYRO_BIAS_WALK),
        "compass_std_rad": max(float(imu["compass_noise_std_rad"]), SMALLEST_COMPASS_STD_RAD),
        "compass_bias_std_rad": abs(float(imu["compass_bias_rad"])),
    }


def _of_wheels(sensor: ConfigTable) -> dict[str, Any]:
    return {
        "wheel_period_s": float(sensor["period_s"]),
        "wheel_std_mps": max(float(sensor["speed_noise_std_mps"]), SMALLEST_WHEEL_STD_MPS),
        "wheel_scale_std": float(sensor["speed_scale_std"]),
    }


def _sample_std(imu: ConfigTable, sensor: str, unit: str, axis: int, period_s: float) -> float:
    """White noise of a sample: its own, the density over the period (σ = N/√T), and rounding (step/√12)."""
    white = _axes(imu[f"{sensor}_noise_std_{unit}"], 3)[axis]
    density = _axes(imu[f"{sensor}_noise_density"], 3)[axis]
    step = _axes(imu[f"{sensor}_resolution_{unit}"], 3)[axis]
    return math.sqrt(white**2 + density**2 / period_s + step**2 / 12.0)


def _axes(value: float | list[float], count: int) -> list[float]:
    """One number stands for all axes."""
    return [float(v) for v in value] if isinstance(value, list) else [float(value)] * count
