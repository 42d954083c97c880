"""Our PPO learns to drive: in a world of one lane that listens to actions, with heroes that come and go."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from caraware.learn.rollout import Horizon
from caraware.run.config import RunConfig
from caraware.run.learner import Learner
from caraware.run.loop import TrainingLoop
from caraware.run.player import FollowedScoreboard, PlayTally
from caraware.tasks import ends
from synthetic import SyntheticObservation, run_file
from synthetic_vehicle import sensor_tables
from torch import Tensor

HEROES, TICK_S, LANE_M, ROUTE_M, LIMIT_TICKS = 8, 0.1, 2.0, 60.0, 120
RANGES = {"speed": [0.0, 20.0], "speed_limit": [0.0, 20.0], "route_offset": [-5.0, 5.0], "route_left": [0.0, 1000.0]}


@dataclass
class LaneTick(SyntheticObservation):
    """A tick of heroes on the lane."""

    why: np.ndarray = field(default_factory=lambda: np.zeros(HEROES, np.uint32))

    @property
    def ended_by(self) -> np.ndarray:
        """u32 `[n]`."""
        return self.why


class Lane:
    """A channel in lock-step: the next tick comes when the one before is answered.

    Steering moves a hero across the lane, acceleration changes its speed. Beside the lane or at the end of 60 m its
    trip ends; the slot is empty for a tick, then the next hero takes it.
    """

    def __init__(self, run: dict[str, Any], ticks: int) -> None:
        self.run, self._last_tick = run, ticks - 1
        self._rng = np.random.default_rng(1)
        self._tick, self._heroes = 0, HEROES
        self._vehicle = np.arange(HEROES, dtype=np.uint32)
        self._x, self._y, self._v, self._age = (np.zeros(HEROES) for _ in range(4))
        self._why, self._time_up = np.zeros(HEROES, np.uint32), np.zeros(HEROES, bool)
        self._held = np.ones(HEROES, bool)
        self._ready: LaneTick | None = None
        self.is_done = False
        self.rewards: list[float] = []
        self._start(np.arange(HEROES))
        self._make()

    def _start(self, slots: np.ndarray) -> None:
        self._x[slots], self._v[slots], self._age[slots] = 0.0, 5.0, 0
        self._y[slots] = self._rng.uniform(-1, 1, len(slots))

    def _make(self) -> None:
        values = {"speed": self._v, "speed_limit": np.full(HEROES, 10.0)}
        values |= {"route_offset": -self._y, "route_left": ROUTE_M - self._x}
        columns = [(values[n] - low) / (high - low) * 2 - 1 for n, (low, high) in RANGES.items()]
        truth = np.stack((self._x, self._y, np.zeros(HEROES), self._v), 1)
        over = self._why != 0
        self._ready = LaneTick(
            tick=self._tick,
            observation=torch.tensor(np.stack(columns, 1).clip(-1, 1), dtype=torch.float32),
            truth=torch.tensor(truth, dtype=torch.float32),
            gnss_m=torch.zeros(HEROES, 2),
            vehicle=self._vehicle.copy(),
            valid=self._held.copy(),
            terminated=over & ~self._time_up,
            truncated=over & self._time_up,
            last=self._tick == self._last_tick,
            why=self._why.copy(),
        )

    def publish_predictions(
        self, observation: Any, predictions: Tensor, policy_version: int, estimates: Any = None
    ) -> None:
        """A driver has none."""
        raise AssertionError("a driver answers with actions")

    def publish_actions(
        self, observation: Any, actions: np.ndarray, policy_version: int = 0, *, now: bool = True
    ) -> None:
        """Move every hero by its action."""
        assert now
        if observation.tick != self._tick or observation.last:
            return
        steering, acceleration = actions.astype(np.float64).T
        assert np.abs(actions).max() <= 1
        ended = self._end()
        self._v = (self._v + 3 * acceleration * TICK_S).clip(0, 20)
        self._y += 2 * steering * TICK_S
        self._x += self._v * TICK_S
        self._age += 1
        returning = ~self._held
        self._held = ~ended
        self._vehicle[returning] = np.arange(self._heroes, self._heroes + returning.sum())
        self._heroes += int(returning.sum())
        self._start(np.flatnonzero(returning))
        self._tick += 1
        self._make()

    def _end(self) -> np.ndarray:
        """Which trips ended with the tick that was seen last."""
        off, arrived = np.abs(self._y) > LANE_M, self._x >= ROUTE_M - 5
        self._time_up = (self._age >= LIMIT_TICKS) & ~off & ~arrived
        why = np.where(off, ends.OFF_ROAD, np.where(arrived, ends.ARRIVAL, np.where(self._time_up, ends.TIME_LIMIT, 0)))
        self._why = np.where(self._held, why, 0).astype(np.uint32)
        over: np.ndarray = self._why != 0
        return over

    def receive(self, timeout_s: float) -> Sequence[LaneTick]:
        """The next tick, once."""
        ready, self._ready = self._ready, None
        return [ready] if ready else []

    def wait_for_any(self, timeout_s: float) -> None:
        """Never waits."""

    def consumed(self, tick: int) -> None:
        """No credit is counted."""

    def commit(self, tick: int) -> None:
        """There is no record."""

    def committed(self, tick: int) -> None:
        """There is no journal."""

    def decided(self, lessons: int, since: int, stage: int) -> None:
        """No curriculum."""

    def lag_ticks(self) -> int:
        """Lock-step."""
        return 2

    def actor_lag_ticks(self) -> int:
        """Lock-step."""
        return 2

    def done(self) -> None:
        """Remember the end."""
        self.is_done = True

    def report(self, **status: Any) -> None:
        """Remember the reward of each update."""
        if "reward" in status:
            self.rewards.append(status["reward"])


def lane_run(folder: Path, learning_rate: float) -> dict[str, Any]:
    """A run file for the lane."""
    run = run_file(
        str(folder),
        network="mlp",
        hidden=[32],
        activation="tanh",
        learning_rate=learning_rate,
        learning_rate_decay=1.0,
        discount=0.97,
        gae_lambda=0.95,
        initial_std=0.5,
        entropy_scale=0.0,
        horizon=1024,
        batch_size=256,
        epochs=6,
        actions_per_observation=1,
        supervised=False,
        checkpoint_interval=100,
    )
    run["config"]["task"] = {"kind": "driving", "reward": "", "begin_from": ""}
    run["config"]["observation"] = {"fields": list(RANGES), "history": 1, "scale": "minus_one_to_one"}
    run["config"]["run"] |= {"tick_s": TICK_S}
    run["observation_fields"] = [{"name": name, "unit": "", "range": list(ends_)} for name, ends_ in RANGES.items()]
    return run


def drive(folder: Path, learning_rate: float) -> tuple[list[float], dict[str, int]]:
    """The rewards of all updates, and how trips ended in the last third."""
    run = lane_run(folder, learning_rate)
    lane = Lane(run, 3200)
    loop = TrainingLoop(lane, RunConfig.from_run(run), lambda: False)
    early: dict[str, int] = {}

    def note_early() -> bool:
        trips = loop._environments[0].trips.training
        if not early and lane._tick > 2100:
            early.update(trips)
        return False

    loop._stop_requested = note_early
    assert loop.run() and lane.is_done
    counted = loop._environments[0].trips.training
    late = counted - type(counted)(early)
    # The lines of the updates count each of them once, but for those after the last update.
    lines = [json.loads(line) for line in (folder / "learning.jsonl").read_text().splitlines()]
    logged = sum((Counter(line.get("ends", {})) for line in lines), Counter())
    assert logged <= counted and logged.total() > 0.9 * counted.total(), (logged, counted)
    return lane.rewards, dict(late)


def test_a_learner_learns_to_stay_in_its_lane_and_arrive_and_one_without_steps_does_not(tmp_path: Path) -> None:
    def share(trips: dict[str, int]) -> float:
        return trips.get("arrival", 0) / sum(trips.values())

    rewards, late = drive(tmp_path / "learns", 3e-3)
    # No trip of the last third lasts so long that it could hide there.
    assert sum(late.values()) > 40 and share(late) > 0.8, late
    assert np.mean(rewards[-4:]) > np.mean(rewards[:4]) + 0.05, rewards
    _, still = drive(tmp_path / "stays", 1e-9)
    assert share(still) < 0.6, f"without steps nothing is learnt: {still}"


class LaneTakenOver(Lane):
    """The lane after another policy has driven there and has committed nothing: its ticks come again."""

    def __init__(self, run: dict[str, Any], ticks: int, driven: int) -> None:
        super().__init__(run, ticks)
        self._again, self._consumed, rng = [], 0, np.random.default_rng(2)
        for _ in range(driven):
            (obs,) = super().receive(0.0)
            self._again.append(obs)
            super().publish_actions(obs, rng.uniform(-1, 1, (HEROES, 2)))

    def receive(self, timeout_s: float) -> Sequence[LaneTick]:
        """First what comes again, tick by tick."""
        return [self._again.pop(0)] if self._again else super().receive(timeout_s)

    def publish_actions(
        self, observation: Any, actions: np.ndarray, policy_version: int = 0, *, now: bool = True
    ) -> None:
        """What was answered before is skipped."""
        if observation.tick == self._tick:
            super().publish_actions(observation, actions, policy_version, now=now)

    def consumed(self, tick: int) -> None:
        """Remember the credit."""
        self._consumed = tick + 1

    def actor_lag_ticks(self) -> int:
        """The lane has made the tick that it waits with."""
        return self._tick + 1 - self._consumed


def learnt_ticks(folder: Path, monkeypatch: pytest.MonkeyPatch, *, follows_another: bool) -> tuple[list[int], int]:
    """The ticks that a learner of a lane with 50 ticks of another learns from, and the first that it then commits."""
    run = lane_run(folder, 1e-3)
    config = RunConfig.from_run(run)
    learner = Learner.begin(config, len(RANGES))
    learner.follows_another = follows_another
    learnt: list[int] = []
    samples: list[int] = []
    commits: list[int] = []
    score = learner.ppo.score

    def scored(horizon: Horizon, environment: int) -> Any:
        learnt.extend(horizon.tick.tolist())
        samples.append(horizon.samples())
        return score(horizon, environment)

    monkeypatch.setattr(learner.ppo, "score", scored)
    lane = LaneTakenOver(run, 500, driven=50)
    monkeypatch.setattr(lane, "committed", commits.append)
    assert TrainingLoop(lane, config, lambda: False, learner=learner).run()
    part = json.loads((folder / "parts" / "trainer.json").read_text())
    assert (part["received_ticks"], part["lost_ticks"], part["duplicated_ticks"]) == (500, 0, 0)
    assert part["env_steps"] - part["untrained_env_steps"] == sum(samples)
    return learnt, commits[0]


def test_nothing_is_learnt_from_ticks_that_another_policy_drove(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learnt, committed = learnt_ticks(tmp_path / "other", monkeypatch, follows_another=True)
    # Tick 50 was made but not answered; whether it was is not known.
    assert learnt == list(range(51, 51 + len(learnt))) and len(learnt) > 300
    assert committed == 50, "a successor receives only ticks that this learner drew"
    # A learner that continues with its own parameters draws again what it drew.
    learnt, _ = learnt_ticks(tmp_path / "own", monkeypatch, follows_another=False)
    assert learnt == list(range(len(learnt))) and len(learnt) > 300


def test_the_table_of_a_player_is_empty_when_an_episode_begins(tmp_path: Path) -> None:
    """What a tick leads to is known at the next one: the first tick of an episode shows no vehicle."""
    run = lane_run(tmp_path, 1e-3)
    run["config"] = sensor_tables() | run["config"]
    lane = Lane(run, 10)
    board = FollowedScoreboard(lane.run, RunConfig.from_run(run), PlayTally())
    rows = []
    for episode in (0, 0, 1, 1):
        (obs,) = lane.receive(0.0)
        board.add(replace(obs, episode=episode), torch.zeros(HEROES, 2))
        rows.append(len(board.table()["vehicles"]))
        lane.publish_actions(obs, np.zeros((HEROES, 2)))
    assert rows == [0, HEROES, 0, HEROES]
