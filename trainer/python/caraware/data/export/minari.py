"""Minari: offline reinforcement learning, a trajectory for each time that a vehicle held its slot.

A part is a directory of one run's episode with a directory for each trajectory in it; the data set is made of all
parts, in Minari's Arrow format: `data/ID/part-0.arrow` and `metadata.json`. Trajectories begin and end as they do in
`caraware.envs`.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch

from caraware import _native
from caraware.data.export.rows import by_tick, localisation_reward
from caraware.data.names import RoadUsers
from caraware.data.recording import Array, Episode, Recording, RecordingError
from caraware.ipc.arrays import Float32Array, Int64Array
from caraware.ipc.run_file import ConfigError
from caraware.tasks.contract import Task, TaskOutcome, TaskRows, TaskStep
from caraware.tasks.driving import Driving
from caraware.tasks.ends import END_NAMES, name_of
from caraware.tasks.fields import Fields
from caraware.tasks.localisation import Localisation
from caraware.tasks.table import task_of_run

VERSION = "0.5.4"
"""Version of Minari whose layout this is; its loader refuses versions that it does not know."""

ENDS = _native.TERMINATED | _native.TRUNCATED
"""Bits of a slot's flags, which say how the trajectory ended that held the slot a tick before."""


@dataclass(frozen=True)
class Trajectory:
    """T consecutive ticks of a vehicle, each answered by the trainer."""

    vehicle: str
    """SUMO's id."""
    rows: Int64Array
    """i64 [T]: its rows in the sections of `observation`."""
    ticks: Int64Array
    """i64 [T]."""
    actions: Float32Array
    """f32 [T, a]: what the trainer answered."""
    terminated: bool
    """Nothing follows the last action; else the trajectory was cut there."""
    ended_by: int
    """Bits of `caraware.tasks.ends` that say why it ended; 0 where the recording does not."""

    def __len__(self) -> int:
        """Number of steps, T."""
        return len(self.rows)


def trajectories(recording: Recording, episode: Episode) -> Iterator[Trajectory]:
    """The trajectories of one episode, by vehicle and tick. Raises `RecordingError` without predictions.

    A trajectory ends where its slot is flagged, where its vehicle leaves the slot, is not valid or was not answered,
    and with the recording.
    """
    if "prediction" not in recording.channels:
        raise RecordingError(f"{recording.path} has no channel 'prediction': record it with record.channels")
    offsets = recording.offsets("observation", "vehicle")
    begin, end = int(offsets[episode.messages.start]), int(offsets[episode.messages.stop])
    lengths = np.diff(offsets[episode.messages.start : episode.messages.stop + 1])
    answers = by_tick(recording, "prediction", episode.headers["tick"], lengths)
    if answers is None:
        raise RecordingError(f"{recording.path} has no predictions: record a run of `caraware train`")
    flags = recording.rows("observation", "flags")
    vehicles = recording.rows("observation", "vehicle")
    follows = _following(recording, episode)
    answered = np.isfinite(answers).all(1) & ((flags[begin:end] & _native.VALID) != 0)
    users = RoadUsers(recording)
    for track in episode.vehicles():
        rows = track.rows[answered[track.rows - begin]]
        ticks = track.ticks[answered[track.rows - begin]]
        if len(rows) == 0:
            continue
        next_rows = follows[rows - begin]
        next_flags = np.where(next_rows >= 0, flags[next_rows], 0)
        is_same = (next_rows >= 0) & (next_rows < end) & (vehicles[next_rows] == track.vehicle)
        # The row that follows is the next one of the trajectory, and nothing was flagged between them.
        continues = is_same & ((next_flags & ENDS) == 0) & (np.append(rows[1:], -1) == next_rows)
        ends = np.flatnonzero(~continues) + 1
        for first, last in zip([0, *ends[:-1]], ends, strict=True):
            yield Trajectory(
                users.of(track.id_hash).id,
                rows[first:last],
                ticks[first:last],
                answers[rows[first:last] - begin],
                bool(next_flags[last - 1] & _native.TERMINATED),
                int(next_flags[last - 1] & sum(END_NAMES)),
            )


