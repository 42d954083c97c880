"""A baseline beside PPO for tasks with a distance: a network of the policy's size, taught by regression on the truth.

It learns from the policy's samples by as many gradient steps of the same size, and it is shown the distance that the
policy's rewards are made of. PPO's distance to it is the price of learning by trial. It takes no part in PPO: random
numbers, parameters and moments are its own. `caraware.learn.supervised` is the same for positions, written out by hand.
"""

from typing import Protocol

import torch
from torch import Tensor, nn

from caraware.ipc.stream import Observation
from caraware.learn.adam import ModuleAdam
from caraware.learn.batch import Batch
from caraware.learn.cnn import mean_network
from caraware.learn.config import BuiltInNetwork, TrainerConfig
from caraware.learn.frames import Seen
from caraware.learn.networks import Activation, policy_mlp
from caraware.learn.prediction import visible
from caraware.learn.seeing import FrameHistory, SeeingBatch
from caraware.learn.supervised import SEED_OFFSET
from caraware.tasks.contract import ActionSpec


class DistanceTask(Protocol):
    """A task whose rewards follow from a distance between action and truth."""

    @property
    def actions(self) -> ActionSpec:
        """See `Task.actions`."""
        ...

    def targets(self, truth: Tensor) -> Tensor:
        """The true answers `[n, a]` for rows of truth `[n, 4]`."""
        ...

    def distance(self, action: Tensor, targets: Tensor) -> Tensor:
        """Distances `[n]` of actions `[n, a]` to `targets`."""
        ...

    def answer(self, action: Tensor, observation: Tensor | None = None) -> Tensor:
        """See `Task.answer`."""
        ...

    def network_input(self, observation: Tensor) -> Tensor:
        """See `Task.network_input`."""
        ...


class Regression:
    """The policy's network, taught to be close to the truth: from every horizon in as many epochs as PPO makes."""

    def __init__(self, config: TrainerConfig, observation_size: int, task: DistanceTask, device: torch.device) -> None:
        """A network that sees where the policy does; otherwise an MLP of the policy's widths."""
        self._config, self._task, self._device = config, task, device
        self._seed, self._steps = config.seed + SEED_OFFSET, torch.tensor(0)
        self._sees = config.network is BuiltInNetwork.CNN
        actions = task.actions.size
        if self._sees:
            self._network: nn.Module = mean_network(config, observation_size, actions, self._seed).to(device)
            self._history = FrameHistory(config)
        else:
            mlp = policy_mlp(observation_size, actions, config.hidden, Activation(config.activation))
            mlp.initialise(torch.Generator().manual_seed(self._seed))
            self._network = mlp.to(device)
        self._adam = ModuleAdam(self._network.parameters())

    def learn(self, batch: Batch, learning_rate: float) -> float:
        """PPO's epochs over a batch, in minibatches of PPO's size; the mean distance.

        The order follows from the seed and the steps taken, so a checkpoint needs no state of a generator.
        """
        generator = torch.Generator().manual_seed(self._seed + 1 + int(self._steps))
        samples = len(batch.reward)
        parts = max(1, round(samples / self._config.batch_size))
        targets = self._task.targets(batch.truth)
        distances = torch.zeros((), device=self._device)
        for _ in range(self._config.epochs):
            for rows in torch.randperm(samples, generator=generator).tensor_split(parts):
                action = self._network(self._input(batch, rows))
                distance = self._task.distance(action, targets[rows.to(self._device)]).mean()
                self._adam.zero_grad()
                distance.backward()
                nn.utils.clip_grad_norm_(self._network.parameters(), self._config.max_grad_norm)
                self._adam.step(learning_rate)
                self._steps += 1
                distances += distance.detach()
        return (distances / (parts * self._config.epochs)).item()

    def _input(self, batch: Batch, rows: Tensor) -> Tensor | Seen:
        fields = batch.observation[rows.to(self._device)]
        if not self._sees:
            return fields
        assert isinstance(batch, SeeingBatch)
        return Seen(fields, batch.stacks.of(rows).to(self._device))

    @torch.no_grad()
    def answers(self, obs: Observation, dark_is_nan: bool) -> Tensor:
        """Answers `[n, a]` to a tick, 0 in rows that are not valid; ticks of an environment come in order."""
        valid = torch.from_numpy(obs.valid)
        rows = valid.nonzero().squeeze(1)
        fields = self._task.network_input(visible(obs, dark_is_nan).index_select(0, rows))
        seen: Tensor | Seen = fields.to(self._device)
        if self._sees:
            self._history.forget_before(obs.tick)
            stacks = self._history.stacks(obs)
            seen = Seen(fields.to(self._device), stacks.of(rows).to(self._device))
        answers = torch.zeros(len(valid), self._task.actions.size)
        if len(rows):
            answers[rows] = self._task.answer(self._network(seen).cpu())
        return answers

    def tensors(self) -> dict[str, Tensor]:
        """Parameters and moments by name, for a checkpoint."""
        tensors = {f"network.{name}": tensor for name, tensor in self._network.state_dict().items()}
        for moment, columns in (("exp_avg", self._adam.means), ("exp_avg_sq", self._adam.squares)):
            tensors |= {f"{moment}.{number}": column for number, column in enumerate(columns)}
        return tensors | {"steps": self._steps}

    def restore(self, stored: dict[str, Tensor]) -> None:
        """Continue with what `tensors` returned."""
        self._network.load_state_dict(
            {name.removeprefix("network."): tensor for name, tensor in stored.items() if name.startswith("network.")}
        )
        self._steps = stored["steps"].clone()
        means, squares = (
            [stored[f"{moment}.{number}"] for number in range(len(self._adam.means))]
            for moment in ("exp_avg", "exp_avg_sq")
        )
        self._adam.restore(means, squares, self._steps.item())
