"""How far the stream of one environment has come: ticks seen, episodes begun, ticks learned and evaluated."""

from dataclasses import dataclass, replace

from caraware.ipc.commits import CommittedPosition, EpisodeStarts


class TickLedger:
    """Counts the ticks that came, those that did not, and those that came twice."""

    def __init__(self, committed_tick: int | None) -> None:
        """`committed_tick` is the newest that a resumed run has learned from; without, the first tick is any."""
        self.received = self.lost = self.duplicated = 0
        self.newest = committed_tick

    def first_sight(self, tick: int) -> bool:
        """Count `tick`; False if it has come before."""
        if self.newest is not None:
            if tick <= self.newest:
                self.duplicated += 1
                return False
            self.lost += tick - self.newest - 1
        self.received += 1
        self.newest = tick
        return True


@dataclass(frozen=True)
class StreamPosition:
    """How far one environment has come, up to a checkpoint."""

    committed_tick: int = -1
    """Newest tick that the parameters have learned from; -1 before the first."""
    received_ticks: int = 0
    lost_ticks: int = 0
    duplicated_ticks: int = 0
    evaluated_tick: int = -1
    """Newest tick of the finished evaluations; -1 before the first."""
    next_episode: int = 0
    """The episode that the tick after the committed one belongs to: a resumed simulation begins there."""
    next_episode_tick: int = 0
    """The first tick of that episode."""

    def committed(self) -> CommittedPosition:
        """As the record of commits has it."""
        return CommittedPosition(self.committed_tick + 1, self.next_episode, self.next_episode_tick)

    def after(self, others: CommittedPosition) -> "StreamPosition":
        """At least where other learners have come: what they have learnt has been received."""
        ticks = others.ticks - (self.committed_tick + 1)
        if ticks <= 0:
            return self
        return replace(
            self,
            committed_tick=others.ticks - 1,
            received_ticks=self.received_ticks + ticks,
            evaluated_tick=max(self.evaluated_tick, others.ticks - 1),
            next_episode=others.episode,
            next_episode_tick=others.episode_tick,
        )


class StreamProgress:
    """The position of a running stream, continued from that of a checkpoint."""

    def __init__(self, position: StreamPosition | None = None) -> None:
        position = position or StreamPosition()
        self.committed_tick, self.evaluated_tick = position.committed_tick, position.evaluated_tick
        self.ledger = TickLedger(position.committed_tick if position.committed_tick >= 0 else None)
        self.ledger.received, self.ledger.lost = position.received_ticks, position.lost_ticks
        self.ledger.duplicated = position.duplicated_ticks
        self.starts = EpisodeStarts(position.next_episode, position.next_episode_tick)

    def position(self) -> StreamPosition:
        """For a checkpoint. Ticks after the committed one do not count: they will be delivered again."""
        newest = self.ledger.newest
        beyond = 0 if newest is None else newest - self.committed_tick
        next_episode, next_episode_tick = self.starts.after(self.committed_tick)
        return StreamPosition(
            committed_tick=self.committed_tick,
            received_ticks=self.ledger.received - beyond,
            lost_ticks=self.ledger.lost,
            duplicated_ticks=self.ledger.duplicated,
            evaluated_tick=self.evaluated_tick,
            next_episode=next_episode,
            next_episode_tick=next_episode_tick,
        )
