"""`python -m caraware.train RUN_FILE`: the trainer process of one run.

A trainer that replaces another continues from the newest checkpoint that verifies. In a planned handover
(`CARAWARE_SUCCESSOR`) the successor gets ready first, reports so on standard output, and starts when standard input
says so. Exit codes: `caraware.run.process`.
"""

import logging
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from caraware.run.process import HandoverRole, StopSignal, read_run, run_process

if TYPE_CHECKING:
    from caraware.learn.ranks import Ranks
    from caraware.run.config import RunConfig
    from caraware.run.learner import Learner

log = logging.getLogger("caraware.train")


def train(run_file: Path, stop: StopSignal, role: HandoverRole) -> None:
    """Train until the run ends. Imports are local so that a missing package is reported like any other failure."""
    from caraware.run.config import RunConfig
    from caraware.run.loop import TrainingLoop

    config = RunConfig.from_run(read_run(run_file))

    from caraware.ipc.channel import Channel
    from caraware.learn import ranks

    together = ranks.of_run(config.trainer.ranks)
    if role.replaces:
        learner = _successor(run_file, config, role)
        if role.gets_ready:
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
    if role.checkpoint is not None:
        loop.commit()
    if not loop.run():
        # The successor and the simulation wait for this process to end: torch would take seconds to tidy up.
        logging.shutdown()
        os._exit(0)
    together.close()


def _resumed(config: "RunConfig", ranks: "Ranks") -> "Learner | None":
    """A learner continued from the checkpoint that the run begins with; None if the run starts from the beginning."""
    from caraware.run.checkpoint import remove_partial
    from caraware.run.learner import Learner
    from caraware.run.manifest import read_manifest

    if config.resume_from is None:
        return None
    remove_partial(config.run_dir / "checkpoints")
    learner = Learner.begin(config, read_manifest(config.resume_from).observation_size, ranks)
    log.info("resumed from %s at tick %d", config.resume_from, learner.first_tick())
    return learner


def _successor(run_file: Path, config: "RunConfig", role: HandoverRole) -> "Learner | None":
    """A learner continued from the run's newest sound checkpoint; None if the supervisor cancels the handover."""
    from caraware import _native
    from caraware.run.checkpoint import remove_partial
    from caraware.run.learner import Learner
    from caraware.run.manifest import newest_sound_checkpoint

    size, folder = _native.observation_size(str(run_file)), config.run_dir / "checkpoints"
    if role.gets_ready:
        # Errors in the settings or the checkpoint show here, while the predecessor is still learning.
        trial = replace(config, resume_from=role.checkpoint or newest_sound_checkpoint(folder))
        Learner.begin(trial, size).warm_up()
        if not role.wait_for_turn():
            return None
    remove_partial(folder)
    newest = newest_sound_checkpoint(folder)
    learner = Learner.begin(replace(config, resume_from=newest or config.resume_from), size)
    log.info("continues from %s at tick %d", newest.name if newest else "the beginning", learner.first_tick())
    if role.checkpoint is not None:
        learner.take_parameters(role.checkpoint)
    return learner


def main(arguments: list[str]) -> int:
    """Run the trainer of one run file; returns the exit code of the process."""
    return run_process(arguments, train)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
