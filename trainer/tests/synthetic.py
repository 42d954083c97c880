"""A street map with noisy GNSS, in numpy, and a channel over it; for the trainer's unit tests."""

import math
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import torch
from caraware.ipc.stream import TrainingReport
from caraware.learn.build import build_ppo
from caraware.learn.config import TrainerConfig
from caraware.learn.ppo import Ppo
from caraware.run.manifest import LATEST
from caraware.tasks.bounds import MapBounds
from caraware.tasks.localisation import Localisation
from torch import Tensor

PRESET = tomllib.loads((Path(__file__).parents[2] / "configs" / "town.toml").read_text())
OPTIONAL_KEYS = ("learning_rate_final", "clip_epsilon_final", "entropy_scale_final", "value_clip", "target_kl")
"""Unset in the presets; a run file has them as null."""
SIZE_M = 220.0
STREETS_M = np.array([10.0, 75.0, 140.0, 210.0])
FIELDS = 4
"""Of an observation: GNSS x, y and the heading's cosine, sine; all in [-1, 1]."""


@dataclass
class SyntheticObservation:
    """One tick, as `caraware.ipc.stream.Observation` describes it."""

    tick: int
    observation: Tensor
    truth: Tensor
    gnss_m: Tensor
    vehicle: np.ndarray
    valid: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    episode: int = 0
    evaluation: bool = False
    last: bool = False
    episode_last: bool = False
    lesson_last: bool = False
    stage: int = 0
    sim_time_ns: int = 0
    gnss_quality: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    imu: Tensor = field(default_factory=lambda: torch.zeros(0, 1, 7))
    speed_steering: Tensor = field(default_factory=lambda: torch.zeros(0, 2))
    sensors: np.ndarray = field(default_factory=lambda: np.zeros(0, np.uint32))
    age_s: np.ndarray = field(default_factory=lambda: np.zeros((0, 4), np.float32))
    episode_step: np.ndarray = field(default_factory=lambda: np.zeros(0, np.uint32))

    @property
    def id_hash(self) -> np.ndarray:
        """u64 `[n]`."""
        return self.vehicle.astype(np.uint64)

    @property
    def ended_by(self) -> np.ndarray:
        """u32 `[n]`: no heroes."""
        return np.zeros(len(self.vehicle), np.uint32)


@dataclass
class SyntheticChannel:
    """Returns prepared ticks, up to `window` at a time, and records what the trainer sends."""

    run: dict[str, Any]
    ticks: Iterator[SyntheticObservation]
    group: int = 8
    consumed_up_to: int = -1
    committed_up_to: int = -1
    is_done: bool = False
    predictions: dict[int, Tensor] = field(default_factory=dict)
    versions: dict[int, int] = field(default_factory=dict)
    reports: list[TrainingReport] = field(default_factory=list)
    decisions: list[tuple[int, int, int]] = field(default_factory=list)

    def receive(self, timeout_s: float) -> Sequence[SyntheticObservation]:
        """The next ticks."""
        return [obs for _, obs in zip(range(self.group), self.ticks, strict=False)]

    def wait_for_any(self, timeout_s: float) -> None:
        """All ticks are available already."""

    def consumed(self, tick: int) -> None:
        """Remember the credit."""
        assert tick >= self.consumed_up_to
        self.consumed_up_to = tick

    def decided(self, lessons: int, since: int, stage: int) -> None:
        """Remember the newest decision."""
        self.decisions.append((lessons, since, stage))

    def commit(self, tick: int) -> None:
        """As `committed`: there is no record."""
        self.committed(tick)

    def committed(self, tick: int) -> None:
        """Remember the commit."""
        assert tick >= self.committed_up_to
        self.committed_up_to = tick

    def lag_ticks(self) -> int:
        """No lag: every returned tick has been consumed."""
        return 0

    def actor_lag_ticks(self) -> int:
        """No process waits for actions."""
        return 0

    def done(self) -> None:
        """Remember the end."""
        self.is_done = True

    def publish_predictions(
        self,
        observation: SyntheticObservation,
        predictions: Tensor,
        policy_version: int,
        estimates: np.ndarray | None = None,
    ) -> None:
        """Remember the predictions."""
        assert predictions.shape == (len(observation.vehicle), 2)
        self.predictions[observation.tick] = predictions.clone()
        self.versions[observation.tick] = policy_version

    def publish_actions(
        self, observation: SyntheticObservation, actions: np.ndarray, policy_version: int = 0, *, now: bool = True
    ) -> None:
        """Remember the actions as predictions."""
        self.publish_predictions(observation, torch.from_numpy(actions), policy_version)

    def report(self, **status: Unpack[TrainingReport]) -> None:
        """Remember the status."""
        self.reports.append(status)


