"""`python -m caraware_bench.trainer [--pairs N] [--threads N]`: compares the learner with SB3 and a plain loop.

All learners have the same networks, horizon, minibatches, epochs and threads, and alternate in one process: ours, the
same PPO with its plain update, a plain loop, Stable-Baselines3's PPO. Rollouts are measured twice, alike on all sides:
with one forward pass for each tick of eight vehicles, and with one for 64 ticks that wait (as many sub-environments
where a learner steps its environments). The program prints JSON, which `caraware bench trainer` turns into a report. A
sample visit is one sample in one epoch.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Normal

from caraware.ipc.arrays import BoolArray, Float32Array, UInt32Array
from caraware.learn.batch import Batch
from caraware.learn.build import build_ppo, paper_networks
from caraware.learn.config import (
    BuiltInNetwork,
    EstimateTimes,
    HiddenActivation,
    MapBounds,
    MatmulPrecision,
    TrainerConfig,
    TrainerDevice,
)
from caraware.learn.ppo import PlainUpdate, Ppo
from caraware.learn.rollout import Rollout
from caraware.report.evaluation import Mean
from caraware.tasks.localisation import Localisation, raw_errors_m
from caraware.tasks.rewards import RewardName

if TYPE_CHECKING:
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

OBSERVATIONS, HORIZON, BATCH, EPOCHS = 9, 32_768, 2_048, 4
VEHICLES = 8
WINDOW_TICKS = 64
"""Ticks that wait together where forward passes are batched."""
OURS, PLAIN_UPDATE = "ours", "ours with the plain update"
PLAIN_LOOP, SB3 = "plain loop (CleanRL's manner)", "Stable-Baselines3's PPO"
SIZES = (50, 500, 5_000)
"""Numbers of vehicles for the cost of a tick."""
BOUNDS = MapBounds(0.0, 0.0, 220.0, 220.0)


class PlainAgent(nn.Module):
    """The paper's networks in plain `torch.nn`."""

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
    """Run epochs of minibatches through autograd and one optimiser for both networks, in CleanRL's manner."""
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


def learner_config(
    threads: int,
    matmul_precision: MatmulPrecision = MatmulPrecision.FLOAT32,
    device: TrainerDevice = TrainerDevice.CPU,
) -> TrainerConfig:
    """Configuration of the paper's learner at the sizes of this comparison."""
    return TrainerConfig(
        learning_rate=1e-4,
        learning_rate_decay=0.995,
        learning_rate_final=None,
        discount=0.0,
        gae_lambda=0.95,
        clip_epsilon=0.2,
        clip_epsilon_final=None,
        initial_std=1.0,
        entropy_scale=0.001,
        entropy_scale_final=None,
        value_scale=1.0,
        value_clip=None,
        target_kl=None,
        value_updates=0,
        max_grad_norm=0.5,
        actions_per_observation=1,
        horizon=HORIZON,
        batch_size=BATCH,
        epochs=EPOCHS,
        network=BuiltInNetwork.MLP,
        hidden=(500, 300),
        activation=HiddenActivation.RELU,
        truncation_ticks=32,
        frames=4,
        supervised=False,
        reward=RewardName.BOUNDED_INVERSE,
        reward_scale_m=5.0,
        matmul_precision=matmul_precision,
        ranks=1,
        threads=threads,
        device=device,
        seed=1,
        checkpoint_interval_updates=10,
        checkpoints_kept=5,
        checkpoint_keep_every=0,
        estimates=EstimateTimes.NEVER,
        plots=False,
        images=None,
    )


def random_batch(ppo: Ppo) -> Batch:
    """A batch of the given policy's actions with random advantages."""
    observation = torch.rand(HORIZON, OBSERVATIONS) * 2 - 1
    with torch.no_grad():
        action = ppo.updater.mean(observation.to(ppo.device)).cpu() + torch.randn(HORIZON, 2)
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
        metrics={"error_m": nothing},
        vehicle=nothing.long(),
        tick=nothing.long(),
    )


@dataclass
class FreeTick:
    """A tick without a simulation: the arrays that the rollout and the error meter read."""

    tick: int
    observation: Tensor
    truth: Tensor
    gnss_m: Tensor
    vehicle: UInt32Array
    valid: BoolArray
    terminated: BoolArray
    truncated: BoolArray

    @property
    def ended_by(self) -> UInt32Array:
        """No heroes."""
        return np.zeros(len(self.vehicle), np.uint32)


@dataclass
class FreeTicks:
    """Windows of ticks with `vehicles` vehicles, without end."""

    vehicles: int
    window: int = WINDOW_TICKS
    _tick: FreeTick = field(init=False)

    def __post_init__(self) -> None:
        n, never = self.vehicles, np.zeros(self.vehicles, bool)
        truth = torch.rand(n, 4) * 220
        self._tick = FreeTick(
            0,
            torch.rand(n, OBSERVATIONS) * 2 - 1,
            truth,
            truth[:, :2] + 5,
            np.arange(n, dtype=np.uint32),
            ~never,
            never,
            never,
        )

    def __iter__(self) -> Iterator[list[FreeTick]]:
        tick = 0
        while True:
            window = [FreeTick(**vars(self._tick) | {"tick": tick + i}) for i in range(self.window)]
            tick += self.window
            yield window


