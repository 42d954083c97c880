"""Proximal policy optimisation (Schulman et al., arXiv 1707.06347) for the paper's localisation task.

A horizon of observations is collected; every observation gets a sampled action (a predicted position), its reward
(from the distance to the truth) and its advantage; then, for some epochs, the policy climbs the clipped surrogate
objective in minibatches while the value network regresses on the returns.

Actions are sampled when the horizon is full, not tick by tick: predictions do not influence the world. So the
samples depend on the seed and on the data alone, never on how many ticks happened to arrive together.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from caraware.learn import rewards
from caraware.learn.adam import Adam
from caraware.learn.batch import Batch
from caraware.learn.config import MapBounds, TrainerConfig
from caraware.learn.gae import generalised_advantage
from caraware.learn.graphed import GraphedUpdate, StepTable
from caraware.learn.networks import Activation, FlatParameters, GaussianPolicy, ValueNetwork, entropy, log_probability
from caraware.learn.objective import clipped_error, clipped_surrogate
from caraware.learn.prediction import Predictor, RowPredictor
from caraware.learn.ranks import Minibatch, Ranks, Union
from caraware.learn.rollout import Horizon
from caraware.learn.supervised import Supervised

P, V = TypeVar("P"), TypeVar("V")
ACTIONS = 2
SMALL_ROWS = 256
"""Rows of a block below which blocks are put together before the network sees them."""
SMALLEST_DEVIATION = 1e-8
SEED_STRIDE = 0x9E3779B97F4A7C15
"""Between the seeds of neighbouring environments: 2^64 over the golden ratio, so that they look nothing alike."""


class NonFiniteLoss(Exception):
    """A loss or gradient stopped being a number. The parameters are as before the step; the batch is saved."""

    def __init__(self, what: str, update: int) -> None:
        super().__init__(f"{what} is not finite in update {update}")
        self.update = update
        self.batch_file: Path | None = None


@dataclass(frozen=True)
class UpdateStats:
    """What one update did: means over its minibatches, unless the name says otherwise."""

    policy_loss: float
    value_loss: float
    entropy: float
    approximate_kl: float
    """Mean of (ratio - 1) - log ratio, an unbiased estimate of KL(old, new) that is never negative."""
    clip_fraction: float
    ratio_mean: float
    ratio_max: float
    sigma: float
    """Standard deviation of the policy after the update, mean over the actions, in actions."""
    advantage_mean: float
    advantage_std: float
    return_mean: float
    """Of the value targets."""
    return_std: float
    reward_mean: float
    action_mean_x: float
    """Of the actions that this trainer sampled: 0 is the middle of the map, ±1 its edge."""
    action_mean_y: float
    action_std_x: float
    action_std_y: float
    action_outside: float
    """Share of the sampled positions that lie outside the map."""
    explained_variance: float
    """1 - Var(target - value) / Var(target), of the values before the update."""
    policy_gradient_norm: float
    value_gradient_norm: float
    learning_rate: float
    clip_epsilon: float
    entropy_scale: float
    policy_epochs: int
    """Fewer than configured where `target_kl` ended the policy's update early."""
    samples: int


@dataclass(frozen=True)
class Settings:
    """What schedules say of one update."""

    learning_rate: float
    clip_epsilon: float
    entropy_scale: float

    @classmethod
    def at(cls, config: TrainerConfig, updates: int, progress: float) -> "Settings":
        """After `updates` updates, with the share `progress` of all training episodes behind."""

        def scheduled(start: float, end: float | None) -> float:
            return start if end is None else start + (end - start) * min(max(progress, 0.0), 1.0)

        decayed = config.learning_rate * config.learning_rate_decay**updates
        linear = config.learning_rate_final is not None
        return cls(
            learning_rate=scheduled(config.learning_rate, config.learning_rate_final) if linear else decayed,
            clip_epsilon=scheduled(config.clip_epsilon, config.clip_epsilon_final),
            entropy_scale=scheduled(config.entropy_scale, config.entropy_scale_final),
        )


