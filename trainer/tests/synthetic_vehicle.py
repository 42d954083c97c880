"""Vehicles with sensors, in numpy: tracks with known truth, and the samples of configured sensors."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from caraware import _native
from caraware.baselines.noise import GRAVITY_MPS2, METRES_PER_DEGREE
from caraware.ipc.stream import EMPTY_SLOT
from synthetic import SyntheticObservation, run_file

TICK_S = 0.1
SUB_STEPS = 10
GNSS, IMU, SPEED_STEERING = 1, 2, 4


def sensor_tables(**changes: Any) -> dict[str, Any]:
    """The preset's sensor tables; a change is `table__key=value`."""
    tables: dict[str, Any] = {
        "run": {"tick_s": TICK_S},
        "gnss": {
            "period_s": 0.1,
            "noise_std_deg": [5e-5, 5e-5],
            "bias_deg": [0.0, 0.0],
            "noise_std_m": [0.0, 0.0, 0.0],
            "bias_m": [0.0, 0.0, 0.0],
            "correlated_std_m": [0.0, 0.0, 0.0],
            "correlation_time_s": 60.0,
            "sky_view": False,
        },
        "imu": {
            "period_s": 0.1,
            "convention": "kinematic",
            "compass_noise_std_rad": 0.0,
            "compass_bias_rad": 0.0,
        },
        "speed_steering": {"period_s": 0.1, "speed_noise_std_mps": 0.0028, "speed_scale_std": 0.0},
    }
    for sensor, unit in (("accel", "mps2"), ("gyro", "radps")):
        tables["imu"] |= {f"{sensor}_{key}": [0.0] * 3 for key in ("noise_density", f"bias_{unit}", "bias_walk")}
        tables["imu"] |= {f"{sensor}_noise_std_{unit}": [0.001] * 3, f"{sensor}_resolution_{unit}": [0.0] * 3}
    for name, value in changes.items():
        table, key = name.split("__")
        tables[table][key] = value
    return tables


def vehicle_run(run_dir: str, tables: dict[str, Any] | None = None, **trainer: object) -> dict[str, Any]:
    """A run file with sensors."""
    run = run_file(run_dir, **trainer)
    for name, table in (tables or sensor_tables()).items():
        run["config"][name] = run["config"].get(name, {}) | table
    return run


@dataclass
class VehicleObservation(SyntheticObservation):
    """A tick with its raw sections. Vehicles are called as population control would."""

    @property
    def id_hash(self) -> np.ndarray:
        """u64 `[n]`."""
        return np.array([_native.id_hash(f"cav.{vehicle}") for vehicle in self.vehicle], np.uint64)


@dataclass(frozen=True)
class Track:
    """The true motion of vehicles at every sub-step from the first tick on; arrays `[steps, n]`."""

    x_m: np.ndarray
    y_m: np.ndarray
    yaw_rad: np.ndarray
    speed_mps: np.ndarray
    accel_mps2: np.ndarray
    yaw_rate_radps: np.ndarray
    felt_mps2: np.ndarray
    """Acceleration of the rear axle along the body, which slides sideways in bends."""

    def ticks(self) -> int:
        """Number of ticks."""
        return (len(self.x_m) - 1) // SUB_STEPS + 1

    def truth(self, tick: int) -> np.ndarray:
        """f64 `[n, 4]`."""
        columns = (self.x_m, self.y_m, self.yaw_rad, self.speed_mps)
        return np.stack([column[tick * SUB_STEPS] for column in columns], 1)


def steady_track(ticks: int, vehicles: int, seed: int, speed_mps: float = 10.0) -> Track:
    """Constant turn rate and constant speed, another for each vehicle."""
    rng = np.random.default_rng(seed)
    rate = np.tile(rng.normal(0.0, 0.1, vehicles), ((ticks - 1) * SUB_STEPS + 1, 1))
    speeds = speed_mps * rng.uniform(0.8, 1.2, vehicles)
    return _driven(rng, np.zeros_like(rate), rate, speeds)


