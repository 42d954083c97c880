"""From the raw sections of an observation to what a filter takes: right-handed, SI, f64, slots last."""

from dataclasses import dataclass

import numpy as np

from caraware.baselines.noise import ImuConvention
from caraware.ipc.arrays import BoolArray, Float64Array, UInt32Array
from caraware.ipc.layout import SENSOR_BITS
from caraware.ipc.stream import Observation

YAW_RATE_SIGN = {ImuConvention.KINEMATIC: 1.0, ImuConvention.SPECIFIC_FORCE: 1.0, ImuConvention.CARLA: -1.0}
"""CARLA's frame is left-handed (y to the right): its rates about the upward axis are clockwise. Forward is forward."""

OLDEST_S = 1e5
"""Ages are cut here, so that the arithmetic of sensors that never delivered stays finite."""


@dataclass(frozen=True)
class Samples:
    """One tick of `n` slots, `k` IMU samples each, oldest first. Ages are those of the newest sample."""

    time_s: float
    vehicle: UInt32Array
    """u32 `[n]`: the vehicle in the slot, `EMPTY_SLOT` without one."""
    valid: BoolArray
    """bool `[n]`: all sensors have delivered, so that there is a fix."""
    begins: BoolArray
    """bool `[n]`: another trajectory than at the tick before."""
    fix_m: Float64Array
    """f64 `[2, n]`: east, north."""
    fix_error_m: Float64Array
    """f64 `[n]`: the receiver's own estimate of its horizontal error; 0 where it has none."""
    fix_age_s: Float64Array
    fix_on: BoolArray
    accel_mps2: Float64Array
    """f64 `[k, n]`: forward."""
    yaw_rate_radps: Float64Array
    """f64 `[k, n]`: counter-clockwise seen from above."""
    yaw_rad: Float64Array
    """f64 `[k, n]`: the compass as a yaw, counter-clockwise from east."""
    imu_age_s: Float64Array
    imu_on: BoolArray
    wheel_mps: Float64Array
    wheel_age_s: Float64Array
    wheel_on: BoolArray


def read_samples(obs: Observation, convention: ImuConvention) -> Samples:
    """Copies of what the filter needs; the observation's memory may change afterwards."""
    imu = _f64(obs.imu).transpose(2, 1, 0)
    age_s = np.clip(np.nan_to_num(_f64(obs.age_s)), 0.0, OLDEST_S)
    sensors = np.asarray(obs.sensors)
    wheel_mps = _f64(obs.speed_steering)[:, 0]
    fix_m = np.ascontiguousarray(_f64(obs.gnss_m)[:, :2].T)
    accel_mps2, yaw_rate_radps, compass_rad = (np.ascontiguousarray(imu[column]) for column in (0, 5, 6))
    finite_imu = np.isfinite(accel_mps2 + yaw_rate_radps + compass_rad).all(0)
    return Samples(
        time_s=obs.sim_time_ns * 1e-9,
        vehicle=np.array(obs.vehicle),
        valid=np.array(obs.valid),
        begins=obs.terminated | obs.truncated | (np.asarray(obs.episode_step) == 0),
        fix_m=fix_m,
        fix_error_m=_f64(obs.gnss_quality)[:, 0],
        fix_age_s=age_s[:, 0],
        fix_on=((sensors & SENSOR_BITS["gnss"]) != 0) & np.isfinite(fix_m).all(0),
        accel_mps2=accel_mps2,
        yaw_rate_radps=YAW_RATE_SIGN[convention] * yaw_rate_radps,
        yaw_rad=np.pi / 2 - compass_rad,
        imu_age_s=age_s[:, 1],
        imu_on=((sensors & SENSOR_BITS["imu"]) != 0) & finite_imu,
        wheel_mps=wheel_mps,
        wheel_age_s=age_s[:, 2],
        wheel_on=((sensors & SENSOR_BITS["speed_steering"]) != 0) & np.isfinite(wheel_mps),
    )


def _f64(array: object) -> Float64Array:
    return np.asarray(array).astype(np.float64)
