"""The update of `caraware.learn.ppo` in less time: gradients written out, flat parameters, a second core, ranks.

It keeps the contract of `PolicyUpdate` and takes the same steps as `PlainUpdate`, to the rounding of float32; a test
holds the two together. Policy and value network share nothing, so each learns on its own core.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from caraware.learn.adam import Adam
from caraware.learn.batch import Batch
from caraware.learn.config import TrainerConfig
from caraware.learn.fast_mlp import Network
from caraware.learn.flat import FlatParameters
from caraware.learn.networks import entropy
from caraware.learn.objective import clipped_error, clipped_surrogate
from caraware.learn.ppo import (
    PolicyFigures,
    ScheduledValues,
    UpdateFigures,
    ValueFigures,
    finite,
    mean_columns,
    normalised,
)
from caraware.learn.ranks import Minibatch, Ranks, SampleUnion

P = TypeVar("P")
V = TypeVar("V")
SMALL_ROWS = 256
"""Rows of a block below which blocks are put together before the network sees them."""


@dataclass(frozen=True)
class SharedBatch:
    """A batch, and the samples of all ranks that it is a part of."""

    batch: Batch
    union: SampleUnion
    minibatches: int
    """In an epoch: about `batch_size` samples of each rank in one."""


class FastUpdate:
    """A `PolicyUpdate` of networks that bring their own backward pass."""

    def __init__(
        self, config: TrainerConfig, policy: Network, value: Network, device: torch.device, ranks: Ranks | None = None
    ) -> None:
        """`log_std` is among the parameters of `policy`. `ranks` are the trainers that learn together."""
        self.device, self.policy_network, self.value_network = device, policy, value
        self.ranks = ranks or Ranks()
        self.policy_adam, self.value_adam = Adam(policy.parameters), Adam(value.parameters)
        self._log_std, self._log_std_gradient = policy.parameters.value["log_std"], policy.parameters.grad["log_std"]
        self._config = config
        self._second_core = _worker(config, device)

    @torch.no_grad()
    def improve(self, batch: Batch, shuffling: torch.Generator, now: ScheduledValues) -> UpdateFigures:
        """See `PolicyUpdate.improve`. Both networks learn side by side."""
        union = self.ranks.union(batch.advantage, batch.reward, batch.value_target)
        shared = SharedBatch(batch, union, minibatches(union, self._config, self.ranks))
        orders = self._orders(self._pieces(shared), shuffling)
        policy, value = self._both(
            lambda: self._improve_policy(shared, orders, now), lambda: self._improve_value(shared, orders, now)
        )
        return UpdateFigures(policy, value, union.advantage, union.reward, union.value_target)

    def _orders(self, pieces: int, shuffling: torch.Generator) -> list[Tensor]:
        """The shuffled pieces of every epoch."""
        orders = [torch.randperm(pieces, generator=shuffling) for _ in range(self._config.epochs)]
        return [order.to(self.device) for order in orders]

    def _both(self, of_policy: Callable[[], P], of_value: Callable[[], V]) -> tuple[P, V]:
        """The results of both jobs: side by side where there is a second core; if one fails, the other still ends."""
        if self._second_core is None:
            return of_policy(), of_value()
        value_job = self._second_core.submit(of_value)
        try:
            policy = of_policy()
        finally:
            value_job.exception()
        return policy, value_job.result()

    def _pieces(self, shared: SharedBatch) -> int:
        """How many pieces of the union are shuffled: its samples."""
        return len(shared.union)

    def _minibatches(
        self, network: str, shared: SharedBatch, columns: Sequence[Tensor], order: Tensor
    ) -> Iterator[Minibatch]:
        """The pieces in `order`, cut into minibatches: the inputs of `network`, then rows of `columns`."""
        return shared.union.minibatches((shared.batch.observation, *columns), order, shared.minibatches)

    @torch.no_grad()
    def _improve_policy(self, shared: SharedBatch, orders: list[Tensor], now: ScheduledValues) -> PolicyFigures:
        """Climb the clipped surrogate objective plus the entropy bonus."""
        network, epochs = self.policy_network, 0
        log: list[list[float]] = []
        largest: list[float] = []
        columns = (shared.batch.action, shared.batch.log_probability)
        for order in orders:
            steps: list[tuple[float, ...]] = []
            for part in self._minibatches("policy", shared, columns, order):
                *figures, ratio_max = self._policy_gradient(part, now)
                norm = self._step("policy", network.parameters, self.policy_adam, now)
                steps.append(tuple(number * part.share for number in (*figures, norm)))
                largest.append(ratio_max)
            log += self._of_all("policy", steps)
            epochs += 1
            if self._went_far([row[1] for row in log[-len(steps) :]]):
                break
        loss, kl, clipped, ratio_mean, norm = mean_columns(log)
        spread, ratio_max = entropy(self._log_std).item(), self.ranks.largest(max(largest))
        return PolicyFigures(epochs, loss, spread, kl, clipped, ratio_mean, ratio_max, norm)

    def _policy_gradient(self, part: Minibatch, now: ScheduledValues) -> tuple[float, float, float, float, float]:
        """This rank's part of the gradient; its loss, KL, clip fraction, mean and largest ratio."""
        network, log_std = self.policy_network, self._log_std
        if part.share == 0.0:
            network.parameters.gradient.zero_()
            return 0.0, 0.0, 0.0, 0.0, 0.0
        observation, action, old_log_probability = part.own
        mean = network.forward(observation)
        advantage = part.mine(normalised(part.advantage))
        surrogate = clipped_surrogate(mean, log_std, action, old_log_probability, advantage, now.clip_epsilon)
        loss = finite("the policy's loss", surrogate.loss - now.entropy_scale * entropy(log_std), now)
        network.backward(observation, surrogate.mean_gradient * part.share)
        self._log_std_gradient.copy_((surrogate.log_std_gradient - now.entropy_scale) * part.share)
        ratio, kl = surrogate.ratio, surrogate.approximate_kl()
        return loss, kl, surrogate.clip_fraction(), ratio.mean().item(), ratio.max().item()

    def _of_all(self, network: str, steps: Sequence[tuple[float, ...]]) -> list[list[float]]:
        """The numbers of every step, weighted with the shares of the ranks, of all ranks."""
        table = torch.tensor(steps, dtype=torch.float64)
        self.ranks.add_up(network, table)
        return table.tolist()

    def _went_far(self, kl_of_steps: Sequence[float]) -> bool:
        """Whether the policy has left the one that sampled by more than `target_kl` in an epoch."""
        return self._config.target_kl is not None and sum(kl_of_steps) / len(kl_of_steps) > self._config.target_kl

    @torch.no_grad()
    def _improve_value(self, shared: SharedBatch, orders: list[Tensor], now: ScheduledValues) -> ValueFigures:
        """Regress on the value targets with the mean squared error, clipped where `value_clip` says so."""
        steps: list[tuple[float, float]] = []
        columns = (shared.batch.value_target, shared.batch.value_advantage())
        for order in orders:
            for part in self._minibatches("value", shared, columns, order):
                loss = self._value_gradient(part, now)
                norm = self._step("value", self.value_network.parameters, self.value_adam, now)
                steps.append((loss * part.share, norm * part.share))
        return ValueFigures(*mean_columns(self._of_all("value", steps)))

    def _value_gradient(self, part: Minibatch, now: ScheduledValues) -> float:
        """This rank's part of the gradient; its loss."""
        network = self.value_network
        if part.share == 0.0:
            network.parameters.gradient.zero_()
            return 0.0
        observation, target, advantage = part.own
        error = clipped_error(network.forward(observation).squeeze(1), target, advantage, self._config.value_clip)
        loss = finite("the value network's loss", error.loss.mean(), now)
        weight = 2 * self._config.value_scale / len(target) * part.share
        network.backward(observation, error.pull.unsqueeze(1) * weight)
        return loss

    def _step(self, network: str, parameters: FlatParameters, adam: Adam, now: ScheduledValues) -> float:
        """Add up the gradient of all ranks, clip it to `max_grad_norm`, take an Adam step; the norm before clipping."""
        self.ranks.add_up(network, parameters.gradient)
        norm = finite(f"the {network} gradient", torch.linalg.vector_norm(parameters.gradient), now)
        if norm > self._config.max_grad_norm:
            parameters.gradient.mul_(self._config.max_grad_norm / norm)
        adam.step(now.learning_rate)
        return norm

    @property
    def log_std(self) -> Tensor:
        """See `PolicyUpdate.log_std`."""
        return self._log_std

    @torch.no_grad()
    def mean(self, *observations: Tensor) -> Tensor:
        """See `PolicyUpdate.mean`. One forward pass over all rows.

        Large blocks are read where they lie, which is shared memory; small ones are put together first, which costs
        less than to call for each.
        """
        # Nothing here writes to the blocks. Without the check of a `ReadOnlyTensor` in every operation, a pass over one
        # tick of 8 rows takes 98 µs instead of 174.
        with torch._C.DisableTorchFunctionSubclass():
            rows = sum(len(block) for block in observations)
            if len(observations) > 1 and rows < SMALL_ROWS * len(observations):
                return self.policy_network.infer(torch.cat(observations).to(self.device))
            return self.policy_network.infer(*(block.to(self.device) for block in observations))

    @torch.no_grad()
    def value(self, observation: Tensor) -> Tensor:
        """See `PolicyUpdate.value`."""
        return self.value_network.infer(observation).squeeze(1)

    @torch.no_grad()
    def mean_and_value(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """See `PolicyUpdate.mean_and_value`."""
        return self._both(lambda: self.policy_network.infer(observation), lambda: self.value(observation))

    def parameters(self) -> dict[str, Tensor]:
        """See `PolicyUpdate.parameters`."""
        return {
            f"{name}.{parameter}": tensor
            for name, network in (("policy", self.policy_network), ("value", self.value_network))
            for parameter, tensor in network.parameters.value.items()
        }

    def moments(self) -> dict[str, Tensor]:
        """See `PolicyUpdate.moments`."""
        return {
            f"{name}.{moment}": tensor
            for name, adam in (("policy", self.policy_adam), ("value", self.value_adam))
            for moment, tensor in adam.state().items()
        }

    def restore_moments(self, moments: dict[str, Tensor]) -> None:
        """See `PolicyUpdate.restore_moments`."""
        for name, tensor in self.moments().items():
            tensor.copy_(moments[name])


def minibatches(union: SampleUnion, config: TrainerConfig, ranks: Ranks) -> int:
    """Minibatches in an epoch, of about `batch_size` samples of each rank."""
    return max(1, round(len(union) / (config.batch_size * ranks.size)))


def threads_per_network(config: TrainerConfig) -> int:
    """CPU threads within an operation: policy and value network have half of them each."""
    return max(1, config.thread_count() // 2)


def _worker(config: TrainerConfig, device: torch.device) -> ThreadPoolExecutor | None:
    """A thread for the value network where there is a second core for it.

    Two threads, each with its own network, scale better than one network's operations spread over two threads:
    nothing waits at the end of every operation, least of all for a core that another process is using.
    """
    if config.thread_count() < 2 or device.type != "cpu":
        return None
    return ThreadPoolExecutor(1, "value", initializer=torch.set_num_threads, initargs=(threads_per_network(config),))
