"""Samples visited per second by our PPO update and by a plain loop in CleanRL's manner, alternating in one run.

Same networks, batch, epochs, and threads. `python trainer/benches/ppo_update.py [--threads N] [--precision P]`;
prints the median of each, and the median of the pairwise ratios. A sample visit is one sample in one epoch.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from caraware.config import MapBounds, TrainerConfig
from caraware.ppo import Batch, Ppo
from torch import Tensor, nn
from torch.distributions import Normal

OBSERVATIONS, HORIZON, BATCH, EPOCHS = 9, 32_768, 2_048, 4


class PlainAgent(nn.Module):
    """The paper's networks as anybody would write them."""

    def __init__(self) -> None:
        super().__init__()
        self.value = nn.Sequential(
            nn.Linear(OBSERVATIONS, 500), nn.ReLU(), nn.Linear(500, 300), nn.ReLU(), nn.Linear(300, 1)
        )
        self.mean = nn.Sequential(
            nn.Linear(OBSERVATIONS, 500), nn.ReLU(), nn.Linear(500, 300), nn.Tanh(), nn.Linear(300, 2), nn.Tanh()
        )
        self.log_std = nn.Parameter(torch.zeros(1, 2))

    def evaluate(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Log-probability, entropy and value, `[b]` each."""
        mean = self.mean(observation)
        normal = Normal(mean, self.log_std.expand_as(mean).exp())
        value = self.value(observation).squeeze(1)
        return normal.log_prob(action).sum(1), normal.entropy().sum(1), value


def plain_update(agent: PlainAgent, adam: torch.optim.Adam, batch: Batch) -> None:
    """Epochs of minibatches through autograd and a joint optimiser."""
    for _ in range(EPOCHS):
        order = torch.randperm(HORIZON).to(batch.reward.device)
        for start in range(0, HORIZON, BATCH):
            rows = order[start : start + BATCH]
            new_log_probability, entropy, value = agent.evaluate(batch.observation[rows], batch.action[rows])
            ratio = (new_log_probability - batch.log_probability[rows]).exp()
            advantage = batch.advantage[rows]
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            policy_loss = torch.max(-advantage * ratio, -advantage * ratio.clamp(0.8, 1.2)).mean()
            value_loss = (value - batch.value_target[rows]).square().mean()
            adam.zero_grad()
            (policy_loss - 0.01 * entropy.mean() + value_loss).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            adam.step()


def random_batch(ppo: Ppo) -> Batch:
    """Actions of the given policy with made-up advantages."""
    observation = torch.rand(HORIZON, OBSERVATIONS) * 2 - 1
    with torch.no_grad():
        action = ppo.policy.mlp.infer(observation.to(ppo.device)).cpu() + torch.randn(HORIZON, 2)
    nothing = torch.zeros(HORIZON)
    log_probability = -0.5 * torch.randn(HORIZON, 2).square().sum(1) - 1.8379
    target = torch.rand(HORIZON)
    return Batch(
        observation=observation,
        action=action,
        log_probability=log_probability,
        reward=target,
        advantage=torch.randn(HORIZON),
        value_target=target,
        truth=torch.zeros(HORIZON, 4),
        vehicle=nothing.long(),
        tick=nothing.long(),
    )


def on(device: torch.device, batch: Batch) -> Batch:
    """The batch where the networks are."""
    return Batch(**{name: column.to(device) for name, column in vars(batch).items()})


def visits_per_s(update: Callable[[], object]) -> float:
    """Rate of one update."""
    start = time.perf_counter()
    update()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return HORIZON * EPOCHS / (time.perf_counter() - start)


def main() -> None:
    """Alternate the two and print medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--precision", choices=("float32", "bfloat16", "auto"), default="float32")
    parser.add_argument("--device", choices=("cpu", "auto"), default="cpu", help="auto: a GPU if there is one")
    parser.add_argument("--pairs", type=int, default=5)
    options = parser.parse_args()
    config = TrainerConfig(
        horizon=HORIZON,
        batch_size=BATCH,
        epochs=EPOCHS,
        learning_rate=1e-4,
        threads=options.threads,
        matmul_precision=options.precision,
        device=options.device,
    )
    ppo = Ppo(config, OBSERVATIONS, MapBounds(0.0, 0.0, 220.0, 220.0))
    threads_ours, precision_ours = torch.get_num_threads(), torch.get_float32_matmul_precision()
    batch, agent = on(ppo.device, random_batch(ppo)), PlainAgent().to(ppo.device)
    adam = torch.optim.Adam(agent.parameters(), lr=1e-4, eps=1e-5)
    rates: list[tuple[float, float]] = []
    for _ in range(options.pairs + 1):
        torch.set_num_threads(options.threads)
        torch.set_float32_matmul_precision("highest")
        plain = visits_per_s(lambda: plain_update(agent, adam, batch))
        torch.set_num_threads(threads_ours)
        torch.set_float32_matmul_precision(precision_ours)
        rates.append((visits_per_s(lambda: ppo.update(batch)), plain))
    pairs = rates[1:]
    ours, plain = (statistics.median(column) for column in zip(*pairs, strict=True))
    ratio = statistics.median(a / b for a, b in pairs)
    print(f"{ppo.device}, {options.threads} threads, {precision_ours} matmul precision, {options.pairs} pairs")
    update_ms = {name: 1e3 * HORIZON * EPOCHS / rate for name, rate in (("plain", plain), ("ours", ours))}
    print(f"plain loop {plain:9.0f} visits/s  {update_ms['plain']:7.1f} ms an update")
    print(f"ours       {ours:9.0f} visits/s  {update_ms['ours']:7.1f} ms an update\nratio      {ratio:9.2f}")


if __name__ == "__main__":
    main()
