"""`python -m caraware.fusion.train RUN_FILE`: the trainer process of the preset `fusion`.

The estimator runs on every tick as it comes, in training as in evaluations, and learns at the end of every training
episode. There nothing is carried on: all vehicles start again. So a checkpoint needs no state of filters, and a trainer
that continues from it ends in the same bytes. The handover between processes: `caraware.run.process`.
"""

import logging
import os
import sys
from dataclasses import replace
from pathlib import Path

from caraware.fusion.carrier import COLUMNS
from caraware.fusion.estimating import FusionPlayer
from caraware.fusion.learner import FusionConfig, FusionLearner
from caraware.fusion.loop import Beginning, FusionLoop
from caraware.fusion.past import FOLDER, Past
from caraware.ipc.commits import CommitLog
from caraware.ipc.run_file import RunFile
from caraware.learn.config import ConfigError
from caraware.learn.stored import FUSION
from caraware.run.checkpoint import load_checkpoint, remove_partial
from caraware.run.config import RunConfig
from caraware.run.continuation import Continuation, remove_uncommitted
from caraware.run.process import HandoverRole, StopSignal, SuccessorClaims, read_run, run_process

log = logging.getLogger(__name__)


def begin(run: RunFile, observation_size: int, found: Continuation) -> tuple[RunConfig, FusionLearner, Beginning]:
    """The learner of a run file, new or continued. Raises `ConfigError` and `CheckpointError`."""
    config = RunConfig.from_run(run)
    if len(config.environments) > 1:
        raise ConfigError(
            f"`caraware.fusion.train` learns from one environment, the run has {len(config.environments)}",
            "start it without --envs",
        )
    learner = _learner(run, config, observation_size, Past(config.run_dir / FOLDER))
    # Before the first checkpoint of the run it is the one that the run begins with.
    checkpoint = found.checkpoint or (None if found.others else config.resume_from)
    beginning = Beginning.load(checkpoint, learner) if checkpoint else Beginning()
    return config, learner, beginning.follow(found, learner)


def player(run: RunFile, config: RunConfig, observation_size: int) -> FusionPlayer:
    """The estimator of the checkpoint that a run of `caraware play` names. Raises `ConfigError`, `CheckpointError`."""
    learner = _learner(run, config, observation_size)
    assert config.resume_from is not None and config.sensors is not None
    load_checkpoint(config.resume_from, learner)
    return FusionPlayer(learner, learner.carrier(config.sensors))


def _learner(run: RunFile, config: RunConfig, observation_size: int, past: Past | None = None) -> FusionLearner:
    fusion = FusionConfig.from_run(run)
    if config.sensors is None:
        raise ConfigError("the run file has no sensor tables", "start the trainer through `caraware train fusion`")
    return FusionLearner(config.trainer, fusion, fusion.pieces(run), config.bounds, observation_size, past)


def train(run_file: Path, stop: StopSignal, role: HandoverRole) -> None:
    """Train the estimator of one run file."""
    run = read_run(run_file)
    from caraware import _native
    from caraware.ipc.channel import Channel as SharedChannel

    size, folder = _native.observation_size(str(run_file)), Path(run["run_dir"]) / "checkpoints"
    commits = CommitLog(run)
    if role.gets_ready:
        # Errors in the settings or the checkpoint show here, while the predecessor is still learning.
        found = Continuation.find(folder, commits, FUSION)
        begin(run, size, replace(found, checkpoint=role.checkpoint or found.checkpoint))
        claims = SuccessorClaims(
            observation_size=size,
            task="localisation",
            environments=1,
            decides_lessons=False,
            first_tick=found.first_tick(),
        )
        if not role.wait_for_turn(claims):
            return
    remove_partial(folder)
    if role.replaces:
        remove_uncommitted(folder, commits, FUSION)
    found = Continuation.find(folder, commits, FUSION)
    if not (role.replaces or found.others):
        # The supervisor has chosen the checkpoint that a resumed run begins with.
        found = replace(found, checkpoint=None)
    config, learner, beginning = begin(run, size, found)
    if role.checkpoint is not None:
        updates = learner.updates
        load_checkpoint(role.checkpoint, learner)
        learner.updates = updates
    log.info("%d columns, %s, %s", COLUMNS, config.trainer, learner.fusion)
    position = beginning.history.first_position(beginning.counters).committed()
    commits.begin(FUSION, {0: position}, lambda: stop.requested)
    channel = SharedChannel(str(run_file), position.ticks)
    loop = FusionLoop(
        channel,
        config,
        learner,
        beginning,
        lambda: stop.requested,
        lambda: stop.leave_requested,
        lambda: stop.leave_now_requested,
    )
    if role.checkpoint is not None:
        loop.commit()
    if not loop.run():
        # The successor and the simulation wait for this process to end: torch would take seconds to tidy up.
        logging.shutdown()
        os._exit(0)


if __name__ == "__main__":
    sys.exit(run_process(sys.argv[1:], train))
