"""Extended Kalman filters of many vehicles at once, one for each slot (S. Thrun et al., Probabilistic Robotics, 3.3).

Each filter predicts with every IMU sample and is corrected by fix, wheel speed and compass. A sample counts once, and
for the time at which it was taken. A sensor that is dark corrects nothing. The tuning follows from the configuration
of the sensors (`noise.py`) and of how vehicles move (`motion.py`). Equations and sources: docs/baselines.md.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch

from caraware.baselines.motion import (
    ACCEL_BIAS,
    GYRO_BIAS,
    SLIP,
    SPEED,
    YAW,
    Entry,
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
from caraware.baselines.noise import SensorNoise
from caraware.baselines.samples import Samples
from caraware.ipc.arrays import BoolArray, Float64Array
from caraware.ipc.stream import EMPTY_SLOT

Coefficients = list[tuple[int, Float64Array | float]]
"""A row of a Jacobian: index and coefficient `[n]` of what is not zero."""

NO_HEADING_VARIANCE = math.pi**2 / 3.0
"""Variance of an unknown heading, uniform on the circle. Above it the next fix starts the filter again."""

GATE_PROBABILITY = 0.9999
"""Share of good fixes that pass the gate, where fixes may be reflections."""

GATE_PATIENCE = 20
"""After this many refused fixes in a row the filter is wrong, not the fixes: it starts again from the next one."""

CERTAIN = 10.0
"""Standard deviations from which on a wheel turns for certain: what is cut off is below the last bit."""

FORGOTTEN_TIMES = 40.0
"""Correlation times after which a held sample says nothing."""


def wrapped(angle_rad: Float64Array) -> Float64Array:
    """Angles in [−π, π)."""
    return (angle_rad + np.pi) % (2.0 * np.pi) - np.pi


def never_negative(value: Float64Array, std: float) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Mean, derivative by `value` and variance of `max(0, value + n)`, `n` of standard deviation `std`.

    A wheel at rest that cannot count backwards reads 0.4 σ on average; taken at its word it creeps away (B. Allik et
    al., The Tobit Kalman filter, IEEE Transactions on Control Systems Technology 24(1), 2016). Below −σ, as at −σ.
    """
    value = np.maximum(value, -std)
    share = np.minimum(value / std, CERTAIN)
    passed = torch.special.ndtr(torch.from_numpy(share)).numpy()
    density = np.exp(-0.5 * share**2) / math.sqrt(2.0 * math.pi)
    mean = value * passed + std * density
    variance = (value**2 + std**2) * passed + value * std * density - mean**2
    return mean, passed, np.where(share < CERTAIN, variance, std**2)


@dataclass
class Belief:
    """A Gaussian for each of `n` slots."""

    mean: Float64Array
    """f64 `[d, n]`."""
    covariance: Float64Array
    """f64 `[d, d, n]`, symmetric to the last bit."""

    @classmethod
    def of_empty_slots(cls, size: int, slots: int) -> "Belief":
        """Zero with unit covariance, which keeps the arithmetic of empty slots finite."""
        return cls(np.zeros((size, slots)), np.repeat(np.eye(size)[:, :, None], slots, axis=2))

    def predict(self, moved: Float64Array, jacobian: list[Entry], noise: list[Entry]) -> None:
        """`x ← f(x)`, `P ← F P Fᵀ + Q`."""
        propagate_rows(self.covariance, jacobian)
        propagate_columns(self.covariance, jacobian)
        for row, column, variance in noise:
            self.covariance[row, column] += variance
        for row in range(len(self.mean)):
            self.covariance[row + 1 :, row] = self.covariance[row, row + 1 :]
        self.mean = moved

    def correct(
        self, row: Coefficients, innovation: Float64Array, variance: Float64Array | float, use: BoolArray
    ) -> None:
        """One scalar measurement with Jacobian `row` = [(index, coefficient)], innovation `[n]`, in the slots `use`.

        `S = H P Hᵀ + R`, `x ← x + P Hᵀ S⁻¹ (z − h)`, `P ← P − P Hᵀ S⁻¹ H P`. Measurements with independent noise may
        be taken one after the other (Bar-Shalom, section 7.3), which needs no inverse. Written as `P − g gᵀ` with
        `g = P Hᵀ / √S` the covariance stays exactly symmetric.
        """
        toward = np.asarray(sum(coefficient * self.covariance[:, index] for index, coefficient in row))
        spread = sum(coefficient * toward[index] for index, coefficient in row) + variance
        root = use / np.sqrt(spread)
        gain = toward * root
        self.mean += gain * (np.where(use, innovation, 0.0) * root)
        for i in range(len(gain)):  # row by row, which stays in the cache
            self.covariance[i] -= gain[i] * gain


