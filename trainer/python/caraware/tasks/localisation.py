"""The paper's task: an action says where the vehicle is, and earns the more, the closer that is to the truth.

It names a place in the map, as in the paper, or corrects the newest fix (`task.action`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import accumulate, pairwise

import numpy as np
import torch
from torch import Tensor

from caraware import _native
from caraware.ipc.arrays import FloatArray
from caraware.ipc.run_file import RunFile, config_table, setting, typed
from caraware.ipc.stream import MeasuredTick
from caraware.tasks import rewards
from caraware.tasks.bounds import MapBounds
from caraware.tasks.contract import ActionSpec, EndKind, EndReason, Sampling, TaskRows, TaskStep
from caraware.tasks.correction import FixCorrection
from caraware.tasks.metrics import metrics_of

ACTIONS = ActionSpec(names=("x", "y"), low=-1.0, high=1.0, is_clipped=False)

CORRECTIONS = ActionSpec(names=("east", "north"), low=-1.0, high=1.0, is_clipped=False)


class LocalisationAction(StrEnum):
    """Values of `task.action`."""

    PLACE = "place"
    """A place in the box of the map, as in the paper."""
    CORRECTION = "correction"
    """A correction of the newest fix, in its standard deviations."""


ENDS = (
    EndReason("arrival", EndKind.TERMINATED),
    EndReason("removal", EndKind.TERMINATED),
    EndReason("resynchronisation", EndKind.TRUNCATED),
    EndReason("end of the run's episode", EndKind.TRUNCATED),
)


@dataclass(frozen=True)
class Localisation:
    """Actions `[..., 2]` are positions in the box of the map: 0 is its middle, ±1 its edge, and beyond lies outside.

    With a `correction` they are the way from the newest fix, in standard deviations of a fix.
    """

    bounds: MapBounds
    reward_name: rewards.RewardName
    reward_scale_m: float
    correction: FixCorrection | None = None
    name: str = "localisation"
    actions: ActionSpec = ACTIONS
    sampling: Sampling = Sampling.WHEN_FULL
    ends: tuple[EndReason, ...] = ENDS
    metrics: tuple[_native.Metric, ...] = field(default_factory=lambda: metrics_of("localisation"))

    @classmethod
    def from_run(cls, run: RunFile) -> "Localisation":
        """Read `map.bounds_m` and the reward. Raises `ConfigError`."""
        reward = setting(run, "trainer.reward", rewards.RewardName)
        bounds, scale_m = MapBounds.from_run(run), setting(run, "trainer.reward_scale_m", float)
        # Run files from before the key name places.
        named = config_table(run, "task").get("action", LocalisationAction.PLACE)
        if typed("task.action", named, LocalisationAction) is LocalisationAction.PLACE:
            return cls(bounds, reward, scale_m)
        return cls(bounds, reward, scale_m, FixCorrection.from_run(run), actions=CORRECTIONS)

    @property
    def is_relative(self) -> bool:
        """See `Task.is_relative`."""
        return self.correction is not None

    def answer(self, action: Tensor, observation: Tensor | None = None) -> Tensor:
        """Positions `[..., 2]` (m, world). A correction needs the rows `[n, d]`; raises `ValueError` without."""
        if self.correction is None:
            return self.bounds.to_world_m(action)
        if observation is None:
            raise ValueError("a correction needs the observation that holds the fix")
        return self.correction.answer(action, observation)

    def metres_per_action(self) -> list[float]:
        """How far the position moves east and north with an action of 1 (m)."""
        if self.correction is not None:
            return [self.correction.unit_m] * 2
        box = self.bounds
        return [(box.x_max_m - box.x_min_m) / 2, (box.y_max_m - box.y_min_m) / 2]

    def network_input(self, observation: Tensor) -> Tensor:
        """See `Task.network_input`."""
        return observation if self.correction is None else self.correction.network_input(observation)

    def reward(self, step: TaskStep, action: Tensor) -> Tensor:
        """The named reward of the distance to the truth; see `Task.reward`."""
        return rewards.REWARDS[self.reward_name](self.error_m(action, step), self.reward_scale_m)

    def measure(self, step: TaskStep, action: Tensor) -> dict[str, Tensor]:
        """`error_m`: distance of the position to the truth (m)."""
        return {"error_m": self.error_m(action, step)}

    def measure_answers(self, tick: MeasuredTick, answers: Tensor) -> dict[str, FloatArray]:
        """`error_m`: distance of the published positions to the truth (m)."""
        return {"error_m": _distance_m(answers.numpy(), tick.truth.numpy())[tick.valid]}

    def measure_references(self, ticks: Sequence[MeasuredTick]) -> dict[str, list[FloatArray]]:
        """`raw_gnss_error_m`: distance of the raw GNSS fix to the truth (m)."""
        return {"raw_gnss_error_m": raw_errors_m(ticks)}

    def error_m(self, action: Tensor, step: TaskRows) -> Tensor:
        """Distances `[...]` of the positions of actions `[..., 2]` to the truth of the rows (m).

        A learner's rows are float32 and lie on its device; a face's are float64, and numpy measures them.
        """
        truth = step.truth if action.ndim == step.truth.ndim else step.truth.unsqueeze(1)
        position_m = self.answer(action, step.observation)
        if position_m.dtype == torch.float64:
            return torch.from_numpy(_distance_m(position_m.numpy(), truth.numpy()))
        return rewards.distance_m(position_m, truth)


def raw_errors_m(ticks: Sequence[MeasuredTick]) -> list[FloatArray]:
    """Distances to the truth `[v]` of raw GNSS, on the valid rows of each of some ticks.

    The same numbers, bit for bit, whichever ticks come together.
    """
    truth = np.concatenate([obs.truth.numpy() for obs in ticks])
    errors = _distance_m(np.concatenate([obs.gnss_m.numpy() for obs in ticks]), truth)
    ends = list(accumulate((len(obs.valid) for obs in ticks), initial=0))
    return [errors[begin:end][obs.valid] for obs, (begin, end) in zip(ticks, pairwise(ends), strict=True)]


def _distance_m(position: FloatArray, truth: FloatArray) -> FloatArray:
    """Horizontal distance `[...]`. Elementwise, so that a row's result does not depend on the rows beside it.

    Positions of float64 are those of filters and faces. Their distance is numpy's `hypot`, as it is of baselines.
    """
    east, north = position[..., 0] - truth[..., 0], position[..., 1] - truth[..., 1]
    is_double = position.dtype == np.float64
    distance_m: FloatArray = np.hypot(east, north) if is_double else np.sqrt(east * east + north * north)
    return distance_m