def town_track(ticks: int, vehicles: int, seed: int) -> Track:
    """Accelerations and turns as Gauss–Markov processes, drawn back to 10 m/s; none drives backwards."""
    rng = np.random.default_rng(seed)
    steps = (ticks - 1) * SUB_STEPS + 1
    accel, rate = np.zeros((steps, vehicles)), np.zeros((steps, vehicles))
    dt_s = TICK_S / SUB_STEPS
    for process, std, time_s in ((accel, 1.2, 2.0), (rate, 0.15, 2.0)):
        kept = math.exp(-dt_s / time_s)
        process[0] = rng.normal(0.0, std, vehicles)
        drawn = rng.normal(0.0, std * math.sqrt(1 - kept**2), (steps, vehicles))
        for i in range(1, steps):
            process[i] = kept * process[i - 1] + drawn[i]
    return _driven(rng, accel, rate, rng.uniform(6.0, 14.0, vehicles), drawn_to_mps=10.0)


def standing_track(ticks: int, vehicles: int, seed: int) -> Track:
    """No vehicle moves."""
    still = np.zeros(((ticks - 1) * SUB_STEPS + 1, vehicles))
    return _driven(np.random.default_rng(seed), still, still, np.zeros(vehicles))


def _driven(
    rng: np.random.Generator, accel: np.ndarray, rate: np.ndarray, speed: np.ndarray, drawn_to_mps: float | None = None
) -> Track:
    """Integrate; row i of accelerations and rates is the mean over the sub-step that ends there.

    Rear axles slip outwards in proportion to the lateral acceleration, each vehicle's by its own: at `−κ v² ω/g` to the
    left, which is felt along the body, `v̇ − ω (−κ v² ω/g)`.
    """
    steps, vehicles = accel.shape
    dt_s = TICK_S / SUB_STEPS
    x_m, y_m, yaw_rad, speed_mps = (np.zeros((steps, vehicles)) for _ in range(4))
    track = Track(x_m, y_m, yaw_rad, speed_mps, accel.copy(), rate, accel.copy())
    track.x_m[0], track.y_m[0] = rng.uniform(0, 200, vehicles), rng.uniform(0, 200, vehicles)
    track.yaw_rad[0], track.speed_mps[0] = rng.uniform(-np.pi, np.pi, vehicles), speed
    slip_s2pm = rng.normal(0.05, 0.04, vehicles) / GRAVITY_MPS2
    track.felt_mps2[0] += slip_s2pm * (speed * rate[0]) ** 2
    for i in range(1, steps):
        before = track.speed_mps[i - 1]
        push = track.accel_mps2[i] - (0.2 * (before - drawn_to_mps) if drawn_to_mps else 0.0)
        track.accel_mps2[i] = np.maximum(push, -before / dt_s)
        track.speed_mps[i] = before + dt_s * track.accel_mps2[i]
        track.yaw_rad[i] = track.yaw_rad[i - 1] + dt_s * rate[i]
        course = track.yaw_rad[i - 1] + (0.5 * dt_s - slip_s2pm * before) * rate[i]
        path = 0.5 * dt_s * (before + track.speed_mps[i])
        track.felt_mps2[i] = track.accel_mps2[i] + slip_s2pm * (before * rate[i]) ** 2
        track.x_m[i] = track.x_m[i - 1] + path * np.cos(course)
        track.y_m[i] = track.y_m[i - 1] + path * np.sin(course)
    return track


