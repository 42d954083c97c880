"""One environment of a run as the training loop takes it: its ticks in order, and its share of the horizon.

Environments learn together but do not wait for each other tick by tick: each collects its share of the horizon from
its own ticks, and the update takes the shares in the order of the environments. So what is learnt depends on the
environments' own ticks alone, never on how they happen to arrive together.
"""

from collections import deque
from dataclasses import dataclass

from caraware.ipc.arrays import Float32Array
from caraware.ipc.stream import Channel, Observation
from caraware.learn.rollout import Rollout
from caraware.report.evaluation import Evaluation
from caraware.run.config import RunConfig
from caraware.run.estimates import Estimates


class TickLedger:
    """Counts the ticks that came, those that did not, and those that came twice."""

    def __init__(self, committed_tick: int | None) -> None:
        """`committed_tick` is the newest that a resumed run has learnt from; without, the first tick is any."""
        self.received = self.lost = self.duplicated = 0
        self.newest = committed_tick

    def first_sight(self, tick: int) -> bool:
        """Count `tick`; False if it came before."""
        if self.newest is not None:
            if tick <= self.newest:
                self.duplicated += 1
                return False
            self.lost += tick - self.newest - 1
        self.received += 1
        self.newest = tick
        return True


class EpisodeStarts:
    """At which tick episodes began: a simulation that goes on behind a tick begins with the episode of the next."""

    def __init__(self, episode: int = 0, tick: int = 0) -> None:
        self._starts = [(tick, episode)]

    def note(self, obs: Observation) -> None:
        """Note a tick of the run, in order."""
        if obs.episode != self._starts[-1][1]:
            self._starts.append((obs.tick, obs.episode))
        if obs.episode_last:
            self._starts.append((obs.tick + 1, obs.episode + 1))

    def behind(self, committed_tick: int) -> tuple[int, int]:
        """Episode of the tick behind `committed_tick`, and its first tick; what lies before is forgotten."""
        while len(self._starts) > 1 and self._starts[1][0] <= committed_tick + 1:
            del self._starts[0]
        tick, episode = self._starts[0]
        return episode, tick


@dataclass(frozen=True)
class Place:
    """How far one environment has come, up to a checkpoint."""

    committed_tick: int = -1
    """Newest tick that the parameters have learnt from; -1 before the first."""
    received_ticks: int = 0
    lost_ticks: int = 0
    duplicated_ticks: int = 0
    evaluated_tick: int = -1
    """Newest tick of the finished evaluations; -1 before the first."""
    next_episode: int = 0
    """The episode that the tick after the committed one belongs to: a resumed simulation begins there."""
    next_episode_tick: int = 0
    """The first tick of that episode."""


class Environment:
    """The stream of one environment."""

    def __init__(self, index: int, channel: Channel, config: RunConfig) -> None:
        self.index, self.channel, self._config = index, channel, config
        self.pending: deque[Observation] = deque()
        """Ticks that have come and not been looked at."""
        self.committed_tick = -1
        self.episode = 0
        self.ledger = TickLedger(None)
        self.starts = EpisodeStarts()
        self.evaluation: Evaluation | None = None
        self.evaluation_tick = self.evaluated_tick = -1
        """Newest tick of the open evaluation phase, and of those that are finished."""
        shown = config.sensors if config.shows_estimates() else None
        self._estimates = Estimates(shown) if shown else None
        self._received_last = False

    def estimates_m(self, obs: Observation) -> Float32Array | None:
        """f32 `[n, 2]`: the Kalman filter's positions (m, world), for whoever watches; None if it is not to run."""
        return self._estimates.position_m(obs) if self._estimates else None

    def start(self, place: Place, horizon: int, observation_size: int) -> None:
        """Go on from `place`, collecting `horizon` samples for every update."""
        self.committed_tick, self.evaluated_tick = place.committed_tick, place.evaluated_tick
        self.ledger = TickLedger(place.committed_tick if place.committed_tick >= 0 else None)
        self.ledger.received, self.ledger.lost = place.received_ticks, place.lost_ticks
        self.ledger.duplicated = place.duplicated_ticks
        self.starts = EpisodeStarts(place.next_episode, place.next_episode_tick)
        self.rollout = Rollout(
            horizon,
            observation_size,
            bootstrap=self._config.trainer.discount > 0,
            dark_is_nan=self._config.dark_is_nan,
        )

    def admit(self, ticks: list[Observation]) -> None:
        """Take over what the channel gave; what came before is only given back."""
        fresh = [obs for obs in ticks if self.ledger.first_sight(obs.tick)]
        if not fresh:
            self.channel.consumed(ticks[-1].tick)
        self.pending.extend(fresh)
        self._received_last |= ticks[-1].last

    @property
    def ended(self) -> bool:
        """Whether every tick of the run has been looked at."""
        return self._received_last and not self.pending

    @property
    def listens(self) -> bool:
        """Whether more ticks are to come."""
        return not self._received_last

    def place(self) -> Place:
        """How far it has come; ticks after the committed one do not count, they will be delivered again."""
        newest = self.ledger.newest
        beyond = 0 if newest is None else newest - self.committed_tick
        next_episode, next_episode_tick = self.starts.behind(self.committed_tick)
        return Place(
            committed_tick=self.committed_tick,
            received_ticks=self.ledger.received - beyond,
            lost_ticks=self.ledger.lost,
            duplicated_ticks=self.ledger.duplicated,
            evaluated_tick=self.evaluated_tick,
            next_episode=next_episode,
            next_episode_tick=next_episode_tick,
        )


def share(horizon: int, environments: int, index: int) -> int:
    """Samples of a horizon that environment `index` of `environments` collects: as even as can be."""
    return horizon // environments + (index < horizon % environments)
