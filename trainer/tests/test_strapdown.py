"""Delivered IMU samples of a recorded run, integrated by a strap-down navigator, against the recorded truth.

The valley has slopes, bridges and two-wheelers that lean. Without noise the navigator arrives where the vehicle is;
with noise its errors are those that the densities predict (P. Groves, *Principles of GNSS, Inertial, and Multisensor
Integrated Navigation Systems*, 2nd edition, chapters 5 and 14).
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sumolib
from caraware.data import open_recording
from caraware.ipc.arrays import Float64Array
from recorded_run import recorded_run

VALLEY = Path(__file__).parents[2] / "maps" / "valley"
GRAVITY_MPS2 = 9.80665
PERIOD_S = 0.01
TICKS_PER_S = 10
# Bits of `world`'s flags: set onto SUMO's path, first tick, led along the path.
RESYNCHRONISED, APPEARED, GUIDED = 1, 2, 1 << 9
EXACT: dict[str, Any] = {
    "fanout.enabled": "false",
    "traffic.cav_share": 0.3,
    "imu.period_s": PERIOD_S,
    "imu.convention": "specific_force",
    "imu.accel_noise_std_mps2": 0.0,
    "imu.gyro_noise_std_radps": 0.0,
    "record.channels": '["world", "observation", "traffic-meta"]',
}
ACCEL_DENSITY, GYRO_DENSITY = 0.02, 1e-3
NOISY = EXACT | {"imu.accel_noise_density": ACCEL_DENSITY, "imu.gyro_noise_density": GYRO_DENSITY}


@dataclass(frozen=True)
class Windows:
    """Stretches of equal length in which vehicles were moved, not set: `count` of them."""

    samples: Float64Array
    """f64 [count, samples, 6]: specific force (m/s²) and angular rate (rad/s)."""
    start: np.ndarray[Any, Any]
    """World states at their beginning [count]."""
    end: np.ndarray[Any, Any]
    """World states at their end [count]."""
    guided: np.ndarray[Any, Any]
    """bool [count]: the vehicle was led along its path in a tick of the window."""
    climb_m: Float64Array
    """f64 [count]: difference of the highest and the lowest point."""
    roll_rad: Float64Array
    """f64 [count]: largest roll to either side."""


def windows(run_dir: Path, duration_s: float) -> Windows:
    """All windows of a run with this length."""
    ticks = round(duration_s * TICKS_PER_S)
    recording = open_recording(run_dir)
    worlds = {message.tick: message.section("states") for message in recording.messages("world")}
    ways: dict[int, list[tuple[int, Any, Any]]] = {}
    found = []
    for message in recording.messages("observation"):
        states = {int(state["vehicle"]): state for state in worlds[message.tick]}
        imu = message.section("imu")
        for slot, number in enumerate(message.section("vehicle").tolist()):
            if number not in states:
                continue
            way = ways.setdefault(number, [])
            row = (message.tick, states[number], imu[slot])
            is_set = int(row[1]["flags"]) & (RESYNCHRONISED | APPEARED)
            if is_set or (way and way[-1][0] + 1 != message.tick):
                way.clear()
            way.append(row)
            if len(way) == ticks + 1:
                found.append(list(way))
                del way[:-1]
    moved = np.array([[row[1] for row in way] for way in found])
    samples = np.array([[row[2] for row in way[1:]] for way in found], dtype=np.float64)
    return Windows(
        samples=samples.reshape(len(found), -1, 7)[:, :, :6],
        start=moved[:, 0],
        end=moved[:, -1],
        guided=np.asarray((moved["flags"] & GUIDED).any(1)),
        climb_m=np.ptp(moved["z_m"], 1),
        roll_rad=np.abs(moved["roll_rad"]).max(1),
    )


def cross_matrix(vector: Float64Array) -> Float64Array:
    """f64 [..., 3, 3]: the matrix of the cross product with f64 [..., 3]."""
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def exponential(angle: Float64Array) -> Float64Array:
    """f64 [..., 3, 3]: the rotation by f64 [..., 3] radians (O. Rodrigues)."""
    size = np.linalg.norm(angle, axis=-1)[..., None, None]
    cross = cross_matrix(angle)
    half = np.sinc(size / (2.0 * np.pi))
    rotation: Float64Array = np.eye(3) + np.sinc(size / np.pi) * cross + 0.5 * half**2 * (cross @ cross)
    return rotation


def attitude(states: np.ndarray[Any, Any]) -> Float64Array:
    """f64 [count, 3, 3]: `Rz(yaw) Ry(−pitch) Rx(roll)`."""

    def about(axis: int, angle: Float64Array) -> Float64Array:
        return exponential(np.eye(3)[axis] * angle[:, None].astype(np.float64))

    return about(2, states["yaw_rad"]) @ about(1, -states["pitch_rad"]) @ about(0, states["roll_rad"])


def motion(states: np.ndarray[Any, Any]) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Attitude, velocity and position of states, in the world."""
    turned = attitude(states)
    velocity = np.einsum("nij,nj->ni", turned, states["velocity_body_mps"].astype(np.float64))
    return turned, velocity, np.stack([states[name] for name in ("x_m", "y_m", "z_m")], 1)


