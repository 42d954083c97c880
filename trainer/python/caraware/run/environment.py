"""One environment of a run as the training loop takes it: its ticks in order, and its share of the horizon.

Environments learn together but do not wait for each other tick by tick: each collects its share of the horizon from
its own ticks, and the update takes the shares in the order of the environments. So what is learned depends on the
environments' own ticks alone, never on how they happen to arrive together.
"""

from collections import deque

from caraware.ipc.arrays import Float32Array
from caraware.ipc.stream import Channel, Observation
from caraware.learn.rollout import Rollout
from caraware.run.config import RunConfig
from caraware.run.estimates import Estimates
from caraware.run.stream_position import StreamPosition, StreamProgress


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

    def estimates_m(self, obs: Observation) -> Float32Array | None:
        """f32 `[n, 2]`: the Kalman filter's positions (m, world), for viewers; None if it does not run."""
        return self._estimates.position_m(obs) if self._estimates else None

    def start(self, position: StreamPosition, horizon: int, observation_size: int) -> None:
        """Continue from `position`, collecting `horizon` samples for every update."""
        self.progress = StreamProgress(position)
        self.rollout = Rollout(
            horizon,
            observation_size,
            bootstrap=self._config.trainer.discount > 0,
            dark_is_nan=self._config.dark_is_nan,
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