class Sensors:
    """Sensors of the vehicles of a track. Errors that are constant for a vehicle are drawn once."""

    def __init__(self, track: Track, tables: dict[str, Any], seed: int) -> None:
        self._track, self._tables, self._rng = track, tables, np.random.default_rng((seed, 1))
        self._n = track.x_m.shape[1]
        gnss, imu, wheels = tables["gnss"], tables["imu"], tables["speed_steering"]
        self._scale = 1.0 + wheels["speed_scale_std"] * self._rng.normal(size=self._n)
        # Of the configured size, in one direction or the other: filters know the size alone.
        self._gyro_bias = imu["gyro_bias_radps"][2] * self._rng.normal(size=self._n)
        self._accel_bias = imu["accel_bias_mps2"][0] * self._rng.normal(size=self._n)
        self._compass_bias = imu["compass_bias_rad"] * self._rng.normal(size=self._n)
        self._fix_bias = np.array(gnss["bias_m"][:2])[:, None] * self._rng.normal(size=(2, self._n))
        self._slow = np.array(gnss["correlated_std_m"][:2])[:, None] * self._rng.normal(size=(2, self._n))
        self._fix = np.zeros((2, self._n))
        self._imu = np.zeros((self._per_tick(), self._n, 7))
        self._wheel = np.zeros(self._n)

    def _per_tick(self) -> int:
        period_s: float = self._tables["imu"]["period_s"]
        return max(1, round(TICK_S / period_s))

    def observe(self, tick: int, dark: np.ndarray | None = None, **changes: Any) -> VehicleObservation:
        """The observation of a tick; ticks in order. `dark` are bits `[n]` of sensors in a blackout."""
        dark = np.zeros(self._n, np.uint32) if dark is None else dark
        ages = [self._age(tick, table) for table in ("gnss", "imu", "speed_steering")]
        self._slow_walks()
        if tick == 0:
            self._dark_ticks = np.zeros((3, self._n))
        for i, (bit, sample) in enumerate(
            ((GNSS, self._sample_fix), (IMU, self._sample_imu), (SPEED_STEERING, self._sample_wheels))
        ):
            lit = (dark & bit) == 0
            if ages[i] == 0.0:
                sample(tick, lit)
            self._dark_ticks[i] = np.where(lit & (ages[i] == 0.0), 0, self._dark_ticks[i] + 1)
        truth = self._track.truth(tick)
        none = np.zeros(self._n, bool)
        values: dict[str, Any] = {
            "tick": tick,
            "observation": torch.tensor(np.concatenate((self._fix.T / 100 - 1, truth[:, 2:]), 1), dtype=torch.float32),
            "truth": torch.tensor(truth, dtype=torch.float32),
            "gnss_m": torch.tensor(np.pad(self._fix.T, ((0, 0), (0, 1))), dtype=torch.float32),
            "vehicle": np.arange(self._n, dtype=np.uint32),
            "valid": ~none,
            "terminated": none.copy(),
            "truncated": none.copy(),
            "sim_time_ns": tick * round(TICK_S * 1e9),
            "gnss_quality": np.zeros((self._n, 2), np.float32),
            "imu": torch.tensor(self._imu.transpose(1, 0, 2), dtype=torch.float32),
            "speed_steering": torch.tensor(np.stack((self._wheel, 0 * self._wheel), 1), dtype=torch.float32),
            "sensors": (GNSS | IMU | SPEED_STEERING) & ~dark,
            "age_s": np.pad((TICK_S * self._dark_ticks.T), ((0, 0), (0, 1))).astype(np.float32),
            "episode_step": np.full(self._n, tick, np.uint32),
        }
        return VehicleObservation(**(values | changes))

    def _age(self, tick: int, table: str) -> float:
        period_s: float = self._tables[table]["period_s"]
        period = max(1, round(period_s / TICK_S))
        return (tick % period) * TICK_S

    def _slow_walks(self) -> None:
        gnss = self._tables["gnss"]
        kept = math.exp(-TICK_S / gnss["correlation_time_s"])
        drawn = np.array(gnss["correlated_std_m"][:2])[:, None] * self._rng.normal(size=(2, self._n))
        self._slow = kept * self._slow + math.sqrt(1 - kept**2) * drawn

    def _sample_fix(self, tick: int, lit: np.ndarray) -> None:
        gnss = self._tables["gnss"]
        north_deg, east_deg = gnss["noise_std_deg"]
        std = np.hypot(np.array([east_deg, north_deg]) * METRES_PER_DEGREE, gnss["noise_std_m"][:2])
        white = std[:, None] * self._rng.normal(size=(2, self._n))
        fix = self._track.truth(tick)[:, :2].T + white + self._slow + self._fix_bias
        self._fix = np.where(lit, fix, self._fix)

    def _sample_imu(self, tick: int, lit: np.ndarray) -> None:
        imu, rng, track = self._tables["imu"], self._rng, self._track
        count = self._per_tick()
        std = {
            sensor: math.hypot(imu[f"{sensor}_noise_std_{unit}"][axis], density / math.sqrt(imu["period_s"]))
            for sensor, unit, axis in (("accel", "mps2", 0), ("gyro", "radps", 2))
            for density in (imu[f"{sensor}_noise_density"][axis],)
        }
        sign = -1.0 if imu["convention"] == "carla" else 1.0
        for j in range(count):
            i = max(0, tick * SUB_STEPS - (count - 1 - j) * SUB_STEPS // count)
            sample = np.zeros((self._n, 7))
            sample[:, 0] = track.felt_mps2[i] + self._accel_bias + std["accel"] * rng.normal(size=self._n)
            sample[:, 2] = 0.0 if imu["convention"] == "kinematic" else GRAVITY_MPS2
            sample[:, 5] = sign * (track.yaw_rate_radps[i] + self._gyro_bias + std["gyro"] * rng.normal(size=self._n))
            yaw = track.yaw_rad[i] + imu["compass_noise_std_rad"] * rng.normal(size=self._n) - self._compass_bias
            sample[:, 6] = (np.pi / 2 - yaw) % (2 * np.pi)
            self._imu[j] = np.where(lit[:, None], sample, self._imu[j])

    def _sample_wheels(self, tick: int, lit: np.ndarray) -> None:
        wheels = self._tables["speed_steering"]
        noise = wheels["speed_noise_std_mps"] * self._rng.normal(size=self._n)
        speed = np.maximum(self._scale * self._track.truth(tick)[:, 3] + noise, 0.0)
        self._wheel = np.where(lit, speed, self._wheel)


def observations(
    track: Track, tables: dict[str, Any] | None = None, seed: int = 0, dark: np.ndarray | None = None, **changes: Any
) -> Iterator[VehicleObservation]:
    """All ticks of a track; `dark` are bits `[ticks, n]`."""
    sensors = Sensors(track, tables or sensor_tables(), seed)
    for tick in range(track.ticks()):
        yield sensors.observe(tick, None if dark is None else dark[tick], **changes)


def in_slots(obs: VehicleObservation, slots: list[int], count: int) -> VehicleObservation:
    """The same vehicles in other slots of `count`; the rest is empty, and its memory holds not-a-number."""
    values = dict(vars(obs))
    empty = np.setdiff1d(np.arange(count), slots)
    for name in ("observation", "truth", "gnss_m", "imu", "speed_steering", "gnss_quality", "age_s"):
        old = np.asarray(values[name])
        new = np.full((count, *old.shape[1:]), np.nan, np.float32)
        new[slots] = old
        values[name] = torch.from_numpy(new) if isinstance(values[name], torch.Tensor) else new
    for name, nothing in (("vehicle", EMPTY_SLOT), ("sensors", 0), ("episode_step", 0), ("valid", False)):
        new = np.full(count, nothing, values[name].dtype)
        new[slots] = values[name]
        values[name] = new
    for name in ("terminated", "truncated"):
        new = np.zeros(count, bool)
        new[slots] = values[name]
        values[name] = new
    assert (values["vehicle"][empty] == EMPTY_SLOT).all()
    return VehicleObservation(**values)
