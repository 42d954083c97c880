"""The named rewards."""

import math

import pytest
import torch
from caraware.learn import rewards
from caraware.learn.rewards import RewardName


def test_equation_5_euclidean_distance() -> None:
    truth = torch.tensor([[3.0, 4.0, 1.0, 9.0]])
    assert rewards.distance_m(torch.zeros(1, 2), truth).item() == 5.0


@pytest.mark.parametrize(
    ("name", "distance_m", "expected"),
    [
        (RewardName.INVERSE, 4.0, 0.25),
        (RewardName.INVERSE, 0.0, 1.0),
        (RewardName.BOUNDED_INVERSE, 0.0, 1.0),
        (RewardName.BOUNDED_INVERSE, 5.0, 0.5),
        (RewardName.EXPONENTIAL, 5.0, math.exp(-1)),
    ],
)
def test_values(name: RewardName, distance_m: float, expected: float) -> None:
    reward = rewards.REWARDS[name](torch.tensor([distance_m]), 5.0)
    assert reward.item() == pytest.approx(expected)


@pytest.mark.parametrize("name", list(rewards.REWARDS))
def test_closer_is_never_worse_and_the_reward_stays_in_0_1(name: RewardName) -> None:
    reward = rewards.REWARDS[name](torch.linspace(0, 300, 1000), 10.0)
    assert (reward.diff() <= 0).all()
    assert reward.min() > 0
    assert reward.max() <= 1
