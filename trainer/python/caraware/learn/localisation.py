"""The paper's task: an action is a predicted position of the vehicle, its reward a function of the distance to truth.

PPO knows a task by this object alone: the number of actions, their reward, and their error in metres.
"""

from torch import Tensor

from caraware.learn import rewards
from caraware.learn.config import MapBounds, TrainerConfig


class Localisation:
    """Actions `[..., 2]` are positions on the map, in half its widths from its middle: ±1 is the edge."""

    actions = 2
    """Numbers in one action."""

    def __init__(self, config: TrainerConfig, bounds: MapBounds) -> None:
        """Raises `caraware.learn.rewards.UnknownReward`."""
        self.bounds = bounds
        self._reward, self._scale_m = rewards.by_name(config.reward), config.reward_scale_m

    def position_m(self, action: Tensor) -> Tensor:
        """Positions `[..., 2]` in world metres."""
        return self.bounds.to_world_m(action)

    def reward(self, action: Tensor, truth: Tensor) -> Tensor:
        """Rewards `[...]` of actions `[..., 2]`, given the truth `[..., 4]`."""
        return self._reward(self.error_m(action, truth), self._scale_m)

    def error_m(self, action: Tensor, truth: Tensor) -> Tensor:
        """Distances `[...]` between the positions of actions `[..., 2]` and the truth `[..., 4]`, in metres."""
        return rewards.distance_m(self.position_m(action), truth)
