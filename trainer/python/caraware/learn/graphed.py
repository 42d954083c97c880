"""PPO's gradient steps on a GPU: a CUDA graph for a minibatch of each network, replayed without asking anything back.

The steps of `caraware.learn.ppo` read losses and norms back after every minibatch, which costs nothing on a CPU and
most of the time on a GPU, whose kernels here last microseconds. So on a GPU an update runs as replays of captured
steps: a step finds its own rows (a counter on the device), takes its own Adam step, and writes its numbers into a
table that is read when the update is over (with `target_kl`, after every epoch). Policy and value network have a
stream each.

A graph has fixed shapes, but horizons differ by some samples: minibatches are filled up with rows of weight 0.
"""

import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass

import torch
from torch import Tensor

from caraware.learn.adam import BETA_MEAN, BETA_SQUARE, EPSILON, Adam
from caraware.learn.batch import Batch
from caraware.learn.config import TrainerConfig
from caraware.learn.fast import FastUpdate
from caraware.learn.fast_mlp import CHUNK_ROWS, FastMlp
from caraware.learn.flat import FlatParameters
from caraware.learn.networks import entropy, log_probability
from caraware.learn.objective import clipped_error
from caraware.learn.ppo import (
    SMALLEST_DEVIATION,
    NonFiniteLoss,
    PolicyFigures,
    ScheduledValues,
    UpdateFigures,
    ValueFigures,
)

WARM_UP_STEPS = 3
"""Steps before the capture: libraries choose their kernels and workspaces in the first calls."""
POLICY_COLUMNS, VALUE_COLUMNS = 6, 2


@dataclass(frozen=True)
class StepTable:
    """What the gradient steps of one update wrote, in order, on the CPU."""

    policy: Tensor
    """f64 `[steps, 6]`: loss, KL, clip fraction, mean ratio, largest ratio, gradient norm."""
    value: Tensor
    """f64 `[steps, 2]`: loss, gradient norm."""
    policy_epochs: int
    """Epochs that the policy went through; rows of `policy` beyond them are left out."""

    def finite(self) -> bool:
        """Whether every number is one."""
        return bool(self.policy.isfinite().all() and self.value.isfinite().all())


