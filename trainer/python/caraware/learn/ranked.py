"""The reference update over the samples of several ranks: any network's gradient steps are those of all together.

It wraps `PlainUpdate` from outside, as `caraware.learn.ranks` describes: every rank back-propagates the loss of its own
rows of a minibatch, weighted by their share of it, and the sum of the gradients is that of the whole minibatch.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from caraware.learn.batch import Batch
from caraware.learn.config import TrainerConfig
from caraware.learn.fast import minibatches
from caraware.learn.networks import GaussianPolicy, entropy
from caraware.learn.ppo import (
    PlainUpdate,
    PolicyFigures,
    ScheduledValues,
    UpdateFigures,
    ValueFigures,
    finite,
    mean_columns,
    normalised,
)
from caraware.learn.ranks import Minibatch, Ranks


class RankedUpdate(PlainUpdate):
    """`PlainUpdate` for trainers that learn together.

    A network must map each row by itself: a row's output may not depend on the rows beside it, as with batch
    statistics, because those are other rows on every rank.
    """

    def __init__(
        self, config: TrainerConfig, policy: GaussianPolicy, value: nn.Module, device: torch.device, ranks: Ranks
    ) -> None:
        super().__init__(config, policy, value, device)
        self._ranks = ranks

    def improve(self, batch: Batch, shuffling: torch.Generator, now: ScheduledValues) -> UpdateFigures:
        """See `PolicyUpdate.improve`. The samples of all ranks are shuffled and cut alike on each."""
        self._acting_version = -1
        union = self._ranks.union(batch.advantage, batch.reward, batch.value_target)
        parts = minibatches(union, self._config, self._ranks)
        own_rows = torch.arange(union.own, device=self.device)
        policy_steps: list[list[float]] = []
        value_steps: list[list[float]] = []
        largest, policy_epochs, is_near = 0.0, 0, True
        for _ in range(self._config.epochs):
            order = torch.randperm(len(union), generator=shuffling).to(self.device)
            of_policy: list[list[float]] = []
            of_value: list[list[float]] = []
            for part in union.minibatches((own_rows,), order, parts):
                if is_near:
                    *figures, ratio_max = self._policy_part(batch, part, now)
                    of_policy.append(figures)
                    largest = max(largest, ratio_max)
                of_value.append(self._value_part(batch, part, now))
            value_steps += self._of_all("value", of_value)
            if is_near:
                policy_steps += self._of_all("policy", of_policy)
                policy_epochs += 1
                kl = sum(step[1] for step in policy_steps[-parts:]) / parts
                is_near = self._config.target_kl is None or kl <= self._config.target_kl
        loss, kl, clipped, ratio_mean, norm = mean_columns(policy_steps)
        spread, largest = entropy(self.log_std).item(), self._ranks.largest(largest)
        return UpdateFigures(
            policy=PolicyFigures(policy_epochs, loss, spread, kl, clipped, ratio_mean, largest, norm),
            value=ValueFigures(*mean_columns(value_steps)),
            advantage=union.advantage,
            reward=union.reward,
            value_target=union.value_target,
        )

    def _policy_part(self, batch: Batch, part: Minibatch, now: ScheduledValues) -> list[float]:
        """One step of all ranks; this rank's shares of loss, KL, clip fraction, mean ratio and norm; largest ratio."""
        (rows,) = part.own
        loss, figures, largest = torch.zeros(()), [0.0] * 3, 0.0
        if part.share > 0.0:
            advantage = part.mine(normalised(part.advantage))
            loss, (*figures, largest) = self._policy_loss(batch, rows, advantage, now)
        norm = self._shared_step("policy", loss, part.share, now)
        return [*(figure * part.share for figure in (loss.item(), *figures, norm)), largest]

    def _value_part(self, batch: Batch, part: Minibatch, now: ScheduledValues) -> list[float]:
        """One step of all ranks; this rank's shares of loss and norm."""
        (rows,) = part.own
        loss = self._value_loss(batch, rows) if part.share > 0.0 else torch.zeros(())
        norm = self._shared_step("value", self._config.value_scale * loss, part.share, now)
        return [loss.item() * part.share, norm * part.share]

    def _shared_step(self, name: str, loss: Tensor, share: float, now: ScheduledValues) -> float:
        """Add up the gradients of all ranks, then take a step with the sum; its norm before clipping."""
        finite(f"the {name} loss", loss, now)
        self._adam[name].zero_grad()
        if share > 0.0:
            (loss * share).backward()
        parameters = self._ordered(name)
        gradients = [torch.zeros_like(each) if each.grad is None else each.grad for each in parameters]
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        self._ranks.add_up(name, flat)
        for parameter, summed in zip(parameters, flat.split([each.numel() for each in parameters]), strict=True):
            parameter.grad = summed.view_as(parameter)
        return self._descend(name, now)

    def _of_all(self, name: str, steps: Sequence[Sequence[float]]) -> list[list[float]]:
        """The figures of every step, of which each rank has its share, of all ranks."""
        table = torch.tensor(steps, dtype=torch.float64)
        self._ranks.add_up(name, table)
        figures: list[list[float]] = table.tolist()
        return figures
