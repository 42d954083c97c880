"""`python -m caraware.play RUN_FILE`: the policy of a checkpoint predicts, an EKF runs beside it, nothing learns.

Runs in the trainer's place in `caraware play`. Twice a second it writes its counts to `<run>/live.json`: the supervisor
shows them, and a successor continues from them. Exit codes: `caraware.run.process`.
"""

import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from caraware.run.process import HandoverRole, StopSignal, read_run, run_process

if TYPE_CHECKING:
    from caraware.ipc.run_file import RunFile
    from caraware.run.config import RunConfig
    from caraware.run.player import PlayedPolicy

log = logging.getLogger("caraware.play")


def play(run_file: Path, stop: StopSignal, _role: HandoverRole) -> None:
    """Play the checkpoint that the run file names, until the run ends or a request to stop."""
    from caraware import _native
    from caraware.ipc.channel import Channel
    from caraware.run.config import RunConfig
    from caraware.run.player import LIVE, PlayLoop, PlayTally

    run = read_run(run_file)
    config = RunConfig.from_run(run)
    policy = _policy(run, config, _native.observation_size(str(run_file)))
    first_tick = PlayTally.read(config.run_dir / LIVE).tick + 1
    log.info("plays %s from tick %d", config.resume_from, first_tick)
    PlayLoop(Channel(str(run_file), first_tick), config, policy, lambda: stop.requested).run()


def _policy(run: "RunFile", config: "RunConfig", observation_size: int) -> "PlayedPolicy":
    """The policy of the checkpoint, of whichever learner wrote it. Raises `CheckpointError`."""
    from caraware.fusion import train as fusion
    from caraware.run.learner import Learner
    from caraware.run.manifest import read_manifest

    if config.resume_from is not None and read_manifest(config.resume_from).learner == "fusion":
        return fusion.player(run, config, observation_size)
    return Learner.begin(config, observation_size).for_play()


if __name__ == "__main__":
    sys.exit(run_process(sys.argv[1:], play))