def take(ppo: Ppo, rollout: Rollout, raw_m: Mean, window: list[FreeTick]) -> None:
    """Process the waiting ticks as the training loop does: one forward pass, all errors, then a copy of each tick."""
    ppo.predict_m([obs.observation for obs in window])
    for obs, error_m in zip(window, raw_errors_m(window), strict=True):
        raw_m.add(error_m)
        rollout.add(obs)


def our_horizon(ppo: Ppo, rollout: Rollout, ticks: Iterator[list[FreeTick]]) -> None:
    """Collect a horizon of ticks and make its update."""
    raw_m = Mean()
    while not rollout.full():
        take(ppo, rollout, raw_m, next(ticks))
    ppo.learn(rollout.take())


def plain_horizon(agent: PlainAgent, adam: torch.optim.Adam, rows: int) -> None:
    """Collect a horizon with `rows` rows in each forward pass, and make its update: the plain loop."""
    observation = torch.rand(rows, OBSERVATIONS) * 2 - 1
    columns: list[tuple[Tensor, ...]] = []
    for _ in range(HORIZON // rows):
        with torch.no_grad():
            mean = agent.mean(observation)
            normal = Normal(mean, agent.log_std.expand_as(mean).exp())
            action = normal.sample()
            value = agent.value(observation).squeeze(1)
        reward = -(action - observation[:, :2]).square().sum(1)
        columns.append((observation, action, normal.log_prob(action).sum(1), reward, reward - value))
    observations, actions, log_probabilities, rewards, advantages = (
        torch.cat(column) for column in zip(*columns, strict=True)
    )
    nothing = torch.zeros(HORIZON)
    batch = Batch(
        observation=observations,
        action=actions,
        log_probability=log_probabilities,
        reward=rewards,
        advantage=advantages,
        value_target=rewards,
        truth=torch.zeros(HORIZON, 4),
        metrics={},
        vehicle=nothing.long(),
        tick=nothing.long(),
    )
    plain_update(agent, adam, batch)


def sb3_model(rows: int) -> "PPO":
    """Stable-Baselines3's PPO with the same sizes, on an environment without a simulation that has `rows` parts."""
    from gymnasium import spaces
    from stable_baselines3 import PPO
    from stable_baselines3.common.logger import Logger
    from stable_baselines3.common.vec_env.base_vec_env import VecEnv

    class FreeEnv(VecEnv):
        def __init__(self) -> None:
            box = spaces.Box(-1, 1, (OBSERVATIONS,), np.float32)
            self.render_mode = None
            super().__init__(rows, box, spaces.Box(-1, 1, (2,), np.float32))
            self._observation = np.random.default_rng(1).uniform(-1, 1, (rows, OBSERVATIONS)).astype(np.float32)
            self._infos: list[dict[str, Any]] = [{} for _ in range(rows)]

        def reset(self) -> Float32Array:
            return self._observation

        def step_async(self, actions: Float32Array) -> None:
            self._actions = actions

        def step_wait(self) -> "VecEnvStepReturn":
            reward = -np.square(self._actions - self._observation[:, :2]).sum(1)
            return self._observation, reward, np.zeros(rows, bool), self._infos

        def close(self) -> None:
            pass

        def get_attr(self, attr_name: str, indices: object = None) -> list[Any]:
            return [getattr(self, attr_name)] * rows

        def set_attr(self, attr_name: str, value: object, indices: object = None) -> None:
            setattr(self, attr_name, value)

        def env_method(self, method_name: str, *args: object, indices: object = None, **kwargs: object) -> list[Any]:
            raise NotImplementedError(method_name)

        def env_is_wrapped(self, wrapper_class: type, indices: object = None) -> list[bool]:
            return [False] * rows

    model = PPO(
        "MlpPolicy",
        FreeEnv(),
        n_steps=HORIZON // rows,
        batch_size=BATCH,
        n_epochs=EPOCHS,
        learning_rate=1e-4,
        policy_kwargs={"net_arch": [500, 300], "activation_fn": nn.ReLU},
        device="cpu",
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model


def seconds(work: Callable[[], object]) -> float:
    """Wall time of one call."""
    return cost(work)[0]


def cost(work: Callable[[], object]) -> tuple[float, float]:
    """Wall time and processor time of all threads of one call, seconds."""
    cpu_s, wall_s = time.process_time(), time.perf_counter()
    work()
    return time.perf_counter() - wall_s, time.process_time() - cpu_s


class Contest:
    """Pieces of work that alternate, each the same for every learner."""

    def __init__(self, threads: int) -> None:
        self._threads, self._own_threads = threads, torch.get_num_threads()
        self._work: dict[str, tuple[Callable[[], object], bool]] = {}
        self.costs: dict[str, list[tuple[float, float]]] = {}

    def add(self, learner: str, work: Callable[[], object], *, sets_threads: bool = False) -> None:
        """`sets_threads`: the learner has set torch's threads; the others get all of `threads` within an operation."""
        self._work[learner], self.costs[learner] = (work, sets_threads), []

    def round(self, *, counts: bool) -> None:
        """Every learner once; the first round warms up and does not count."""
        for learner, (work, sets_threads) in self._work.items():
            torch.set_num_threads(self._own_threads if sets_threads else self._threads)
            try:
                taken = cost(work)
            finally:
                torch.set_num_threads(self._own_threads)
            self.costs[learner] += [taken] if counts else []

    def figures(self) -> list[dict[str, object]]:
        """Seconds by learner and round."""
        return [
            {"name": name, "wall_s": [wall for wall, _ in each], "cpu_s": [cpu for _, cpu in each]}
            for name, each in self.costs.items()
        ]


def python_calls(work: Callable[[], object]) -> int:
    """Function calls of Python and of C that one call makes."""
    count = 0

    def note(frame: object, event: str, argument: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    sys.setprofile(note)
    try:
        work()
    finally:
        sys.setprofile(None)
    return count


def measure_tick(ppo: Ppo, vehicles: int) -> dict[str, float]:
    """Cost of a tick of `vehicles` before the update: its time, and its calls from Python, which must not grow."""
    rollout, raw_m, ticks = Rollout(10**9, OBSERVATIONS, bootstrap=False), Mean(), iter(FreeTicks(vehicles))
    for _ in range(2):
        take(ppo, rollout, raw_m, next(ticks))
    window = next(ticks)
    forward = seconds(lambda: ppo.predict_m([obs.observation for obs in window]))
    calls = python_calls(lambda: take(ppo, rollout, raw_m, window))
    whole = seconds(lambda: take(ppo, rollout, raw_m, next(ticks)))
    per_tick = 1e6 / WINDOW_TICKS
    return {
        "vehicles": vehicles,
        "us_per_tick": whole * per_tick,
        "forward_us_per_tick": forward * per_tick,
        "calls_per_tick": calls / WINDOW_TICKS,
    }


def plain_ppo(config: TrainerConfig, task: Localisation) -> Ppo:
    """Our PPO with the update that the fast one is tested against: autograd and `torch.optim.Adam`."""
    generator = torch.Generator().manual_seed(config.seed)
    policy, value = paper_networks(config, OBSERVATIONS, task.actions.size, generator)
    update = PlainUpdate(config, policy, value, torch.device("cpu"))
    return Ppo(config, task, OBSERVATIONS, update, generator, (0,))


def rollout_contest(threads: int, window: int) -> Contest:
    """Horizons with their updates: `window` ticks of eight vehicles, or as many sub-environments, in a forward pass."""
    config, contest = learner_config(threads), Contest(threads)
    task = Localisation(BOUNDS, config.reward, config.reward_scale_m)
    for name, ppo in ((OURS, build_ppo(config, OBSERVATIONS, task)), (PLAIN_UPDATE, plain_ppo(config, task))):
        rollout, ticks = Rollout(HORIZON, OBSERVATIONS, bootstrap=False), iter(FreeTicks(VEHICLES, window))
        contest.add(name, partial(our_horizon, ppo, rollout, ticks), sets_threads=name == OURS)
    agent, model = PlainAgent(), sb3_model(VEHICLES * window)
    adam = torch.optim.Adam(agent.parameters(), lr=1e-4, eps=1e-5)
    contest.add(PLAIN_LOOP, partial(plain_horizon, agent, adam, VEHICLES * window))
    contest.add(SB3, partial(model.learn, HORIZON, reset_num_timesteps=False))
    return contest


def main() -> None:
    """Measure all learners in turn and print the seconds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--json", type=Path, help="file for the seconds, in place of standard output")
    options = parser.parse_args()
    config = learner_config(options.threads)
    task = Localisation(BOUNDS, config.reward, config.reward_scale_m)
    ppo = build_ppo(config, OBSERVATIONS, task)
    updates = Contest(options.threads)
    batch, agent, plain = random_batch(ppo), PlainAgent(), plain_ppo(config, task)
    adam = torch.optim.Adam(agent.parameters(), lr=1e-4, eps=1e-5)
    model = sb3_model(VEHICLES)
    model.learn(HORIZON)
    updates.add(OURS, lambda: ppo.update(batch), sets_threads=True)
    updates.add(PLAIN_UPDATE, lambda: plain.update(batch))
    updates.add(PLAIN_LOOP, lambda: plain_update(agent, adam, batch))
    updates.add(SB3, model.train)
    rollouts = {window: rollout_contest(options.threads, window) for window in (1, WINDOW_TICKS)}
    for number in range(options.pairs + 1):
        for contest in (updates, *rollouts.values()):
            contest.round(counts=number > 0)
    result = {
        "threads": options.threads,
        "precision": torch.get_float32_matmul_precision(),
        "updates": updates.figures(),
        "rollouts": [{"window": window, "learners": contest.figures()} for window, contest in rollouts.items()],
        "ticks": [measure_tick(ppo, vehicles) for vehicles in SIZES],
    }
    if options.json:
        options.json.write_text(json.dumps(result))
    else:
        print(json.dumps(result))


if __name__ == "__main__":
    main()
