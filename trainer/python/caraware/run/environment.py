"""One environment of a run as the training loop takes it: its ticks in order, and its share of the horizon.

Environments learn together but do not wait for each other tick by tick: each collects its share of the horizon from
its own ticks, and the update takes the shares in the order of the environments. So what is learned depends on the
environments' own ticks alone, never on how they happen to arrive together.
"""

from collections import deque

from caraware.ipc.arrays import Float32Array
from caraware.ipc.stream import Channel, Observation
from caraware.learn.config import BuiltInNetwork
from caraware.learn.rollout import Rollout
from caraware.run.config import RunConfig
from caraware.run.estimates import Estimates
from caraware.run.stream_position import StreamPosition, StreamProgress
from caraware.run.trips import TripCounts
from caraware.tasks.contract import Sampling

AWAITED_LAG_TICKS = 4
"""In lock-step the process that waits for actions is two ticks ahead of the one that is consumed, at most; farther
ahead, the tick was answered before."""


class Environment:
    """The stream of one environment."""

    def __init__(self, index: int, channel: Channel, config: RunConfig) -> None:
        self.index, self.channel, self._config = index, channel, config
        self.pending: deque[Observation] = deque()
        """Ticks that have come and are not processed yet."""
        self.progress = StreamProgress()
        self.episode = 0
        shown = config.sensors if config.shows_estimates() else None
        self._estimates = Estimates(shown) if shown else None
        self._received_last = False
        self.trips = TripCounts()
        """How the trips of heroes ended."""
        self._catches_up = True
        self.answered_by_another = -1
        """The newest tick whose actions another policy may have drawn: nothing is learnt up to it. -1: none."""

    def is_awaited(self, obs: Observation) -> bool:
        """Whether the world waits for the actions of a tick. Ticks that come again were answered by a predecessor.

        Once the trainer has caught up, every tick is awaited.
        """
        if self._catches_up:
            self._catches_up = self.channel.actor_lag_ticks() > AWAITED_LAG_TICKS
        return not self._catches_up

    def estimates_m(self, obs: Observation) -> Float32Array | None:
        """f32 `[n, 2]`: the Kalman filter's positions (m, world), for viewers; None if it does not run."""
        return self._estimates.position_m(obs) if self._estimates else None

    def start(
        self, position: StreamPosition, horizon: int, observation_size: int, *, follows_another: bool = False
    ) -> None:
        """Continue from `position`, collecting `horizon` samples for every update.

        `follows_another`: another policy drove before. Of the ticks that come again, the world has gone on with its
        actions, up to the newest that the process that waits for actions has finished.
        """
        self.progress = StreamProgress(position)
        task = self._config.task
        sees = self._config.trainer.network is BuiltInNetwork.CNN
        drawn = task.actions.size if task.sampling is Sampling.EACH_TICK else 0
        if drawn and follows_another:
            self.answered_by_another = position.committed_tick + self.channel.actor_lag_ticks()
        self.rollout = Rollout(
            horizon,
            observation_size,
            bootstrap=self._config.trainer.discount > 0 or drawn > 0,
            dark_is_nan=self._config.dark_is_nan,
            drawn_actions=drawn,
            images=self._config.trainer.images if sees else None,
            leading=self._config.trainer.frames - 1,
        )

    def admit(self, ticks: list[Observation]) -> None:
        """Queue the ticks that are new; of those that have come before, only the credit is returned."""
        fresh = [obs for obs in ticks if self.progress.ledger.first_sight(obs.tick)]
        if not fresh:
            self.channel.consumed(ticks[-1].tick)
        self.pending.extend(fresh)
        self._received_last |= ticks[-1].last

    @property
    def ended(self) -> bool:
        """Whether every tick of the run has been processed."""
        return self._received_last and not self.pending

    @property
    def listens(self) -> bool:
        """Whether more ticks are to come."""
        return not self._received_last


def share(horizon: int, environments: int, index: int) -> int:
    """Samples of a horizon that environment `index` of `environments` collects: as even as can be."""
    return horizon // environments + (index < horizon % environments)
