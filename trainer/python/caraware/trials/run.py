"""One trial: a run of `caraware train` that is watched while it learns, and stopped where it is not worth its time."""

import json
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from caraware.run.program import end_with_parent

POINTS = 20
"""Places of a run at which its live metric is compared with that of other trials."""
POLL_S = 0.5
ENDING_S = 120.0
"""Longest time in which a run that was told to end does so."""


class TrialFailed(Exception):
    """The run failed; the text says how."""


@dataclass
class TrialRun:
    """A run in the background. Use it as a context: at its end the run has ended, too."""

    command: list[str]
    directory: Path
    metric: str
    _read: int = 0
    _values: list[tuple[int, float]] = field(default_factory=list)
    _ticks_of_a_place: int = 0
    """0 until the run has written its run file."""
    _process: subprocess.Popen[bytes] | None = None
    _ended: ExitStack = field(default_factory=ExitStack)

    def __enter__(self) -> "TrialRun":
        self._errors: IO[str] = self._ended.enter_context(tempfile.TemporaryFile("w+"))
        self._process = subprocess.Popen(
            self.command,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            preexec_fn=lambda: end_with_parent(signal.SIGINT),
        )
        self._ended.callback(self.stop)
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.close()

    @property
    def process(self) -> subprocess.Popen[bytes]:
        """The supervisor of the run."""
        assert self._process is not None
        return self._process

    def points(self, beat: Callable[[], None]) -> Iterator[tuple[int, float]]:
        """The live metric while the run goes on: (place from 1, mean since the place before). Ends with the run.

        `beat` is called all the time.
        """
        given = 0
        while self.process.poll() is None:
            time.sleep(POLL_S)
            beat()
            if (length := self._place_length()) == 0:
                continue
            self._read_on()
            newest = self._values[-1][0] // length if self._values else 0
            for place in range(given, newest):
                given = place + 1
                if values := [value for tick, value in self._values if tick // length == place]:
                    yield given, sum(values) / len(values)

    def final(self, value_of: Callable[[dict[str, Any]], float | None]) -> float:
        """What the report says, once the run has ended. Raises `TrialFailed`."""
        if (status := self.process.wait()) != 0:
            self._errors.seek(0)
            raise TrialFailed(self._errors.read().strip() or f"exit status {status}")
        value = value_of(json.loads((self.directory / "report.json").read_text()))
        if value is None:
            raise TrialFailed(f"{self.directory / 'report.json'} has no result of an evaluation")
        return value

    def stop(self) -> None:
        """End the run as Ctrl-C does: it writes a checkpoint and a report."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            try:
                self.process.wait(ENDING_S)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()

    def _place_length(self) -> int:
        run = self.directory / "run.json"
        if self._ticks_of_a_place == 0 and run.exists():
            episode = json.loads(run.read_text())["config"]["episode"]
            self._ticks_of_a_place = max(1, int(episode["ticks"]) * int(episode["training_episodes"]) // POINTS)
        return self._ticks_of_a_place

    def _read_on(self) -> None:
        """The lines of `learning.jsonl` since the last time."""
        file = self.directory / "learning.jsonl"
        if not file.exists():
            return
        with file.open("rb") as lines:
            lines.seek(self._read)
            for line in lines:
                if not line.endswith(b"\n"):
                    break
                self._read += len(line)
                update = json.loads(line)
                if (value := update.get("training", {}).get(self.metric)) is not None:
                    self._values.append((int(update["tick"]), float(value)))
