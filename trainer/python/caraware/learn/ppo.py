"""Proximal policy optimisation (Schulman et al., arXiv 1707.06347), algorithm 1, on `torch.nn` and autograd.

A horizon of observations is collected; every observation gets a sampled action (a predicted position), its reward
(from the distance to the truth) and its advantage; then, for some epochs, the policy climbs the clipped surrogate
objective in minibatches while the value network regresses on the returns.

Where predictions do not influence the world, actions are sampled when the horizon is full: so the samples depend on the
seed and on the data alone, never on how many ticks happened to arrive together. Where the world waits for every action
(driving), it is drawn when the tick comes (`caraware.learn.drawing`), and its log-probability is stored with it.

Read `Ppo.score`, then `PlainUpdate`. The forms that are faster (`caraware.learn.fast`, `caraware.learn.graphed`) keep
the contract of `PolicyUpdate`; docs/decisions/0020.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor, nn

from caraware.learn.adam import EPSILON, ModuleAdam
from caraware.learn.batch import Batch
from caraware.learn.config import TrainerConfig
from caraware.learn.drawing import DrawingPredictor
from caraware.learn.gae import generalised_advantage
from caraware.learn.networks import GaussianPolicy, entropy, log_probability
from caraware.learn.noise import action_noise
from caraware.learn.prediction import Predictor, RowPredictor
from caraware.learn.rollout import DrawnHorizon, DrawnTick, Horizon
from caraware.learn.stored import MEMORY, OPTIMISER, PARAMETERS, PPO, RANDOM, LearnerShape, StoredTensors
from caraware.tasks.contract import Sampling, Task, TaskOutcome, TaskRows, TaskStep

if TYPE_CHECKING:
    from caraware.learn.frames import Seen

ACTING_ROWS = 512
"""So many observations or fewer are quicker on the CPU than the way to a GPU and back."""
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
class ScheduledValues:
    """The values that change over training, as they are in one update."""

    update: int
    """Counted from 1."""
    learning_rate: float
    clip_epsilon: float
    entropy_scale: float

    @classmethod
    def at(cls, config: TrainerConfig, updates: int, progress: float) -> "ScheduledValues":
        """After `updates` updates, with the share `progress` of all training episodes done."""

        def scheduled(start: float, end: float | None) -> float:
            return start if end is None else start + (end - start) * min(max(progress, 0.0), 1.0)

        decayed = config.learning_rate * config.learning_rate_decay**updates
        linear = config.learning_rate_final is not None
        return cls(
            update=updates + 1,
            learning_rate=scheduled(config.learning_rate, config.learning_rate_final) if linear else decayed,
            clip_epsilon=scheduled(config.clip_epsilon, config.clip_epsilon_final),
            entropy_scale=scheduled(config.entropy_scale, config.entropy_scale_final),
        )


@dataclass(frozen=True)
class PolicyFigures:
    """Means over the policy's gradient steps in one update, unless the name says otherwise."""

    epochs: int
    loss: float
    entropy: float
    approximate_kl: float
    clip_fraction: float
    ratio_mean: float
    ratio_max: float
    gradient_norm: float


@dataclass(frozen=True)
class ValueFigures:
    """Means over the value network's gradient steps in one update."""

    loss: float
    gradient_norm: float


@dataclass(frozen=True)
class UpdateFigures:
    """What an update returns: its figures, and the numbers of all samples that it learned from, of all ranks."""

    policy: PolicyFigures
    value: ValueFigures
    advantage: Tensor
    """f32 `[S]`, or `[S, k]` with k > 1 actions per observation."""
    reward: Tensor
    """f32 `[S]`."""
    value_target: Tensor
    """f32 `[S]`."""


