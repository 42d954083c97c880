"""The one loop behind all faces: answers a tick, takes the next, and returns how trajectories continued.

A slot at tick k + 1 shows how the trajectory that held it at k ended; by then a new one may hold it. So a step from k
to k + 1 gives, for each slot, the reward of k's action, whether k was the last tick of its trajectory, and the row of
k + 1, which is that of another vehicle where a trajectory ended.
"""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from caraware.envs import rewards
from caraware.envs.evaluation import EvaluationMeans
from caraware.envs.rendering import RgbImage
from caraware.envs.settings import FaceSettings
from caraware.envs.simulation import SimulationError
from caraware.envs.transition import Rows, Transition
from caraware.ipc.arrays import (
    BoolArray,
    Float32Array,
    Float64Array,
    FloatArray,
    Int64Array,
    Scalar,
    UInt32Array,
    UInt64Array,
)
from caraware.ipc.channel import StreamEndedError
from caraware.ipc.report_part import write_entries
from caraware.ipc.run_file import setting
from caraware.ipc.stream import EMPTY_SLOT, Channel, Observation
from caraware.tasks.contract import Sampling

if TYPE_CHECKING:
    from caraware.envs.picture import MapPicture

log = logging.getLogger(__name__)

RUN_ON_TICKS = 2000
"""A reset in an episode with more ticks left than this starts a new run instead of running on to the end."""
REPORT_S = 1.0
"""Time between two reports of the status."""

Policy = Callable[[Float32Array], Float32Array]
"""`observation f32 [N, d] -> action [N, 2]`."""


class RunEndedError(Exception):
    """The last tick of a run that `caraware` started has been taken: there is nothing to step any more."""


class Source(Protocol):
    """Where ticks come from."""

    can_restart: bool
    current: Observation | None
    """The tick received last. No other object may keep it: the memory of a run must be released before its end."""

    @property
    def channel(self) -> Any:
        """The trainer's place in the present run: a `Channel` that takes actions too."""

    @property
    def seed(self) -> int:
        """Seed of the present run."""

    def receive(self) -> Observation | None:
        """The next tick, or None after the last of the run."""

    def is_passed(self) -> bool:
        """The world has gone on with another policy's answer to the current tick: nothing can be learnt from it."""

    def restart(self, seed: int | None = None) -> None:
        """Begin another run, where that is possible; there is no current tick then until one is received."""

    def close(self, part: dict[str, Any] | None = None) -> None:
        """Leave the run; `part` goes into its report."""


class GivenChannel:
    """A channel that is open already, in a process that the supervisor started by `trainer.module`."""

    can_restart = False

    def __init__(self, channel: Channel) -> None:
        self.channel, self.seed = channel, setting(channel.run, "run.seed", int)
        self.current: Observation | None = None
        self._queue: list[Observation] = []
        # Where a run is taken over, what comes before the first tick is the predecessor's.
        self._last, self._newest = False, getattr(channel, "first_tick", 0) - 1
        self.lost_ticks = self.duplicated_ticks = 0
        self._passed_until = -1
        # A world that waits for actions is one tick ahead of a learner at most, but for what a predecessor answered.
        if channel.actor_lag_ticks() > 1:
            self._passed_until = self._newest + channel.actor_lag_ticks()
            log.info("ticks up to %d were driven by another policy, and are not learnt from", self._passed_until)

    def receive(self) -> Observation | None:
        """The next tick, or None after the last of the run."""
        self.current = None
        while not self._queue and not self._last:
            try:
                self._queue = list(self.channel.receive(0.2))[::-1]
            except StreamEndedError:
                self._last = True
        if not self._queue:
            return None
        self.current = self._queue.pop()
        self.lost_ticks += max(self.current.tick - self._newest - 1, 0)
        self.duplicated_ticks += self.current.tick <= self._newest
        self._last, self._newest = self.current.last, self.current.tick
        return self.current

    def is_passed(self) -> bool:
        """The world has gone on with what a predecessor answered to the current tick."""
        return self.current is not None and self.current.tick <= self._passed_until

    def restart(self, seed: int | None = None) -> None:
        """Never called: the run is its supervisor's."""
        raise RunEndedError

    def close(self, part: dict[str, Any] | None = None) -> None:
        """Write the trainer's part of the report; say that all is done, if it is."""
        if part is not None:
            part = part | {"lost_ticks": self.lost_ticks, "duplicated_ticks": self.duplicated_ticks}
            write_entries(Path(self.channel.run["run_dir"]), part)
        if self._last:
            # There will be no successor that could want old ticks.
            self.channel.committed(self._newest)
            self.channel.done()


