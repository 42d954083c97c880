"""The named rewards of the localisation task (`caraware.tasks.rewards`), as the learner's modules import them."""

from caraware.tasks.rewards import (
    CLOSEST_M,
    REWARDS,
    Reward,
    UnknownReward,
    bounded_inverse,
    by_name,
    distance_m,
    exponential,
    inverse,
)

__all__ = [
    "CLOSEST_M",
    "REWARDS",
    "Reward",
    "UnknownReward",
    "bounded_inverse",
    "by_name",
    "distance_m",
    "exponential",
    "inverse",
]
