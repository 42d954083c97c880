"""`python -m caraware.play RUN_FILE`: the policy of a checkpoint predicts, an EKF runs beside it, nothing learns.

Runs in the trainer's place in `caraware play`. Twice a second it writes its counts to `<run>/live.json`: the supervisor
shows them, and a successor continues from them. Exit codes: `caraware.run.process`.
"""

import logging
import sys
from pathlib import Path

from caraware.run.process import HandoverRole, StopSignal, read_run, run_process

log = logging.getLogger("caraware.play")


def play(run_file: Path, stop: StopSignal, _role: HandoverRole) -> None:
    """Play the checkpoint that the run file names, until the run ends or a request to stop."""
    from caraware import _native
    from caraware.ipc.channel import Channel
    from caraware.run.config import RunConfig
    from caraware.run.loop import Learner
    from caraware.run.player import LIVE, PlayLoop, Tally

    config = RunConfig.from_run(read_run(run_file))
    learner = Learner.begin(config, _native.observation_size(str(run_file)))
    first_tick = Tally.read(config.run_dir / LIVE).tick + 1
    log.info("plays %s from tick %d", config.resume_from, first_tick)
    PlayLoop(Channel(str(run_file), first_tick), config, learner, lambda: stop.requested).run()


if __name__ == "__main__":
    sys.exit(run_process(sys.argv[1:], play))
