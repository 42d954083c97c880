"""A recording as lazy arrays: nothing is read before it is asked for; then it lies in memory maps beside the file."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caraware import _native
from caraware.data import layout
from caraware.ipc.arrays import BoolArray, Int64Array
from caraware.ipc.run_file import RunFile

FILE = "recording.mcap"
"""Name of a recording in the directory of an environment."""

Array = NDArray[Any]
"""An array over a memory map; its docstring or section says what it holds."""


class RecordingError(Exception):
    """A file is no recording, is of another version, or lacks what is asked for."""


@dataclass(frozen=True)
class Message:
    """One recorded message."""

    channel: str
    """Name of its channel."""
    header: np.void
    """The header (`caraware.data.layout.HEADER`)."""
    payload: bytes
    """As it lay in shared memory."""

    @property
    def tick(self) -> int:
        """Tick number, 0-based over the run."""
        return int(self.header["tick"])

    def section(self, name: str) -> Array:
        """A section of the payload, read-only, in the shape of this tick."""
        return layout.section(self.channel, self.header, self.payload, name)


def open_recording(path: str | Path) -> Recording:
    """Open a recording: its file, or the directory of its run or environment. Raises `RecordingError`."""
    path = Path(path)
    return Recording(path / FILE if path.is_dir() else path)


class Recording:
    """A recording of one environment."""

    def __init__(self, path: Path) -> None:
        """Open the file. One that was cut off opens up to there (`damage`). Raises `RecordingError`."""
        self.path = path
        try:
            self._file = _native.RecordingFile(path)
        except (ValueError, OSError) as error:
            raise RecordingError(str(error)) from error
        self.start: dict[str, Any] = json.loads(self._file.start_json)
        """Versions, run, environment, seed, length of a tick (s), and channels."""
        self._tables: dict[str, _Table] = {}

    @property
    def channels(self) -> list[str]:
        """Names of the recorded channels."""
        return list(self.start["channels"])

    @property
    def tick_s(self) -> float:
        """Length of a tick (s)."""
        return float(self.start["tick_s"])

    @property
    def damage(self) -> tuple[int, str] | None:
        """Byte and reason, if the file was cut off or its structure is damaged; the messages before are complete."""
        return self._file.damage

    @cached_property
    def run(self) -> RunFile:
        """The run file: configuration, map and source of the traffic. Raises `RecordingError`."""
        content = self._file.attachment("run.json")
        if content is None:
            raise RecordingError(f"{self.path} has no run.json")
        run: RunFile = json.loads(content)
        return run

    @cached_property
    def end(self) -> dict[str, Any] | None:
        """Observation hash, missed ticks and numbers of messages; None if the recording was not finished."""
        content = self._file.attachment("end.json")
        return None if content is None else json.loads(content)

    def messages(self, *channels: str) -> Iterator[Message]:
        """The messages of these channels, or of all, in the order of recording, up to the damage if there is one."""
        for chunk in range(self._file.chunks):
            try:
                parts = self._file.chunk(chunk)
            except ValueError:
                return
            for topic, header, payload in parts:
                if header and (not channels or topic in channels):
                    yield Message(topic, np.frombuffer(header, layout.HEADER)[0], payload)

    def lines(self, topic: str) -> Iterator[dict[str, Any]]:
        """The lines of a log of the run: "commands" or "curriculum"."""
        for chunk in range(self._file.chunks):
            for name, header, payload in self._file.chunk(chunk):
                if name == topic and not header:
                    yield json.loads(payload)

    def headers(self, channel: str = "observation") -> Array:
        """Headers of a channel's messages (`caraware.data.layout.HEADER`), one for each. Raises `RecordingError`."""
        return self._table(channel).headers

    def ticks(self, channel: str = "observation") -> Int64Array:
        """i64 [messages]: tick of each message of a channel."""
        return self.headers(channel)["tick"].astype(np.int64)

    def rows(self, channel: str, name: str) -> Array:
        """All rows of a section, those of each message behind those of the one before: [rows, …], a memory map.

        `offsets(channel, name)` says where each message begins. Raises `RecordingError`.
        """
        return self._table(channel).section(name)

    def offsets(self, channel: str, name: str) -> Int64Array:
        """i64 [messages + 1]: the first row of each message in `rows(channel, name)`, and the number of rows."""
        return self._table(channel).offsets(name)

    def at(self, channel: str, index: int, name: str) -> Array:
        """A section of the message `index` of a channel, counted from 0: a part of `rows`."""
        offsets = self.offsets(channel, name)
        return self.rows(channel, name)[offsets[index] : offsets[index + 1]]

    def _table(self, channel: str) -> _Table:
        if channel not in self.channels:
            raise RecordingError(f"{self.path} has no channel {channel!r}; it has {', '.join(self.channels)}")
        if channel not in self._tables:
            self._tables[channel] = _Table(self, channel)
        return self._tables[channel]

    @property
    def cache(self) -> Path:
        """Directory of the memory maps, beside the file; `clear_cache` removes it."""
        return self.path.with_name(f"{self.path.name}.arrays")

    def clear_cache(self) -> None:
        """Remove the memory maps, which are made again when they are needed."""
        self._tables.clear()
        shutil.rmtree(self.cache, ignore_errors=True)

    def episodes(self) -> Iterator[Episode]:
        """The recorded episodes in order, by the observations."""
        numbers = self.headers()["episode"]
        begins = np.flatnonzero(np.diff(numbers, prepend=numbers[:1] - 1)).tolist()
        for begin, end in zip(begins, [*begins[1:], len(numbers)], strict=True):
            yield Episode(self, int(numbers[begin]), slice(int(begin), int(end)))