class GraphedUpdate(FastUpdate):
    """A `FastUpdate` whose steps run in fixed memory. With a CPU device they run one by one, for the tests.

    The steps of several ranks meet on the way, which a graph of one rank's step does not know of: it learns alone.
    """

    def __init__(self, config: TrainerConfig, policy: FastMlp, value: FastMlp, device: torch.device) -> None:
        super().__init__(config, policy, value, device)
        self._networks = (policy, value)
        self._samples = self._rows = self._steps = 0
        self._policy_steps = _NetworkSteps(device, self._policy_step)
        self._value_steps = _NetworkSteps(device, self._value_step)
        scalars = (torch.zeros((), device=device) for _ in range(3))
        self._learning_rate, self._clip_epsilon, self._entropy_scale = scalars
        self._device_policy_adam = _DeviceAdam(self.policy_adam, policy.parameters, self._learning_rate)
        self._device_value_adam = _DeviceAdam(self.value_adam, value.parameters, self._learning_rate)

    @torch.no_grad()
    def improve(self, batch: Batch, shuffling: torch.Generator, now: ScheduledValues) -> UpdateFigures:
        """See `PolicyUpdate.improve`. The figures are read back at the end."""
        orders = self._orders(len(batch.reward), shuffling)
        table = self.run(batch, orders, now)
        if not table.finite():
            raise NonFiniteLoss("a loss or gradient", now.update)
        epochs = min(len(orders), table.policy_epochs)
        loss, kl, clipped, ratio_mean, _, norm = table.policy.mean(0).tolist()
        ratio_max = table.policy[:, 4].max().item()
        return UpdateFigures(
            policy=PolicyFigures(
                epochs, loss, entropy(self.log_std).item(), kl, clipped, ratio_mean, ratio_max, gradient_norm=norm
            ),
            value=ValueFigures(*table.value.mean(0).tolist()),
            advantage=batch.advantage,
            reward=batch.reward,
            value_target=batch.value_target,
        )

    def run(self, batch: Batch, orders: list[Tensor], now: ScheduledValues) -> StepTable:
        """Take all steps. If a number is not finite, the parameters and moments are as before the update."""
        parts = max(1, round(len(batch.reward) / self._config.batch_size))
        rows = -(-len(batch.reward) // parts)
        if (rows, parts * len(orders)) != (self._rows, self._steps) or len(batch.reward) > self._samples:
            self._allocate(batch, rows, parts * len(orders))
            self._load(batch, orders, parts)
            self._capture()
        self._load(batch, orders, parts)
        for scalar, value in (
            (self._learning_rate, now.learning_rate),
            (self._clip_epsilon, now.clip_epsilon),
            (self._entropy_scale, now.entropy_scale),
        ):
            scalar.fill_(value)
        before = self._snapshot()
        epochs = self._replay(parts, len(orders))
        policy_log = self._policy_log[: epochs * parts]
        table = StepTable(policy_log.double().cpu(), self._value_log.double().cpu(), epochs)
        if not table.finite():
            self._restore(before)
            return table
        self.policy_adam.steps += epochs * parts
        self.value_adam.steps += self._steps
        return table

    def _replay(self, parts: int, epochs: int) -> int:
        """All steps of both networks side by side; returns the epochs that the policy went through."""
        policy_epochs = 0
        for steps in (self._policy_steps, self._value_steps):
            steps.begin()
        for epoch in range(epochs):
            self._value_steps.run(parts)
            if policy_epochs == epoch and not self._left_after(policy_epochs, parts):
                self._policy_steps.run(parts)
                policy_epochs += 1
        for steps in (self._policy_steps, self._value_steps):
            steps.end()
        return policy_epochs

    def _left_after(self, epochs: int, parts: int) -> bool:
        """Whether the last of `epochs` epochs took the policy farther than `target_kl`; reads from the GPU if set."""
        if self._config.target_kl is None or epochs == 0:
            return False
        self._policy_steps.end()
        kl = self._policy_log[(epochs - 1) * parts : epochs * parts, 1].mean().item()
        return kl > self._config.target_kl

    def _allocate(self, batch: Batch, rows: int, steps: int) -> None:
        """Room for the samples of `batch` and one row of weight 0, and for the numbers of `steps` steps."""
        samples = len(batch.reward)
        self._samples, self._rows, self._steps = samples + samples // 8, rows, steps
        full, device = self._samples + 1, self.device
        # The graph remembers addresses: no later pass without gradient may make the networks ask for more.
        for network in self._networks:
            network.reserve(max(rows, CHUNK_ROWS))
        self._observation = torch.zeros(full, *batch.observation.shape[1:], device=device)
        tries = self._config.actions_per_observation
        self._action = torch.zeros(full, tries, len(self.log_std), device=device)
        self._old_log_probability = torch.zeros(full, tries, device=device)
        self._advantage = torch.zeros(full, tries, device=device)
        self._target = torch.zeros(full, device=device)
        self._weight = torch.zeros(full, device=device)
        self._order = torch.zeros(steps, rows, dtype=torch.int64, device=device)
        self._policy_log = torch.zeros(steps, POLICY_COLUMNS, device=device)
        self._value_log = torch.zeros(steps, VALUE_COLUMNS, device=device)

    def _load(self, batch: Batch, orders: list[Tensor], parts: int) -> None:
        """Put a batch into the fixed memory, and its minibatches, filled up, into the table of orders."""
        count = len(batch.reward)
        columns = (batch.observation, batch.action, batch.log_probability, batch.advantage, batch.value_target)
        rooms = (self._observation, self._action, self._old_log_probability, self._advantage, self._target)
        for room, column in zip(rooms, columns, strict=True):
            room[:count].copy_(column.view(count, *room.shape[1:]))
        self._weight.zero_()[:count].fill_(1)
        weightless = self._samples
        pieces = [piece for order in orders for piece in order.tensor_split(parts)]
        self._order.fill_(weightless)
        for row, piece in zip(self._order, pieces, strict=True):
            row[: len(piece)].copy_(piece)
        for steps in (self._policy_steps, self._value_steps):
            steps.step.zero_()
        self._device_policy_adam.load()
        self._device_value_adam.load()

    def _capture(self) -> None:
        """Record a step of each network. What the warm-up moved is put back."""
        before = self._snapshot()
        for steps in (self._policy_steps, self._value_steps):
            steps.capture()
        self._restore(before)

    def _minibatch(self, step: Tensor, *columns: Tensor) -> tuple[Tensor, ...]:
        rows = self._order.index_select(0, step.view(1)).view(-1)
        return tuple(column.index_select(0, rows) for column in columns)

    def _policy_step(self, step: Tensor) -> None:
        """As `FastUpdate._policy_gradient`, with weights: equation 7's gradient, clipped, and Adam."""
        network, log_std = self.policy_network, self.log_std
        observation, action, old, advantage, weight = self._minibatch(
            step, self._observation, self._action, self._old_log_probability, self._advantage, self._weight
        )
        weight = weight.unsqueeze(1)
        share = weight / (weight.sum() * advantage.shape[1])
        centred = advantage - (advantage * share).sum()
        advantage = centred / ((centred.square() * share).sum().sqrt() + SMALLEST_DEVIATION)
        mean = network.forward(observation).unsqueeze(1)
        inverse_std = torch.exp(-log_std)
        deviation = (action - mean) * inverse_std
        log_ratio = (log_probability(action, mean, log_std) - old) * weight
        ratio = log_ratio.exp()
        unclipped = ratio * advantage
        clipped = torch.minimum(torch.maximum(ratio, 1 - self._clip_epsilon), 1 + self._clip_epsilon) * advantage
        pull = (torch.where(unclipped <= clipped, unclipped, 0.0) * -share).unsqueeze(2)
        network.backward(observation, (pull * deviation * inverse_std).sum(1))
        self._log_std_gradient.copy_((pull * (deviation.square() - 1)).sum((0, 1)) - self._entropy_scale)
        norm = self._device_policy_adam.step(self._config.max_grad_norm)
        loss = -(torch.minimum(unclipped, clipped) * share).sum() - self._entropy_scale * entropy(log_std)
        numbers = (
            loss,
            ((ratio - 1 - log_ratio) * share).sum(),
            (((ratio - 1).abs() > self._clip_epsilon) * share).sum(),
            (ratio * share).sum(),
            (ratio * weight).max(),
            norm,
        )
        self._policy_log.index_copy_(0, step.view(1), torch.stack(numbers).unsqueeze(0))

    def _value_step(self, step: Tensor) -> None:
        """As `FastUpdate._value_gradient`, with weights."""
        config, network = self._config, self.value_network
        columns = (self._observation, self._target, self._advantage, self._weight)
        observation, target, advantage, weight = self._minibatch(step, *columns)
        share = weight / weight.sum()
        error = clipped_error(network.forward(observation).squeeze(1), target, advantage.mean(1), config.value_clip)
        network.backward(observation, (2 * config.value_scale * error.pull * share).unsqueeze(1))
        norm = self._device_value_adam.step(config.max_grad_norm)
        numbers = torch.stack(((error.loss * share).sum(), norm))
        self._value_log.index_copy_(0, step.view(1), numbers.unsqueeze(0))

    def _state(self) -> list[Tensor]:
        return [
            tensor
            for adam in (self._device_policy_adam, self._device_value_adam)
            for tensor in (adam.parameters.values, adam.optimiser.mean, adam.optimiser.square, adam.steps)
        ]

    def _snapshot(self) -> list[Tensor]:
        return [tensor.clone() for tensor in self._state()]

    def _restore(self, before: list[Tensor]) -> None:
        for tensor, kept in zip(self._state(), before, strict=True):
            tensor.copy_(kept)


class _NetworkSteps:
    """The steps of one network, with a counter of their own; on a GPU a stream and the graph of one step."""

    def __init__(self, device: torch.device, take: Callable[[Tensor], None]) -> None:
        self.step = torch.zeros((), dtype=torch.int64, device=device)
        self._take = take
        self._stream = torch.cuda.Stream() if device.type == "cuda" else None
        self._replay: Callable[[], None] = self._one

    def capture(self) -> None:
        """Record one step, after some that let libraries choose their kernels."""
        if self._stream is None:
            return
        self.begin()
        with torch.cuda.stream(self._stream):
            for _ in range(WARM_UP_STEPS):
                self.step.zero_()
                self._one()
        self.end()
        self.step.zero_()
        graph = torch.cuda.CUDAGraph()
        # On its own stream: graphs captured on one stream share cuBLAS's workspace, and wait for ever side by side.
        with torch.cuda.graph(graph, stream=self._stream):
            self._one()
        self._replay = graph.replay

    def begin(self) -> None:
        """What was asked of the device before comes before the steps."""
        if self._stream is not None:
            self._stream.wait_stream(torch.cuda.current_stream())

    def run(self, steps: int) -> None:
        """Take so many steps."""
        with torch.cuda.stream(self._stream) if self._stream is not None else nullcontext():
            for _ in range(steps):
                self._replay()

    def end(self) -> None:
        """What will be asked of the device comes after the steps."""
        if self._stream is not None:
            torch.cuda.current_stream().wait_stream(self._stream)

    def _one(self) -> None:
        self._take(self.step)
        self.step += 1


class _DeviceAdam:
    """`Adam` with the step count and the learning rate on the device; it clips the gradient first."""

    def __init__(self, optimiser: Adam, parameters: FlatParameters, learning_rate: Tensor) -> None:
        self.optimiser, self.parameters = optimiser, parameters
        self.steps = torch.zeros((), dtype=torch.float64, device=parameters.values.device)
        self._learning_rate = learning_rate

    def load(self) -> None:
        """Take over the optimiser's count."""
        self.steps.fill_(float(self.optimiser.steps))

    def step(self, max_grad_norm: float) -> Tensor:
        """One step; returns the norm before clipping."""
        gradient, adam = self.parameters.gradient, self.optimiser
        norm: Tensor = torch.linalg.vector_norm(gradient)
        gradient.mul_((max_grad_norm / norm).clamp(max=1.0))
        self.steps += 1
        adam.mean.lerp_(gradient, 1 - BETA_MEAN)
        adam.square.mul_(BETA_SQUARE).addcmul_(gradient, gradient, value=1 - BETA_SQUARE)
        seen_mean = (1 - torch.exp(self.steps * math.log(BETA_MEAN))).float()
        seen_square = (1 - torch.exp(self.steps * math.log(BETA_SQUARE))).float()
        scale = adam.square.sqrt().div_(seen_square.sqrt()).add_(EPSILON)
        self.parameters.values.sub_(adam.mean * (self._learning_rate / seen_mean) / scale)
        return norm