def _following(recording: Recording, episode: Episode) -> Int64Array:
    """i64 [rows of the episode]: the row of the same slot a tick later; -1 where there is none."""
    messages = range(episode.messages.start, episode.messages.stop)
    offsets, ticks = recording.offsets("observation", "vehicle"), recording.ticks()
    following = np.full(int(offsets[messages.stop] - offsets[messages.start]), -1, np.int64)
    for message in messages:
        if message + 1 == len(ticks) or ticks[message + 1] != ticks[message] + 1:
            continue
        begin, middle, end = offsets[message : message + 3]
        count = min(middle - begin, end - middle)
        place = begin - offsets[messages.start]
        following[place : place + count] = np.arange(middle, middle + count)
    return following


def _reward(recording: Recording, task: Task, trajectory: Trajectory, observation: Array, truth: Array) -> Array:
    """f32 [T]: the reward of each action; `observation` [T + 1, d] and `truth` [T + 1, 4] repeat their last row."""
    if not isinstance(task, Driving):
        return localisation_reward(recording, trajectory.actions, truth[:-1])[1]
    ended = np.zeros(len(trajectory), bool)
    ended[-1] = True
    terminated = torch.from_numpy(ended & trajectory.terminated)
    outcome = TaskOutcome(
        next=TaskRows(torch.from_numpy(observation[1:]), torch.from_numpy(truth[1:])),
        terminated=terminated,
        truncated=torch.from_numpy(ended) & ~terminated,
        ended_by=torch.from_numpy(np.where(ended, trajectory.ended_by, 0).astype(np.int64)),
    )
    step = TaskStep(torch.from_numpy(observation[:-1]), torch.from_numpy(truth[:-1]), outcome)
    reward: Float32Array = task.reward(step, torch.from_numpy(trajectory.actions)).numpy().astype(np.float32)
    return reward


def _lists(values: Array) -> pa.Array:
    """Rows [n, k] as lists of fixed length, Minari's form of a box."""
    return pa.FixedSizeListArray.from_arrays(pa.array(np.ascontiguousarray(values).reshape(-1)), values.shape[1])


def _batch(recording: Recording, task: Task, trajectory: Trajectory) -> pa.RecordBatch:
    """T + 1 rows: an observation each; the last has no action, so the other columns are padded by zeros."""
    kept = np.append(trajectory.rows, trajectory.rows[-1])
    part = {name: np.array(recording.rows("observation", name)[kept]) for name in ("observation", "truth", "gnss_m")}
    # As the environment faces have it: a sensor that is dark shows 0.
    observation = np.nan_to_num(part["observation"])
    reward = _reward(recording, task, trajectory, observation, part["truth"])
    ended = np.zeros(len(kept), bool)
    ended[-2] = True
    ticks = np.append(trajectory.ticks, trajectory.ticks[-1])
    infos = {"tick": pa.array(ticks), "truth": _lists(part["truth"]), "gnss_m": _lists(part["gnss_m"])}
    shapes = {"truth": "4", "gnss_m": "3"}
    fields = [
        pa.field(name, values.type, metadata={"shape": shapes[name]} if name in shapes else None)
        for name, values in infos.items()
    ]
    return pa.RecordBatch.from_pydict(
        {
            "observations": _lists(observation),
            "actions": _lists(np.pad(trajectory.actions, ((0, 1), (0, 0)))),
            "rewards": np.pad(reward, (0, 1)),
            "terminations": ended & trajectory.terminated,
            "truncations": ended & (not trajectory.terminated),
            "infos": pa.StructArray.from_arrays(list(infos.values()), fields=fields),
        }
    )


