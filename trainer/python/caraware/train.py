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

from caraware.run.process import HandoverRole, StopSignal, SuccessorClaims, read_run, run_process

if TYPE_CHECKING:
    from caraware.ipc.channel import Channel
    from caraware.learn.meeting import Meeting
    from caraware.learn.ranks import Ranks
    from caraware.run.config import RunConfig
    from caraware.run.learner import Learner

log = logging.getLogger("caraware.train")


def train(run_file: Path, stop: StopSignal, role: HandoverRole) -> None:
    """Train until the run ends. Imports are local so that a missing package is reported like any other failure."""
    from caraware.run.config import RunConfig
    from caraware.run.loop import TrainingLoop

    config = RunConfig.from_run(read_run(run_file))

    from caraware import _native
    from caraware.ipc.channel import Channel
    from caraware.learn import ranks
    from caraware.learn.waiting import WaitNotes

    if role.gets_ready and not _get_ready(run_file, config, role):
        return
    # Before the meeting: the supervisor must know that a trainer that waits there lives.
    place = _native.Place(str(run_file)) if config.trainer.ranks > 1 else None
    notes = WaitNotes(place)
    meeting = _meeting(config, role, stop) if config.trainer.ranks > 1 else None
    together = ranks.of_run(config.trainer.ranks, meeting, notes)
    if meeting is not None and meeting.is_over:
        _receive_the_rest(Channel(str(run_file), place=place), config, stop)
        return
    if meeting is not None:
        _forget_uncommon(config.run_dir / "checkpoints", meeting, stop)
    learner = _successor(run_file, config, role, together) if role.replaces else _resumed(config, together)
    first_ticks = [learner.first_tick(index) if learner else 0 for index in range(len(config.environments))]
    if learner is not None:
        positions = enumerate(position.committed() for position in learner.positions())
        config.commits.begin(learner.shape().learner, dict(positions), lambda: stop.requested)
    channel = Channel(str(run_file), first_ticks[0], place=place)
    if place is not None:
        notes.board = channel
    loop = TrainingLoop(
        channel,
        config,
        lambda: stop.requested,
        others=[channel.in_environment(index, tick) for index, tick in enumerate(first_ticks) if index > 0],
        leave_requested=lambda: stop.leave_requested,
        leave_now_requested=lambda: stop.leave_now_requested,
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


def _meeting(config: "RunConfig", role: HandoverRole, stop: StopSignal) -> "Meeting":
    """The meeting with the trainers of the other ranks, at which this one names its checkpoints."""
    from caraware.learn.meeting import Attendance, Meeting
    from caraware.run.manifest import sound_checkpoints

    names = tuple(checkpoint.name for checkpoint in sound_checkpoints(config.run_dir / "checkpoints"))
    return Meeting(Attendance(role.incarnation, role.handovers, names), lambda: stop.requested)


def _forget_uncommon(folder: Path, meeting: "Meeting", stop: StopSignal) -> None:
    """Remove checkpoints that only some ranks have: an update counts when all ranks have committed it."""
    from caraware.run.checkpoint import remove_newer
    from caraware.run.manifest import BEGINNING, NEWEST

    if meeting.continues():
        remove_newer(folder, meeting.common_checkpoint(), lambda: stop.requested)
    elif newest := os.environ.get(NEWEST):
        # The first trainers of runs that were resumed.
        remove_newer(folder, None if newest == BEGINNING else newest, lambda: stop.requested)


def _receive_the_rest(channel: "Channel", config: "RunConfig", stop: StopSignal) -> None:
    """Receive what is left of the run after all ranks have written their results."""
    from caraware.ipc.channel import StreamEndedError

    log.info("all ranks had written their results before this trainer came")
    waiting = [channel, *(channel.in_environment(index) for index in range(1, len(config.environments)))]
    while waiting and not stop.requested:
        for environment in list(waiting):
            try:
                for observation in environment.receive(0.0):
                    environment.consumed(observation.tick)
            except StreamEndedError:
                environment.done()
                waiting.remove(environment)
        channel.wait_for_any(0.2)


def _resumed(config: "RunConfig", ranks: "Ranks") -> "Learner | None":
    """A learner continued from the checkpoint that the run begins with; None if the run starts from the beginning."""
    from caraware.learn.stored import PPO
    from caraware.run.checkpoint import remove_partial
    from caraware.run.continuation import Continuation
    from caraware.run.learner import Learner
    from caraware.run.manifest import read_manifest

    if config.resume_from is None:
        return None
    folder = config.run_dir / "checkpoints"
    remove_partial(folder)
    found = Continuation.find(folder, config.commits, PPO)
    # In a run in which other learners took turns, the checkpoint that it is resumed from may be another's.
    resume_from = found.checkpoint if found.others else config.resume_from
    size = read_manifest(config.resume_from).observation_size
    learner = Learner.begin(replace(config, resume_from=resume_from), size, ranks)
    learner.follow(found)
    log.info("resumed from %s at tick %d", resume_from or "the beginning", learner.first_tick())
    return learner


def _get_ready(run_file: Path, config: "RunConfig", role: HandoverRole) -> bool:
    """Find errors in settings or checkpoint while the predecessor learns; False if the handover is cancelled."""
    from caraware import _native
    from caraware.learn.stored import PPO
    from caraware.run.continuation import Continuation
    from caraware.run.learner import Learner

    size = _native.observation_size(str(run_file))
    found = Continuation.find(config.run_dir / "checkpoints", config.commits, PPO)
    Learner.begin(replace(config, resume_from=role.checkpoint or found.checkpoint), size).warm_up()
    claims = SuccessorClaims(
        observation_size=size,
        task=config.task.name,
        action_size=config.task.actions.size,
        environments=len(config.environments),
        decides_lessons=True,
        first_tick=found.first_tick(),
    )
    return role.wait_for_turn(claims)


def _successor(run_file: Path, config: "RunConfig", role: HandoverRole, ranks: "Ranks") -> "Learner":
    """A learner continued from the run's newest sound checkpoint."""
    from caraware import _native
    from caraware.learn.stored import PPO
    from caraware.run.checkpoint import remove_partial
    from caraware.run.continuation import Continuation, remove_uncommitted
    from caraware.run.learner import Learner

    size, folder = _native.observation_size(str(run_file)), config.run_dir / "checkpoints"
    remove_partial(folder)
    remove_uncommitted(folder, config.commits, PPO)
    found = Continuation.find(folder, config.commits, PPO)
    # Before the first checkpoint of the run it is the one that the run begins with.
    beginning = None if found.others else config.resume_from
    learner = Learner.begin(replace(config, resume_from=found.checkpoint or beginning), size, ranks)
    learner.follow(found)
    name = found.checkpoint.name if found.checkpoint else "the beginning"
    log.info("continues from %s at tick %d", name, learner.first_tick())
    if role.checkpoint is not None:
        learner.take_parameters(role.checkpoint)
    return learner


def main(arguments: list[str]) -> int:
    """Run the trainer of one run file; returns the exit code of the process."""
    return run_process(arguments, train)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
