"""`python -m caraware.train RUN_FILE`: the trainer process of one run.

Exit codes: 0 done, or stopped by SIGTERM or SIGINT after a checkpoint; 1 the run failed; 2 configuration;
3 something is missing on this machine. A failure is told once, in `<run>/logs/trainer.error.json`.
"""

import json
import logging
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

log = logging.getLogger("caraware.train")

EXIT_CODES = {"run": 1, "config": 2, "missing": 3}


@dataclass(frozen=True)
class Failure:
    """What went wrong, for the supervisor to show."""

    kind: str
    message: str
    help: str

    def write(self, run_dir: Path) -> None:
        """Leave it where the supervisor looks."""
        file = run_dir / "logs" / "trainer.error.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({"kind": self.kind, "message": self.message, "help": self.help}) + "\n")


class StopSignal:
    """Remembers SIGTERM and SIGINT, so that the loop ends between two batches."""

    def __init__(self) -> None:
        self.requested = False
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._remember)

    def _remember(self, number: int, frame: FrameType | None) -> None:
        self.requested = True


def main(arguments: list[str]) -> int:
    """Run the trainer of one run file; the process's exit code."""
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    if len(arguments) != 1:
        print("usage: python -m caraware.train RUN_FILE", file=sys.stderr)
        return EXIT_CODES["config"]
    run_file = Path(arguments[0])
    stop = StopSignal()
    try:
        _train(run_file, stop)
    except Exception as error:  # the edge of the process: everything ends up in one place
        failure = _explain(error)
        log.exception("%s", failure.message)
        failure.write(_run_dir(run_file))
        return EXIT_CODES[failure.kind]
    return 0


def _run_dir(run_file: Path) -> Path:
    """The run's directory; where the run file cannot be read, the directory it is in."""
    try:
        return Path(json.loads(run_file.read_text())["run_dir"])
    except (OSError, ValueError, KeyError, TypeError):
        return run_file.parent


def _train(run_file: Path, stop: StopSignal) -> None:
    """Imports stand here so that a missing package is reported like any other failure."""
    from caraware.config import RunConfig
    from caraware.loop import TrainingLoop

    config = RunConfig.from_run(_read_run(run_file))

    from caraware.channel import Channel

    channel = Channel(str(run_file))
    TrainingLoop(channel, config, lambda: stop.requested).run()


def _read_run(run_file: Path) -> dict:
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
    from caraware.checkpoint import CheckpointError
    from caraware.config import ConfigError
    from caraware.ppo import NonFiniteLoss

    if isinstance(error, ConfigError):
        return Failure("config", str(error), error.help)
    if isinstance(error, CheckpointError):
        return Failure("run", f"checkpoint refused: {error}", "continue from another checkpoint of the run")
    if isinstance(error, NonFiniteLoss):
        saved = f"the batch is in {error.batch_file}; " if error.batch_file else ""
        return Failure("run", str(error), f"{saved}a smaller `trainer.learning_rate` is the usual cure")
    return Failure("run", f"{type(error).__name__}: {error}", "the traceback is in the trainer's log")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