def write_minari(recording: Recording, episode: Episode, path: Path) -> None:
    """Write the trajectories of one episode. Raises `RecordingError` without predictions."""
    task = _task(recording)
    path.mkdir(parents=True)
    for number, trajectory in enumerate(trajectories(recording, episode)):
        directory = path / str(number)
        directory.mkdir()
        batch = _batch(recording, task, trajectory)
        with pa.ipc.new_file(directory / "part-0.arrow", batch.schema) as file:
            file.write_batch(batch)
        about = {
            "id": number,
            "total_steps": len(trajectory),
            "seed": episode.seed,
            "episode": episode.number,
            "is_evaluation": episode.is_evaluation,
            "vehicle": trajectory.vehicle,
        }
        if isinstance(task, Driving):
            about["ended_by"] = name_of(trajectory.ended_by)
        (directory / "metadata.json").write_text(json.dumps(about), encoding="utf-8")


def dataset_id(recording: Recording) -> str:
    """Name of the data set, which is its directory too: Minari takes letters, digits, `_` and `-`."""
    return f"{re.sub(r'[^-a-zA-Z0-9_]', '_', str(recording.start['run']))}-v0"


def join_parts(recording: Recording, directory: Path, parts: Sequence[str]) -> None:
    """Make the data set of all parts, with trajectories numbered from 0; files of parts are linked, not copied."""
    name = dataset_id(recording)
    partial = directory / f".{name}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    data = partial / "data"
    data.mkdir(parents=True)
    total_episodes = total_steps = total_bytes = 0
    for part in parts:
        for place in range(sum(1 for _ in (directory / part).iterdir())):
            source, target = directory / part / str(place), data / str(total_episodes)
            target.mkdir()
            about = json.loads((source / "metadata.json").read_text(encoding="utf-8")) | {"id": total_episodes}
            (target / "metadata.json").write_text(json.dumps(about), encoding="utf-8")
            _link(source / "part-0.arrow", target / "part-0.arrow")
            total_episodes, total_steps = total_episodes + 1, total_steps + int(about["total_steps"])
            total_bytes += (target / "part-0.arrow").stat().st_size
    about = {
        "total_episodes": total_episodes,
        "total_steps": total_steps,
        "dataset_size": round(total_bytes / 1e6, 1),
        "data_format": "arrow",
        "dataset_id": name,
        "minari_version": VERSION,
        "description": f"The run {recording.start['run']} of caraware; README.md beside the data set describes it.",
        **{key: json.dumps(space) for key, space in _spaces(recording).items()},
    }
    (data / "metadata.json").write_text(json.dumps(about), encoding="utf-8")
    shutil.rmtree(directory / name, ignore_errors=True)
    os.replace(partial, directory / name)


def _link(source: Path, target: Path) -> None:
    """Link a file, or copy it where the file system has no links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def _task(recording: Recording) -> Task:
    """The task of the run. Raises `RecordingError` for one whose rewards do not follow from what was published."""
    try:
        task = task_of_run(recording.run)
    except ConfigError as error:
        raise RecordingError(f"{recording.path}: {error}; {error.help}") from error
    if not isinstance(task, Driving | Localisation):
        raise RecordingError(
            f"{recording.path} is a run of the task {task.name!r}: Minari's data sets are written of the tasks "
            "'localisation' and 'driving'"
        )
    return task


def _spaces(recording: Recording) -> Mapping[str, Mapping[str, Any]]:
    """The boxes of observations and actions, as Minari writes them. Positions have no bounds (m, world)."""
    fields, task = Fields.from_run(recording.run), _task(recording)
    low, high = (task.actions.low, task.actions.high) if isinstance(task, Driving) else (-np.inf, np.inf)
    return {
        "observation_space": _box(fields.low, 1.0, fields.width),
        "action_space": _box(low, high, task.actions.size),
    }


def _box(low: float, high: float, size: int) -> dict[str, Any]:
    return {"type": "Box", "dtype": "float32", "shape": [size], "low": [low] * size, "high": [high] * size}