def navigate(stretch: Windows) -> tuple[Float64Array, Float64Array]:
    """Errors at the end and their predicted covariance: attitude (rad), velocity (m/s), position (m), in the world.

    f64 [count, 9] and f64 [count, 9, 9]. The covariance is that of white noise of the densities, propagated with the
    linearised errors along the way: `δψ' = n`, `δv' = δψ × f + n`, `δp' = δv`.
    """
    turned, velocity, position = motion(stretch.start)
    count = len(position)
    covariance = np.zeros((count, 9, 9))
    noise = np.diag(np.repeat([GYRO_DENSITY**2, ACCEL_DENSITY**2, 0.0], 3)) * PERIOD_S
    transition = np.tile(np.eye(9), (count, 1, 1))
    transition[:, 6:, 3:6] = PERIOD_S * np.eye(3)
    for sample in np.moveaxis(stretch.samples, 1, 0):
        angle = sample[:, 3:] * PERIOD_S
        felt = np.einsum("nij,nj->ni", turned @ exponential(0.5 * angle), sample[:, :3])
        accel = felt - [0.0, 0.0, GRAVITY_MPS2]
        position = position + (velocity + 0.5 * PERIOD_S * accel) * PERIOD_S
        velocity = velocity + PERIOD_S * accel
        turned = turned @ exponential(angle)
        transition[:, 3:6, :3] = -PERIOD_S * cross_matrix(felt)
        covariance = transition @ covariance @ np.swapaxes(transition, 1, 2) + noise
    turned_end, velocity_end, position_end = motion(stretch.end)
    wrong = turned @ np.swapaxes(turned_end, 1, 2)
    skew = 0.5 * np.stack(
        [wrong[:, 2, 1] - wrong[:, 1, 2], wrong[:, 0, 2] - wrong[:, 2, 0], wrong[:, 1, 0] - wrong[:, 0, 1]], 1
    )
    return np.concatenate([skew, velocity - velocity_end, position - position_end], 1), covariance


@pytest.fixture(scope="module")
def valley(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first 150 s of the valley."""
    directory = tmp_path_factory.mktemp("map") / "valley"
    shutil.copytree(VALLEY, directory)
    netconvert = sumolib.checkBinary("netconvert")
    command = [netconvert, "-c", "valley.netccfg", "-o", "valley.net.xml"]
    subprocess.run(command, cwd=directory, check=True, capture_output=True)
    sumocfg = directory / "valley.sumocfg"
    text = sumocfg.read_text(encoding="utf-8")
    assert '<end value="3600"/>' in text
    sumocfg.write_text(text.replace('<end value="3600"/>', '<end value="150"/>'), encoding="utf-8")
    return sumocfg


@pytest.fixture(scope="module")
def runs(valley: Path) -> Iterator[Mapping[str, Path]]:
    """The same traffic without and with noise."""
    with (
        recorded_run("simulate", EXACT, preset=str(valley), name="exact") as exact,
        recorded_run("simulate", NOISY, preset=str(valley), name="noisy") as noisy,
    ):
        yield {"exact": exact, "noisy": noisy}


@pytest.mark.parametrize(("duration_s", "position_m", "guided_m"), [(10, 0.001, 0.05), (60, 0.02, 0.1)])
def test_samples_without_noise_lead_to_the_truth(
    runs: Mapping[str, Path], duration_s: float, position_m: float, guided_m: float
) -> None:
    stretch = windows(runs["exact"], duration_s)
    errors, _ = navigate(stretch)
    assert len(errors) >= 20 and stretch.climb_m.max() > 2.0
    assert stretch.roll_rad.max() > 0.05
    away = np.linalg.norm(errors[:, 6:], axis=1)
    print(
        f"{len(away)} times {duration_s} s: {away[~stretch.guided].max():.5f} m, led {away[stretch.guided].max():.4f} m"
    )
    assert away[~stretch.guided].max() < position_m
    assert away[stretch.guided].max() < guided_m
    assert np.linalg.norm(errors[:, 3:6], axis=1).max() < 0.002
    assert np.linalg.norm(errors[:, :3], axis=1).max() < 2e-5


@pytest.mark.parametrize("duration_s", [5, 20])
def test_errors_grow_as_the_noise_predicts(runs: Mapping[str, Path], duration_s: float) -> None:
    errors, covariance = navigate(windows(runs["noisy"], duration_s))
    count = len(errors)
    normalised = np.einsum("ni,ni->n", errors, np.linalg.solve(covariance, errors[..., None])[..., 0]) / 9.0
    print(f"{count} times {duration_s} s: squared error by its covariance {normalised.mean():.3f}")
    # Chi-square with 9 degrees of freedom: five standard errors of the mean.
    assert abs(normalised.mean() - 1.0) < 5.0 * np.sqrt(2.0 / (9.0 * count))
    for first, name in ((0, "attitude"), (3, "velocity"), (6, "position")):
        part = slice(first, first + 3)
        variance = np.einsum("nii->n", covariance[:, part, part])
        share = (errors[:, part] ** 2).sum(1) / variance
        # At least one degree of freedom each.
        assert abs(share.mean() - 1.0) < 5.0 * np.sqrt(2.0 / count), name
