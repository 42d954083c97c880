"""Starts the real `caraware train` for a learner that is not its child: this process is the run's trainer."""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import json
import os
import select
import shutil
import signal
import socket
import struct
import subprocess
import tempfile
import weakref
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from caraware.envs import outside
from caraware.ipc.channel import Channel
from caraware.ipc.report_part import write_entries
from caraware.ipc.stream import Observation
from caraware.run.program import ProgramError, caraware_program

RECEIVE_TIMEOUT_S = 0.2
"""Time between two looks at whether the simulation still runs, while it sends nothing."""
STOP_WITHIN_S = 40.0
"""Longest time from the request to stop to the supervisor's end; it gives its own processes 30 s."""

INTERRUPTED = 130
"""Exit code of `caraware` after an interrupt."""

_TEMPORARY = "caraware-env-"

ENDLESS = {
    "episode.training_episodes": 10_000,
    "episode.evaluation_interval": 0,
    "episode.evaluation_ticks": 1,
    "episode.final_evaluations": 1,
    "fanout.enabled": False,
}
"""Settings of a simulation that its user ends: no evaluation between episodes, and no viewer unless asked for."""


class SimulationError(RuntimeError):
    """The simulation could not be started, or it ended by itself; the message is that of `caraware`."""


class Simulation:
    """A simulation of this process's own: it starts at once, can be started again, and ends with this process.

    It can be used by one thread at a time. After `fork` only the parent may use it.
    """

    can_restart = True

    def __init__(
        self,
        config: str | Path = "town",
        settings: Mapping[str, Any] | None = None,
        seed: int = 1,
        *,
        runs: str | Path | None = None,
        program: str | Path | None = None,
    ) -> None:
        self._config, self._settings, self._runs = str(config), dict(settings or {}), runs
        for key, instead in (
            ("run.seed", "give seed="),
            ("run.envs", "make several simulations"),
            ("trainer.module", "this process is the trainer"),
        ):
            if key in self._settings:
                raise ValueError(f"`{key}` cannot be set here: {instead}")
        self._owner = os.getpid()
        self._program = Path(program) if program else _find_program()
        self._restarts = 0
        self._seed = self._first_seed = int(seed)
        self.current: Observation | None = None
        self._temporary: _TemporaryRuns | None = None
        self._run: _Run | None = None
        _open_simulations.add(self)
        try:
            self._start(seed)
        except BaseException:
            self.close()
            raise

    @property
    def run(self) -> dict[str, Any]:
        """The run file: resolved configuration, map, directories."""
        return self._alive().channel.run

    @property
    def channel(self) -> Channel:
        """The trainer's place in the present run."""
        return self._alive().channel

    @property
    def seed(self) -> int:
        """Seed of the present run."""
        return self._seed

    @property
    def pid(self) -> int:
        """Process id of the present run's supervisor."""
        return self._alive().process.pid

    def restart(self, seed: int | None = None) -> None:
        """Ends the present run and starts one with `seed`, without with the next of a sequence that `seed` began."""
        if seed is None:
            self._restarts += 1
            drawn = np.random.SeedSequence(self._first_seed, spawn_key=(self._restarts,)).generate_state(1)
            seed, first = int(drawn[0]), self._first_seed
        else:
            self._restarts, first = 0, seed
        self._alive()
        self._end()
        self._start(seed)
        self._first_seed = first

    def is_passed(self) -> bool:
        """Never: no other policy has answered before."""
        return False

    def receive(self) -> Observation | None:
        """The next tick, or None after the last of the run. Raises `SimulationError` if the simulation ends before."""
        self.current = None
        self.current = self._alive().receive()
        return self.current

    def close(self, part: Mapping[str, Any] | None = None) -> None:
        """Ends the simulation in order. Closing twice does no harm, nor does closing in a forked child."""
        if os.getpid() != self._owner:
            return
        self._end(part)
        _open_simulations.discard(self)
        if self._temporary is not None:
            self._temporary.remove()
            self._temporary = None

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __del__(self) -> None:
        with contextlib.suppress(AttributeError):  # where __init__ did not get far
            self.close()

    def _alive(self) -> _Run:
        if self._run is None:
            raise SimulationError("the simulation has been closed")
        return self._run

    def _start(self, seed: int) -> None:
        self._seed = self._first_seed = int(seed)
        if self._runs is None and self._temporary is None:
            self._temporary = _TemporaryRuns()
        runs = self._temporary.path if self._temporary is not None else Path(str(self._runs))
        settings = ENDLESS | self._settings | {"run.seed": self._seed, "trainer.module": outside.__name__}
        self._run = _Run(self._program, self._config, settings, runs)

    def _end(self, part: Mapping[str, Any] | None = None) -> None:
        self.current = None
        run, self._run = self._run, None
        if run is not None:
            run.end(part)


def make(
    config: str | Path = "town",
    set: Mapping[str, Any] | None = None,
    seed: int = 1,
    *,
    runs: str | Path | None = None,
    program: str | Path | None = None,
) -> Simulation:
    """Starts a simulation for a face: `CarAwareVectorEnv(make("town", {"traffic.cavs": 8}))`.

    `config` is what `caraware train` takes: a preset, a `.toml` or a `.sumocfg`; `set` changes single settings of it
    by their keys (configs/README.md). `runs` is the directory for run directories, one for each start; without,
    results are thrown away. `program` is the `caraware` command; without, it is that of the environment variable
    `CARAWARE`, the build beside this package or this Python, or the one in `PATH`.

    Raises `SimulationError` with the message of `caraware` where the configuration is wrong or something is missing.
    """
    return Simulation(config, set, seed, runs=runs, program=program)


