"""PufferLib's PPO over the Gymnasium face: `python -m caraware.examples.puffer_ppo [STEPS]`, one policy for all heroes.

PufferLib asks for an older Gymnasium than this project has, so it has an environment of its own: `make puffer`, then
`.venv-puffer/bin/python -m caraware.examples.puffer_ppo`.
"""

import contextlib
import math
import signal
import sys
import tempfile

import numpy as np
import torch

from caraware.envs import CarAwareVectorEnv, make
from caraware.ipc.arrays import BoolArray, Float32Array

# PufferLib's import leaves a link in the working directory, and Ctrl-C then ends the process without `finally` blocks.
with tempfile.TemporaryDirectory() as directory, contextlib.chdir(directory):
    import pufferlib
    from pufferlib import pufferl
    from pufferlib.models import Default
signal.signal(signal.SIGINT, signal.default_int_handler)

SEED = 1
HORIZON = 64
"""Ticks of a row of PufferLib's batch."""
REWARD_SCALE = 0.1
"""PufferLib clips rewards to −1 … 1; arrival earns 10 and a collision −10."""
Infos = list[dict[str, list[float]]]


class CarAwarePufferEnv(pufferlib.PufferEnv):  # type: ignore[misc]  # pufferlib has no types
    """All slots of a simulation as PufferLib's agents. Each tick is written into the arrays that its trainer reads.

    PufferLib 3.0 also learns from rows without a vehicle: observation and reward are 0 there. It never bootstraps from
    `final_obs`, so a truncated trajectory counts as terminated.
    """

    def __init__(self, face: CarAwareVectorEnv) -> None:
        self.face, self.num_agents = face, face.num_envs
        self.single_observation_space = face.single_observation_space
        self.single_action_space = face.single_action_space
        self.returns = np.zeros(self.num_agents)
        super().__init__()

    def reset(self, seed: int | None = None) -> tuple[Float32Array, Infos]:
        """The first observations, f32 `[N, d]`."""
        self.observations[:], infos = self.face.reset(seed=seed)
        self.masks[:] = infos["mask"]
        for of_a_tick in (self.rewards, self.terminals, self.truncations, self.returns):
            of_a_tick[:] = 0
        return self.observations, []

    def step(self, actions: Float32Array) -> tuple[Float32Array, Float32Array, BoolArray, BoolArray, Infos]:
        """Observations `[N, d]`, rewards, ends and truncations `[N]`, and the returns of trajectories that ended."""
        self.observations[:], reward, terminated, self.truncations[:], infos = self.face.step(actions)
        self.rewards[:], self.masks[:] = REWARD_SCALE * reward, infos["mask"]
        self.terminals[:] = terminated | self.truncations
        self.returns += reward
        ended = {"return": self.returns[self.terminals].tolist()}
        self.returns[self.terminals] = 0
        return self.observations, self.rewards, self.terminals, self.truncations, [ended]

    def close(self) -> None:
        """Ends the simulation."""
        self.face.close()


class Trainer(pufferl.PuffeRL):  # type: ignore[misc]
    """PufferLib's trainer without its dashboard, which clears the terminal."""

    def print_dashboard(self, clear: bool = False) -> None:
        """Prints nothing."""


def main(steps: int, ticks: int = 256, config: str = "driving", **changes: object) -> list[float]:
    """Learns for about `steps` ticks; the mean return of the trajectories that ended, by update.

    An update takes `ticks` ticks, a multiple of `HORIZON`. The mean is NaN where no trajectory has ended.
    """
    returns: list[float] = []
    updates = math.ceil(steps / ticks)
    torch.manual_seed(SEED)
    torch.set_num_threads(1)  # of two cores the simulation needs one; torch's idle threads would spin on it
    with make(config, changes, seed=SEED) as simulation, tempfile.TemporaryDirectory() as checkpoints:
        env = CarAwarePufferEnv(CarAwareVectorEnv(simulation))
        batch_size = ticks * env.num_agents
        settings = pufferl.load_config("default")["train"] | {
            "device": "cpu",
            "seed": SEED,
            "data_dir": checkpoints,
            "total_timesteps": updates * batch_size,
            "batch_size": batch_size,
            "bptt_horizon": HORIZON,
            "minibatch_size": HORIZON * env.num_agents,
            "update_epochs": 4,
            "optimizer": "adam",
            "learning_rate": 3e-3,
            "gamma": 0.99,
        }
        trainer = Trainer(settings, env, Default(env))
        try:
            while len(returns) < updates:
                ended = trainer.evaluate().pop("return", [])
                returns.append(float(np.mean(ended)) if ended else math.nan)
                trainer.train()
                print(f"{len(returns) * ticks} ticks, return {returns[-1]:.2f}", flush=True)
        finally:
            trainer.close()
    return returns


if __name__ == "__main__":
    # PufferLib reads what is left of the command line.
    main(int(sys.argv.pop(1)) if len(sys.argv) > 1 else 20_000)
