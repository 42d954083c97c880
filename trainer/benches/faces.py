"""Env-steps per second with random actions through each face, beside the raw channel.

`python trainer/benches/faces.py [SECONDS]`: town and driving, each face in turn, three times; the median is told.
"""

import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
from caraware.envs import CarAwareEnv, CarAwareParallelEnv, CarAwareVecEnv, CarAwareVectorEnv, Simulation, make

REPEATS = 3
CONFIGS = {
    "town, 32 vehicles": ("town", {}),
    "town, 1 vehicle": ("town", {"traffic.cavs": 1}),
    "driving, 1 hero": ("driving", {}),
    "driving, 32 heroes": ("driving", {"traffic.heroes": 32, "traffic.hero_route": []}),
}


def until(seconds: float, step: Callable[[], int]) -> float:
    """Env-steps per second of `step`, which gives how many it made."""
    step()
    began, steps = time.perf_counter(), 0
    while (passed := time.perf_counter() - began) < seconds:
        steps += step()
    return steps / passed


def raw(simulation: Simulation, seconds: float) -> float:
    """Take a tick, answer it, give credit: what no face can beat."""
    channel, rng = simulation.channel, np.random.default_rng(0)
    drives = channel.run["config"]["task"]["kind"] == "driving"

    def step() -> int:
        ticks = channel.receive(10.0)
        for obs in ticks:
            if drives:
                channel.publish_actions(obs, rng.uniform(-1, 1, (len(obs.vehicle), 2)))
            channel.consumed(obs.tick)
        return sum(int(obs.valid.sum()) for obs in ticks)

    return until(seconds, step)


def vector(simulation: Simulation, seconds: float) -> float:
    """Gymnasium's VectorEnv."""
    env, rng = CarAwareVectorEnv(simulation), np.random.default_rng(0)
    env.reset()
    return until(seconds, lambda: int(env.step(rng.uniform(-1, 1, (env.num_envs, 2)))[4]["mask"].sum()))


def sb3(simulation: Simulation, seconds: float) -> float:
    """Stable-Baselines3's VecEnv."""
    env, rng = CarAwareVecEnv(simulation), np.random.default_rng(0)
    env.reset()

    def step() -> int:
        env.step(rng.uniform(-1, 1, (env.num_envs, 2)))
        return int(env.slots.now.mask.sum())

    return until(seconds, step)


def parallel(simulation: Simulation, seconds: float) -> float:
    """PettingZoo's ParallelEnv."""
    env, rng = CarAwareParallelEnv(simulation), np.random.default_rng(0)
    env.reset()

    def step() -> int:
        if not env.agents:
            env.reset()
        actions = rng.uniform(-1, 1, (len(env.agents), 2))
        return len(env.step(dict(zip(env.agents, actions, strict=True)))[0])

    return until(seconds, step)


def single(simulation: Simulation, seconds: float) -> float:
    """Gymnasium's Env; of several vehicles it sees one."""
    env, rng = CarAwareEnv(simulation), np.random.default_rng(0)
    env.reset()

    def step() -> int:
        _, _, terminated, truncated, _ = env.step(rng.uniform(-1, 1, 2))
        if terminated or truncated:
            env.reset()
        return 1

    return until(seconds, step)


def main(seconds: float) -> None:
    """All faces on all configurations."""
    for name, (config, settings) in CONFIGS.items():
        for face in (raw, vector, sb3, parallel, single):
            rates = []
            for repeat in range(REPEATS):
                with make(config, settings, seed=repeat + 1) as simulation:
                    rates.append(face(simulation, seconds))
            spread = ", ".join(f"{rate:,.0f}" for rate in sorted(rates))
            print(
                f"{name:20} {face.__name__:10} {statistics.median(rates):10,.0f} env-steps/s   ({spread})", flush=True
            )


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 3.0)
