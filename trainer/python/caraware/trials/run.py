"""One trial: a run of `caraware train` that is watched while it learns, and stopped where it is not worth its time."""

import ctypes
import json
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

POINTS = 20
"""Places of a run at which its live metric is compared with that of other trials."""
POLL_S = 0.5
PR_SET_PDEATHSIG = 1
ENDING_S = 120.0
"""Longest time in which a run that was told to end does so."""
CONFIG_STATUS = 2
"""Exit status of a wrong configuration: no other values of the varied keys would help."""


class TrialFailed(Exception):
    """The run failed; the text says how."""

    def __init__(self, text: str, status: int) -> None:
        super().__init__(text)
        self.is_configuration = status == CONFIG_STATUS


@dataclass
class TrialRun:
    """A run in the background. Use it as a context: at its end the run has ended, too."""

    command: list[str]
    directory: Path
    metric: str
    _read: int = 0
    _values: list[tuple[int, float]] = field(default_factory=list)
    _process: subprocess.Popen[str] | None = None

    def __enter__(self) -> "TrialRun":
        library = ctypes.CDLL(None)

        def end_with_the_search() -> None:
            library.prctl(PR_SET_PDEATHSIG, signal.SIGINT)

        self._process = subprocess.Popen(
            self.command,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=end_with_the_search,
        )
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def process(self) -> subprocess.Popen[str]:
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
            length = self._ticks_of_a_place()
            if length == 0:
                continue
            self._read_on()
            newest = self._values[-1][0] // length if self._values else 0
            for place in range(given, newest):
                given = place + 1
                if values := [value for tick, value in self._values if tick // length == place]:
                    yield given, sum(values) / len(values)

    def final(self, value_of: Callable[[dict[str, Any]], float | None]) -> float:
        """What the report says, once the run has ended. Raises `TrialFailed`."""
        assert self.process.stderr is not None
        text, status = self.process.stderr.read().strip(), self.process.wait()
        if status != 0:
            raise TrialFailed(text or f"exit status {status}", status)
        value = value_of(json.loads((self.directory / "report.json").read_text()))
        if value is None:
            raise TrialFailed(f"{self.directory / 'report.json'} has no {self.metric}", 1)
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

    def _ticks_of_a_place(self) -> int:
        """0 until the run has written its run file."""
        try:
            episode = json.loads((self.directory / "run.json").read_text())["config"]["episode"]
        except (OSError, ValueError):
            return 0
        return max(1, int(episode["ticks"]) * int(episode["training_episodes"]) // POINTS)

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
