"""A process in the trainer's place: signals, its part in a handover, exit codes, and how it reports a failure.

Exit codes: 0 done, or stopped by SIGTERM or SIGINT after a checkpoint; 1 the run failed; 2 configuration;
3 something is missing on this machine; 75 and 76 the trainer of another rank was replaced (`caraware.learn.meeting`). A
failure is reported once, in `<run>/logs/trainer.error.json`.
"""

import gc
import importlib
import json
import logging
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType

from caraware import _native
from caraware.ipc.run_file import RunFile

log = logging.getLogger("caraware.train")

EXIT_CODES = {"run": 1, "config": 2, "missing": 3}


@dataclass(frozen=True)
class Failure:
    """What went wrong, for the supervisor to show."""

    kind: str
    message: str
    help: str

    def write(self, run_dir: Path, process: str) -> None:
        """Write it to the file that the supervisor reads."""
        file = run_dir / "logs" / f"{process}.error.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({"kind": self.kind, "message": self.message, "help": self.help}) + "\n")


class StopSignal:
    """Remembers signals until the loop is between two batches.

    SIGTERM and SIGINT stop; SIGUSR1 asks for a handover after the next update, SIGUSR2 at the next tick.
    """

    def __init__(self) -> None:
        self.requested = self.leave_requested = self.leave_now_requested = False
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1, signal.SIGUSR2):
            signal.signal(number, self._remember)

    def _remember(self, number: int, frame: FrameType | None) -> None:
        if number in (signal.SIGUSR1, signal.SIGUSR2):
            self.leave_requested = True
            self.leave_now_requested |= number == signal.SIGUSR2
        else:
            self.requested = True


@dataclass(frozen=True)
class SuccessorClaims:
    """What a successor is made for: the supervisor refuses it where the run is another. None says nothing."""

    schema_version: int | None = _native.SCHEMA_VERSION
    """Of the payloads that it reads, whatever else it says."""
    observation_size: int | None = None
    observation_fields: tuple[str, ...] | None = None
    action_size: int | None = None
    task: str | None = None
    environments: int | None = None
    decides_lessons: bool | None = None
    """Whether it decides the lessons of a curriculum, for which the simulation waits."""
    first_tick: int | None = None
    """The first tick it needs, as far as it knows: the journal must hold it."""

    def line(self) -> bytes:
        """The line that says that the successor is ready."""
        said = {name: value for name, value in asdict(self).items() if value is not None}
        return b"ready " + json.dumps(said).encode() + b"\n"


@dataclass
class HandoverRole:
    """The part of this process in a handover; the supervisor passes it in environment variables."""

    replaces: bool
    """Another trainer of this run came before."""
    gets_ready: bool
    """The other trainer is still running: get ready, then wait for the handover."""
    checkpoint: Path | None
    """Parameters to take instead of the newest of the run."""
    incarnation: int = 0
    """Number of trainers of this run before it, since the run was started or resumed."""
    handovers: int = 0
    """Completed handovers of the run, without those that fell back."""

    @classmethod
    def from_environment(cls) -> "HandoverRole":
        """Without the variables, the process is the first trainer of its run."""
        checkpoint = os.environ.get("CARAWARE_CHECKPOINT")
        incarnation = int(os.environ.get("CARAWARE_INCARNATION", "0"))
        return cls(
            replaces=incarnation > 0,
            gets_ready=bool(os.environ.get("CARAWARE_SUCCESSOR")),
            checkpoint=Path(checkpoint) if checkpoint else None,
            incarnation=incarnation,
            handovers=int(os.environ.get("CARAWARE_HANDOVERS", "0")),
        )

    def wait_for_turn(self, claims: SuccessorClaims | None = None) -> bool:
        """Report that this successor is ready, and wait for the handover; False if the supervisor cancels it.

        It compares the `claims` with the run before the old trainer leaves.
        """
        os.write(1, (claims or SuccessorClaims()).line())
        os.dup2(2, 1)
        log.info("the successor is ready, and waits for its turn")
        if os.read(0, 16) != b"go\n":
            return False
        self.gets_ready = False
        return True


TrainerWork = Callable[[Path, StopSignal, HandoverRole], None]
"""The work of a trainer process, given its run file."""


def run_process(arguments: list[str], work: TrainerWork) -> int:
    """Run `work` for the run file in `arguments`; returns the exit code of the process."""
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    if len(arguments) != 1:
        print("usage: python -m caraware.train RUN_FILE", file=sys.stderr)
        return EXIT_CODES["config"]
    run_file = Path(arguments[0])
    stop, role = StopSignal(), HandoverRole.from_environment()
    try:
        _import_torch()
        work(run_file, stop, role)
    except Exception as error:  # the edge of the process: every failure is reported in one place
        failure = _explain(error)
        log.exception("%s", failure.message)
        failure.write(_run_dir(run_file), "successor" if role.gets_ready else "trainer")
        return EXIT_CODES[failure.kind]
    return 0


def _import_torch() -> None:
    """Import what takes longest in a third less time: without the garbage collector, which finds none meanwhile.

    What is there afterwards is never garbage. Frozen, it is left out by later collections and by that at the exit.
    """
    gc.disable()
    try:
        importlib.import_module("torch")
    finally:
        gc.freeze()
        gc.enable()


def read_run(run_file: Path) -> RunFile:
    """The run file, parsed. Raises `ConfigError`."""
    from caraware.learn.config import ConfigError

    try:
        run: RunFile = json.loads(run_file.read_text())
        return run
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read the run file {run_file}: {error}", "start it by `caraware train`") from error


def _run_dir(run_file: Path) -> Path:
    """The run's directory; where the run file cannot be read, the directory that contains it."""
    try:
        return Path(json.loads(run_file.read_text())["run_dir"])
    except (OSError, ValueError, KeyError, TypeError):
        return run_file.parent


def _explain(error: Exception) -> Failure:
    """Sort an exception into the three kinds, each with what to do about it."""
    if isinstance(error, ImportError):
        return Failure(
            "missing", f"cannot import {error.name}: {error}", "`make train` installs what the trainer needs"
        )
    from caraware.ipc.commits import CommitLogError
    from caraware.learn.config import ConfigError
    from caraware.learn.ppo import NonFiniteLoss
    from caraware.learn.ranks import RankError
    from caraware.run.manifest import CheckpointError

    if isinstance(error, ConfigError):
        return Failure("config", str(error), error.help)
    if isinstance(error, CheckpointError):
        return Failure("run", f"checkpoint refused: {error}", "continue from another checkpoint of the run")
    if isinstance(error, NonFiniteLoss):
        saved = f"the batch is in {error.batch_file}; " if error.batch_file else ""
        return Failure("run", str(error), f"{saved}a smaller `trainer.learning_rate` is the usual cure")
    if isinstance(error, CommitLogError):
        return Failure("run", str(error), error.help)
    if isinstance(error, RankError):
        return Failure("run", str(error), "all ranks end together; the first to fail says why")
    return Failure("run", f"{type(error).__name__}: {error}", "the traceback is in the trainer's log")
