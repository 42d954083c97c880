"""Named rewards of a prediction, all functions of its Euclidean distance to the truth (paper, equation 5)."""

from collections.abc import Callable, Mapping
from enum import StrEnum

import torch
from torch import Tensor

Reward = Callable[[Tensor, float], Tensor]
"""`(distance_m [...], scale_m) -> reward [...]` in (0, 1], larger when closer."""

CLOSEST_M = 1.0
"""Distances below this earn no more: 1/d alone is unbounded, and one lucky sample would rule a whole batch."""


class RewardName(StrEnum):
    """Values of `trainer.reward`."""

    INVERSE = "inverse"
    BOUNDED_INVERSE = "bounded_inverse"
    EXPONENTIAL = "exponential"


def inverse(distance_m: Tensor, scale_m: float) -> Tensor:
    """1/d, as in the paper, with d at least `CLOSEST_M`; `scale_m` is not used."""
    return distance_m.clamp_min(CLOSEST_M).reciprocal()


def bounded_inverse(distance_m: Tensor, scale_m: float) -> Tensor:
    """1 / (1 + d/scale): 1 at the truth, one half at `scale_m`, and no corner."""
    return (1 + distance_m / scale_m).reciprocal()


def exponential(distance_m: Tensor, scale_m: float) -> Tensor:
    """exp(-d/scale)."""
    return torch.exp(-distance_m / scale_m)


REWARDS: Mapping[RewardName, Reward] = {
    RewardName.INVERSE: inverse,
    RewardName.BOUNDED_INVERSE: bounded_inverse,
    RewardName.EXPONENTIAL: exponential,
}


def distance_m(predicted_m: Tensor, truth: Tensor) -> Tensor:
    """Euclidean distance (paper, equation 5) of the x, y of `[..., 2 or 3]` positions to `[..., 4]` truth, metres."""
    distance_m: Tensor = torch.linalg.vector_norm(predicted_m[..., :2] - truth[..., :2], dim=-1)
    return distance_m