class _Table:
    """The sections of one channel as files of numpy, unpacked once."""

    def __init__(self, recording: Recording, channel: str) -> None:
        self._recording, self._channel = recording, channel
        stat = recording.path.stat()
        # Another file under the same name has maps of its own.
        self._directory = recording.cache / f"{channel}-{stat.st_size}-{stat.st_mtime_ns}"
        if not self._directory.is_dir():
            self._unpack()
        self.headers: Array = np.load(self._directory / "headers.npy", mmap_mode="r")

    def section(self, name: str) -> Array:
        path = self._directory / f"{name}.npy"
        if not path.exists():
            names = ", ".join(layout.sections(self._channel))
            raise RecordingError(f"{self._channel} has no section {name!r}; it has {names}")
        array: Array = np.load(path, mmap_mode="r")
        return array

    def offsets(self, name: str) -> Int64Array:
        self.section(name)
        offsets: Int64Array = np.load(self._directory / f"{name}.offsets.npy", mmap_mode="r")
        return offsets

    def _unpack(self) -> None:
        """Write each section to a file, message by message, and give the directory its name at the end."""
        parent = self._directory.parent
        parent.mkdir(exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{self._channel}-", dir=parent))
        try:
            headers: list[np.void] = []
            columns = {name: _Column(partial, name) for name in layout.sections(self._channel)}
            for message in self._recording.messages(self._channel):
                headers.append(message.header)
                for name, column in columns.items():
                    column.add(message.section(name))
            np.save(partial / "headers.npy", np.array(headers, layout.HEADER))
            for column in columns.values():
                column.close()
            os.replace(partial, self._directory)
        except OSError:
            shutil.rmtree(partial, ignore_errors=True)
            # Another process may have unpacked it meanwhile.
            if not self._directory.is_dir():
                raise


class _Column:
    """A section that is written row by row: its bytes first, the head of the file of numpy at the end."""

    def __init__(self, directory: Path, name: str) -> None:
        self._path = directory / f"{name}.npy"
        self._rows = (directory / f"{name}.rows").open("w+b")
        self._offsets = [0]
        self._first: Array | None = None

    def add(self, rows: Array) -> None:
        if self._first is None or (len(self._first) == 0 and len(rows)):
            self._first = rows
        if len(rows) and rows.shape[1:] != self._first.shape[1:]:
            raise RecordingError(f"{self._path.stem}: rows of shape {rows.shape[1:]} and {self._first.shape[1:]}")
        self._rows.write(rows.tobytes())
        self._offsets.append(self._offsets[-1] + len(rows))

    def close(self) -> None:
        first = np.empty(0, np.float32) if self._first is None else self._first
        shape = (self._offsets[-1], *first.shape[1:])
        head = {"descr": np.lib.format.dtype_to_descr(first.dtype), "fortran_order": False, "shape": shape}
        self._rows.seek(0)
        with self._path.open("wb") as file:
            np.lib.format.write_array_header_1_0(file, head)
            shutil.copyfileobj(self._rows, file)
        self._rows.close()
        Path(self._rows.name).unlink()
        np.save(self._path.with_name(f"{self._path.stem}.offsets.npy"), np.array(self._offsets, np.int64))


@dataclass(frozen=True)
class Episode:
    """One recorded episode."""

    recording: Recording
    number: int
    """Episode number, 0-based over the run."""
    messages: slice
    """Its observations among those of the recording."""

    @property
    def headers(self) -> Array:
        """Headers of its observations."""
        part: Array = self.recording.headers()[self.messages]
        return part

    @property
    def seed(self) -> int:
        """Seed of the episode."""
        return int(self.headers["episode_seed"][0])

    @property
    def is_evaluation(self) -> bool:
        """True if its seed is never used in training."""
        return bool(self.headers["flags"][0] & 1)

    def vehicles(self) -> Iterator[VehicleTrack]:
        """Every vehicle of the episode that had a slot, by its index."""
        recording, offsets = self.recording, self.recording.offsets("observation", "vehicle")
        begin, end = offsets[self.messages.start], offsets[self.messages.stop]
        vehicles = np.asarray(recording.rows("observation", "vehicle")[begin:end])
        lengths = np.diff(offsets[self.messages.start : self.messages.stop + 1])
        ticks = np.repeat(self.headers["tick"].astype(np.int64), lengths)
        for vehicle in np.unique(vehicles[vehicles != _native.EMPTY_SLOT]):
            rows = begin + np.flatnonzero(vehicles == vehicle)
            yield VehicleTrack(self, int(vehicle), rows, ticks[rows - begin])

    def __len__(self) -> int:
        """Number of ticks."""
        return int(self.messages.stop) - int(self.messages.start)


@dataclass(frozen=True)
class VehicleTrack:
    """A vehicle in an episode: its rows of the observations, in the order of ticks."""

    episode: Episode
    vehicle: int
    """Dense index within the episode."""
    rows: Int64Array
    """i64 [t]: its rows in the sections of `observation`."""
    ticks: Int64Array
    """i64 [t]: the tick of each row."""

    def section(self, name: str) -> Array:
        """[t, …]: a section of its observations, such as "truth", copied out of the memory map."""
        part: Array = self.episode.recording.rows("observation", name)[self.rows]
        return part

    @property
    def valid(self) -> BoolArray:
        """bool [t]: all its sensors had delivered."""
        flagged: BoolArray = (self.section("flags") & _native.VALID) != 0
        return flagged

    @property
    def id_hash(self) -> int:
        """Hash of its SUMO id."""
        return int(self.section("id_hash")[0])
