"""The paper's task: an action is a predicted position of the vehicle, which earns the more, the closer it is."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from caraware import _native
from caraware.ipc.arrays import FloatArray
from caraware.ipc.run_file import RunFile, setting
from caraware.ipc.stream import MeasuredTick
from caraware.tasks import rewards
from caraware.tasks.bounds import MapBounds
from caraware.tasks.contract import ActionSpec, EndKind, EndReason, Sampling, TaskStep
from caraware.tasks.metrics import metrics_of

ACTIONS = ActionSpec(names=("x", "y"), low=-1.0, high=1.0, is_clipped=False)

ENDS = (
    EndReason("arrival", EndKind.TERMINATED),
    EndReason("removal", EndKind.TERMINATED),
    EndReason("resynchronisation", EndKind.TRUNCATED),
    EndReason("end of the run's episode", EndKind.TRUNCATED),
)


@dataclass(frozen=True)
class Localisation:
    """Actions `[..., 2]` are positions in the box of the map: 0 is its middle, ±1 its edge, and beyond lies outside."""

    bounds: MapBounds
    reward_name: rewards.RewardName
    reward_scale_m: float
    name: str = "localisation"
    actions: ActionSpec = ACTIONS
    sampling: Sampling = Sampling.WHEN_FULL
    ends: tuple[EndReason, ...] = ENDS
    metrics: tuple[_native.Metric, ...] = field(default_factory=lambda: metrics_of("localisation"))

    @classmethod
    def from_run(cls, run: RunFile) -> "Localisation":
        """Read `map.bounds_m` and the reward. Raises `ConfigError`."""
        reward = setting(run, "trainer.reward", rewards.RewardName)
        return cls(MapBounds.from_run(run), reward, setting(run, "trainer.reward_scale_m", float))

    def answer(self, action: Tensor) -> Tensor:
        """Positions `[..., 2]` (m, world)."""
        return self.bounds.to_world_m(action)

    def reward(self, step: TaskStep, action: Tensor) -> Tensor:
        """The named reward of the distance to the truth; see `Task.reward`."""
        return rewards.REWARDS[self.reward_name](self.error_m(action, step.truth), self.reward_scale_m)

    def measure(self, step: TaskStep, action: Tensor) -> dict[str, Tensor]:
        """`error_m`: distance of the position to the truth (m)."""
        return {"error_m": self.error_m(action, step.truth)}

    def measure_answers(self, tick: MeasuredTick, answers: Tensor) -> dict[str, FloatArray]:
        """`error_m`: distance of the published positions to the truth (m)."""
        return {"error_m": _distance_m(answers.numpy(), tick.truth.numpy())[tick.valid]}

    def measure_references(self, ticks: Sequence[MeasuredTick]) -> dict[str, list[FloatArray]]:
        """`raw_gnss_error_m`: distance of the raw GNSS fix to the truth (m)."""
        return {"raw_gnss_error_m": raw_errors_m(ticks)}

    def error_m(self, action: Tensor, truth: Tensor) -> Tensor:
        """Distances `[...]` of the positions of actions `[..., 2]` to the truth `[n, 4]` (m).

        A learner's rows are float32 and lie on its device; a face's are float64, and numpy measures them.
        """
        position_m, truth = self.answer(action), truth if action.ndim == truth.ndim else truth.unsqueeze(1)
        if position_m.dtype == torch.float64:
            return torch.from_numpy(_distance_m(position_m.numpy(), truth.numpy()))
        return rewards.distance_m(position_m, truth)


def raw_errors_m(ticks: Sequence[MeasuredTick]) -> list[FloatArray]:
    """Distances to the truth `[v]` of raw GNSS, on the valid rows of each of some ticks.

    The same numbers, bit for bit, whichever ticks come together.
    """
    truth = torch.cat([obs.truth for obs in ticks]).numpy()
    errors = _distance_m(torch.cat([obs.gnss_m for obs in ticks]).numpy(), truth)
    ends = np.cumsum([len(obs.valid) for obs in ticks])[:-1]
    return [error[obs.valid] for obs, error in zip(ticks, np.split(errors, ends), strict=True)]


def _distance_m(position: FloatArray, truth: FloatArray) -> FloatArray:
    """Horizontal distance `[...]`. Elementwise, so that a row's result does not depend on the rows beside it.

    Positions of float64 are those of filters and faces. Their distance is numpy's `hypot`, as it is of baselines.
    """
    east, north = position[..., 0] - truth[..., 0], position[..., 1] - truth[..., 1]
    is_double = position.dtype == np.float64
    distance_m: FloatArray = np.hypot(east, north) if is_double else np.sqrt(east * east + north * north)
    return distance_m