def street_ticks(count: int, vehicles: int, noise_m: float, seed: int) -> Iterator[SyntheticObservation]:
    """Vehicles at independent random places on the streets of a grid, drawn again at every tick."""
    rng = np.random.default_rng(seed)
    for tick in range(count):
        along = rng.uniform(0, SIZE_M, vehicles)
        across = rng.choice(STREETS_M, vehicles)
        east = rng.random(vehicles) < 0.5
        x, y = np.where(east, along, across), np.where(east, across, along)
        yaw = np.where(east, 0.0, math.pi / 2)
        truth = np.stack((x, y, yaw, np.full(vehicles, 8.0)), 1)
        gnss = truth[:, :2] + rng.normal(0, noise_m, (vehicles, 2))
        fields = np.concatenate((gnss / (SIZE_M / 2) - 1, np.cos(yaw)[:, None], np.sin(yaw)[:, None]), 1)
        none = np.zeros(vehicles, bool)
        yield SyntheticObservation(
            tick=tick,
            observation=torch.tensor(fields, dtype=torch.float32),
            truth=torch.tensor(truth, dtype=torch.float32),
            gnss_m=torch.tensor(gnss, dtype=torch.float32),
            vehicle=np.arange(vehicles, dtype=np.uint32),
            valid=~none,
            terminated=none.copy(),
            truncated=none.copy(),
        )


def with_evaluation(
    count: int, evaluation: int, vehicles: int, noise_m: float, seed: int
) -> Iterator[SyntheticObservation]:
    """`evaluation` ticks before and after `count` training ticks; the very last is marked."""
    total = count + 2 * evaluation
    for obs in street_ticks(total, vehicles, noise_m, seed):
        first, last = obs.tick < evaluation, obs.tick >= evaluation + count
        episode = 0 if first else 2 if last else 1
        boundary = obs.tick in (evaluation, evaluation + count)
        truncated = np.full(vehicles, boundary)
        yield replace(obs, evaluation=first or last, episode=episode, truncated=truncated, last=obs.tick == total - 1)


def run_file(run_dir: str, **trainer: object) -> dict[str, Any]:
    """A run file of the preset `town` with these changes, but small: one thread, one action on an observation."""
    small = {
        "actions_per_observation": 1,
        "threads": 1,
        "matmul_precision": "float32",
        "hidden": [32, 16],
        "horizon": 256,
        "batch_size": 64,
        "plots": False,
    }
    section = dict.fromkeys(OPTIONAL_KEYS) | PRESET["trainer"] | small | {"checkpoint_interval": 10} | trainer
    config = {
        "run": PRESET["run"] | {"seed": section.pop("seed", 1)},
        "episode": PRESET["episode"] | {"training_episodes": 1, "evaluation_interval": 0},
        **{table: dict(PRESET[table]) for table in ("curriculum", "task", "traffic", "blackout")},
        "trainer": section,
    }
    return {
        "run_dir": run_dir,
        "config": config,
        "map": {"bounds_m": [0.0, 0.0, SIZE_M, SIZE_M]},
        "source": {"population": {}},
    }


def latest_checkpoint(folder: Path) -> Path:
    """The checkpoint that `folder/latest` names."""
    return folder / (folder / LATEST).read_text().strip()


def locating_ppo(config: TrainerConfig, observation_size: int, bounds: MapBounds) -> Ppo:
    """A new learner of the localisation task on a map of this size."""
    return build_ppo(config, observation_size, Localisation(bounds, config.reward, config.reward_scale_m))
