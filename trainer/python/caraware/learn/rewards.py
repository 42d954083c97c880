"""The named rewards of the localisation task (`caraware.tasks.rewards`), as the learner's modules import them."""

from caraware.tasks.rewards import (
    CLOSEST_M,
    REWARDS,
    Reward,
    RewardName,
    bounded_inverse,
    distance_m,
    exponential,
    inverse,
)

__all__ = [
    "CLOSEST_M",
    "REWARDS",
    "Reward",
    "RewardName",
    "bounded_inverse",
    "distance_m",
    "exponential",
    "inverse",
]
