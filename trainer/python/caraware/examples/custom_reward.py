"""A reward of one's own, in five lines: `python -m caraware.examples.custom_reward`."""

import numpy as np

from caraware.envs import CarAwareVectorEnv, Transition, make
from caraware.ipc.arrays import Float32Array, Float64Array


def reward(obs: Transition, action: Float32Array) -> Float64Array:
    """Half for the position, half for doing better than the raw GNSS fix."""
    error_m = np.linalg.norm(obs.to_world_m(action) - obs.truth[:, :2], axis=1)
    raw_m = np.linalg.norm(obs.gnss_m - obs.truth[:, :2], axis=1)
    earned: Float64Array = 0.5 * np.exp(-error_m / 5.0) + 0.5 * (error_m < raw_m)
    return earned


def main(steps: int = 500, **settings: object) -> float:
    """Mean reward of random actions."""
    earned, samples = 0.0, 0
    with make("town", settings) as simulation:
        env = CarAwareVectorEnv(simulation, reward=reward)
        _, infos = env.reset()
        for _ in range(steps):
            samples += int(infos["mask"].sum())
            _, rewards, _, _, infos = env.step(env.action_space.sample())
            earned += float(rewards.sum())
    return earned / samples


if __name__ == "__main__":
    print(f"mean reward of random actions: {main():.4f}")
