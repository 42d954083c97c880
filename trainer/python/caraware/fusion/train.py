"""`python -m caraware.fusion.train RUN_FILE`: the trainer process of the preset `fusion`.

The estimator runs on every tick as it comes, in training as in evaluations, and learns at the end of every training
episode. There nothing is carried on: all vehicles start again. So a checkpoint needs no state of filters, and a trainer
that continues from it ends in the same bytes. The handover between processes: `caraware.run.process`.
"""

import logging
import os
import sys
from pathlib import Path

from caraware.fusion.carrier import COLUMNS, Carrier
from caraware.fusion.estimating import FusionPlayer
from caraware.fusion.learner import FusionConfig, FusionLearner
from caraware.fusion.loop import Beginning, FusionLoop
from caraware.ipc.run_file import RunFile
from caraware.learn.config import ConfigError
from caraware.run.checkpoint import load_checkpoint, remove_partial
from caraware.run.config import RunConfig
from caraware.run.manifest import newest_sound_checkpoint
from caraware.run.process import HandoverRole, StopSignal, read_run, run_process

log = logging.getLogger(__name__)


def begin(run: RunFile, observation_size: int, resume_from: Path | None) -> tuple[RunConfig, FusionLearner, Beginning]:
    """The learner of a run file, new or continued. Raises `ConfigError` and `CheckpointError`."""
    config = RunConfig.from_run(run)
    if len(config.environments) > 1:
        raise ConfigError(
            f"`caraware.fusion.train` learns from one environment, the run has {len(config.environments)}",
            "start it without --envs",
        )
    learner = _learner(run, config, observation_size)
    checkpoint = resume_from or config.resume_from
    return config, learner, Beginning.load(checkpoint, learner) if checkpoint else Beginning()


def player(run: RunFile, config: RunConfig, observation_size: int) -> FusionPlayer:
    """The estimator of the checkpoint that a run of `caraware play` names. Raises `ConfigError`, `CheckpointError`."""
    learner = _learner(run, config, observation_size)
    assert config.resume_from is not None and config.sensors is not None
    load_checkpoint(config.resume_from, learner)
    centre_x_m, centre_y_m = learner.estimator.centre_m.tolist()
    return FusionPlayer(learner, Carrier(config.sensors, (centre_x_m, centre_y_m)))


def _learner(run: RunFile, config: RunConfig, observation_size: int) -> FusionLearner:
    fusion = FusionConfig.from_run(run)
    if config.sensors is None:
        raise ConfigError("the run file has no sensor tables", "start the trainer through `caraware train fusion`")
    return FusionLearner(config.trainer, fusion, fusion.pieces(run), config.bounds, observation_size)


def train(run_file: Path, stop: StopSignal, role: HandoverRole) -> None:
    """Train the estimator of one run file."""
    run = read_run(run_file)
    from caraware import _native
    from caraware.ipc.channel import Channel as SharedChannel

    size, folder = _native.observation_size(str(run_file)), Path(run["run_dir"]) / "checkpoints"
    if role.gets_ready:
        # Errors in the settings or the checkpoint show here, while the predecessor is still learning.
        begin(run, size, role.checkpoint or newest_sound_checkpoint(folder))
        if not role.wait_for_turn():
            return
    # Continue from the run's newest checkpoint, or from the one that the run begins with.
    remove_partial(folder)
    config, learner, beginning = begin(run, size, newest_sound_checkpoint(folder) if role.replaces else None)
    if role.checkpoint is not None:
        updates = learner.updates
        load_checkpoint(role.checkpoint, learner)
        learner.updates = updates
    log.info("%d columns, %s, %s", COLUMNS, config.trainer, learner.fusion)
    channel = SharedChannel(str(run_file), beginning.counters.committed_tick + 1)
    loop = FusionLoop(channel, config, learner, beginning, lambda: stop.requested, lambda: stop.leave_requested)
    if role.checkpoint is not None:
        loop.commit()
    if not loop.run():
        # The successor and the simulation wait for this process to end: torch would take seconds to tidy up.
        logging.shutdown()
        os._exit(0)


if __name__ == "__main__":
    sys.exit(run_process(sys.argv[1:], train))