class Ekf:
    """The filters of all slots. Feed `step` with every tick; `position_m` is the estimate at that tick."""

    def __init__(self, noise: SensorNoise, model: MotionModel | None = None) -> None:
        self.noise, self.model, self.layout = noise, model or MotionModel(), StateLayout.of(noise)
        self.belief = Belief.of_empty_slots(self.layout.size, 0)
        self.running = np.zeros(0, bool)
        """bool `[n]`: slots with a filter."""
        self.started = np.zeros(0, bool)
        """bool `[n]`: slots whose filter started at this tick: nothing connects it with the tick before."""
        self.predicted = self.belief
        """The belief at this tick before its corrections, where `keep_prediction` asks for it."""
        self.cross = self.belief.covariance
        """Covariance of the state at the tick before with the predicted one, `P Fᵀ` `[d, d, n]`."""
        self.keep_prediction = False
        self._motion = Motion(0.0, *np.zeros((2, 0)))
        self._time_s: float | None = None
        self._vehicle = np.zeros(0, np.uint32)
        self._lost = np.zeros(0, bool)
        self._refused = np.zeros(0, int)
        self._fix_time_s = self._imu_time_s = self._wheel_time_s = np.zeros(0)
        self._held = np.zeros((2, 0))
        """Newest IMU sample: yaw rate, acceleration."""

    @property
    def position_m(self) -> Float64Array:
        """f64 `[n, 2]`: east and north; the truth's place is the rear axle, and so is this."""
        return self.belief.mean[:2].T

    def step(self, samples: Samples) -> None:
        """One tick for all slots: predict to it, correct with what is new, start filters that have none."""
        self._grow(len(samples.vehicle))
        self.running &= (samples.vehicle == self._vehicle) & (samples.vehicle != EMPTY_SLOT) & ~samples.begins
        self._vehicle = samples.vehicle
        if self._time_s is not None and samples.time_s < self._time_s:
            self.running[:] = False
        fix_new = self._is_new(self._fix_time_s, samples.fix_on, samples.fix_age_s, samples.time_s)
        wheel_new = self._is_new(self._wheel_time_s, samples.wheel_on, samples.wheel_age_s, samples.time_s)
        imu_new = self._is_new(self._imu_time_s, samples.imu_on, samples.imu_age_s, samples.time_s)
        self._predict(samples, imu_new)
        self._lost |= self.belief.covariance[YAW, YAW] > NO_HEADING_VARIANCE
        self._lost |= self._refused >= GATE_PATIENCE
        can_start = samples.valid & np.isfinite(samples.fix_m).all(0)
        self.started = can_start & (~self.running | (self._lost & fix_new))
        steady = self.running & ~self.started
        self._correct_compass(samples, imu_new & steady)
        self._correct_wheel_speed(samples, wheel_new & steady)
        self._correct_position(samples, fix_new & steady)
        self._correct_by_map(steady)
        self.belief.mean[YAW] = wrapped(self.belief.mean[YAW])
        if self.started.any():
            self._start(samples)
        self._remember(samples, fix_new, imu_new, wheel_new)

    def _predict(self, samples: Samples, imu_new: BoolArray) -> None:
        """Through every IMU sample since the tick before; where there are none, through the last one, held."""
        steps = len(samples.accel_mps2)
        dt_s = (samples.time_s - self._time_s) / steps if self._time_s is not None else 0.0
        self._yaw_at_sample = np.zeros((steps, len(imu_new)))
        self._motion = Motion(0.0, *np.zeros((2, len(imu_new))))
        if self.keep_prediction:
            self.cross = self.belief.covariance.copy()
        for i in range(steps if dt_s > 0 else 0):
            end_s = samples.time_s - (steps - 1 - i) * dt_s
            self._motion = motion = self._motion_between(samples, i, imu_new, end_s, dt_s)
            kept = math.exp(-dt_s / self.noise.fix_slow_time_s)
            belief, layout = self.belief, self.layout
            moved, jacobian = transition(belief.mean, motion, layout, kept)
            noise = process_noise(belief.mean, belief.covariance, motion, self.noise, self.model, layout, kept)
            belief.predict(moved, jacobian, noise)
            self._yaw_at_sample[i] = moved[YAW]
            if self.keep_prediction:
                propagate_columns(self.cross, jacobian)
        if self.keep_prediction:
            self.predicted = Belief(self.belief.mean.copy(), self.belief.covariance.copy())

    def _motion_between(self, samples: Samples, i: int, imu_new: BoolArray, end_s: float, dt_s: float) -> Motion:
        """What is known about the `i`-th interval of a tick.

        Between two samples the rate goes in a line from one to the other; what it does beside that has a quarter of
        the variance that it has without the second sample (`q T³/12`, a bridge, against `q T³/3`).
        """
        noise, model = self.noise, self.model
        newest = np.stack((samples.yaw_rate_radps[i], samples.accel_mps2[i]))
        before = self._held if i == 0 else np.stack((samples.yaw_rate_radps[i - 1], samples.accel_mps2[i - 1]))
        linked = imu_new if i else imu_new & (end_s - dt_s - self._imu_time_s < 0.5 * dt_s)
        mean = np.where(imu_new, np.where(linked, 0.5 * (newest + before), newest), self._held)
        sampled_s2 = max(noise.imu_period_s, dt_s) * dt_s
        parts = []
        for std, time_s, sensor_std in (
            (model.yaw_rate_std_radps, model.yaw_rate_time_s, noise.gyro_std_radps),
            (model.accel_std_mps2, model.accel_time_s, noise.accel_std_mps2),
        ):
            trust, variance = self._trust(imu_new, end_s, dt_s, std, time_s)
            parts.append((trust, variance + (trust * sensor_std) ** 2 * sampled_s2))
        (rate_trust, yaw_variance), (accel_trust, speed_variance) = parts
        return Motion(dt_s, mean[0], mean[1], rate_trust, accel_trust, yaw_variance, speed_variance)

    def _trust(
        self, imu_new: BoolArray, end_s: float, dt_s: float, std: float, time_s: float
    ) -> tuple[Float64Array | float, Float64Array | float]:
        """How much the sample counts `[n]`, and the variance of what the interval adds to its integral `[n]`."""
        bridge = forgotten(dt_s, std, time_s) / 4.0
        if imu_new.all():
            return 1.0, bridge
        age_s = np.minimum(end_s - dt_s - self._imu_time_s, FORGOTTEN_TIMES * time_s)
        added = forgotten(age_s + dt_s, std, time_s) - forgotten(age_s, std, time_s)
        held = np.exp(-(age_s + 0.5 * dt_s) / time_s)
        return np.where(imu_new, 1.0, held), np.where(imu_new, bridge, added)

    def _correct_compass(self, samples: Samples, use: BoolArray) -> None:
        """`z = ψ + b_c + n` at every IMU sample of the tick; their mean, as the gyro links them within the tick."""
        if not use.any():
            return
        row: Coefficients = [(YAW, 1.0)]
        expected = self._yaw_at_sample
        if self.layout.compass is not None:
            row.append((self.layout.compass, 1.0))
            expected = expected + self.belief.mean[self.layout.compass]
        innovation = wrapped(samples.yaw_rad - expected).mean(0)
        self.belief.correct(row, innovation, self.noise.compass_std_rad**2 / len(samples.yaw_rad), use)

    def _correct_wheel_speed(self, samples: Samples, use: BoolArray) -> None:
        """`z = max(0, (1 + s) v + n)`, of the speed when the sample was taken. Vehicles do not drive backwards.

        The cut is linearised at the prediction, which only a prediction sharper than the sensor allows; else
        `(1 + s) v + n`.
        """
        if not use.any():
            return
        mean = self.belief.mean
        _, accel = self._rates()
        speed = mean[SPEED] - samples.wheel_age_s * accel
        row: Coefficients = [(SPEED, 1.0)]
        scale: Float64Array | float = 0.0
        if self.layout.scale is not None:
            scale = mean[self.layout.scale]
            row = [(SPEED, 1.0 + scale), (self.layout.scale, speed)]
        turned, std = (1.0 + scale) * speed, self.noise.wheel_std_mps
        sharp = self.belief.covariance[SPEED, SPEED] < std**2
        expected, passed, variance = (
            np.where(sharp, cut, plain)
            for cut, plain in zip(never_negative(turned, std), (turned, 1.0, std**2), strict=True)
        )
        row = [(index, coefficient * passed) for index, coefficient in row]
        self.belief.correct(row, samples.wheel_mps - expected, variance, use)

    def _correct_position(self, samples: Samples, use: BoolArray) -> None:
        """`z = p − s (cos ψ_m, sin ψ_m) + e + b + n`: the place `a` seconds ago, when the fix was taken.

        `s = a v − a² α/2` and `ψ_m = ψ − a ω/2` lead back there, with the newest acceleration and yaw rate.
        """
        if not use.any():
            return
        variance = self._fix_variance(samples)
        use = use & self._passes(samples, variance, use)
        for axis in (0, 1):
            row, expected = self._fix_row(axis, samples.fix_age_s)
            self.belief.correct(row, samples.fix_m[axis] - expected, variance[axis], use)

    def _correct_by_map(self, use: BoolArray) -> None:
        """This filter has no map; `caraware.baselines.map_ekf` has one."""

    def _fix_row(self, axis: int, age_s: Float64Array) -> tuple[Coefficients, Float64Array]:
        """Jacobian and expectation of a fix's `axis` (0 east, 1 north)."""
        mean = self.belief.mean
        rows = [rows[axis] for rows in (self.layout.slow, self.layout.bias) if rows is not None]
        row: Coefficients = [(X + axis, 1.0), *((error, 1.0) for error in rows)]
        expected = sum(mean[error] for error in [X + axis, *rows])
        if not age_s.any():
            return row, expected
        rate, accel = self._rates()
        heading = mean[YAW] - 0.5 * age_s * rate
        along, turned = (np.cos(heading), -np.sin(heading)) if axis == 0 else (np.sin(heading), np.cos(heading))
        back_m = age_s * mean[SPEED] - 0.5 * age_s**2 * accel
        return [*row, (SPEED, -age_s * along), (YAW, -back_m * turned)], expected - back_m * along

    def _rates(self) -> tuple[Float64Array, Float64Array]:
        """Yaw rate and acceleration now `[n]`. H leaves their biases out: they lead back no further than an age."""
        motion, mean = self._motion, self.belief.mean
        rate = motion.yaw_rate_trust * (motion.yaw_rate_radps - mean[GYRO_BIAS])
        return rate, motion.accel_trust * (motion.accel_mps2 - mean[ACCEL_BIAS])

    def _fix_variance(self, samples: Samples) -> Float64Array:
        """R of both axes `[2, n]`: the configuration's, or more where the receiver says that the fix is worse."""
        noise = self.noise
        nominal_m = math.hypot(*noise.fix_std_m, *noise.fix_slow_std_m, *noise.fix_bias_std_m)
        factor = np.maximum(samples.fix_error_m / nominal_m, 1.0)
        std_m = np.array(noise.fix_std_m)[:, None] * np.where(np.isfinite(factor), factor, 1.0)
        variance_m2: Float64Array = np.square(std_m)
        return variance_m2

    def _passes(self, samples: Samples, variance: Float64Array, use: BoolArray) -> BoolArray:
        """Chi-square test of the innovation, two degrees of freedom (Bar-Shalom, section 5.4): bool `[n]`."""
        if not self.noise.fix_outliers:
            return use
        east, north = (self._fix_row(axis, samples.fix_age_s) for axis in (0, 1))
        innovation = samples.fix_m - np.stack((east[1], north[1]))
        ee, en, nn = (self._spread(a[0], b[0]) for a, b in ((east, east), (east, north), (north, north)))
        ee, nn = ee + variance[0], nn + variance[1]
        distance = nn * innovation[0] ** 2 - 2.0 * en * innovation[0] * innovation[1] + ee * innovation[1] ** 2
        passes: BoolArray = distance <= -2.0 * math.log(1.0 - GATE_PROBABILITY) * (ee * nn - en**2)
        self._refused = np.where(use, np.where(passes, 0, self._refused + 1), self._refused)
        return passes

    def _spread(self, one: Coefficients, other: Coefficients) -> Float64Array:
        """`H₁ P H₂ᵀ` `[n]`."""
        return np.asarray(sum(a * b * self.belief.covariance[i, j] for i, a in one for j, b in other))

    def _start(self, samples: Samples) -> None:
        """New filters from the first fix, compass and wheel speed, as far as there are.

        What two rows owe to the same measurement is in their covariance: `p = z − e` has the error of `e`.
        """
        use, noise, layout = self.started, self.noise, self.layout
        speed, speed_variance = self._first_speed(samples)
        yaw, yaw_variance = self._first_yaw(samples)
        mean = np.zeros_like(self.belief.mean)
        covariance = np.zeros_like(self.belief.covariance)
        mean[SPEED], covariance[SPEED, SPEED] = speed, speed_variance
        mean[YAW], covariance[YAW, YAW] = yaw, yaw_variance
        covariance[GYRO_BIAS, GYRO_BIAS] = noise.gyro_bias_std_radps**2
        covariance[ACCEL_BIAS, ACCEL_BIAS] = noise.accel_bias_std_mps2**2
        mean[SLIP], covariance[SLIP, SLIP] = self.model.slip_rad_per_g, self.model.slip_std_rad_per_g**2
        moved_m = samples.fix_age_s * speed
        mean[X] = samples.fix_m[0] + moved_m * np.cos(yaw)
        mean[Y] = samples.fix_m[1] + moved_m * np.sin(yaw)
        white = self._fix_variance(samples) + samples.fix_age_s**2 * (speed_variance + speed**2 * yaw_variance)
        covariance[X, X], covariance[Y, Y] = white
        for rows, stds in ((layout.slow, noise.fix_slow_std_m), (layout.bias, noise.fix_bias_std_m)):
            for place, row, std in zip((X, Y), rows or (), stds, strict=False):
                _owe(covariance, place, row, -1.0, std)
        if layout.scale is not None:
            measured = np.where(samples.wheel_on, samples.wheel_mps, 0.0)
            _owe(covariance, SPEED, layout.scale, -measured, noise.wheel_scale_std)
        if layout.compass is not None:
            _owe(covariance, YAW, layout.compass, np.where(samples.imu_on, -1.0, 0.0), noise.compass_bias_std_rad)
        self.belief.mean = np.where(use, mean, self.belief.mean)
        self.belief.covariance = np.where(use, covariance, self.belief.covariance)

    def _first_speed(self, samples: Samples) -> tuple[Float64Array, Float64Array]:
        unknown = self.model.first_speed_std_mps**2
        variance = np.where(samples.wheel_on, self.noise.wheel_std_mps**2, unknown)
        return np.where(samples.wheel_on, samples.wheel_mps, 0.0), variance

    def _first_yaw(self, samples: Samples) -> tuple[Float64Array, Float64Array]:
        variance = np.where(samples.imu_on, self.noise.compass_std_rad**2, NO_HEADING_VARIANCE)
        return np.where(samples.imu_on, wrapped(samples.yaw_rad[-1]), 0.0), variance

    def _is_new(self, last_s: Float64Array, on: BoolArray, age_s: Float64Array, time_s: float) -> BoolArray:
        """bool `[n]`: the sensor delivers, and its newest sample was taken after the last one that counted."""
        fresh_s = np.where(self.running, last_s, -np.inf) + 0.25 * self._shortest_period_s()
        return on & (time_s - age_s > fresh_s)

    def _shortest_period_s(self) -> float:
        """Samples are at least this far apart as seen from a tick."""
        return min(self.noise.tick_s, self.noise.fix_period_s, self.noise.imu_period_s, self.noise.wheel_period_s)

    def _remember(self, samples: Samples, fix_new: BoolArray, imu_new: BoolArray, wheel_new: BoolArray) -> None:
        """When the newest samples were taken, and the IMU's; a filter that starts has seen what it started from."""
        now, begun = samples.time_s, self.started
        self._fix_time_s = np.where(fix_new | begun, now - samples.fix_age_s, self._fix_time_s)
        self._wheel_time_s = np.where(wheel_new | begun, now - samples.wheel_age_s, self._wheel_time_s)
        imu_time_s = np.where(samples.imu_on, now - samples.imu_age_s, -np.inf)
        self._imu_time_s = np.where(imu_new | begun, imu_time_s, self._imu_time_s)
        newest = np.stack((samples.yaw_rate_radps[-1], samples.accel_mps2[-1]))
        newest = np.where(samples.imu_on, newest, 0.0)
        self._held = np.where(imu_new | begun, newest, self._held)
        self._refused[begun], self._lost[begun] = 0, False
        self.running |= begun
        self._time_s = now

    def _grow(self, slots: int) -> None:
        """Slots only become more."""
        more = slots - len(self.running)
        if more <= 0:
            return
        fresh = Belief.of_empty_slots(self.layout.size, more)
        self.belief = Belief(
            np.concatenate((self.belief.mean, fresh.mean), axis=1),
            np.concatenate((self.belief.covariance, fresh.covariance), axis=2),
        )
        self.running, self.started, self._lost = (
            np.concatenate((a, np.zeros(more, bool))) for a in (self.running, self.started, self._lost)
        )
        self._vehicle = np.concatenate((self._vehicle, np.full(more, EMPTY_SLOT, np.uint32)))
        self._refused = np.concatenate((self._refused, np.zeros(more, int)))
        self._fix_time_s, self._imu_time_s, self._wheel_time_s = (
            np.concatenate((a, np.full(more, -np.inf)))
            for a in (self._fix_time_s, self._imu_time_s, self._wheel_time_s)
        )
        self._held = np.concatenate((self._held, np.zeros((2, more))), axis=1)


def _owe(covariance: Float64Array, row: int, error: int, coefficient: Float64Array | float, std: float) -> None:
    """Row `row` was set from a measurement with the error in row `error`, times `coefficient`."""
    covariance[error, error] = std**2
    covariance[row, error] = covariance[error, row] = coefficient * std**2
    covariance[row, row] += coefficient**2 * std**2
