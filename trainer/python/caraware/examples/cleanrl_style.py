"""PPO in one file and plain torch, over the Gymnasium face: `python -m caraware.examples.cleanrl_style [STEPS]`.

Two things differ from the usual single file: rows without a vehicle (`mask`) are left out of every batch, and a
truncated trajectory is worth what its last observation (`final_obs`) promises, a terminated one nothing more.
"""

import math
import sys
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from caraware.envs import CarAwareVectorEnv, make
from caraware.ipc.arrays import BoolArray, Float32Array


@dataclass(frozen=True)
class Settings:
    """Hyper-parameters."""

    ticks: int = 256
    """Ticks between updates; each is a sample of every slot that holds a vehicle."""
    batch_size: int = 1024
    epochs: int = 4
    learning_rate: float = 1e-3
    discount: float = 0.0
    """Predictions do not change the world; 0.99 for driving."""
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy: float = 0.001
    initial_std: float = 1.0
    """Standard deviation of the first actions; much less for driving."""
    seed: int = 1


class Agent(nn.Module):
    """Gaussian policy and value."""

    def __init__(self, fields: int, actions: int, initial_std: float) -> None:
        super().__init__()
        self.mean = nn.Sequential(
            nn.Linear(fields, 256), nn.Tanh(), nn.Linear(256, 128), nn.Tanh(), nn.Linear(128, actions)
        )
        self.log_std = nn.Parameter(torch.full((actions,), math.log(initial_std)))
        self.critic = nn.Sequential(nn.Linear(fields, 128), nn.Tanh(), nn.Linear(128, 1))

    def policy(self, observation: Tensor) -> torch.distributions.Normal:
        """The distribution of actions."""
        return torch.distributions.Normal(self.mean(observation), self.log_std.exp())

    def value(self, observation: Tensor) -> Tensor:
        """What an observation is worth, `[…]`."""
        value: Tensor = self.critic(observation)[..., 0]
        return value


@dataclass
class Collected:
    """`T` ticks of `N` slots; every array is `[T, N, …]`."""

    observation: Tensor
    action: Tensor
    log_prob: Tensor
    reward: Tensor
    value: Tensor
    next_value: Tensor
    """Of what followed: 0 after a termination, of `final_obs` after a truncation."""
    goes_on: Tensor
    mask: Tensor

    def advantage(self, discount: float, gae_lambda: float) -> Tensor:
        """Generalised advantage estimation (Schulman et al. 2016, equation 16), cut where a trajectory ends."""
        delta = self.reward + discount * self.next_value - self.value
        advantage, ahead = torch.zeros_like(delta), torch.zeros_like(delta[0])
        for t in reversed(range(len(delta))):
            ahead = delta[t] + discount * gae_lambda * self.goes_on[t] * ahead
            advantage[t] = ahead
        return advantage


@torch.no_grad()
def collect(
    env: CarAwareVectorEnv, agent: Agent, observation: Float32Array, mask: BoolArray, ticks: int
) -> tuple[Collected, Float32Array, BoolArray, float]:
    """`ticks` ticks, the observation and mask after them, and the mean error of the predictions."""
    rows, error_m, samples = [], 0.0, 0
    for _ in range(ticks):
        seen = torch.from_numpy(observation)
        policy = agent.policy(seen)
        action = policy.sample()
        following, earned, terminated, truncated, infos = env.step(action.numpy())
        after = torch.from_numpy(following.copy())
        for slot in np.flatnonzero(truncated):
            after[slot] = torch.from_numpy(infos["final_obs"][slot])
        alive = torch.from_numpy(~terminated).float()
        goes_on = torch.from_numpy(~(terminated | truncated)).float()
        log_prob, value = policy.log_prob(action).sum(-1), agent.value(seen)
        reward = torch.from_numpy(earned).float()
        next_value = agent.value(after) * alive
        rows.append((seen, action, log_prob, reward, value, next_value, goes_on, torch.from_numpy(mask)))
        error_m, samples = error_m + float(infos.get("error_m", np.zeros(1)).sum()), samples + int(mask.sum())
        observation, mask = following, infos["mask"]
    return Collected(*map(torch.stack, zip(*rows, strict=True))), observation, mask, error_m / max(samples, 1)


def update(agent: Agent, optimizer: torch.optim.Optimizer, batch: Collected, settings: Settings) -> None:
    """A few epochs of clipped policy gradient over the rows that hold vehicles."""
    held = batch.mask
    advantage = batch.advantage(settings.discount, settings.gae_lambda)
    target = (advantage + batch.value)[held]
    observation, action, log_prob, gain = (
        batch.observation[held],
        batch.action[held],
        batch.log_prob[held],
        advantage[held],
    )
    gain = (gain - gain.mean()) / (gain.std() + 1e-8)
    for _ in range(settings.epochs):
        for rows in torch.randperm(len(gain)).split(settings.batch_size):
            policy = agent.policy(observation[rows])
            ratio = (policy.log_prob(action[rows]).sum(-1) - log_prob[rows]).exp()
            clipped = ratio.clamp(1 - settings.clip, 1 + settings.clip)
            policy_loss = -torch.min(ratio * gain[rows], clipped * gain[rows]).mean()
            value_loss = (agent.value(observation[rows]) - target[rows]).square().mean()
            loss = policy_loss + 0.5 * value_loss - settings.entropy * policy.entropy().sum(-1).mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()


def main(steps: int, settings: Settings | None = None, config: str = "town", **changes: object) -> list[float]:
    """Learns for `steps` env-steps; the mean error before each update, metres (0 in the driving task)."""
    settings, errors_m, done = settings or Settings(), [], 0
    torch.manual_seed(settings.seed)
    torch.set_num_threads(1)  # of two cores the simulation needs one; torch's idle threads would spin on it
    with make(config, changes, seed=settings.seed) as simulation:
        env = CarAwareVectorEnv(simulation)
        run = env.slots.settings
        agent = Agent(run.fields.width, run.task.actions.size, settings.initial_std)
        optimizer = torch.optim.Adam(agent.parameters(), settings.learning_rate)
        observation, infos = env.reset()
        mask = infos["mask"]
        while done < steps:
            batch, observation, mask, error_m = collect(env, agent, observation, mask, settings.ticks)
            update(agent, optimizer, batch, settings)
            done += int(batch.mask.sum())
            errors_m.append(error_m)
            print(f"{done} env-steps, error {error_m:.2f} m, reward {float(batch.reward[batch.mask].mean()):.4f}")
    return errors_m


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 500_000)
