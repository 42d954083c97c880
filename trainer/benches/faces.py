"""Measures env-steps per second with random actions through each face, compared with the raw channel.

`python trainer/benches/faces.py [SECONDS]`: town and driving, the faces in turn, six times. It prints the best of each,
as whatever else the machine does can only slow them down, and the least CPU time of this process for a step of all
slots.
"""

import sys
import time
from collections import deque
from collections.abc import Callable

import numpy as np
import torch
from caraware.envs import CarAwareEnv, CarAwareParallelEnv, CarAwareVecEnv, CarAwareVectorEnv, Simulation, make
from caraware.ipc.channel import Observation

REPEATS = 6
CONFIGS = {
    "town, 32 vehicles": ("town", {}),
    "driving, 1 hero": ("lap", {}),
    "driving, 32 heroes": ("lap", {"traffic.heroes": 32, "traffic.hero_route": []}),
}


def until(seconds: float, step: Callable[[], int]) -> tuple[float, float]:
    """Env-steps per second of `step`, which gives how many it made, and this process's CPU time for a call (µs)."""
    step()
    began, cpu_began, steps, calls = time.perf_counter(), time.process_time(), 0, 0
    while (passed := time.perf_counter() - began) < seconds:
        steps, calls = steps + step(), calls + 1
    return steps / passed, (time.process_time() - cpu_began) / calls * 1e6


def raw(simulation: Simulation, seconds: float) -> tuple[float, float]:
    """Take a tick, answer it and return its credit: the upper limit of every face."""
    channel, rng = simulation.channel, np.random.default_rng(0)
    waiting: deque[Observation] = deque()
    drives = channel.run["config"]["task"]["kind"] == "driving"

    def step() -> int:
        if not waiting:
            waiting.extend(channel.receive(10.0))
        obs = waiting.popleft()
        actions = rng.uniform(-1, 1, (len(obs.vehicle), 2))
        if drives:
            channel.publish_actions(obs, actions)
        else:
            channel.publish_predictions(obs, torch.from_numpy(actions), 0)
        channel.consumed(obs.tick)
        return int(obs.valid.sum())

    try:
        return until(seconds, step)
    finally:
        waiting.clear()


def vector(simulation: Simulation, seconds: float) -> tuple[float, float]:
    """Gymnasium's VectorEnv."""
    env, rng = CarAwareVectorEnv(simulation), np.random.default_rng(0)
    env.reset()
    return until(seconds, lambda: int(env.step(rng.uniform(-1, 1, (env.num_envs, 2)))[4]["mask"].sum()))


def sb3(simulation: Simulation, seconds: float) -> tuple[float, float]:
    """Stable-Baselines3's VecEnv."""
    env, rng = CarAwareVecEnv(simulation), np.random.default_rng(0)
    env.reset()

    def step() -> int:
        env.step(rng.uniform(-1, 1, (env.num_envs, 2)))
        return int(env.slots.now.mask.sum())

    return until(seconds, step)


def parallel(simulation: Simulation, seconds: float) -> tuple[float, float]:
    """PettingZoo's ParallelEnv."""
    env, rng = CarAwareParallelEnv(simulation, agents="ids"), np.random.default_rng(0)
    env.reset()

    def step() -> int:
        if not env.agents:
            env.reset()
        actions = rng.uniform(-1, 1, (len(env.agents), 2))
        return len(env.step(dict(zip(env.agents, actions, strict=True)))[0])

    return until(seconds, step)


def single(simulation: Simulation, seconds: float) -> tuple[float, float]:
    """Gymnasium's Env; of several vehicles it sees one."""
    env, rng = CarAwareEnv(simulation), np.random.default_rng(0)
    env.reset()

    def step() -> int:
        _, _, terminated, truncated, _ = env.step(rng.uniform(-1, 1, 2))
        if terminated or truncated:
            env.reset()
        return 1

    return until(seconds, step)


FACES = (raw, vector, sb3, parallel, single)


def main(seconds: float) -> None:
    """Measure all faces on all configurations in turn, so that other work on the machine affects all of them."""
    for name, (config, settings) in CONFIGS.items():
        measured: dict[str, list[tuple[float, float]]] = {face.__name__: [] for face in FACES}
        for repeat in range(REPEATS):
            for face in FACES:
                with make(config, settings, seed=repeat + 1) as simulation:
                    measured[face.__name__].append(face(simulation, seconds))
        best_raw = max(rate for rate, _ in measured["raw"])
        for face_name, results in measured.items():
            rates, cpu_us = zip(*results, strict=True)
            share = max(rates) / best_raw
            line = f"{max(rates):9,.0f} env-steps/s {share:6.0%} of raw {min(cpu_us):6.0f} µs of CPU a step"
            print(
                f"{name:18} {face_name:9} {line}   ({', '.join(f'{rate:,.0f}' for rate in sorted(rates))})", flush=True
            )


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 3.0)
