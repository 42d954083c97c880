"""Several actions on one observation: their distribution, and what spreading them is worth beside independent ones."""

import math

import torch
from caraware.learn.noise import action_noise, spread_noise
from caraware.learn.rewards import bounded_inverse
from scipy.stats import kstest
from torch import Tensor


def test_the_pairs_of_an_observation_are_spread_over_directions_and_distances() -> None:
    samples, pairs = 20_000, 8
    spread = spread_noise(samples, pairs, 2, torch.Generator().manual_seed(1))
    # Of one observation: directions a sixteenth of a turn apart, a distance in each of eight equally likely rings.
    direction = torch.atan2(spread[..., 1], spread[..., 0]).double()
    apart = (direction.diff(dim=1) / torch.pi * pairs).remainder(2 * pairs)
    assert torch.allclose(apart, torch.ones_like(apart), atol=1e-3)
    below = 1 - (-spread.square().sum(2) / 2).exp()
    assert ((below * pairs).clamp(max=pairs - 1e-3).long().sort(1).values == torch.arange(pairs)).all()
    # Each pair alone has the whole normal distribution, whichever its number.
    for number in range(pairs):
        of_a_number = spread[:, number]
        for column in (of_a_number[:, 0], of_a_number[:, 1], of_a_number.sum(1) / math.sqrt(2)):
            assert kstest(column.numpy(), "norm").pvalue > 1e-4
    assert spread.square().sum(2).max() < torch.inf


def test_spread_pairs_have_a_fraction_of_the_variance_of_independent_ones() -> None:
    samples, pairs, generator = 20_000, 8, torch.Generator().manual_seed(1)
    spread = spread_noise(samples, pairs, 2, generator)
    independent = torch.randn(samples, pairs, 2, generator=generator)
    way = torch.tensor([0.1, 0.06])  # from the mean to the truth, in standard deviations

    def gradient(half: Tensor) -> Tensor:
        action = torch.cat((half, -half), 1)
        reward = bounded_inverse((action - way).norm(dim=2), 0.5)
        return (action * reward.unsqueeze(2)).mean(1)

    first, second = gradient(spread), gradient(independent)
    assert first.var(0).sum() < 0.1 * second.var(0).sum()
    error = (second.var(0) / samples).sqrt()
    assert ((first.mean(0) - second.mean(0)).abs() < 4 * error).all()


def test_an_odd_number_of_tries_or_of_numbers_is_drawn_independently() -> None:
    for tries, size in ((7, 2), (8, 3), (1, 2)):
        noise = action_noise(20_000, tries, size, torch.Generator().manual_seed(1))
        assert noise.shape == (20_000, tries, size)
        assert kstest(noise.flatten()[::7].numpy(), "norm").pvalue > 1e-4
