"""RLlib's PPO over the PettingZoo face: `python -m caraware.examples.rllib_ppo [STEPS]`, one policy for all heroes.

RLlib needs another version of Gymnasium than this project, so it has an environment of its own: `make faces`, then
`.venv-faces/bin/python -m caraware.examples.rllib_ppo`.
"""

import os
import sys
from typing import Any

import numpy as np

os.environ.setdefault("RAY_AUTH_MODE", "disabled")  # nothing listens beyond this machine

import ray
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

from caraware.envs import CarAwareParallelEnv, make


def make_env(settings: dict[str, Any]) -> ParallelPettingZooEnv:
    """The heroes of one simulation with these settings as RLlib's agents; closing it ends the simulation."""
    return ParallelPettingZooEnv(CarAwareParallelEnv(make("driving", settings)))


def main(steps: int, batch_size: int = 2000, **changes: object) -> list[float]:
    """Learns for about `steps` ticks; the mean return of the episodes that ended, all heroes together, by update.

    An update takes `batch_size` ticks. The mean is NaN where no episode has ended yet.
    """
    register_env("caraware", make_env)
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
    config = (
        PPOConfig()
        .environment("caraware", env_config=dict(changes))
        .env_runners(num_env_runners=0)  # the simulation is in other processes already
        .multi_agent(policies={"hero"}, policy_mapping_fn=lambda agent, episode, **_: "hero")
        .training(train_batch_size_per_learner=batch_size, minibatch_size=min(512, batch_size), num_epochs=4)
    )
    returns, done = [], 0
    algorithm = config.build_algo()
    try:
        while done < steps:
            report = algorithm.train()["env_runners"]
            done += int(report["num_env_steps_sampled"])
            returns.append(float(report.get("episode_return_mean", np.nan)))
            print(f"{done} ticks, return {returns[-1]:.2f}", flush=True)
    finally:
        algorithm.stop()
        ray.shutdown()
    return returns


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 20_000)
