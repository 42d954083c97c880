"""The task of a learner that sees: an action says where on the road the vehicle is, across the direction of travel.

A fix says where a vehicle is to some metres, a lane is 3.5 m wide: neither the lane nor the place in it follows from a
fix, but both show in an image. The truth is computed from the net's lanes and the mirror's rear axle. In a junction it
is that of the nearest lane through it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch
from torch import Tensor

from caraware import _native
from caraware.ipc.arrays import FloatArray
from caraware.ipc.run_file import ConfigError, RunFile, config_table, setting
from caraware.ipc.stream import MeasuredTick
from caraware.tasks import rewards
from caraware.tasks.contract import ActionSpec, EndReason, Sampling, TaskStep
from caraware.tasks.localisation import ENDS
from caraware.tasks.metrics import metrics_of
from caraware.tasks.road_lanes import LanePlaces, RoadLanes, road_lanes

ACTIONS = ActionSpec(names=("lateral", "lane"), low=-1.0, high=1.0, is_clipped=False)

LATERAL_RANGE_M = 2.0
"""Offset from the middle of the lane of an action of 1: a little more than half a lane."""
LANE_WIDTH_M = 3.5
"""What a whole lane beside the truth counts in the distance that is rewarded, m."""
WRONG_PERCENT = 100.0


@dataclass(frozen=True)
class LanePosition:
    """Actions `[..., 2]`: offset from the middle of the lane, in 2 m to the left; and the lane, -1 the rightmost, 1 the
    leftmost of the widest road."""

    roads: RoadLanes
    reward_name: rewards.RewardName
    reward_scale_m: float
    name: str = "lane"
    actions: ActionSpec = ACTIONS
    sampling: Sampling = Sampling.WHEN_FULL
    ends: tuple[EndReason, ...] = ENDS
    is_relative: bool = False
    metrics: tuple[_native.Metric, ...] = field(default_factory=lambda: metrics_of("lane"))

    @classmethod
    def from_run(cls, run: RunFile) -> "LanePosition":
        """Read the net and the reward. Raises `ConfigError` where the run has no net, or several."""
        net_file = (run.get("scene_files") or {}).get("net_file")
        several = len(config_table(run, "curriculum").get("maps") or ()) > 1
        if not net_file or several:
            raise ConfigError(
                '`task.kind` = "lane" needs the lanes of one net, and this run has several maps or none',
                "leave one map in curriculum.maps",
            )
        x_m, y_m = (run.get("map") or {}).get("world_origin_m", (0.0, 0.0))
        try:
            roads = road_lanes(Path(net_file), (float(x_m), float(y_m)))
        except (OSError, ValueError, ElementTree.ParseError) as error:
            raise ConfigError(f"the lanes of {net_file} cannot be read: {error}", "give a net of SUMO") from error
        return cls(
            roads,
            setting(run, "trainer.reward", rewards.RewardName),
            setting(run, "trainer.reward_scale_m", float),
        )

    def answer(self, action: Tensor, observation: Tensor | None = None) -> Tensor:
        """`[..., 2]`: offset from the middle of the lane (m, to the left), and the lane from the right, not rounded."""
        lateral_m = action[..., 0] * LATERAL_RANGE_M
        return torch.stack((lateral_m, (action[..., 1] + 1.0) * ((self.roads.lanes - 1) / 2)), -1)

    def network_input(self, observation: Tensor) -> Tensor:
        """See `Task.network_input`: the same."""
        return observation

    def truth_of(self, truth: Tensor) -> LanePlaces:
        """Where rows of truth `[n, 4]` lie on the lanes."""
        return self.roads.locate(truth[:, 0], truth[:, 1], truth[:, 2])

    def targets(self, truth: Tensor) -> Tensor:
        """`[n, 2]`: the true answers for rows of truth `[n, 4]`."""
        places = self.truth_of(truth)
        return torch.stack((places.lateral_m, places.index), 1)

    def distance(self, action: Tensor, targets: Tensor) -> Tensor:
        """Distances `[n]` or `[n, k]` of actions `[n, 2]` or `[n, k, 2]` to `targets` (m): a lane counts 3.5 m."""
        targets = targets if action.ndim == targets.ndim else targets.unsqueeze(1)
        away = self.answer(action) - targets
        return torch.hypot(away[..., 0], LANE_WIDTH_M * away[..., 1])

    def reward(self, step: TaskStep, action: Tensor) -> Tensor:
        """The named reward of the distance; see `Task.reward`."""
        return rewards.REWARDS[self.reward_name](self.distance(action, self.targets(step.truth)), self.reward_scale_m)

    def measure(self, step: TaskStep, action: Tensor) -> dict[str, Tensor]:
        """`lateral_error_m`: of the offset (m); `wrong_lane_percent`: 100 where the lane is another one, else 0."""
        return self._errors(self.answer(action), self.truth_of(step.truth))

    def measure_answers(self, tick: MeasuredTick, answers: Tensor) -> dict[str, FloatArray]:
        """The same of published answers."""
        errors = self._errors(answers, self.truth_of(tick.truth))
        return {name: values.numpy()[tick.valid] for name, values in errors.items()}

    def measure_references(self, ticks: Sequence[MeasuredTick]) -> dict[str, list[FloatArray]]:
        """The same of raw GNSS: the place of the fix on the lane nearest to it, with the vehicle's true heading."""
        truth = torch.cat([torch.as_tensor(tick.truth) for tick in ticks])
        fix_m = torch.cat([torch.as_tensor(tick.gnss_m)[:, :2] for tick in ticks])
        found = self.roads.locate(fix_m[:, 0], fix_m[:, 1], truth[:, 2])
        half_m = LANE_WIDTH_M / 2
        answers = torch.stack((found.lateral_m.clamp(-half_m, half_m), found.index), 1)
        errors = self._errors(answers, self.truth_of(truth))
        ends = np.cumsum([len(tick.valid) for tick in ticks])[:-1]
        return {
            f"raw_gnss_{name}": [
                part[tick.valid] for tick, part in zip(ticks, np.split(values.numpy(), ends), strict=True)
            ]
            for name, values in errors.items()
        }

    def _errors(self, answers: Tensor, places: LanePlaces) -> dict[str, Tensor]:
        wrong = answers[..., 1].round() != places.index
        return {
            "lateral_error_m": (answers[..., 0] - places.lateral_m).abs(),
            "wrong_lane_percent": wrong.float() * WRONG_PERCENT,
        }
