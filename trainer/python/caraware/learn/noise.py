"""Random numbers for several actions on one observation: samples of the policy whose mean gradient has little noise."""

import torch
from torch import Tensor


def action_noise(samples: int, tries: int, size: int, generator: torch.Generator) -> Tensor:
    """Standard normal `[samples, tries, size]`; an even number of tries comes in pairs on both sides of the mean.

    Each is still a sample of the policy, and the mean gradient that of the policy. What two opposite actions have
    in common drops out of it, which is most of its variance (antithetic variates; Owen, Monte Carlo, section 8.2).
    The pairs are spread over directions and distances, which is most of the rest.
    """
    if tries % 2:
        return torch.randn(samples, tries, size, generator=generator)
    half = spread_noise(samples, tries // 2, size, generator)
    return torch.cat((half, -half), 1)


def spread_noise(samples: int, count: int, size: int, generator: torch.Generator) -> Tensor:
    """Standard normal `[samples, count, size]`. If `size` is 2, the `count` points of a sample lie evenly around 0.

    Each point has the whole distribution. Together they have directions half a turn divided by `count` apart, so that
    with their opposites they go round, and one distance from 0 in each of `count` equally likely rings (stratification;
    Owen, Monte Carlo, section 8.4).
    """
    if size != 2:
        return torch.randn(samples, count, size, generator=generator)
    turn = 2 * torch.pi * torch.rand(samples, 1, generator=generator)
    direction = turn + torch.pi / count * torch.arange(count)
    ring = torch.rand(samples, count, generator=generator).argsort(1)
    below = (ring + torch.rand(samples, count, generator=generator)) / count
    # Rounded up to 1, a share would lie infinitely far away.
    radius = (-2 * torch.log1p(-below.clamp(max=1 - 2**-24))).sqrt()
    return torch.stack((radius * direction.cos(), radius * direction.sin()), 2)
