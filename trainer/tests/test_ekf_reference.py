"""The filter compared with filterpy, for which the equations of docs/baselines.md are written a second time."""

import math

import numpy as np
import sympy
from caraware.baselines.ekf import never_negative, wrapped
from caraware.baselines.motion import SPEED, MotionModel
from caraware.baselines.noise import ImuConvention, SensorNoise
from caraware.baselines.samples import read_samples
from filterpy.kalman import ExtendedKalmanFilter
from synthetic_vehicle import GNSS, IMU, SPEED_STEERING, observations, standing_track, town_track
from test_ekf import MANY_ERRORS, filtered, noise_of, tables_of


class Reference:
    """One vehicle in filterpy: a second version of the equations of docs/baselines.md, their Jacobian by sympy."""

    def __init__(self, noise: SensorNoise, model: MotionModel, start: np.ndarray, covariance: np.ndarray) -> None:
        self.noise, self.model = noise, model
        self.kf = ExtendedKalmanFilter(dim_x=13, dim_z=1)
        self.kf.x, self.kf.P = start.copy(), covariance.copy()
        self.imu: np.ndarray | None = None
        self.imu_age_s = 0.0
        x = sympy.symbols("x y yaw v bw ba slip ce cn be bn s bc")
        rate, accel, trust_rate, trust_accel, dt, kept = inputs = sympy.symbols("rate accel gr ga dt kept")
        turn, push = trust_rate * (rate - x[4]), trust_accel * (accel - x[5])
        middle, path = x[2] + turn * dt / 2 - x[6] / 9.80665 * x[3] * turn, x[3] * dt + push * dt**2 / 2
        moved = [
            x[0] + path * sympy.cos(middle),
            x[1] + path * sympy.sin(middle),
            x[2] + turn * dt,
            x[3] + (push - x[6] / 9.80665 * x[3] ** 2 * turn**2) * dt,
            *x[4:7],
            kept * x[7],
            kept * x[8],
            *x[9:],
        ]
        self.f = sympy.lambdify((x, inputs), moved)
        self.jacobian = sympy.lambdify((x, inputs), sympy.Matrix(moved).jacobian(x))

    def predict(self, imu: np.ndarray | None, dt: float = 0.1) -> None:
        """`imu`: yaw rate and acceleration, None in the dark. Samples come every `dt`."""
        noise, model, kf = self.noise, self.model, self.kf
        trusts, variances = [], []
        for std, time_s, sensor_std in (
            (model.yaw_rate_std_radps, model.yaw_rate_time_s, noise.gyro_std_radps),
            (model.accel_std_mps2, model.accel_time_s, noise.accel_std_mps2),
        ):
            age = self.imu_age_s
            trust = 1.0 if imu is not None else math.exp(-(age + dt / 2) / time_s)
            walked = self.integrated(dt, std, time_s) / 4
            if imu is None:
                walked = self.integrated(age + dt, std, time_s) - self.integrated(age, std, time_s)
            trusts.append(trust)
            variances.append(walked + (trust * sensor_std * dt) ** 2)
        assert self.imu is not None
        mean = self.imu if imu is None else (imu + self.imu) / 2 if self.imu_age_s == 0 else imu
        self.imu, self.imu_age_s = (self.imu, self.imu_age_s + dt) if imu is None else (imu, 0.0)
        kept = math.exp(-dt / noise.fix_slow_time_s)
        u = (*mean, *trusts, dt, kept)
        yaw, v = kf.x[2], kf.x[3]
        slip = model.slip_noise_rad_per_g / 9.80665 * v**2 * trusts[0] * (mean[0] - kf.x[4])
        q = np.zeros((13, 13))
        left = np.array([-math.sin(yaw), math.cos(yaw)])
        q[:2, :2] = 2 * model.slip_time_s * dt * slip**2 * np.outer(left, left)
        ahead = np.array([math.cos(yaw), math.sin(yaw)])
        lasting, turned = 2 * model.heading_time_s * dt, min(kf.P[2, 2], 1)
        q[:2, :2] += lasting * (v**2 + kf.P[3, 3]) * turned**2 / 2 * np.outer(ahead, ahead)
        q[:2, :2] += lasting * kf.P[3, 3] * turned * np.outer(left, left)
        q[:2, :2] += np.eye(2) * model.position_walk_m**2 * dt
        rate = trusts[0] * (mean[0] - kf.x[4])
        by_rate = np.array([1, -2 * kf.x[6] / 9.80665 * v**2 * rate])
        q[2:4, 2:4] = variances[0] * np.outer(by_rate, by_rate) + np.diag([0, variances[1]])
        q[4, 4], q[5, 5] = noise.gyro_bias_walk**2 * dt, noise.accel_bias_walk**2 * dt
        q[7, 7], q[8, 8] = np.square(noise.fix_slow_std_m) * (1 - kept**2)
        kf.F, kf.Q = np.array(self.jacobian(kf.x, u), float), q
        before = kf.x
        kf.predict_x = lambda u_=0: setattr(kf, "x", np.array(self.f(before, u), float))
        kf.predict()

    @staticmethod
    def integrated(age: float, std: float, time_s: float) -> float:
        """Variance of an integrated Gauss–Markov process by quadrature of its impulse response."""
        nodes, weights = np.polynomial.legendre.leggauss(40)
        s = age * (nodes + 1) / 2
        return float(weights @ (time_s * (1 - np.exp(-s / time_s))) ** 2) * age / 2 * 2 * std**2 / time_s

    def update(self, z: float, h: dict[int, float], expected: float, variance: float, angle: bool = False) -> None:
        row = np.zeros((1, 13))
        for index, coefficient in h.items():
            row[0, index] = coefficient
        residual = (lambda a, b: wrapped(a - b)) if angle else np.subtract
        z_, at = np.array([z]), np.array([expected])
        self.kf.update(z_, lambda x: row, lambda x: at, R=np.array([[variance]]), residual=residual)


