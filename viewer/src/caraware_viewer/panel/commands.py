"""The commands of the panel: `caraware …` as a subprocess, with the line that could be typed, and its output."""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import shlex
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypedDict

from caraware_viewer.child import end_with_parent

ALLOWED = (
    "compare",
    "control",
    "diff",
    "doctor",
    "export",
    "handover",
    "keys",
    "play",
    "ps",
    "record",
    "replay",
    "simulate",
    "stop",
    "train",
    "view",
)
"""The subcommands that the page may run. `panel` is not among them, nor what takes the whole machine."""

LINES_KEPT = 400
"""Newest lines of output that are kept of each command."""
COMMANDS_KEPT = 200
"""Newest commands that are listed. One that runs is always kept."""
END_LIMIT_S = 90.0
"""Longest wait for a command to end after Ctrl-C. A run writes a checkpoint and its report meanwhile."""

_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class RefusedCommandError(ValueError):
    """The panel does not run such a command; the message says why."""


class CommandSummary(TypedDict):
    """A command in the list of the page."""

    id: int
    line: str
    """As it could be typed."""
    exit_code: int | None
    """`None` while it runs."""
    wall_s: float
    lines: int
    """Lines of output so far."""


class CommandOutput(CommandSummary):
    """A command with its newest output."""

    output: list[str]


class Command:
    """A `caraware` command that runs, or has run."""

    def __init__(self, number: int, arguments: Sequence[str], process: subprocess.Popen[bytes]) -> None:
        self.number = number
        self.line = shlex.join(["caraware", *arguments])
        """As it could be typed."""
        self.process = process
        self._lines: deque[str] = deque(maxlen=LINES_KEPT)
        self._count = 0
        self._lock = threading.Lock()
        self._started = time.monotonic()
        self._ended: float | None = None
        self._reader = threading.Thread(target=self._read, name=f"command-{number}", daemon=True)
        self._reader.start()

    @property
    def running(self) -> bool:
        """True until it has ended and its output is read."""
        return self._ended is None

    def summary(self) -> CommandSummary:
        """Its line, its exit code and its times."""
        with self._lock:
            ended = self._ended
            return CommandSummary(
                id=self.number,
                line=self.line,
                exit_code=None if ended is None else self.process.returncode,
                wall_s=(time.monotonic() if ended is None else ended) - self._started,
                lines=self._count,
            )

    def output(self) -> CommandOutput:
        """The summary, and the newest `LINES_KEPT` lines of its output."""
        summary = self.summary()
        with self._lock:
            return CommandOutput(**summary, output=list(self._lines))

    def interrupt(self) -> None:
        """Sends Ctrl-C; does nothing after its end."""
        with contextlib.suppress(ProcessLookupError):
            self.process.send_signal(signal.SIGINT)

    def wait(self, timeout_s: float) -> bool:
        """Waits for the end; true if it came."""
        self._reader.join(timeout_s)
        return not self._reader.is_alive()

    def kill(self) -> None:
        """Ends it and what it has started at once."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)

    def _read(self) -> None:
        assert self.process.stdout is not None
        for raw in self.process.stdout:
            line = _ESCAPES.sub("", raw.decode(errors="replace")).rstrip()
            with self._lock:
                self._lines.append(line)
                self._count += 1
        self.process.wait()
        with self._lock:
            self._ended = time.monotonic()


class CommandLog:
    """Starts commands and keeps them with their output."""

    def __init__(self, program: str) -> None:
        self._program = program
        self._commands: dict[int, Command] = {}
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._closed = False
        # Linux ends a child with the thread that started it, so one thread that lives as long as the panel starts all.
        self._starter = ThreadPoolExecutor(max_workers=1, thread_name_prefix="start")

    def start(self, arguments: Sequence[str]) -> Command:
        """Starts `caraware ARGUMENTS`. Raises `RefusedCommandError`, and `OSError` if the program does not start."""
        if not arguments or arguments[0] not in ALLOWED:
            named = f"`{arguments[0]}`" if arguments else "nothing"
            raise RefusedCommandError(f"the panel runs {', '.join(ALLOWED)}; not {named}")
        if any("\0" in argument for argument in arguments):
            raise RefusedCommandError("an argument holds a zero byte")
        with self._lock:
            if self._closed:
                raise RefusedCommandError("the panel is ending")
            process = self._starter.submit(self._popen, list(arguments)).result()
            command = Command(next(self._numbers), arguments, process)
            self._commands[command.number] = command
            ended = [number for number, other in self._commands.items() if not other.running]
            for number in ended[: max(0, len(self._commands) - COMMANDS_KEPT)]:
                del self._commands[number]
            return command

    def find(self, number: int) -> Command | None:
        """The command of this number; `None` if there is none, or no longer."""
        return self._commands.get(number)

    def summaries(self) -> list[CommandSummary]:
        """All commands, the newest first."""
        with self._lock:
            commands = list(self._commands.values())
        return [command.summary() for command in reversed(commands)]

    def running(self) -> list[Command]:
        """The commands that have not ended."""
        with self._lock:
            return [command for command in self._commands.values() if command.running]

    def read(self, arguments: Sequence[str], timeout_s: float) -> str:
        """Standard output of a command that only reads, which the log does not list.

        Raises `OSError`, or `subprocess.SubprocessError` if it fails or takes longer than `timeout_s` seconds.
        """
        result = subprocess.run(
            [self._program, *arguments], stdin=subprocess.DEVNULL, capture_output=True, timeout=timeout_s, check=True
        )
        return result.stdout.decode(errors="replace")

    def close(self) -> list[str]:
        """Sends Ctrl-C to every command that runs and waits; returns the lines of those that had to be killed."""
        with self._lock:
            self._closed = True
        commands = self.running()
        for command in commands:
            command.interrupt()
        deadline = time.monotonic() + END_LIMIT_S
        killed = []
        for command in commands:
            if not command.wait(max(0.0, deadline - time.monotonic())):
                command.kill()
                killed.append(command.line)
        self._starter.shutdown()
        return killed

    def kill(self) -> None:
        """Ends every command at once."""
        for command in self.running():
            command.kill()

    def _popen(self, arguments: list[str]) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [self._program, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=os.environ | {"NO_COLOR": "1", "PYTHONUNBUFFERED": "1"},
            # Ctrl-C in the terminal reaches the panel alone, which then ends its commands in order.
            start_new_session=True,
            preexec_fn=end_with_parent(),
        )
