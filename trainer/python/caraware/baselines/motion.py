"""How a vehicle moves between two IMU samples: the state, its transition with Jacobian, and the process noise.

Arrays have slots last: a mean is `[d, n]`, a covariance `[d, d, n]`, and everything is done for all slots at once.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from caraware.baselines.noise import GRAVITY_MPS2, SensorNoise
from caraware.ipc.arrays import Float64Array

X, Y, YAW, SPEED, GYRO_BIAS, ACCEL_BIAS, SLIP = range(7)
"""Rows that every state has: m, m, rad, m/s, rad/s, m/s², rad per g; the position is the centre of the rear axle."""

Entry = tuple[int, int, Float64Array | float]
"""Row, column and value `[n]` of what a matrix has beside the identity."""


@dataclass(frozen=True)
class MotionModel:
    """What is known of vehicles beyond their sensors. Reasons: docs/baselines.md."""

    accel_std_mps2: float = 1.5
    """Acceleration along the heading, as a first-order Gauss–Markov process (R. Singer, 1970)."""
    accel_time_s: float = 2.0
    yaw_rate_std_radps: float = 0.2
    yaw_rate_time_s: float = 2.0
    slip_rad_per_g: float = 0.05
    """Angle between heading and motion of the rear axle by lateral acceleration: its compliance, 1/23 for `sedan`."""
    slip_std_rad_per_g: float = 0.04
    """Over vehicles: from 0 for the kinematic model and rails to 1/8 for trucks."""
    slip_noise_rad_per_g: float = 0.01
    """What is not proportional, as tyres near their limit and in transients."""
    slip_time_s: float = 2.0
    """How long a bend lasts."""
    heading_time_s: float = 5.0
    """How long an error of the heading lasts, where the linear model of it is too coarse."""
    position_walk_m: float = 0.01
    """Per √s, on each axis: what the arcs between samples leave out."""
    first_speed_std_mps: float = 10.0
    """Of a vehicle whose wheel speed is not known."""


@dataclass(frozen=True)
class StateLayout:
    """The rows of the state: seven that are always there, and errors of sensors that the configuration speaks of."""

    slow: tuple[int, int] | None = None
    """Slow error of the fix, east and north (m)."""
    bias: tuple[int, int] | None = None
    """Constant error of the fix, east and north (m)."""
    scale: int | None = None
    """Scale error of the wheel speed (-)."""
    compass: int | None = None
    """Constant error of the compass, counter-clockwise (rad)."""
    size: int = 7

    @classmethod
    def of(cls, noise: SensorNoise) -> "StateLayout":
        """Only what has an error gets a row."""
        rows: dict[str, Any] = {}
        size = 7
        for name, stds in (("slow", noise.fix_slow_std_m), ("bias", noise.fix_bias_std_m)):
            if max(stds) > 0:
                rows[name], size = (size, size + 1), size + 2
        for name, std in (("scale", noise.wheel_scale_std), ("compass", noise.compass_bias_std_rad)):
            if std > 0:
                rows[name], size = size, size + 1
        return cls(**rows, size=size)


@dataclass(frozen=True)
class Motion:
    """What an IMU says about an interval: means over it `[n]`, and how much they still count."""

    dt_s: float
    yaw_rate_radps: Float64Array
    accel_mps2: Float64Array
    yaw_rate_trust: Float64Array | float = 1.0
    """1 for a fresh sample; `exp(−age/τ)` for one that is held, the expectation of a Gauss–Markov process."""
    accel_trust: Float64Array | float = 1.0
    yaw_variance: Float64Array | float = field(default=0.0)
    """rad²: what the yaw does in the interval that the IMU does not say, sensor noise included."""
    speed_variance: Float64Array | float = field(default=0.0)
    """(m/s)²: the same of the speed."""


def transition(
    mean: Float64Array, motion: Motion, layout: StateLayout, slow_kept: float
) -> tuple[Float64Array, list[Entry]]:
    """The mean after an interval, and the Jacobian F as entries beside the identity.

    An arc is driven along the heading half-way (second order in dt), less the slip of the rear axle:
    `ω = g_ω (ω_imu − b_ω)`, `a = g_a (a_imu − b_a)`, `χ = ψ + ω dt/2 − κ v ω/g`, `s = v dt + a dt²/2`,
    `x += s cos χ`, `y += s sin χ`, `ψ += ω dt`, `v += (a − κ v² ω²/g) dt`; slow errors decay, the rest stays. What an
    accelerometer feels along the body is `v̇` less yaw rate times lateral speed, which slip makes `−κ v² ω/g`.

    Entries stand in an order in which no row is read after it has been changed: `propagate` works in place.
    """
    dt = motion.dt_s
    rate = motion.yaw_rate_trust * (motion.yaw_rate_radps - mean[GYRO_BIAS])
    accel = motion.accel_trust * (motion.accel_mps2 - mean[ACCEL_BIAS])
    lead_s = 0.5 * dt - mean[SLIP] / GRAVITY_MPS2 * mean[SPEED]
    course = mean[YAW] + lead_s * rate
    path = dt * mean[SPEED] + 0.5 * dt**2 * accel
    east, north = np.cos(course), np.sin(course)
    moved = mean.copy()
    moved[X] += path * east
    moved[Y] += path * north
    moved[YAW] += dt * rate
    bent = dt * mean[SPEED] * rate / GRAVITY_MPS2
    moved[SPEED] += dt * accel - bent * rate * mean[SPEED] * mean[SLIP]
    entries: list[Entry] = []
    for row, along, across in ((X, east, -path * north), (Y, north, path * east)):
        entries += [
            (row, YAW, across),
            (row, SPEED, dt * along - across * rate * mean[SLIP] / GRAVITY_MPS2),
            (row, GYRO_BIAS, -across * lead_s * motion.yaw_rate_trust),
            (row, ACCEL_BIAS, -0.5 * dt**2 * motion.accel_trust * along),
            (row, SLIP, -across * rate * mean[SPEED] / GRAVITY_MPS2),
        ]
    entries += [
        (YAW, GYRO_BIAS, -dt * motion.yaw_rate_trust),
        (SPEED, SPEED, -2.0 * bent * rate * mean[SLIP]),
        (SPEED, GYRO_BIAS, 2.0 * bent * mean[SPEED] * mean[SLIP] * motion.yaw_rate_trust),
        (SPEED, SLIP, -bent * rate * mean[SPEED]),
        (SPEED, ACCEL_BIAS, -dt * motion.accel_trust),
    ]
    for row in layout.slow or ():
        moved[row] *= slow_kept
        entries.append((row, row, slow_kept - 1.0))
    return moved, entries


def propagate_rows(matrix: Float64Array, entries: list[Entry]) -> None:
    """`F M`, in place."""
    for row, column, value in entries:
        matrix[row] += value * matrix[column]


def propagate_columns(matrix: Float64Array, entries: list[Entry]) -> None:
    """`M Fᵀ`, in place."""
    for row, column, value in entries:
        matrix[:, row] += value * matrix[:, column]


def process_noise(
    before: Float64Array,
    covariance: Float64Array,
    motion: Motion,
    noise: SensorNoise,
    model: MotionModel,
    layout: StateLayout,
    slow_kept: float,
) -> list[Entry]:
    """Q of an interval, entries of its upper triangle and diagonal; mean and covariance are those at its start.

    What slips beside the proportion that the state knows is noise across the heading. So are the terms of second order
    that no Jacobian shows (Bar-Shalom, section 10.3.2): a heading in error by `δ` costs `v (1 − cos δ)`, of variance
    `v² V_ψ²/2`, along it; and with an error of the speed it leads aside, by a velocity of variance `V_v V_ψ`.
    """
    dt = motion.dt_s
    rate = motion.yaw_rate_trust * (motion.yaw_rate_radps - before[GYRO_BIAS])
    slip_mps = model.slip_noise_rad_per_g / GRAVITY_MPS2 * before[SPEED] ** 2 * rate
    across = 2.0 * model.slip_time_s * dt * slip_mps**2
    # By `κ v² ω²/g` an error of the yaw rate is one of the acceleration too.
    felt = 2.0 * before[SLIP] / GRAVITY_MPS2 * before[SPEED] ** 2 * rate
    yaw_variance, speed_variance = np.minimum(covariance[YAW, YAW], 1.0), covariance[SPEED, SPEED]
    lasting_s2 = 2.0 * model.heading_time_s * dt
    along = lasting_s2 * (before[SPEED] ** 2 + speed_variance) * yaw_variance**2 / 2.0
    across = across + lasting_s2 * speed_variance * yaw_variance
    east, north = np.cos(before[YAW]), np.sin(before[YAW])
    walk = model.position_walk_m**2 * dt
    entries: list[Entry] = [
        (X, X, along * east**2 + across * north**2 + walk),
        (X, Y, (along - across) * north * east),
        (Y, Y, along * north**2 + across * east**2 + walk),
        (YAW, YAW, motion.yaw_variance),
        (YAW, SPEED, -felt * motion.yaw_variance),
        (SPEED, SPEED, motion.speed_variance + felt**2 * motion.yaw_variance),
        (GYRO_BIAS, GYRO_BIAS, noise.gyro_bias_walk**2 * dt),
        (ACCEL_BIAS, ACCEL_BIAS, noise.accel_bias_walk**2 * dt),
    ]
    for row, std in zip(layout.slow or (), noise.fix_slow_std_m, strict=False):
        entries.append((row, row, std**2 * (1.0 - slow_kept**2)))
    return entries


def forgotten(age_s: Float64Array | float, std: float, time_s: float) -> Float64Array | float:
    """Variance of the integral of a Gauss–Markov process over `age_s` after it was known exactly.

    `σ² τ² (2 a/τ − 3 + 4 e^(−a/τ) − e^(−2a/τ))`: `2 σ² a³/(3 τ)` at first, `2 σ² τ a` in the end (Brown and Hwang,
    Introduction to Random Signals, section 5.3; the series below 0.01 τ, where the terms cancel).
    """
    u = age_s / time_s
    exact = 2.0 * u - 3.0 + 4.0 * np.exp(-u) - np.exp(-2.0 * u)
    return std**2 * time_s**2 * np.where(u < 0.01, 2.0 / 3.0 * u**3 * (1.0 - 0.75 * u), exact)
