"""Stable-Baselines3's PPO, alone or in the trainer's place of a run.

`python -m caraware.examples.sb3_ppo [STEPS]` starts its own simulation.
`caraware train --set trainer.module=caraware.examples.sb3_ppo` learns until the run ends, and answers its evaluations.
"""

import signal
import sys
from pathlib import Path

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import HumanOutputFormat, Logger

from caraware.envs import CarAwareVecEnv, RunEndedError, make
from caraware.ipc.channel import Channel
from caraware.tasks.contract import Sampling


def ppo(env: CarAwareVecEnv, horizon: int = 8192, batch_size: int = 1024) -> PPO:
    """PPO with the settings of the paper; predictions do not change the world, so only driving looks ahead."""
    task = env.slots.task
    torch.set_num_threads(1)  # of two cores the simulation needs one; torch's idle threads would spin on it
    model = PPO(
        "MlpPolicy",
        env,
        learning_rate=1e-3,
        n_steps=max(horizon // env.num_envs, 2),
        batch_size=batch_size,
        n_epochs=4,
        gamma=0.99 if task.sampling is Sampling.EACH_TICK else 0.0,
        ent_coef=0.001,
        policy_kwargs={"net_arch": [256, 128]},
        device="cpu",
    )
    # Its own logger makes a directory for every start, and leaves it.
    model.set_logger(Logger(folder=None, output_formats=[HumanOutputFormat(sys.stdout)]))
    return model


def alone(steps: int, horizon: int = 8192, batch_size: int = 1024, **settings: object) -> PPO:
    """Learns for `steps` env-steps on a simulation of its own."""
    with make("town", settings) as simulation:
        return ppo(CarAwareVecEnv(simulation), horizon, batch_size).learn(steps)


def in_a_run(run_file: str) -> None:
    """Learns until the run ends or is stopped; the model stays in the run directory."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    channel = Channel(run_file)
    trainer = channel.run["config"]["trainer"]
    env = CarAwareVecEnv(channel, evaluation_policy=lambda obs: model.predict(obs, deterministic=True)[0])
    model = ppo(env, trainer["horizon"], trainer["batch_size"])
    try:
        model.learn(sys.maxsize)
    except RunEndedError:
        print("run complete")
    finally:
        model.save(Path(channel.run["run_dir"], "sb3_ppo.zip"))
        env.close()


if __name__ == "__main__":
    argument = sys.argv[1] if len(sys.argv) > 1 else "500000"
    if argument.isdigit():
        alone(int(argument)).save("sb3_ppo.zip")
    else:
        in_a_run(argument)
