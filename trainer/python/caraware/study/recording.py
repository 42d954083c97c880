"""`trainer.module = "caraware.study.recording"`: in the trainer's place, writes down every tick and learns nothing.

`recording/NNNNNN.npz` in the run's directory holds one episode, `env-1/recording/NNNNNN.npz` one of the second
environment. `Recording` reads them back as the ticks that a learner or a filter takes, so that several of them can be
compared on the same bytes.
"""

import itertools
import json
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from caraware.ipc.arrays import BoolArray, Float32Array, UInt32Array, UInt64Array
from caraware.ipc.channel import Channel, StreamEndedError
from caraware.ipc.report_part import write_entries
from caraware.ipc.run_file import RunFile, setting
from caraware.ipc.stream import EMPTY_SLOT, Observation
from caraware.run.process import HandoverRole, StopSignal, run_process

FOLDER = "recording"
TENSORS = ("observation", "truth", "gnss_m", "imu", "speed_steering")
ARRAYS = ("gnss_quality", "sensors", "vehicle", "age_s", "episode_step", "valid", "terminated", "truncated")
MESSAGES = {"neighbour_objects": "objects", "neighbour_ids": "ids", "neighbour_radio": "radio"}
"""Arrays of a run with messages, and their names in `Observation.neighbours`."""
FLOATS = {"neighbour_objects": np.float32}
"""Arrays of messages that are not u32."""
SCALARS = ("tick", "sim_time_ns", "evaluation", "last", "episode_last", "lesson_last", "stage")


@dataclass(frozen=True)
class RecordedTick:
    """One tick, as `caraware.ipc.stream.Observation` describes it."""

    episode: int
    tick: int
    sim_time_ns: int
    evaluation: bool
    last: bool
    episode_last: bool
    lesson_last: bool
    stage: int
    observation: Tensor
    truth: Tensor
    gnss_m: Tensor
    imu: Tensor
    speed_steering: Tensor
    gnss_quality: Float32Array
    sensors: UInt32Array
    vehicle: UInt32Array
    age_s: Float32Array
    episode_step: UInt32Array
    valid: BoolArray
    terminated: BoolArray
    truncated: BoolArray
    neighbour_objects: Float32Array
    """f32 `[n, k, 11]`, `caraware.ipc.channel.Neighbours.objects`; `[n, 0, 11]` of a run without messages."""
    neighbour_ids: UInt32Array
    """u32 `[n, k, 3]`."""
    neighbour_radio: UInt32Array
    """u32 `[n, 5]`."""

    @property
    def ended_by(self) -> UInt32Array:
        """u32 `[n]`: not recorded, because only heroes end by themselves; 0."""
        return np.zeros(len(self.vehicle), np.uint32)

    @property
    def id_hash(self) -> UInt64Array:
        """u64 `[n]`: not recorded; 0."""
        return np.zeros(len(self.vehicle), np.uint64)


@dataclass
class EpisodeWriter:
    """Collects the ticks of an episode and writes them as one file."""

    folder: Path
    has_messages: bool = False
    ticks: list[dict[str, Any]] = field(default_factory=list)

    def add(self, obs: Observation) -> None:
        """Copy one tick; the last one of an episode writes the file."""
        row = {name: np.asarray(getattr(obs, name)).copy() for name in (*TENSORS, *ARRAYS)}
        row |= self._messages(obs)
        self.ticks.append(row | {name: getattr(obs, name) for name in SCALARS})
        if obs.episode_last or obs.last:
            self.write(obs.episode)

    def _messages(self, obs: Observation) -> dict[str, Any]:
        if not self.has_messages:
            shapes = {"neighbour_objects": (0, 11), "neighbour_ids": (0, 3), "neighbour_radio": (5,)}
            return {
                name: np.zeros((len(obs.vehicle), *shape), FLOATS.get(name, np.uint32))
                for name, shape in shapes.items()
            }
        neighbours = getattr(obs, "neighbours")  # noqa: B009  # only an observation of shared memory has them
        return {name: np.asarray(getattr(neighbours, of)).copy() for name, of in MESSAGES.items()}

    def write(self, episode: int) -> None:
        """Write what is there. Slots only become more: earlier ticks are filled up with empty ones."""
        ticks, self.ticks = self.ticks, []
        slots = max(len(tick["vehicle"]) for tick in ticks)
        columns: dict[str, Any] = {name: np.array([tick[name] for tick in ticks]) for name in SCALARS}
        for name in (*TENSORS, *ARRAYS, *MESSAGES):
            first = ticks[0][name]
            whole = np.zeros((len(ticks), slots, *first.shape[1:]), first.dtype)
            for row, tick in zip(whole, ticks, strict=True):
                row[: len(tick[name])] = tick[name]
                if name == "vehicle":
                    row[len(tick[name]) :] = EMPTY_SLOT
            columns[name] = whole
        self.folder.mkdir(parents=True, exist_ok=True)
        partial = self.folder / f".{episode:06d}.partial"
        with partial.open("wb") as stream:
            np.savez(stream, **columns)
        partial.rename(self.folder / f"{episode:06d}.npz")


