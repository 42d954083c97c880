"""`python -m caraware.play RUN_FILE`: the policy of a checkpoint predicts, an EKF runs beside it, nothing learns.

Takes the trainer's place in a run of `caraware play`. What it has counted is in `<run>/live.json`, anew twice a second:
the supervisor shows it, and a successor goes on from it. Exit codes are those of `caraware.train`.
"""

import logging
import sys
from pathlib import Path

from caraware.train import StopSignal, main, read_run

log = logging.getLogger("caraware.play")


def play(run_file: Path, stop: StopSignal) -> None:
    """Play the checkpoint that the run file names, until the run ends or a request to stop."""
    from caraware import _native
    from caraware.channel import Channel
    from caraware.config import RunConfig
    from caraware.loop import Learner
    from caraware.player import LIVE, PlayLoop, Tally

    config = RunConfig.from_run(read_run(run_file))
    learner = Learner.begin(config, _native.observation_size(str(run_file)))
    first_tick = Tally.read(config.run_dir / LIVE).tick + 1
    log.info("plays %s from tick %d", config.resume_from, first_tick)
    PlayLoop(Channel(str(run_file), first_tick), config, learner, lambda: stop.requested).run()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], lambda run_file, stop, _: play(run_file, stop)))