@dataclass(frozen=True)
class ForwardPass:
    """What both networks say of a horizon."""

    rows: Tensor
    """i64 `[s]`: where the samples are in the flattened horizon."""
    observation: Tensor
    """f32 `[s, d]`."""
    mean: Tensor
    """f32 `[s, 2]`: the policy's mean action."""
    value: Tensor
    """f32 `[s]`."""
    value_after: Tensor | None
    """f32 `[N]`: of what followed the last tick in each slot; None where no discount asks for it."""


@dataclass(frozen=True)
class _PolicyMeans:
    epochs: int
    loss: float
    entropy: float
    approximate_kl: float
    clip_fraction: float
    ratio_mean: float
    ratio_max: float
    gradient_norm: float


@dataclass(frozen=True)
class _ValueMeans:
    loss: float
    gradient_norm: float


class Ppo:
    """Policy, value network, their optimisers and random numbers; everything that a checkpoint must hold."""

    def __init__(
        self,
        config: TrainerConfig,
        observation_size: int,
        bounds: MapBounds,
        environments: Sequence[int] = (0,),
        ranks: Ranks | None = None,
    ) -> None:
        """`environments` are the indices, among those of all `ranks`, of those whose horizons it scores."""
        self.ranks = ranks or Ranks()
        self.config, self.bounds = config, bounds
        self.observation_size = observation_size
        self.updates = 0
        self.progress = 0.0
        """Share of all training episodes that is behind; schedules follow it."""
        self.device = _configure_torch(config)
        self.sampling = torch.Generator().manual_seed(config.seed)
        self.shuffling = torch.Generator().manual_seed(config.seed + 1)
        self._environments = tuple(environments)
        self.policy, self.value = self._networks()
        self.policy.initialise(self.sampling, config.initial_std)
        self.value.initialise(self.sampling)
        self._samplings = [self._sampling_of(index) for index in environments]
        self.policy_optimiser = Adam(self.policy.network.parameters)
        self.value_optimiser = Adam(self.value.network.parameters)
        self._reward = rewards.by_name(config.reward)
        self._second_core = _worker(config, self.device)
        self.supervised = (
            Supervised(config, observation_size, bounds, self.device, self.ranks) if config.supervised else None
        )
        self._graphed = self._graphed_update()

    def _networks(self) -> tuple[GaussianPolicy, ValueNetwork]:
        """Policy and value network, before a weight is drawn."""
        config, activation = self.config, Activation(self.config.activation)
        policy = GaussianPolicy(self.observation_size, ACTIONS, config.hidden, self.device, activation)
        return policy, ValueNetwork(self.observation_size, config.hidden, self.device, activation)

    def _graphed_update(self) -> GraphedUpdate | None:
        """On a GPU. The steps of several ranks meet on the way, which a graph of one rank's step does not know of."""
        return GraphedUpdate(self) if self.device.type == "cuda" and self.ranks.size == 1 else None

    def _sampling_of(self, environment: int) -> torch.Generator:
        """Every environment has its own random actions, whoever learns from it; the first goes on after the weights."""
        if environment == 0:
            return self.sampling
        return torch.Generator().manual_seed((self.config.seed + environment * SEED_STRIDE) % 2**63)

    def sampling_generators(self) -> dict[str, torch.Generator]:
        """The random numbers of the actions, by the name that a checkpoint gives them."""
        names = (f"sampling{index or ''}" for index in self._environments)
        return dict(zip(names, self._samplings, strict=True))

    def predictor(self, dark_is_nan: bool, evaluations_alone: bool = True) -> Predictor:
        """What predicts for the ticks of a stream as they come (`caraware.learn.prediction`)."""
        return RowPredictor(self, dark_is_nan, evaluations_alone)

    def memory_tensors(self) -> dict[str, Tensor]:
        """What the networks remember of trajectories up to the newest horizon; nothing, if they see one moment."""
        return {}

    def restore_memory(self, tensors: dict[str, Tensor]) -> None:
        """Remember what `memory_tensors` told; with nothing, forget everything."""

    @torch.no_grad()
    def predict_m(self, observations: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Predicted positions `[n, 2]` in world metres for each of some `[n, d]` blocks: the policy's mean.

        One forward pass over all rows. Large blocks are read where they lie, which is shared memory; small ones are
        put together first, which costs less than to call for each.
        """
        rows = sum(len(block) for block in observations)
        if len(observations) > 1 and rows < SMALL_ROWS * len(observations):
            mean = self.policy.network.infer(torch.cat(list(observations)).to(self.device))
        else:
            mean = self.policy.network.infer(*(block.to(self.device) for block in observations))
        return self.bounds.to_world_m(mean).cpu().split([len(block) for block in observations])

    def learn(self, horizon: Horizon) -> UpdateStats:
        """Sample, score and learn from one horizon. Raises `NonFiniteLoss` with the batch in memory."""
        return self.update(self.score(horizon))

    @torch.no_grad()
    def score(self, horizon: Horizon, environment: int = 0) -> Batch:
        """Give every sample of one environment's horizon its action, reward and advantage."""
        return self._scored(horizon, self._forward(horizon), environment)

    def _forward(self, horizon: Horizon) -> ForwardPass:
        """Both networks over all samples."""
        rows = horizon.valid.flatten().nonzero().squeeze(1)
        observation = horizon.observation.flatten(0, 1).index_select(0, rows).to(self.device)
        mean, value = self._both(
            lambda: self.policy.network.infer(observation), lambda: self.value.network.infer(observation).squeeze(1)
        )
        if horizon.bootstrap is None or self.config.discount == 0.0:
            return ForwardPass(rows, observation, mean, value, None)
        after = self.value.network.infer(horizon.bootstrap.to(self.device)).squeeze(1)
        return ForwardPass(rows, observation, mean, value, after.cpu())

    def _scored(self, horizon: Horizon, forward: ForwardPass, environment: int) -> Batch:
        """Actions around the policy's means, their rewards and advantages."""
        rows, mean, value = forward.rows, forward.mean, forward.value
        truth = horizon.truth.flatten(0, 1).index_select(0, rows).to(self.device)
        tries = self.config.actions_per_observation
        centre, place = (mean, truth) if tries == 1 else (mean.unsqueeze(1), truth.unsqueeze(1))
        noise = _noise(len(mean), tries, self._samplings[environment]).to(self.device)
        action = centre + self.policy.log_std.exp() * (noise.squeeze(1) if tries == 1 else noise)
        reward = self._reward(rewards.distance_m(self.bounds.to_world_m(action), place), self.config.reward_scale_m)
        if tries == 1:
            advantage, value_target = self._advantages(horizon, forward, reward)
        else:
            advantage = reward - value.unsqueeze(1)
            reward = value_target = reward.mean(1)
        return Batch(
            observation=forward.observation,
            action=action,
            log_probability=log_probability(action, centre, self.policy.log_std),
            reward=reward,
            advantage=advantage,
            value_target=value_target,
            truth=truth,
            error_m=rewards.distance_m(self.bounds.to_world_m(mean), truth),
            vehicle=horizon.vehicle.flatten()[rows],
            tick=horizon.tick.repeat_interleave(horizon.valid.shape[1])[rows],
        )

    @torch.no_grad()
    def update(self, batch: Batch) -> UpdateStats:
        """All epochs of minibatches over one batch. Policy and value share nothing, so each has its own core."""
        now = Settings.at(self.config, self.updates, self.progress)
        union = self.ranks.union(batch.advantage, batch.reward, batch.value_target)
        pieces = self._pieces(batch, union)
        orders = [torch.randperm(pieces, generator=self.shuffling) for _ in range(self.config.epochs)]
        orders = [order.to(self.device) for order in orders]
        if self._graphed is not None:
            policy, value = self._means_of(self._graphed.run(batch, orders, now), len(orders))
        else:
            policy, value = self._both(
                lambda: self._improve_policy(batch, union, orders, now),
                lambda: self._improve_value(batch, union, orders, now),
            )
        if self.supervised is not None:
            self.supervised.learn(batch, union, self._parts(union), now.learning_rate)
        self.updates += 1
        return self._stats(batch, union, policy, value, now)

    def _both(self, of_policy: Callable[[], P], of_value: Callable[[], V]) -> tuple[P, V]:
        """What both jobs return: side by side where there is a second core, and none goes on when one has failed."""
        if self._second_core is None:
            return of_policy(), of_value()
        value_job = self._second_core.submit(of_value)
        try:
            policy = of_policy()
        finally:
            value_job.exception()
        return policy, value_job.result()

    def _pieces(self, batch: Batch, union: Union) -> int:
        """How many pieces of the union are shuffled: its samples."""
        return len(union)

    def _minibatches(
        self, lane: str, batch: Batch, union: Union, columns: Sequence[Tensor], order: Tensor
    ) -> Iterator[Minibatch]:
        """The pieces in `order`, cut into minibatches: what the network of `lane` takes, then rows of `columns`."""
        return union.minibatches((batch.observation, *columns), order, self._parts(union))

    @torch.no_grad()
    def _improve_policy(self, batch: Batch, union: Union, orders: list[Tensor], now: Settings) -> _PolicyMeans:
        """Climb the clipped surrogate objective plus the entropy bonus."""
        policy, epochs = self.policy, 0
        log: list[list[float]] = []
        largest: list[float] = []
        columns = (batch.action, batch.log_probability)
        for order in orders:
            steps: list[tuple[float, ...]] = []
            for part in self._minibatches("policy", batch, union, columns, order):
                *told, ratio_max = self._policy_gradient(part, now)
                norm = self._step("policy", policy.network.parameters, self.policy_optimiser, now.learning_rate)
                steps.append(tuple(number * part.share for number in (*told, norm)))
                largest.append(ratio_max)
            log += self._of_all("policy", steps)
            epochs += 1
            if self._went_far([row[1] for row in log[-len(steps) :]]):
                break
        loss, kl, clipped, ratio_mean, norm = _means(log)
        spread, ratio_max = entropy(policy.log_std).item(), self.ranks.largest(max(largest))
        return _PolicyMeans(epochs, loss, spread, kl, clipped, ratio_mean, ratio_max, norm)

    def _policy_gradient(self, part: Minibatch, now: Settings) -> tuple[float, float, float, float, float]:
        """This rank's part of the gradient; its loss, KL, clip fraction, mean and largest ratio."""
        policy = self.policy
        if part.share == 0.0:
            policy.network.parameters.gradient.zero_()
            return 0.0, 0.0, 0.0, 0.0, 0.0
        observation, action, old_log_probability = part.own
        mean = policy.network.forward(observation)
        advantage = part.mine(_normalised(part.advantage))
        surrogate = clipped_surrogate(mean, policy.log_std, action, old_log_probability, advantage, now.clip_epsilon)
        loss = self._finite("the policy's loss", surrogate.loss - now.entropy_scale * entropy(policy.log_std))
        policy.network.backward(observation, surrogate.mean_gradient * part.share)
        policy.log_std_gradient.copy_((surrogate.log_std_gradient - now.entropy_scale) * part.share)
        ratio, kl = surrogate.ratio, surrogate.approximate_kl()
        return loss, kl, surrogate.clip_fraction(), ratio.mean().item(), ratio.max().item()

    def _of_all(self, lane: str, steps: Sequence[tuple[float, ...]]) -> list[list[float]]:
        """The numbers of every step, weighted with the shares of the ranks, of all ranks."""
        table = torch.tensor(steps, dtype=torch.float64)
        self.ranks.add_up(lane, table)
        return table.tolist()

    @torch.no_grad()
    def _went_far(self, kl_of_steps: Sequence[float]) -> bool:
        """Whether the policy has left the one that sampled by more than `target_kl` in an epoch."""
        return self.config.target_kl is not None and sum(kl_of_steps) / len(kl_of_steps) > self.config.target_kl

    def _improve_value(self, batch: Batch, union: Union, orders: list[Tensor], now: Settings) -> _ValueMeans:
        """Regress on the value targets with the mean squared error, clipped where `value_clip` says so."""
        steps = []
        columns = (batch.value_target, batch.value_advantage())
        for order in orders:
            for part in self._minibatches("value", batch, union, columns, order):
                loss = self._value_gradient(part)
                norm = self._step("value", self.value.network.parameters, self.value_optimiser, now.learning_rate)
                steps.append((loss * part.share, norm * part.share))
        loss, norm = _means(self._of_all("value", steps))
        return _ValueMeans(loss, norm)

    def _value_gradient(self, part: Minibatch) -> float:
        """This rank's part of the gradient; its loss."""
        network = self.value.network
        if part.share == 0.0:
            network.parameters.gradient.zero_()
            return 0.0
        observation, target, advantage = part.own
        error = clipped_error(network.forward(observation).squeeze(1), target, advantage, self.config.value_clip)
        loss = self._finite("the value network's loss", error.loss.mean())
        weight = 2 * self.config.value_scale / len(target) * part.share
        network.backward(observation, error.pull.unsqueeze(1) * weight)
        return loss

    def _means_of(self, table: StepTable, epochs: int) -> tuple[_PolicyMeans, _ValueMeans]:
        """The means of an update on a GPU, which tells its numbers at its end."""
        if not table.finite():
            raise NonFiniteLoss("a loss or gradient", self.updates + 1)
        epochs = min(epochs, table.policy_epochs)
        loss, kl, clipped, ratio_mean, _, norm = table.policy.mean(0).tolist()
        ratio_max = table.policy[:, 4].max().item()
        spread = entropy(self.policy.log_std).item()
        value_loss, value_norm = table.value.mean(0).tolist()
        policy = _PolicyMeans(epochs, loss, spread, kl, clipped, ratio_mean, ratio_max, norm)
        return policy, _ValueMeans(value_loss, value_norm)

    def _advantages(self, horizon: Horizon, forward: ForwardPass, reward: Tensor) -> tuple[Tensor, Tensor]:
        """Advantages and value targets `[s]` of the samples, by way of the `[T, N]` grid that GAE needs."""
        rows, value = forward.rows, forward.value
        if self.config.discount == 0.0:
            return reward - value, reward
        grid = horizon.valid.shape
        on_grid = [
            torch.zeros(grid.numel()).index_copy_(0, rows, column.cpu()).view(grid) for column in (reward, value)
        ]
        next_value = on_grid[1].roll(-1, 0)
        if forward.value_after is not None:
            next_value[-1] = forward.value_after
        # What follows a cut is not observed; the value at the cut is the nearest estimate of it.
        next_value = torch.where(horizon.truncated, on_grid[1], next_value)
        results = generalised_advantage(
            reward=on_grid[0],
            value=on_grid[1],
            next_value=next_value,
            terminated=horizon.terminated,
            truncated=horizon.truncated,
            valid=horizon.valid,
            discount=self.config.discount,
            gae_lambda=self.config.gae_lambda,
        )
        advantage, value_target = (result.flatten()[rows].to(self.device) for result in results)
        return advantage, value_target

    def _parts(self, union: Union) -> int:
        """Minibatches of about `batch_size` samples of each rank."""
        return max(1, round(len(union) / (self.config.batch_size * self.ranks.size)))

    def _step(self, lane: str, parameters: FlatParameters, optimiser: Adam, learning_rate: float) -> float:
        """Add up the gradient of all ranks, clip it to `max_grad_norm`, take an Adam step; the norm before clipping."""
        self.ranks.add_up(lane, parameters.gradient)
        norm = self._finite(f"the {lane} gradient", torch.linalg.vector_norm(parameters.gradient))
        if norm > self.config.max_grad_norm:
            parameters.gradient.mul_(self.config.max_grad_norm / norm)
        optimiser.step(learning_rate)
        return norm

    def _finite(self, what: str, value: Tensor) -> float:
        number = value.item()
        if not math.isfinite(number):
            raise NonFiniteLoss(what, self.updates + 1)
        return number

    def _stats(
        self, batch: Batch, union: Union, policy: _PolicyMeans, value: _ValueMeans, now: Settings
    ) -> UpdateStats:
        # With several actions for an observation they lie side by side.
        actions = batch.action.reshape(-1, ACTIONS)
        action_mean_x, action_mean_y = actions.mean(0).tolist()
        action_std_x, action_std_y = actions.std(0, correction=0).tolist()
        return UpdateStats(
            policy_loss=policy.loss,
            value_loss=value.loss,
            entropy=policy.entropy,
            approximate_kl=policy.approximate_kl,
            clip_fraction=policy.clip_fraction,
            ratio_mean=policy.ratio_mean,
            ratio_max=policy.ratio_max,
            sigma=self.sigma(),
            advantage_mean=union.advantage.mean().item(),
            advantage_std=union.advantage.std(correction=0).item(),
            return_mean=union.value_target.mean().item(),
            return_std=union.value_target.std(correction=0).item(),
            reward_mean=union.reward.mean().item(),
            action_mean_x=action_mean_x,
            action_mean_y=action_mean_y,
            action_std_x=action_std_x,
            action_std_y=action_std_y,
            action_outside=(actions.abs() > 1).any(1).float().mean().item(),
            explained_variance=_explained_variance(union),
            policy_gradient_norm=policy.gradient_norm,
            value_gradient_norm=value.gradient_norm,
            learning_rate=now.learning_rate,
            clip_epsilon=now.clip_epsilon,
            entropy_scale=now.entropy_scale,
            policy_epochs=policy.epochs,
            samples=len(union),
        )

    def sigma(self) -> float:
        """Standard deviation of the policy, mean over the actions; 1 is half the map."""
        return self.policy.log_std.exp().mean().item()


def _noise(samples: int, tries: int, generator: torch.Generator) -> Tensor:
    """Standard normal `[samples, tries, 2]`; an even number of tries comes in pairs on both sides of the mean.

    Each is still a sample of the policy, and the mean gradient that of the policy. What two opposite actions have in
    common drops out of it, which is most of its variance (antithetic variates; Owen, Monte Carlo, section 8.2).
    """
    if tries % 2:
        return torch.randn(samples, tries, ACTIONS, generator=generator)
    half = torch.randn(samples, tries // 2, ACTIONS, generator=generator)
    return torch.cat((half, -half), 1)


def _normalised(advantage: Tensor) -> Tensor:
    deviation = advantage.std(correction=0) + SMALLEST_DEVIATION
    return (advantage - advantage.mean()) / deviation


def _means(rows: Sequence[Sequence[float]]) -> list[float]:
    return [sum(column) / len(rows) for column in zip(*rows, strict=True)]


def _explained_variance(union: Union) -> float:
    spread = union.value_target.var(correction=0).item()
    advantage = union.advantage if union.advantage.ndim == 1 else union.advantage.mean(1)
    return 1 - advantage.var(correction=0).item() / spread if spread > 0 else 0.0


def _configure_torch(config: TrainerConfig) -> torch.device:
    """Settings that torch keeps per process: threads within an operation, and the precision of matrix products."""
    torch.set_num_threads(_threads_per_network(config))
    amx = hasattr(torch.cpu, "get_capabilities") and torch.cpu.get_capabilities().get("amx_bf16", False)
    gpu = config.device == "auto" and torch.cuda.is_available()
    reduced = config.matmul_precision == "bfloat16" or (config.matmul_precision == "auto" and amx and not gpu)
    # On a GPU "auto" is TensorFloat-32: 10 bits of mantissa, float32's range.
    full = "high" if gpu and config.matmul_precision == "auto" else "highest"
    torch.set_float32_matmul_precision("medium" if reduced else full)
    return torch.device("cuda" if gpu else "cpu")


def _threads_per_network(config: TrainerConfig) -> int:
    return max(1, config.thread_count() // 2)


def _worker(config: TrainerConfig, device: torch.device) -> ThreadPoolExecutor | None:
    """A thread for the value network where there is a second core for it.

    Two threads, each with its own network, scale better than one network's operations spread over two threads:
    nothing waits at the end of every operation, least of all for a core that another process is using.
    """
    if config.thread_count() < 2 or device.type != "cpu":
        return None
    return ThreadPoolExecutor(1, "value", initializer=torch.set_num_threads, initargs=(_threads_per_network(config),))