@dataclass(frozen=True)
class Tick:
    """One tick of all N slots, copied out of shared memory; rows without a vehicle are zero."""

    over: bool
    """True beyond the end of the run: there is nothing to answer."""
    evaluation: bool
    sim_time_ns: int
    episode: tuple[int, int]
    """Number of the run and of the episode in it."""
    rows: Rows
    mask: BoolArray
    vehicle: UInt32Array
    id_hash: UInt64Array
    terminated: BoolArray
    """Of the trajectory that held the slot a tick before."""
    truncated: BoolArray
    ended_by: Int64Array
    """Bits of `caraware.tasks.ends`."""


class Slots:
    """All slots of a source of ticks, stepped together."""

    def __init__(
        self,
        source: Source | Channel,
        num_envs: int | None = None,
        reward: rewards.Reward | None = None,
        evaluation_policy: Policy | None = None,
        *,
        of_scenario: int | None = None,
    ) -> None:
        """`of_scenario` is the number of slots where neither `num_envs` nor the configuration says one.

        Raises `ValueError` where none of the three does.
        """
        self.source: Source = source if hasattr(source, "can_restart") else GivenChannel(source)  # type: ignore[assignment]
        self.settings = FaceSettings.from_run(self.source.channel.run)
        self.task = self.settings.task
        wanted = num_envs or self.settings.slots or of_scenario
        if not wanted:
            raise ValueError("a scenario does not say how many vehicles sense at a time: give num_envs")
        self.count = int(wanted)
        self._reward = reward or rewards.of_task(self.task)
        self._evaluation_policy, self._evaluation = evaluation_policy, EvaluationMeans(self.task)
        self._idle = np.zeros((self.count, self.task.actions.size), np.float32)
        self._runs, self._answered = 0, -1
        # Another face may have stepped the source before.
        self._untouched = self.source.current is None or self.source.current.tick == 0
        self._stepped, self._warned_narrow, self._closed = True, False, False
        self._now: Tick | None = None
        self._env_steps, self._reported = 0, (time.monotonic(), 0)
        self._picture: MapPicture | None = None

    @property
    def world_waits(self) -> bool:
        """The simulation waits for the action of every tick."""
        return self.task.sampling is Sampling.EACH_TICK

    @property
    def now(self) -> Tick:
        """The tick to be answered next."""
        self._refuse_closed()
        if self._now is None:
            raise RuntimeError("call reset() before step() and render()")
        return self._now

    @property
    def over(self) -> bool:
        """True beyond the end of a run that cannot be started again."""
        return self._now is not None and self._now.over

    def reset(self, seed: int | None) -> Tick:
        """The first tick of a run with `seed`; without, of the next episode."""
        self._refuse_closed()
        if seed is not None and not (self._untouched and seed == self.source.seed):
            self._reseed(int(seed))
        self._refuse_end()
        if self._now is None:
            waiting = self.source.current
            self._now = self._settle(self._take() if waiting is None else self._copied(waiting))
        if self._stepped and not self._untouched and not self.over:
            self._now = self._next_episode(self._now)
        self._stepped = False
        self._refuse_end()
        return self.now

    def seek(self, slot: int) -> Tick:
        """Runs on to the first tick at which `slot` holds a vehicle."""
        while not self.now.mask[slot]:
            self._refuse_end()
            self._answer(self._idle)
            self._now = self._settle(self._take())
        return self.now

    def step(self, action: FloatArray) -> tuple[Transition, Float64Array]:
        """Answers the present tick with actions `[N, 2]` and continues to the next.

        Returns what happened and its rewards, f64 `[N]`.
        """
        now = self.now
        self._refuse_end()
        action = self._checked(action)
        self._answer(action)
        following = self._take()
        self._untouched, self._stepped = False, True
        transition = self._transition(now, following)
        self._env_steps += int(np.count_nonzero(now.mask))
        with np.errstate(all="ignore"):
            rewards_ = np.asarray(self._reward(transition, action), np.float64)
        if rewards_.shape != (self.count,):
            raise ValueError(f"the reward function gave shape {rewards_.shape}, one number a slot is ({self.count},)")
        self._now = self._settle(following)
        self._show()
        return transition, np.where(now.mask, rewards_, 0.0)

    def render(self, slot: int | None = None) -> RgbImage:
        """The map from above with the vehicles of the tick, that in `slot` in another colour: u8 `[H, W, 3]`."""
        if self._picture is None:
            from caraware.envs.picture import MapPicture  # a learner that draws nothing needs no drawing libraries

            self._picture = MapPicture(self.source.channel.run)
        return self._picture.draw(self.now.rows, self.now.mask, slot)

    @property
    def answered(self) -> int:
        """Newest tick that has been answered; -1 before the first."""
        return self._answered

    def commit(self) -> None:
        """Your saved state contains what was learned so far: earlier ticks never come again (`Channel.commit`)."""
        if self._answered >= 0:
            self.source.channel.commit(self._answered)

    def close(self) -> None:
        """Leaves the run; what the environment is asked for after that is refused."""
        self._closed, self._now = True, None
        self.source.close(self._part())

    def _reseed(self, seed: int) -> None:
        if not self.source.can_restart:
            started = f"caraware started it, with `run.seed` {self.source.seed}"
            message = f"seed {seed} cannot start this run again: {started}"
            warnings.warn(message, stacklevel=4)
            return
        self._now, self._untouched = None, True
        self.source.restart(seed)
        self._runs, self._answered = self._runs + 1, -1

    def _checked(self, action: FloatArray) -> Float32Array:
        action = np.asarray(action, np.float32)
        if action.shape != (self.count, self.task.actions.size):
            raise ValueError(
                f"actions of shape {action.shape}, {self.count} slots take ({self.count}, {self.task.actions.size})"
            )
        return action

    def _refuse_closed(self) -> None:
        if self._closed:
            raise SimulationError("the environment has been closed: make another one")

    def _refuse_end(self) -> None:
        if self.over:
            raise RunEndedError("the run has ended: its last tick has been answered")

    def _next_episode(self, tick: Tick) -> Tick:
        if self.source.can_restart and self._ticks_left(tick) > RUN_ON_TICKS:
            self._restart()
            return self._settle(self._take())
        episode = tick.episode
        while tick.episode == episode:
            self._answer(self._idle)
            tick = self._settle(self._take())
        return tick

    def _ticks_left(self, tick: Tick) -> float:
        return self.settings.episode_ticks - tick.sim_time_ns / (self.settings.tick_s * 1e9)

    def _restart(self) -> None:
        self.source.restart()
        self._runs, self._answered = self._runs + 1, -1

    def _take(self) -> Tick | None:
        """The next tick of the run, or None after its last."""
        obs = self.source.receive()
        return None if obs is None else self._copied(obs)

    def _settle(self, tick: Tick | None) -> Tick:
        """Runs on to the first tick that asks for a decision.

        It is not an evaluation's, has a vehicle in some slot, and no predecessor has answered it.
        """
        while True:
            if tick is None:
                if not self.source.can_restart:
                    return self._end_of_run()
                self._restart()
            elif self.source.is_passed():
                self._answer(self._idle)
            elif tick.evaluation:
                self._evaluate(tick)
            elif tick.mask.any():
                return tick
            else:
                self._answer(self._idle)
            tick = self._take()

    def _evaluate(self, tick: Tick) -> None:
        """Answers a tick of an evaluation; no learner sees it."""
        if self._evaluation_policy is None:
            self._answer(self._idle, publish=self.world_waits)
            return
        if self._evaluation.episode is None or tick.episode[1] > self._evaluation.episode + 1:
            self._evaluation = EvaluationMeans(self.task)
        action = self._checked(self._evaluation_policy(tick.rows.observation))
        self._answer(action)
        self._evaluation.add(tick.episode[1], tick.rows, tick.mask, action)

    def _answer(self, action: Float32Array, *, publish: bool = True) -> None:
        """Answers the tick received last, once: an interrupted step may be taken again."""
        obs, channel = self.source.current, self.source.channel
        if obs is None:
            return
        self.source.current, self._answered = None, obs.tick
        if publish:
            rows = self.settings.answer(action, len(obs.vehicle), obs.observation)
            if self.world_waits:
                channel.publish_actions(obs, rows)
            else:
                channel.publish_predictions(obs, torch.from_numpy(rows), 0)
        if obs.last or (obs.tick + 1) % self.settings.credit_ticks == 0:
            channel.consumed(obs.tick)
            if self.source.can_restart:
                # Old ticks are never delivered again: the run does not outlive this process.
                channel.committed(obs.tick)

    def _copied(self, obs: Observation) -> Tick:
        n = self.count
        vehicle = _padded(obs.vehicle, n, EMPTY_SLOT)
        mask = _padded(obs.valid, n) & (vehicle != EMPTY_SLOT)
        observation = _padded(_array(obs, "observation"), n)
        if self.settings.dark_is_nan:
            np.nan_to_num(observation, copy=False)
        if observation.shape[1] != self.settings.width:
            raise ValueError(f"rows of {observation.shape[1]} numbers, the run file says {self.settings.width}")
        truth, gnss_m = _padded(_array(obs, "truth"), n), _padded(_array(obs, "gnss_m")[:, :2], n)
        if not mask.all():
            for rows in (observation, truth, gnss_m):
                rows[~mask] = 0
        if len(obs.vehicle) > n and not self._warned_narrow and np.any(obs.vehicle[n:] != EMPTY_SLOT):
            log.warning("%d slots, of which this environment has the first %d", len(obs.vehicle), n)
            self._warned_narrow = True
        return Tick(
            over=False,
            evaluation=obs.evaluation,
            sim_time_ns=obs.sim_time_ns,
            episode=(self._runs, obs.episode),
            rows=Rows(self.settings, observation, truth, gnss_m),
            mask=mask,
            vehicle=vehicle,
            id_hash=_padded(getattr(obs, "id_hash", obs.vehicle).astype(np.uint64), n),
            terminated=_padded(obs.terminated, n),
            truncated=_padded(obs.truncated, n),
            ended_by=_padded(obs.ended_by.astype(np.int64), n),
        )

    def _end_of_run(self) -> Tick:
        """The tick without vehicles after the last tick of a run."""
        n, none = self.count, np.zeros(self.count, bool)
        zeros = [np.zeros((n, width), np.float32) for width in (self.settings.width, 4, 2)]
        vehicle = np.full(n, EMPTY_SLOT, np.uint32)
        ids = np.zeros(n, np.uint64)
        episode, rows = (self._runs + 1, 0), Rows(self.settings, *zeros)
        return Tick(True, False, 0, episode, rows, none, vehicle, ids, none, none, np.zeros(n, np.int64))

    def _transition(self, now: Tick, following: Tick | None) -> Transition:
        if following is None:
            terminated, truncated, after = np.zeros(self.count, bool), now.mask.copy(), now.rows
        else:
            terminated = now.mask & following.terminated
            same = following.mask & (following.vehicle == now.vehicle) & (following.episode == now.episode)
            # A slot that changed hands or has a gap without a flag: its trajectory continued unseen.
            truncated = now.mask & ~terminated & (following.truncated | ~same)
            after = _where(terminated | truncated, now.rows, following.rows)
        ended_by = np.zeros(self.count, np.int64)
        if following is not None:
            ended_by = np.where(terminated | truncated, following.ended_by, 0)
        return Transition(
            settings=self.settings,
            observation=now.rows.observation,
            truth=now.rows.truth,
            gnss_m=now.rows.gnss_m,
            mask=now.mask,
            vehicle=now.vehicle,
            id_hash=now.id_hash,
            terminated=terminated,
            truncated=truncated,
            next=after,
            ended_by=ended_by,
        )

    def _show(self) -> None:
        clock, (since, steps) = time.monotonic(), self._reported
        if clock - since < REPORT_S:
            return
        rate = (self._env_steps - steps) / (clock - since)
        self._reported = (clock, self._env_steps)
        self.source.channel.report(episode=self.now.episode[1], env_steps=self._env_steps, env_steps_per_s=rate)

    def _part(self) -> dict[str, Any]:
        """The trainer's part of the run's report."""
        return {"env_steps": self._env_steps, **self._evaluation.report()}


def _array(obs: Observation, name: str) -> Float32Array:
    """f32 `[n, …]` of a tick. Straight from shared memory where it lies there: a tensor on the way takes 20 µs."""
    read = getattr(obs, "array", None)
    numbers: Float32Array = getattr(obs, name).numpy() if read is None else read(name, np.float32)
    return numbers


def _padded(values: NDArray[Scalar], n: int, empty: int = 0) -> NDArray[Scalar]:
    """A copy of the first `n` rows, filled up to `n` where there are fewer."""
    if len(values) >= n:
        return values[:n].copy()
    rows = np.full((n, *values.shape[1:]), empty, values.dtype)
    rows[: len(values)] = values
    return rows


def _where(ended: BoolArray, now: Rows, following: Rows) -> Rows:
    """The following rows, those of `now` where `ended`."""
    if not ended.any():
        return following
    pairs = ((now.observation, following.observation), (now.truth, following.truth), (now.gnss_m, following.gnss_m))
    return Rows(now.settings, *(np.where(ended[:, None], old, new) for old, new in pairs))
