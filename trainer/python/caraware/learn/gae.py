"""Generalised advantage estimation (Schulman et al., arXiv 1506.02438, equation 16) over slots of vehicles."""

import torch
from torch import Tensor


def generalised_advantage(
    reward: Tensor,
    value: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    valid: Tensor,
    discount: float,
    gae_lambda: float,
) -> tuple[Tensor, Tensor]:
    """Advantages and value targets of `T` ticks of `N` slots; every argument is `[T, N]`.

    `next_value[t]` is the value of what follows tick `t` in the same trajectory. Where the trajectory
    `terminated` at `t`, nothing follows and it is not read. Where it was `truncated`, it continued unseen: its
    value counts, but no later tick of the slot does, since that is of another vehicle. Rows that are not `valid`
    break the chain like a truncation and get zeros.
    """
    if discount == 0.0:
        advantage = torch.where(valid, reward - value, 0.0)
        return advantage, advantage + torch.where(valid, value, 0.0)
    bootstrap = torch.where(terminated, 0.0, next_value)
    residual = torch.where(valid, reward + discount * bootstrap - value, 0.0)
    chained = (valid & ~terminated & ~truncated).to(reward.dtype) * (discount * gae_lambda)
    advantage = torch.zeros_like(reward)
    later = torch.zeros_like(reward[0])
    for t in range(reward.shape[0] - 1, -1, -1):
        later = residual[t] + chained[t] * later
        advantage[t] = later
    return advantage, advantage + torch.where(valid, value, 0.0)