class PolicyUpdate(Protocol):
    """Policy and value network with their optimisers: what PPO asks of them, however they are computed."""

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        ...

    @property
    def log_std(self) -> Tensor:
        """f32 `[a]`: logarithm of the policy's standard deviation."""
        ...

    def mean(self, *observations: Tensor) -> Tensor:
        """Mean actions `[n, a]` of some blocks of observations `[_, d]`, without gradient."""
        ...

    def value(self, observation: Tensor) -> Tensor:
        """Values `[n]` of observations `[n, d]`, without gradient."""
        ...

    def mean_and_value(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Both, of the same observations."""
        ...

    def improve(self, batch: Batch, shuffling: torch.Generator, now: ScheduledValues) -> UpdateFigures:
        """All epochs of minibatches over one batch. Raises `NonFiniteLoss`."""
        ...

    def parameters(self) -> dict[str, Tensor]:
        """All parameters by name; the tensors are the networks' own, so filling them loads them."""
        ...

    def moments(self) -> dict[str, Tensor]:
        """The optimisers' state by name, to be stored."""
        ...

    def restore_moments(self, moments: dict[str, Tensor]) -> None:
        """Continue with the state that `moments` returned."""
        ...


class PlainUpdate:
    """The reference: autograd and Adam, for any two networks that are `nn.Module`s."""

    def __init__(self, config: TrainerConfig, policy: GaussianPolicy, value: nn.Module, device: torch.device) -> None:
        """`policy` maps observations `[b, d]` to mean actions `[b, a]`, `value` to `[b, 1]`."""
        self.device = device
        self._config = config
        self._policy, self._value = policy.to(device), value.to(device)
        self._acting, self._acting_version = self._policy, -1
        self._adam = {name: ModuleAdam(self._ordered(name), EPSILON) for name in ("policy", "value")}

    @property
    def policy(self) -> GaussianPolicy:
        """The policy's network, for learners beside PPO."""
        return self._policy

    def improve(self, batch: Batch, shuffling: torch.Generator, now: ScheduledValues) -> UpdateFigures:
        """See `PolicyUpdate.improve`. K epochs of minibatches of about M samples (algorithm 1)."""
        minibatches = max(1, round(len(batch.reward) / self._config.batch_size))
        self._acting_version = -1
        policy_steps: list[list[float]] = []
        value_steps: list[list[float]] = []
        policy_epochs, is_near = 0, True
        for _ in range(self._config.epochs):
            order = torch.randperm(len(batch.reward), generator=shuffling).to(self.device)
            for rows in order.tensor_split(minibatches):
                if is_near:
                    policy_steps.append(self._policy_step(batch, rows, now))
                value_steps.append(self._value_step(batch, rows, now))
            if is_near:
                policy_epochs += 1
                kl = sum(step[1] for step in policy_steps[-minibatches:]) / minibatches
                is_near = self._config.target_kl is None or kl <= self._config.target_kl
        loss, kl, clipped, ratio_mean, _, norm = mean_columns(policy_steps)
        largest = max(step[4] for step in policy_steps)
        spread = entropy(self.log_std).item()
        return UpdateFigures(
            policy=PolicyFigures(policy_epochs, loss, spread, kl, clipped, ratio_mean, largest, norm),
            value=ValueFigures(*mean_columns(value_steps)),
            advantage=batch.advantage,
            reward=batch.reward,
            value_target=batch.value_target,
        )

    def _policy_step(self, batch: Batch, rows: Tensor, now: ScheduledValues) -> list[float]:
        """One step up the objective of the policy."""
        loss, figures = self._policy_loss(batch, rows, normalised(batch.advantage[rows]), now)
        norm = self._step("policy", loss, now)
        return [loss.item(), *figures, norm]

    def _policy_loss(
        self, batch: Batch, rows: Tensor, advantage: Tensor, now: ScheduledValues
    ) -> tuple[Tensor, list[float]]:
        """The clipped surrogate objective (equation 7) and the entropy bonus (equation 9) of some rows, negative.

        `advantage` are the normalised ones of these rows. The figures are KL, clip fraction, mean and largest ratio.
        """
        # How much more probable each action is now than when it was sampled.
        mean = self._policy(self._input(batch, rows))
        mean = mean if batch.action.ndim == 2 else mean.unsqueeze(1)
        log_ratio = log_probability(batch.action[rows], mean, self._policy.log_std) - batch.log_probability[rows]
        ratio = log_ratio.exp()
        # Beyond 1 ± ε a change of that probability earns nothing more.
        clipped = ratio.clamp(1 - now.clip_epsilon, 1 + now.clip_epsilon)
        surrogate = torch.minimum(ratio * advantage, clipped * advantage).mean()
        loss = -surrogate - now.entropy_scale * entropy(self._policy.log_std)
        with torch.no_grad():
            kl = (ratio - 1 - log_ratio).mean().item()
            outside = ((ratio - 1).abs() > now.clip_epsilon).float().mean().item()
            return loss, [kl, outside, ratio.mean().item(), ratio.max().item()]

    def _input(self, batch: Batch, rows: Tensor) -> "Tensor | Seen":
        """What the policy sees of some rows of a batch."""
        return batch.observation[rows]

    def _value_step(self, batch: Batch, rows: Tensor, now: ScheduledValues) -> list[float]:
        """One step down the error of the values."""
        loss = self._value_loss(batch, rows)
        norm = self._step("value", self._config.value_scale * loss, now)
        return [loss.item(), norm]

    def _value_loss(self, batch: Batch, rows: Tensor) -> Tensor:
        """The squared error of the values, clipped about those before the update if so configured."""
        value = self._value(batch.observation[rows]).squeeze(1)
        target = batch.value_target[rows]
        error = (value - target).square()
        if self._config.value_clip is not None:
            before = target - batch.value_advantage()[rows]
            held = before + (value - before).clamp(-self._config.value_clip, self._config.value_clip)
            error = torch.maximum(error, (held - target).square())
        loss: Tensor = error.mean()
        return loss

    def _step(self, name: str, loss: Tensor, now: ScheduledValues) -> float:
        """Back-propagate, then take a step with the gradient; its norm before clipping."""
        finite(f"the {name} loss", loss, now)
        self._adam[name].zero_grad()
        loss.backward()
        return self._descend(name, now)

    def _descend(self, name: str, now: ScheduledValues) -> float:
        """Clip the gradient to `max_grad_norm`, take one Adam step; the norm before clipping."""
        adam, network = self._adam[name], self._policy if name == "policy" else self._value
        norm = nn.utils.clip_grad_norm_(network.parameters(), self._config.max_grad_norm)
        finite(f"the {name} gradient", norm, now)
        adam.step(now.learning_rate)
        return norm.item()

    @property
    def log_std(self) -> Tensor:
        """See `PolicyUpdate.log_std`."""
        return self._policy.log_std.detach()

    @torch.no_grad()
    def mean(self, *observations: Tensor) -> Tensor:
        """See `PolicyUpdate.mean`. On the CPU where few rows come from there."""
        if sum(map(len, observations)) <= ACTING_ROWS and all(block.device.type == "cpu" for block in observations):
            mean: Tensor = self._on_cpu()(torch.cat(observations))
        else:
            mean = self._policy(torch.cat([block.to(self.device) for block in observations]))
        return mean

    def _on_cpu(self) -> nn.Module:
        """The policy on the CPU: itself, or a copy of what it is now."""
        if self.device.type == "cpu":
            return self._policy
        # Whatever fills or moves a tensor in place counts up its version.
        version = sum(tensor._version for tensor in self._policy.state_dict().values())
        if version != self._acting_version:
            self._acting, self._acting_version = copy.deepcopy(self._policy).cpu(), version
        return self._acting

    @torch.no_grad()
    def value(self, observation: Tensor) -> Tensor:
        """See `PolicyUpdate.value`."""
        value: Tensor = self._value(observation.to(self.device)).squeeze(1)
        return value

    def mean_and_value(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """See `PolicyUpdate.mean_and_value`."""
        return self.mean(observation), self.value(observation)

    def parameters(self) -> dict[str, Tensor]:
        """See `PolicyUpdate.parameters`. Buffers of a network, running means for example, are among them."""
        names = {f"policy.{name}": tensor for name, tensor in self._policy.network.state_dict().items()}
        names["policy.log_std"] = self._policy.log_std.data
        return names | {f"value.{name}": tensor for name, tensor in self._value.state_dict().items()}

    def moments(self) -> dict[str, Tensor]:
        """See `PolicyUpdate.moments`: of each network the running moments in one vector, and the count of steps."""
        moments: dict[str, Tensor] = {}
        for name, adam in self._adam.items():
            moments[f"{name}.mean"] = torch.cat([mean.flatten() for mean in adam.means])
            moments[f"{name}.square"] = torch.cat([square.flatten() for square in adam.squares])
            moments[f"{name}.steps"] = torch.tensor(int(adam.steps[0]))
        return moments

    def restore_moments(self, moments: dict[str, Tensor]) -> None:
        """See `PolicyUpdate.restore_moments`."""
        for name, adam in self._adam.items():
            sizes = [mean.numel() for mean in adam.means]
            means, squares = (moments[f"{name}.{own}"].split(sizes) for own in ("mean", "square"))
            adam.restore(means, squares, moments[f"{name}.steps"].item())

    def _ordered(self, name: str) -> list[nn.Parameter]:
        """The parameters in the order of a checkpoint: the logarithm of the standard deviation is the last."""
        if name == "value":
            return list(self._value.parameters())
        return [*self._policy.network.parameters(), self._policy.log_std]


@dataclass(frozen=True)
class UpdateStats:
    """The figures of one update: means over its minibatches, unless the name says otherwise."""

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
class ForwardPass:
    """The outputs of both networks for a horizon."""

    rows: Tensor
    """i64 `[s]`: where the samples are in the flattened horizon."""
    observation: Tensor
    """f32 `[s, d]`."""
    mean: Tensor
    """f32 `[s, a]`: the policy's mean action."""
    value: Tensor
    """f32 `[s]`."""
    value_after: Tensor | None
    """f32 `[N]`: of the tick after the last one in each slot; None where no discount asks for it."""


@dataclass(frozen=True)
class StoredPolicy:
    """The policy's parameters and moments before an update that only the value network keeps."""

    parameters: dict[str, Tensor]
    moments: dict[str, Tensor]

    def put_back(self, updater: PolicyUpdate) -> None:
        """Undo the policy's part of the update."""
        own = updater.parameters()
        with torch.no_grad():
            for name, tensor in self.parameters.items():
                own[name].copy_(tensor)
        updater.restore_moments(updater.moments() | self.moments)


def _policy_of(updater: PolicyUpdate) -> StoredPolicy:
    """Copies of what an update changes in the policy."""

    def copied(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        return {name: tensor.clone() for name, tensor in tensors.items() if name.startswith("policy.")}

    return StoredPolicy(copied(updater.parameters()), copied(updater.moments()))


class Ppo:
    """Policy, value network, their optimisers and random numbers; everything that a checkpoint must hold."""

    def __init__(
        self,
        config: TrainerConfig,
        task: Task,
        observation_size: int,
        updater: PolicyUpdate,
        sampling: torch.Generator,
        environments: Sequence[int] = (0,),
    ) -> None:
        """`environments` are the indices, among those of all ranks, of those whose horizons it scores.

        `sampling` has drawn the first weights, and draws the actions of environment 0. `caraware.learn.build` makes
        all of this from a configuration.
        """
        self.config, self.task, self.updater = config, task, updater
        self.observation_size = observation_size
        self.updates = 0
        self.progress = 0.0
        """Share of all training episodes that is done; schedules follow it."""
        self.shuffling = torch.Generator().manual_seed(config.seed + 1)
        self._environments = tuple(environments)
        self.held: dict[int, DrawnTick] = {}
        """By environment: what was drawn before the newest update for the tick after its horizon."""
        self._samplings = [sampling if index == 0 else _sampling(config.seed, index) for index in environments]

    def learn(self, horizon: Horizon) -> UpdateStats:
        """Sample, score and learn from one horizon. Raises `NonFiniteLoss`."""
        return self.update(self.score(horizon))

    @torch.no_grad()
    def score(self, horizon: Horizon, environment: int = 0) -> Batch:
        """Give every sample of one environment's horizon its action, reward and advantage."""
        rows = horizon.valid.flatten().nonzero().squeeze(1)
        observation = self.task.network_input(horizon.observation.flatten(0, 1).index_select(0, rows).to(self.device))
        mean, value = self.updater.mean_and_value(observation)
        after = None
        if horizon.bootstrap is not None and self.config.discount > 0.0:
            after = self.updater.value(self.task.network_input(horizon.bootstrap.to(self.device))).cpu()
        return self._scored(horizon, ForwardPass(rows, observation, mean, value, after), environment)

    def _scored(self, horizon: Horizon, forward: ForwardPass, environment: int) -> Batch:
        """Actions around the policy's means, their rewards and advantages."""
        if horizon.drawn is not None:
            return self._scored_as_drawn(horizon, horizon.drawn, forward, environment)
        rows, mean, value, log_std = forward.rows, forward.mean, forward.value, self.updater.log_std
        truth = horizon.truth.flatten(0, 1).index_select(0, rows).to(self.device)
        tries = self.config.actions_per_observation
        step = TaskStep(forward.observation, truth)
        centre = mean if tries == 1 else mean.unsqueeze(1)
        noise = action_noise(len(mean), tries, self.task.actions.size, self._samplings[environment]).to(self.device)
        action = centre + log_std.exp() * (noise.squeeze(1) if tries == 1 else noise)
        reward = self.task.reward(step, action)
        if tries == 1:
            advantage, value_target = self._advantages(horizon, forward, reward)
        else:
            advantage = reward - value.unsqueeze(1)
            reward = value_target = reward.mean(1)
        return Batch(
            observation=forward.observation,
            action=action,
            log_probability=log_probability(action, centre, log_std),
            reward=reward,
            advantage=advantage,
            value_target=value_target,
            truth=truth,
            metrics=self.task.measure(step, mean),
            vehicle=horizon.vehicle.flatten()[rows],
            tick=horizon.tick.repeat_interleave(horizon.valid.shape[1])[rows],
        )

    def _scored_as_drawn(self, horizon: Horizon, drawn: DrawnHorizon, forward: ForwardPass, environment: int) -> Batch:
        """The actions that moved the world, with the log-probabilities that they were drawn with."""
        self.held[environment] = drawn.held
        rows = forward.rows
        step = _step_of(horizon, drawn, forward)
        action = drawn.action.flatten(0, 1).index_select(0, rows).to(self.device)
        reward = self.task.reward(step, action).float()
        advantage, value_target = self._advantages(horizon, forward, reward)
        return Batch(
            observation=forward.observation,
            action=action,
            log_probability=drawn.log_probability.flatten()[rows].to(self.device),
            reward=reward,
            advantage=advantage,
            value_target=value_target,
            truth=step.truth,
            metrics=self.task.measure(step, action),
            vehicle=horizon.vehicle.flatten()[rows],
            tick=horizon.tick.repeat_interleave(horizon.valid.shape[1])[rows],
        )

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

    def update(self, batch: Batch) -> UpdateStats:
        """Learn from a scored batch. Raises `NonFiniteLoss`."""
        now = ScheduledValues.at(self.config, self.updates, self.progress)
        before = _policy_of(self.updater) if self.updates < self.config.value_updates else None
        figures = self.updater.improve(batch, self.shuffling, now)
        if before is not None:
            before.put_back(self.updater)
        self.updates += 1
        return self._stats(batch, figures, now)

    def _stats(self, batch: Batch, figures: UpdateFigures, now: ScheduledValues) -> UpdateStats:
        policy, value = figures.policy, figures.value
        # With several actions for an observation they lie side by side.
        actions = batch.action.reshape(-1, self.task.actions.size)
        # An action of more numbers shows its first two, one of a single number that one twice.
        x, y = 0, min(1, self.task.actions.size - 1)
        action_mean, action_std = actions.mean(0).tolist(), actions.std(0, correction=0).tolist()
        return UpdateStats(
            policy_loss=policy.loss,
            value_loss=value.loss,
            entropy=policy.entropy,
            approximate_kl=policy.approximate_kl,
            clip_fraction=policy.clip_fraction,
            ratio_mean=policy.ratio_mean,
            ratio_max=policy.ratio_max,
            sigma=self.sigma(),
            advantage_mean=figures.advantage.mean().item(),
            advantage_std=figures.advantage.std(correction=0).item(),
            return_mean=figures.value_target.mean().item(),
            return_std=figures.value_target.std(correction=0).item(),
            reward_mean=figures.reward.mean().item(),
            action_mean_x=action_mean[x],
            action_mean_y=action_mean[y],
            action_std_x=action_std[x],
            action_std_y=action_std[y],
            action_outside=(actions.abs() > 1).any(1).float().mean().item(),
            explained_variance=_explained_variance(figures),
            policy_gradient_norm=policy.gradient_norm,
            value_gradient_norm=value.gradient_norm,
            learning_rate=now.learning_rate,
            clip_epsilon=now.clip_epsilon,
            entropy_scale=now.entropy_scale,
            policy_epochs=policy.epochs,
            samples=len(figures.advantage),
        )

    @property
    def device(self) -> torch.device:
        """Where the networks are."""
        return self.updater.device

    def sigma(self) -> float:
        """Standard deviation of the policy, mean over the actions; 1 is half the map."""
        return self.updater.log_std.exp().mean().item()

    @torch.no_grad()
    def predict_m(self, observations: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Predicted positions `[n, 2]` in world metres for each of some `[n, d]` blocks: the policy's mean."""
        if not observations:
            return ()
        if self.task.is_relative:
            seen = torch.cat(tuple(observations))
            mean = self.updater.mean(self.task.network_input(seen))
            answered = self.task.answer(mean.cpu(), seen)
        else:
            answered = self.task.answer(self.updater.mean(*observations)).cpu()
        answers: tuple[Tensor, ...] = answered.split([len(block) for block in observations])
        return answers

    def predictor(self, dark_is_nan: bool, evaluations_alone: bool = True) -> Predictor:
        """A predictor for the ticks of a stream as they come (`caraware.learn.prediction`).

        With `evaluations_alone`, training ticks are drawn where the world waits for them.
        """
        if self.task.sampling is Sampling.EACH_TICK and evaluations_alone:
            return DrawingPredictor(self, dark_is_nan)
        return RowPredictor(self, dark_is_nan, evaluations_alone)

    def sampling_generators(self) -> dict[str, torch.Generator]:
        """The random numbers of the actions, by the name that a checkpoint gives them."""
        names = (f"sampling{index or ''}" for index in self._environments)
        return dict(zip(names, self._samplings, strict=True))

    def memory_tensors(self) -> dict[str, Tensor]:
        """What is remembered of trajectories up to the newest horizon: what was drawn for the tick after it."""
        memory: dict[str, Tensor] = {}
        for environment, held in self.held.items():
            name = f"held{self.numbered(environment)}"
            memory |= {f"{name}.action": held.action, f"{name}.log_probability": held.log_probability}
            memory[f"{name}.tick"] = torch.tensor(held.tick)
        return memory

    def restore_memory(self, tensors: dict[str, Tensor]) -> None:
        """Continue with what `memory_tensors` returned; with nothing, forget everything."""
        self.held = {}
        for environment in range(len(self._environments)):
            name = f"held{self.numbered(environment)}"
            if f"{name}.tick" in tensors:
                columns = tensors[f"{name}.action"], tensors[f"{name}.log_probability"]
                self.held[environment] = DrawnTick(int(tensors[f"{name}.tick"]), *columns)

    def numbered(self, environment: int) -> int:
        """The index, among those of all ranks, of an environment of this trainer."""
        return self._environments[environment] if environment < len(self._environments) else environment

    def shape(self) -> LearnerShape:
        """See `StoredLearner.shape`."""
        config = self.config
        return LearnerShape(PPO, self.observation_size, str(config.network), config.hidden, config.activation)

    def schedules(self) -> dict[str, float]:
        """See `StoredLearner.schedules`; before the first update, those of that one."""
        now = ScheduledValues.at(self.config, max(self.updates - 1, 0), self.progress)
        return {
            "progress": self.progress,
            "learning_rate": now.learning_rate,
            "clip_epsilon": now.clip_epsilon,
            "entropy_scale": now.entropy_scale,
        }

    def tensors(self) -> StoredTensors:
        """See `StoredLearner.tensors`."""
        random = {name: generator.get_state() for name, generator in self._generators().items()}
        memory = self.memory_tensors()
        files = {PARAMETERS: self.updater.parameters(), OPTIMISER: self.updater.moments(), RANDOM: random}
        return files | ({MEMORY: memory} if memory else {})

    def restore(self, stored: StoredTensors, updates: int) -> None:
        """See `StoredLearner.restore`."""
        for name, tensor in self.updater.parameters().items():
            tensor.copy_(stored[PARAMETERS][name])
        self.updater.restore_moments(stored[OPTIMISER])
        for name, generator in self._generators().items():
            generator.set_state(stored[RANDOM][name])
        self.restore_memory(stored.get(MEMORY, {}))
        self.updates = updates

    def _generators(self) -> dict[str, torch.Generator]:
        return self.sampling_generators() | {"shuffling": self.shuffling}


def finite(what: str, value: Tensor, now: ScheduledValues) -> float:
    """The number in a scalar. Raises `NonFiniteLoss`."""
    number = value.item()
    if not math.isfinite(number):
        raise NonFiniteLoss(what, now.update)
    return number


def normalised(advantage: Tensor) -> Tensor:
    """Advantages of a minibatch with mean 0 and standard deviation 1."""
    deviation = advantage.std(correction=0) + SMALLEST_DEVIATION
    return (advantage - advantage.mean()) / deviation


def mean_columns(rows: Sequence[Sequence[float]]) -> list[float]:
    """The mean of each column."""
    return [sum(column) / len(rows) for column in zip(*rows, strict=True)]


def _step_of(horizon: Horizon, drawn: DrawnHorizon, forward: ForwardPass) -> TaskStep:
    """The samples of a horizon with what followed: a tick later, or of trajectories that ended, the same tick again."""
    assert horizon.bootstrap is not None, "a world that waits for actions is learnt with its next tick"
    ended = (horizon.terminated | horizon.truncated).unsqueeze(2)

    def following(grid: Tensor, after: Tensor) -> Tensor:
        return torch.where(ended, grid, torch.cat((grid[1:], after.unsqueeze(0))))

    def samples(grid: Tensor) -> Tensor:
        return grid.flatten(0, 1).index_select(0, forward.rows).to(forward.observation.device)

    after = TaskRows(
        samples(following(horizon.observation, horizon.bootstrap)),
        samples(following(horizon.truth, drawn.truth_after)),
    )
    flags = (samples(grid) for grid in (horizon.terminated, horizon.truncated, drawn.ended_by))
    return TaskStep(forward.observation, samples(horizon.truth), TaskOutcome(after, *flags))


def _sampling(seed: int, environment: int) -> torch.Generator:
    """Every environment has its own random actions, whichever trainer learns from it."""
    return torch.Generator().manual_seed((seed + environment * SEED_STRIDE) % 2**63)


def _explained_variance(figures: UpdateFigures) -> float:
    spread = figures.value_target.var(correction=0).item()
    advantage = figures.advantage if figures.advantage.ndim == 1 else figures.advantage.mean(1)
    return 1 - advantage.var(correction=0).item() / spread if spread > 0 else 0.0
