"""PPO's two objectives with their gradients: the clipped surrogate of the policy, the error of the values."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from caraware.learn.networks import log_probability


@dataclass(frozen=True)
class Surrogate:
    """PPO's clipped objective of a minibatch (equation 7, as a loss) and its gradient."""

    loss: Tensor
    """Scalar."""
    mean_gradient: Tensor
    """`[b, 2]`: dLoss/dMean."""
    log_std_gradient: Tensor
    """`[2]`: dLoss/dLogStd."""
    ratio: Tensor
    """`[b]`: new over old probability of the action."""
    log_ratio: Tensor
    """`[b]`."""
    clip_epsilon: float

    def approximate_kl(self) -> float:
        """See `UpdateStats.approximate_kl`."""
        return (self.ratio - 1 - self.log_ratio).mean().item()

    def clip_fraction(self) -> float:
        """Share of samples whose ratio left 1 ± ε."""
        return ((self.ratio - 1).abs() > self.clip_epsilon).float().mean().item()


def clipped_surrogate(
    mean: Tensor, log_std: Tensor, action: Tensor, old_log_probability: Tensor, advantage: Tensor, clip_epsilon: float
) -> Surrogate:
    """-E[min(ratio A, clip(ratio, 1 - ε, 1 + ε) A)] and its gradient, for `[b, 2]` means and actions.

    With k actions per observation, actions are `[b, k, 2]`, old log-probabilities and advantages `[b, k]`.

    The gradient flows only through samples where the unclipped term is the smaller: d(ratio)/dθ = ratio dlogπ/dθ,
    with dlogπ/dμ = (a - μ)/σ² and dlogπ/dlogσ = ((a - μ)/σ)² - 1.
    """
    if advantage.ndim == 2:
        tries = advantage.shape[1]
        columns = (action.flatten(0, 1), old_log_probability.flatten(), advantage.flatten(), clip_epsilon)
        each = clipped_surrogate(mean.repeat_interleave(tries, 0), log_std, *columns)
        return replace(each, mean_gradient=each.mean_gradient.view(-1, tries, mean.shape[1]).sum(1))
    inverse_std = torch.exp(-log_std)
    deviation = (action - mean) * inverse_std
    log_ratio = log_probability(action, mean, log_std) - old_log_probability
    ratio = log_ratio.exp()
    unclipped = ratio * advantage
    clipped = ratio.clamp(1 - clip_epsilon, 1 + clip_epsilon) * advantage
    weight = torch.where(unclipped <= clipped, unclipped, 0.0).div_(-len(advantage)).unsqueeze(1)
    return Surrogate(
        loss=-torch.minimum(unclipped, clipped).mean(),
        mean_gradient=weight * deviation * inverse_std,
        log_std_gradient=(weight * (deviation.square() - 1)).sum(0),
        ratio=ratio,
        log_ratio=log_ratio,
        clip_epsilon=clip_epsilon,
    )


@dataclass(frozen=True)
class ClippedError:
    """Squared errors of values and what pulls them: half their derivative."""

    loss: Tensor
    """`[b]`."""
    pull: Tensor
    """`[b]`."""


def clipped_error(value: Tensor, target: Tensor, advantage: Tensor, clip: float | None) -> ClippedError:
    """max((V - R)², (V₀ + clip(V - V₀, ±c) - R)²) of `[b]` values, V₀ = R - A being the value before the update.

    Where the clipped term is the larger, the value has moved far enough and nothing pulls it any more.
    """
    error = value - target
    if clip is None:
        return ClippedError(error.square(), error)
    before = target - advantage
    held = before + (value - before).clamp(-clip, clip) - target
    is_free = ((value - before).abs() <= clip) | (error.abs() >= held.abs())
    return ClippedError(torch.maximum(error.square(), held.square()), torch.where(is_free, error, 0.0))