@dataclass(frozen=True)
class Recording:
    """The ticks of a run that `caraware.study.recording` wrote down."""

    run_dir: Path

    def run(self) -> RunFile:
        """The run file, as the trainer reads it."""
        run: RunFile = json.loads((self.run_dir / "run.json").read_text())
        return run

    def files(self) -> list[Path]:
        """Of every episode of environment 0, then of the next."""
        by_environment = (sorted(folder.glob("*.npz")) for folder in map(self.folder, itertools.count()))
        return list(itertools.chain.from_iterable(itertools.takewhile(bool, by_environment)))

    def folder(self, environment: int) -> Path:
        """Where the episodes of an environment are."""
        return (self.run_dir / f"env-{environment}" if environment else self.run_dir) / FOLDER

    def episodes(self, *, evaluation: bool) -> Iterator[list[RecordedTick]]:
        """Episode by episode, in the run's order: those of evaluations, or those of training."""
        for file in self.files():
            with np.load(file) as stored:
                if bool(stored["evaluation"][0]) == evaluation:
                    yield _ticks(int(file.stem), {name: stored[name] for name in stored.files})


def _ticks(episode: int, columns: dict[str, Any]) -> list[RecordedTick]:
    ticks: list[RecordedTick] = []
    for t in range(len(columns["tick"])):
        values: dict[str, Any] = {name: columns[name][t].item() for name in SCALARS}
        values |= {name: torch.from_numpy(columns[name][t]) for name in TENSORS}
        values |= {name: columns[name][t] for name in (*ARRAYS, *MESSAGES)}
        ticks.append(RecordedTick(episode=episode, **values))
    return ticks


@dataclass
class RecordedEnvironment:
    """One environment of the run: its ticks are committed episode by episode, when their file is written."""

    channel: Channel
    writer: EpisodeWriter
    env_steps: int = 0
    ticks: int = 0
    ended: bool = False

    def take(self, stop_requested: Callable[[], bool]) -> None:
        """Write down what is waiting."""
        try:
            observations = self.channel.receive(0.0)
        except StreamEndedError:
            self.ended = True
            return
        for obs in observations:
            # The channel's observation has all that is recorded.
            self.writer.add(obs)
            self.env_steps, self.ticks = self.env_steps + int(obs.valid.sum()), self.ticks + 1
            self.channel.consumed(obs.tick)
            if obs.episode_last or obs.last:
                self.channel.commit(obs.tick, stop_requested)


def record(run_file: Path, stop: StopSignal, role: HandoverRole) -> None:
    """Record one run and write `parts/trainer.json`. A successor continues with the first episode without a file."""
    if role.gets_ready and not role.wait_for_turn():
        return
    torch.set_num_threads(1)
    first = Channel(str(run_file))
    channels = [first, *map(first.in_environment, range(1, setting(first.run, "run.envs", int)))]
    recording = Recording(Path(first.run["run_dir"]))
    has_messages = setting(first.run, "v2x.share", float) > 0
    environments = [
        RecordedEnvironment(channel, EpisodeWriter(recording.folder(index), has_messages))
        for index, channel in enumerate(channels)
    ]
    while not all(environment.ended for environment in environments) and not stop.requested:
        if stop.leave_requested:
            # The ticks of unfinished episodes come again to the successor.
            return
        for environment in environments:
            environment.take(lambda: stop.requested)
        first.wait_for_any(0.2)
    part = {
        "env_steps": sum(environment.env_steps for environment in environments),
        "received_ticks": sum(environment.ticks for environment in environments),
        "recorded_episodes": len(recording.files()),
    }
    write_entries(recording.run_dir, part, lambda: stop.requested)
    for channel in channels:
        channel.done()


if __name__ == "__main__":
    code = run_process(sys.argv[1:], record)
    # torch would take a while to tidy up, and the run ends when this process does.
    os._exit(code)
