"""From which checkpoint and tick a learner continues, whichever learners were at work before it.

A learner continues from the newest of its own checkpoints that the record of commits counts, at the tick up to which
any learner has committed: what another has learnt meanwhile does not come again.
"""

import logging
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from caraware.ipc.commits import CommitLog, CommittedPosition
from caraware.run.checkpoint import TrainingHistory
from caraware.run.manifest import Counters, newest_update, read_manifest, sound_checkpoints
from caraware.run.stream_position import StreamPosition

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Continuation:
    """Where a learner continues."""

    checkpoint: Path | None = None
    """Its newest that counts; None if it has none."""
    others: tuple[CommittedPosition, ...] = ()
    """Up to where other learners have learnt, in each environment; empty if none has."""
    updates: int = 0
    """Updates in the newest checkpoint of the run, whichever learner wrote it."""

    @classmethod
    def find(cls, folder: Path, commits: CommitLog, learner: str) -> "Continuation":
        """Where `learner` continues in the run with these checkpoints and commits. Raises `CommitLogError`."""
        others = commits.newest_of_others(learner)
        newest = next(own_checkpoints(folder, commits, learner), None)
        return cls(newest, others.positions if others else (), newest_update(folder))

    def follow(self, counters: Counters, history: TrainingHistory) -> tuple[Counters, TrainingHistory]:
        """How far training has come, with what other learners have learnt since the checkpoint."""
        own = [history.first_position(counters), *history.others]
        known = [own[i] if i < len(own) else StreamPosition() for i in range(max(len(own), len(self.others)))]
        after = [p.after(self.others[i]) if i < len(self.others) else p for i, p in enumerate(known)]
        if after == known:
            return counters, history
        first, *rest = after
        counters = replace(
            counters,
            updates=max(counters.updates, self.updates),
            committed_tick=first.committed_tick,
            next_episode=first.next_episode,
            next_episode_tick=first.next_episode_tick,
        )
        return counters, replace(history, received_ticks=first.received_ticks, others=rest)

    def first_tick(self) -> int:
        """The first tick of environment 0 that this learner receives, as far as is known before it continues."""
        own = read_manifest(self.checkpoint).counters.committed_tick + 1 if self.checkpoint else 0
        return max([own, *(position.ticks for position in self.others[:1])])


def own_checkpoints(folder: Path, commits: CommitLog, learner: str) -> Iterator[Path]:
    """Checkpoints of `learner` that verify and count, the newest first. Raises `CommitLogError`."""
    for checkpoint in sound_checkpoints(folder):
        manifest = read_manifest(checkpoint)
        if manifest.learner == learner and commits.counts(learner, manifest.counters.committed_tick + 1):
            yield checkpoint


def remove_uncommitted(folder: Path, commits: CommitLog, learner: str) -> None:
    """Remove checkpoints of `learner` that it wrote but never committed: another learner has learnt those ticks."""
    for checkpoint in sound_checkpoints(folder):
        manifest = read_manifest(checkpoint)
        if manifest.learner == learner and not commits.counts(learner, manifest.counters.committed_tick + 1):
            log.warning("%s was never committed, and another learner has learnt its ticks: removed", checkpoint.name)
            shutil.rmtree(checkpoint)