def censored(value: float, std: float) -> tuple[float, float, float]:
    """Mean, derivative and variance of max(0, value + n), by integration."""

    def mean(power: int, at: float) -> float:
        nodes, weights = np.polynomial.legendre.leggauss(200)
        low = max(-12 * std, -at)
        n = low + (12 * std - low) * (nodes + 1) / 2
        density = np.exp(-0.5 * (n / std) ** 2) / (std * math.sqrt(2 * math.pi))
        return float(weights @ ((at + n) ** power * density) * (12 * std - low) / 2)

    value = max(value, -std)
    return mean(1, value), mean(0, value), mean(2, value) - mean(1, value) ** 2


def test_a_wheel_that_cannot_count_backwards_does_not_creep() -> None:
    """Standing for 30 s with 0.1 m/s of noise, which cut at 0 reads 0.04 m/s: 1.2 m if it were believed."""
    tables = tables_of(speed_steering__speed_noise_std_mps=0.1, gnss__noise_std_deg=[1e-3, 1e-3])
    shown = observations(standing_track(301, 200, 1), tables, 2)
    *_, (_, ekf) = filtered(shown, tables)
    # The mean of 200, each of 0.04 m/s: 0.003.
    assert abs(ekf.belief.mean[SPEED].mean()) < 0.01
    for share in (-0.9, 0.0, 0.5, 3.0, 40.0):
        ours = never_negative(np.array([share * 0.1]), 0.1)
        np.testing.assert_allclose(np.concatenate(ours), censored(share * 0.1, 0.1), rtol=1e-9)


def test_state_and_covariance_are_filterpy_s_to_1e_9() -> None:
    """300 ticks of a vehicle in a town, every error configured, with outages of each sensor."""
    tables, model = tables_of(**MANY_ERRORS, gnss__period_s=0.3), MotionModel()
    noise = noise_of(tables)
    track = town_track(300, 3, 5)
    dark = np.zeros((300, 3), np.uint32)
    dark[100:130] |= GNSS
    dark[120:150] |= IMU
    dark[140:170] |= SPEED_STEERING
    reference: Reference | None = None
    for obs, ekf in filtered(observations(track, tables, 1, dark), tables, model):
        samples = read_samples(obs, ImuConvention.KINEMATIC)
        imu = np.array([samples.yaw_rate_radps[0, 1], samples.accel_mps2[0, 1]])
        lit = {bit: not dark[obs.tick, 1] & bit for bit in (GNSS, IMU, SPEED_STEERING)}
        if reference is None:
            reference = Reference(noise, model, ekf.belief.mean[:, 1], ekf.belief.covariance[:, :, 1])
            reference.imu = imu
            continue
        reference.predict(imu if lit[IMU] else None)
        x = reference.kf
        if lit[IMU]:
            reference.update(samples.yaw_rad[0, 1], {2: 1, 12: 1}, x.x[2] + x.x[12], noise.compass_std_rad**2, True)
        if lit[SPEED_STEERING]:
            v, s = x.x[3], x.x[11]
            expected, passed, variance = (1 + s) * v, 1.0, noise.wheel_std_mps**2
            if x.P[3, 3] < variance:
                expected, passed, variance = censored(expected, noise.wheel_std_mps)
            reference.update(samples.wheel_mps[1], {3: passed * (1 + s), 11: passed * v}, expected, variance)
        if lit[GNSS] and obs.tick % 3 == 0:
            for axis in (0, 1):
                h = {axis: 1.0, 7 + axis: 1.0, 9 + axis: 1.0}
                reference.update(samples.fix_m[axis, 1], h, x.x[list(h)].sum(), noise.fix_std_m[axis] ** 2)
        x.x[2] = wrapped(x.x[2])
        np.testing.assert_allclose(ekf.belief.mean[:, 1], x.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ekf.belief.covariance[:, :, 1], x.P, rtol=1e-9, atol=1e-9)
