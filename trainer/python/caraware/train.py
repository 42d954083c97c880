"""`python -m caraware.train RUN_FILE`: the trainer process of one run.

A trainer that replaces another continues from the newest checkpoint that verifies. As a shadow (`CARAWARE_SHADOW`) it
gets ready first, says so on standard output, and takes over when standard input tells it to.

Exit codes: 0 done, or stopped by SIGTERM or SIGINT after a checkpoint; 1 the run failed; 2 configuration;
3 something is missing on this machine. A failure is told once, in `<run>/logs/trainer.error.json`.
"""

import json
import logging
import os
import signal
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from caraware.config import RunConfig
    from caraware.loop import Learner
    from caraware.ranks import Ranks

log = logging.getLogger("caraware.train")

EXIT_CODES = {"run": 1, "config": 2, "missing": 3}


@dataclass(frozen=True)
class Failure:
    """What went wrong, for the supervisor to show."""

    kind: str
    message: str
    help: str

    def write(self, run_dir: Path, process: str) -> None:
        """Leave it where the supervisor looks."""
        file = run_dir / "logs" / f"{process}.error.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({"kind": self.kind, "message": self.message, "help": self.help}) + "\n")


class StopSignal:
    """Remembers SIGTERM and SIGINT, so that the loop ends between two batches, and SIGUSR1: leave to a successor."""

    def __init__(self) -> None:
        self.requested = self.leave_requested = False
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1):
            signal.signal(number, self._remember)

    def _remember(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGUSR1:
            self.leave_requested = True
        else:
            self.requested = True


@dataclass
class Succession:
    """Whether this process replaces a trainer, and how; what the supervisor says in the environment."""

    replaces: bool
    is_shadow: bool
    """Another trainer is still at work: get ready, then wait."""
    checkpoint: Path | None
    """Parameters to take instead of the newest of the run."""

    @classmethod
    def from_environment(cls) -> "Succession":
        """First trainer of a run unless told otherwise."""
        checkpoint = os.environ.get("CARAWARE_CHECKPOINT")
        return cls(
            replaces=int(os.environ.get("CARAWARE_INCARNATION", "0")) > 0,
            is_shadow=bool(os.environ.get("CARAWARE_SHADOW")),
            checkpoint=Path(checkpoint) if checkpoint else None,
        )

    def wait_for_turn(self) -> bool:
        """Say that this shadow is ready, and wait; False if it is not wanted any more."""
        os.write(1, b"ready\n")
        os.dup2(2, 1)
        if os.read(0, 16) != b"go\n":
            return False
        self.is_shadow = False
        return True


def main(arguments: list[str], work: "Callable[[Path, StopSignal, Succession], None] | None" = None) -> int:
    """Run the trainer of one run file, or whatever `work` does in its place; the process's exit code."""
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    if len(arguments) != 1:
        print("usage: python -m caraware.train RUN_FILE", file=sys.stderr)
        return EXIT_CODES["config"]
    run_file = Path(arguments[0])
    stop, succession = StopSignal(), Succession.from_environment()
    try:
        (work or _train)(run_file, stop, succession)
    except Exception as error:  # the edge of the process: everything ends up in one place
        failure = _explain(error)
        log.exception("%s", failure.message)
        failure.write(_run_dir(run_file), "successor" if succession.is_shadow else "trainer")
        return EXIT_CODES[failure.kind]
    return 0


def _run_dir(run_file: Path) -> Path:
    """The run's directory; where the run file cannot be read, the directory it is in."""
    try:
        return Path(json.loads(run_file.read_text())["run_dir"])
    except (OSError, ValueError, KeyError, TypeError):
        return run_file.parent


def _train(run_file: Path, stop: StopSignal, succession: Succession) -> None:
    """Imports stand here so that a missing package is reported like any other failure."""
    from caraware.config import RunConfig
    from caraware.loop import TrainingLoop

    config = RunConfig.from_run(read_run(run_file))

    from caraware import ranks
    from caraware.channel import Channel

    together = ranks.of_run(config.trainer.ranks)
    if succession.replaces:
        learner = _successor(run_file, config, succession)
        if succession.is_shadow:
            return
    else:
        learner = _resumed(config, together)
    first_ticks = [learner.first_tick(index) if learner else 0 for index in range(len(config.environments))]
    channel = Channel(str(run_file), first_ticks[0])
    loop = TrainingLoop(
        channel,
        config,
        lambda: stop.requested,
        others=[channel.in_environment(index, tick) for index, tick in enumerate(first_ticks) if index > 0],
        leave_requested=lambda: stop.leave_requested,
        learner=learner,
        ranks=together,
    )
    if succession.checkpoint is not None:
        loop.commit()
    if not loop.run():
        # A successor waits for this process to end, and the simulation for it: torch would take seconds to tidy up.
        logging.shutdown()
        os._exit(0)
    together.close()


def _resumed(config: "RunConfig", ranks: "Ranks") -> "Learner | None":
    """A learner that stands where the checkpoint does that the run begins with; None if it begins anew."""
    from caraware.checkpoint import remove_partial
    from caraware.loop import Learner
    from caraware.manifest import read_manifest

    if config.resume_from is None:
        return None
    remove_partial(config.run_dir / "checkpoints")
    learner = Learner.begin(config, read_manifest(config.resume_from).observation_size, ranks)
    log.info("resumed from %s at tick %d", config.resume_from, learner.first_tick())
    return learner


def _successor(run_file: Path, config: "RunConfig", succession: Succession) -> "Learner | None":
    """A learner that stands where the run's newest sound checkpoint does; None if it is not wanted any more."""
    from caraware import _native
    from caraware.checkpoint import remove_partial
    from caraware.loop import Learner
    from caraware.manifest import newest_sound_checkpoint

    size, folder = _native.observation_size(str(run_file)), config.run_dir / "checkpoints"
    if succession.is_shadow:
        # Whatever could be wrong with the settings or the checkpoint shows here, while the predecessor is at work.
        trial = replace(config, resume_from=succession.checkpoint or newest_sound_checkpoint(folder))
        Learner.begin(trial, size).warm_up()
        if not succession.wait_for_turn():
            return None
    remove_partial(folder)
    newest = newest_sound_checkpoint(folder)
    learner = Learner.begin(replace(config, resume_from=newest or config.resume_from), size)
    log.info("continues from %s at tick %d", newest.name if newest else "the beginning", learner.first_tick())
    if succession.checkpoint is not None:
        learner.take_parameters(succession.checkpoint)
    return learner


def read_run(run_file: Path) -> dict:
    """The run file, parsed. Raises `ConfigError`."""
    from caraware.config import ConfigError

    try:
        return json.loads(run_file.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read the run file {run_file}: {error}", "start it by `caraware train`") from error


def _explain(error: Exception) -> Failure:
    """Sort an exception into the three kinds, each with what to do about it."""
    if isinstance(error, ImportError):
        return Failure(
            "missing", f"cannot import {error.name}: {error}", "`make train` installs what the trainer needs"
        )
    from caraware.config import ConfigError
    from caraware.manifest import CheckpointError
    from caraware.ppo import NonFiniteLoss
    from caraware.ranks import RankError

    if isinstance(error, ConfigError):
        return Failure("config", str(error), error.help)
    if isinstance(error, CheckpointError):
        return Failure("run", f"checkpoint refused: {error}", "continue from another checkpoint of the run")
    if isinstance(error, NonFiniteLoss):
        saved = f"the batch is in {error.batch_file}; " if error.batch_file else ""
        return Failure("run", str(error), f"{saved}a smaller `trainer.learning_rate` is the usual cure")
    if isinstance(error, RankError):
        return Failure("run", str(error), "all ranks end together; the first to fail says why")
    return Failure("run", f"{type(error).__name__}: {error}", "the traceback is in the trainer's log")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
