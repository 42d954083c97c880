"""Measures sample visits per second of our PPO update and of a plain loop in CleanRL's manner, alternating in one run.

Same networks, batch, epochs, and threads. `python -m caraware_bench.ppo_update [--threads N] [--precision P]` prints
the median of each, and the median of the pairwise ratios. A sample visit is one sample in one epoch.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import torch

from caraware.learn.batch import Batch
from caraware.learn.build import build_ppo
from caraware.learn.config import MapBounds, MatmulPrecision, TrainerDevice
from caraware.tasks.localisation import Localisation
from caraware_bench.trainer import (
    EPOCHS,
    HORIZON,
    OBSERVATIONS,
    PlainAgent,
    learner_config,
    plain_update,
    random_batch,
)


def on(device: torch.device, batch: Batch) -> Batch:
    """The batch on the device of the networks."""
    return batch.to(device)


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
    parser.add_argument("--precision", type=MatmulPrecision, choices=MatmulPrecision, default="float32")
    parser.add_argument(
        "--device", type=TrainerDevice, choices=TrainerDevice, default="cpu", help="auto: a GPU if there is one"
    )
    parser.add_argument("--pairs", type=int, default=5)
    options = parser.parse_args()
    config = learner_config(options.threads, options.precision, options.device)
    ppo = build_ppo(
        config, OBSERVATIONS, Localisation(MapBounds(0.0, 0.0, 220.0, 220.0), config.reward, config.reward_scale_m)
    )
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