class _TemporaryRuns:
    """A directory for the runs of a simulation whose results are not to be kept.

    It is removed with the simulation, or, if its process was killed, when the next one starts: a live process holds a
    lock on a file in it.
    """

    def __init__(self) -> None:
        for old in Path(tempfile.gettempdir()).glob(f"{_TEMPORARY}*"):
            self._remove_if_dead(old)
        self.path = Path(tempfile.mkdtemp(prefix=f"{_TEMPORARY}{os.getpid()}-"))
        self._lock = open(self.path / "lock", "w")  # noqa: SIM115, it is held as long as this object
        fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def remove(self) -> None:
        """Removes everything."""
        shutil.rmtree(self.path, ignore_errors=True)
        self._lock.close()

    @staticmethod
    def _remove_if_dead(directory: Path) -> None:
        with contextlib.suppress(OSError), open(directory / "lock") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(directory, ignore_errors=True)


class _Run:
    """One run of `caraware train`, from its start to its end."""

    def __init__(self, program: Path, config: str, settings: Mapping[str, Any], runs: Path) -> None:
        self._queue: deque[Observation] = deque()
        self._ended = False
        self._line: socket.socket | None = None
        self._messages = tempfile.TemporaryFile()  # noqa: SIM115, it lives as long as the run
        name = f"caraware-{os.getpid()}-{os.urandom(8).hex()}"
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind("\0" + name)
            listener.listen(1)
            assignments = [f"--set={key}={_text(value)}" for key, value in settings.items()]
            self.process = self._started([program, "train", config, "--runs", runs, *assignments], name)
            try:
                run_file = self._wait_for_run_file(listener)
                self.channel = Channel(run_file, outside=True)
            except BaseException as error:
                self._kill()
                if isinstance(error, RuntimeError) and not isinstance(error, SimulationError):
                    raise SimulationError(f"cannot join the run: {error}\n{self._message()}") from error
                raise

    def _started(self, command: list[str | Path], line: str) -> subprocess.Popen[bytes]:
        addressed = {outside.LINE: line, outside.USER: str(os.getpid()), "PYTHONPATH": _python_path()}
        try:
            return subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._messages,
                env=os.environ | addressed,
                start_new_session=True,  # Ctrl-C in a terminal is this process's affair
            )
        except OSError as error:
            raise SimulationError(f"cannot start {command[0]}: {error.strerror}") from error

    def receive(self) -> Observation | None:
        while not self._queue:
            if self._ended:
                return None
            try:
                blocks = self.channel.receive(RECEIVE_TIMEOUT_S)
            except RuntimeError as error:
                self._check_alive()
                raise SimulationError(str(error)) from error
            if not blocks:
                self._check_alive()
                continue
            self._queue.extend(blocks)
            self._ended = blocks[-1].last
        return self._queue.popleft()

    def end(self, part: Mapping[str, Any] | None) -> None:
        """Stops the run, unless it has ended."""
        self._queue.clear()
        if part is not None and self.process.poll() is None:
            write_entries(Path(self.channel.run["run_dir"]), part, lambda: self.process.poll() is not None)
        if self._ended:
            self.channel.done()
        self.channel.close()
        self._stop()
        self._close_files()

    def _stop(self) -> None:
        if self._ended and self._line is not None:
            with contextlib.suppress(OSError):
                self._line.sendall(outside.DONE)
        elif self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(STOP_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._kill()

    def _kill(self) -> None:
        if self._line is not None:
            self._line.close()
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(STOP_WITHIN_S)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()

    def _close_files(self) -> None:
        if self._line is not None:
            self._line.close()
        self._messages.close()

    def _wait_for_run_file(self, listener: socket.socket) -> str:
        ended = os.pidfd_open(self.process.pid)
        try:
            while True:
                waited: list[socket.socket | int] = [listener, ended]
                ready, _, _ = select.select(waited, [], [])
                if listener not in ready:
                    raise SimulationError(self._message())
                line, _ = listener.accept()
                if _user_of(line) == os.getuid():
                    self._line = line
                    return line.makefile().readline().rstrip("\n")
                line.close()
        finally:
            os.close(ended)

    def _check_alive(self) -> None:
        if self.process.poll() is not None:
            raise SimulationError(self._message())

    def _message(self) -> str:
        """What `caraware` said last: its error, or its last lines."""
        status = self.process.poll()
        file = self._messages.fileno()
        lines = os.pread(file, os.fstat(file).st_size, 0).decode(errors="replace").rstrip().splitlines()
        errors = [number for number, line in enumerate(lines) if line.lstrip().startswith("×")]
        reason = lines[errors[-1] :] if errors else lines[-3:]
        return "\n".join([f"the simulation ended (caraware: {_exit_text(status)})", *reason])


_open_simulations: weakref.WeakSet[Simulation] = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    for simulation in list(_open_simulations):
        simulation.close()


def _text(value: Any) -> str:
    """A setting as the command line takes it: JSON's notation is TOML's for all that a setting can be."""
    return value if isinstance(value, str) else json.dumps(value)


def _exit_text(status: int | None) -> str:
    if status is None:
        return "still alive"
    if status == INTERRUPTED:
        return "stopped by a signal or `caraware stop`"
    return f"signal {-status}" if status < 0 else f"exit code {status}"


def _user_of(line: socket.socket) -> int:
    """User id of the process at the other end: every process on this machine may connect to an abstract name."""
    credentials = line.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    _pid, user, _group = struct.unpack("3i", credentials)
    return int(user)


def _python_path() -> str:
    """The supervisor's Python finds the package that this process uses."""
    package = str(Path(__file__).parents[2])
    return os.pathsep.join(filter(None, (package, os.environ.get("PYTHONPATH"))))


def _find_program() -> Path:
    try:
        return caraware_program()
    except ProgramError as error:
        raise SimulationError(str(error)) from error
