"""One row for each vehicle-tick: truth, sensors, predictions and rewards, as columns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import torch

from caraware import _native
from caraware.data.lanes import has_lanes, lane_columns
from caraware.data.names import RoadUsers
from caraware.data.recording import Episode, Recording
from caraware.ipc.arrays import Float32Array
from caraware.ipc.layout import SENSOR_BITS
from caraware.ipc.run_file import setting
from caraware.tasks import rewards

Columns = dict[str, Any]
"""Arrays of one length by their names, which carry unit and frame."""

SPLIT: Mapping[str, tuple[str, ...]] = {
    "truth": ("truth_x_m", "truth_y_m", "truth_yaw_rad", "truth_speed_mps"),
    "gnss_m": ("gnss_x_m", "gnss_y_m", "gnss_z_m"),
    "gnss_geodetic": ("gnss_latitude_deg", "gnss_longitude_deg", "gnss_altitude_m"),
    "gnss_quality": ("gnss_error_m", "gnss_satellites"),
    "speed_steering": ("wheel_speed_mps", "steering_wheel_rad"),
    "age_s": ("gnss_age_s", "imu_age_s", "speed_steering_age_s", "lidar_age_s"),
}
"""Sections whose columns have names of their own: SI units, world frame (x east, y north, z up)."""

IMU = (
    "accel_x_mps2",
    "accel_y_mps2",
    "accel_z_mps2",
    "gyro_x_radps",
    "gyro_y_radps",
    "gyro_z_radps",
    "compass_rad",
)
"""Columns of an IMU sample."""


def table(recording: Recording, episode: Episode, users: RoadUsers) -> pa.Table:
    """A row for each tick of each vehicle that had a slot, ordered by tick and slot."""
    offsets = recording.offsets("observation", "vehicle")
    begin, end = int(offsets[episode.messages.start]), int(offsets[episode.messages.stop])
    lengths = np.diff(offsets[episode.messages.start : episode.messages.stop + 1])
    part = {name: recording.rows("observation", name)[begin:end] for name in _SECTIONS}
    kept = np.flatnonzero(part["vehicle"] != _native.EMPTY_SLOT)
    headers = episode.headers
    columns: Columns = {
        "episode": np.full(len(kept), episode.number, np.int64),
        "is_evaluation": np.full(len(kept), episode.is_evaluation),
        "tick": np.repeat(headers["tick"].astype(np.int64), lengths)[kept],
        "time_s": np.repeat(headers["sim_time_ns"] * 1e-9, lengths)[kept],
        "slot": np.concatenate([np.arange(length) for length in lengths])[kept].astype(np.int32),
        "vehicle": part["vehicle"][kept],
        "id": [users.of(id_hash).id for id_hash in part["id_hash"][kept]],
        "episode_step": part["episode_step"][kept],
    }
    flags = part["flags"][kept]
    for name in ("VALID", "TERMINATED", "TRUNCATED", "CLIPPED", "RESYNCHRONISED"):
        columns[f"is_{name.lower()}"] = (flags & getattr(_native, name)) != 0
    for name, names in SPLIT.items():
        columns |= {column: part[name][kept, place] for place, column in enumerate(names)}
    if has_lanes(recording):
        columns |= lane_columns(recording, columns["tick"], part["vehicle"][kept].astype(np.int64))
    imu = part["imu"][kept]
    columns |= {name: imu[:, -1, place] for place, name in enumerate(IMU)}
    for name, bit in SENSOR_BITS.items():
        columns[f"{name.replace('-', '_')}_delivers"] = (part["sensors"][kept] & bit) != 0
    columns |= _fields(recording, part["observation"][kept])
    columns |= _predictions(recording, headers["tick"], lengths, kept, part["truth"][kept])
    return pa.table(columns)


_SECTIONS = ("vehicle", "id_hash", "episode_step", "flags", "sensors", "imu", "observation", *SPLIT)


def _fields(recording: Recording, observation: Any) -> Columns:
    """The normalised observation, a column for each field and each tick of its history, the newest as `obs_NAME`."""
    fields = [str(name) for name in recording.run["config"]["observation"]["fields"]]
    history = observation.shape[1] // max(len(fields), 1)
    columns: Columns = {}
    for age in range(history):
        suffix = f"_before_{age}" if age else ""
        begin = (history - 1 - age) * len(fields)
        columns |= {f"obs_{name}{suffix}": observation[:, begin + place] for place, name in enumerate(fields)}
    return columns


def _predictions(recording: Recording, ticks: Any, lengths: Any, kept: Any, truth: Any) -> Columns:
    """What the trainer answered: positions with error and reward, or actions; the filter's positions.

    Not-a-number where a tick has no prediction.
    """
    if "prediction" not in recording.channels:
        return {}
    answers = by_tick(recording, "prediction", ticks, lengths)
    columns: Columns = {}
    if answers is not None and str(recording.run["config"]["task"]["kind"]) == "localisation" and answers.shape[1] == 2:
        predicted = answers[kept]
        columns |= {"predicted_x_m": predicted[:, 0], "predicted_y_m": predicted[:, 1]}
        columns["predicted_error_m"], columns["reward"] = localisation_reward(recording, predicted, truth)
    elif answers is not None:
        columns |= {f"action_{place}": answers[kept, place] for place in range(answers.shape[1])}
    estimates = by_tick(recording, "estimate_m", ticks, lengths)
    if estimates is not None:
        columns |= {"ekf_x_m": estimates[kept, 0], "ekf_y_m": estimates[kept, 1]}
    return columns


def localisation_reward(recording: Recording, predicted: Any, truth: Any) -> tuple[Float32Array, Float32Array]:
    """Distances (m) of positions [n, 2] to the truth [n, 4], and the rewards of the run: f32 [n] each.

    Raises `ConfigError` for a reward that this program does not know.
    """
    distance_m = rewards.distance_m(torch.from_numpy(predicted), torch.from_numpy(np.array(truth)))
    name = setting(recording.run, "trainer.reward", rewards.RewardName)
    scale_m = setting(recording.run, "trainer.reward_scale_m", float)
    return distance_m.numpy(), rewards.REWARDS[name](distance_m, scale_m).numpy()


def by_tick(recording: Recording, name: str, ticks: Any, lengths: Any) -> Any:
    """Rows of a section of `prediction` beside those of the observations of `ticks`, which have `lengths` slots.

    f32 [sum of `lengths`, …], not-a-number where a tick was not answered; None if the recording has no such row.
    """
    rows, offsets = recording.rows("prediction", name), recording.offsets("prediction", name)
    if len(rows) == 0:
        return None
    found = recording.ticks("prediction")
    places = {int(tick): place for place, tick in enumerate(found)}
    beside = np.full((int(lengths.sum()), rows.shape[1]), np.nan, np.float32)
    ends = np.cumsum(lengths)
    for tick, length, end in zip(ticks, lengths, ends, strict=True):
        place = places.get(int(tick))
        if place is not None and offsets[place + 1] - offsets[place] == length:
            beside[end - length : end] = rows[offsets[place] : offsets[place + 1]]
    return beside
