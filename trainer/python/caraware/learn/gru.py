"""Policy and value network with memory: the MLP's layers, with a gated recurrent unit in place of the last hidden one.

Gated recurrent unit: Cho et al., arXiv 1406.1078, in torch's form. Parameters and gradient lie in flat vectors, and
`forward` and `backward` are called as those of `caraware.learn.fast_mlp.FastMlp`; behind them is autograd.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn import functional

from caraware.learn.fast_mlp import activate_
from caraware.learn.flat import FlatParameters
from caraware.learn.networks import Activation, Layer, hidden_layer, mean_layer, value_layer

GATES = 3
"""Reset, update and candidate: rows of the weights, each as many as the unit is wide."""


@dataclass(frozen=True)
class Sequences:
    """Some sequences of samples, step by step: first the first row of each, then the second of each that has one."""

    observation: Tensor
    """f32 `[r, d]`: within a step, the longest sequences come first."""
    step_sizes: Tensor
    """i64 `[L]` on the CPU: how many sequences have a row in each step; never more than in the step before."""
    start: Tensor
    """f32 `[b, h]`: the state before the first row of each sequence."""


@dataclass(frozen=True)
class Steps:
    """Samples of consecutive ticks, in order of tick, then slot, for a walk that carries the states along."""

    observation: Tensor
    """f32 `[s, d]`."""
    slot: Tensor
    """i64 `[s]`."""
    goes_on: Tensor
    """bool `[s]`: the sample continues the slot's trajectory; otherwise it starts from zero."""
    sizes: list[int]
    """Samples of each tick."""


@dataclass(frozen=True)
class Walk:
    """What a walk saw."""

    output: Tensor
    """f32 `[s, o]`."""
    before: Tensor
    """f32 `[s, h]`: the state that each sample started from."""
    last: Tensor
    """f32 `[N, h]`: the states of the slots after the last tick."""


class RecurrentNetwork:
    """Layers, a gated recurrent unit, and one layer more. Not thread-safe: one user at a time."""

    def __init__(
        self,
        inputs: int,
        hidden: Sequence[int],
        activation: Activation,
        head: Layer,
        extra: dict[str, tuple[int, ...]],
        device: torch.device,
    ) -> None:
        """The last of the `hidden` widths is the recurrent unit's; `head` follows it, `activation` those before."""
        widths = (inputs, *hidden)
        self._entry = tuple(hidden_layer(a, b, activation) for a, b in pairwise(widths[:-1]))
        self._head, self.width, self._device = head, widths[-1], device
        shapes: dict[str, tuple[int, ...]] = {}
        for i, layer in enumerate(self._entry):
            shapes |= {f"layer{i}.weight": (layer.outputs, layer.inputs), f"layer{i}.bias": (layer.outputs,)}
        rows = GATES * self.width
        shapes |= {"gru.weight_ih": (rows, widths[-2]), "gru.weight_hh": (rows, self.width)}
        shapes |= {"gru.bias_ih": (rows,), "gru.bias_hh": (rows,)}
        shapes |= {"head.weight": (head.outputs, head.inputs), "head.bias": (head.outputs,)}
        self.parameters = FlatParameters(shapes | extra, device)
        # Leaves for autograd in the memory of the flat vector, which Adam moves.
        self._leaf = {name: self.parameters.value[name].detach().requires_grad_() for name in shapes}
        self._unit = [self._leaf[f"gru.{name}"] for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")]
        self._output: Tensor | None = None

    def initialise(self, generator: torch.Generator) -> None:
        """Draw the weights, the unit's uniform in ± 1/√width; `generator` lives on the CPU. Biases start at 0."""
        bounds = {f"layer{i}.weight": layer.bound for i, layer in enumerate(self._entry)}
        bounds |= dict.fromkeys(("gru.weight_ih", "gru.weight_hh"), 1 / math.sqrt(self.width))
        for name, bound in (bounds | {"head.weight": self._head.bound}).items():
            weight = self.parameters.value[name]
            weight.copy_((2 * torch.rand(weight.shape, generator=generator) - 1) * bound)

    def forward(self, sequences: Sequences) -> Tensor:
        """Outputs `[r, o]`, row by row those of the sequences; keeps what `backward` needs."""
        with torch.enable_grad():
            entry, start = self._enter(sequences.observation), sequences.start.unsqueeze(0)
            options = (True, 1, 0.0, True, False)  # with biases, one layer, no dropout, training, one direction
            states, _ = torch.gru(entry, sequences.step_sizes, start, self._unit, *options)
            self._output = self._leave(states)
        return self._output.detach()

    def backward(self, sequences: Sequences, output_gradient: Tensor) -> None:
        """Overwrite the gradient of all weights, for the last `forward` and dLoss/dOutput `[r, o]`.

        It reaches back to the beginning of each sequence and no farther.
        """
        assert self._output is not None
        gradients = torch.autograd.grad(self._output, list(self._leaf.values()), output_gradient)
        self._output = None
        for name, gradient in zip(self._leaf, gradients, strict=True):
            self.parameters.grad[name].copy_(gradient)

    @torch.no_grad()
    def step(self, observation: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs `[b, o]` and the states `[b, h]` after the rows `[b, d]` that found `state` `[b, h]`."""
        state = torch.gru_cell(self._enter(observation), state, *self._unit)
        return self._leave(state), state

    @torch.no_grad()
    def walk(self, steps: Steps, state: Tensor) -> Walk:
        """All outputs, tick by tick, all samples of a tick at once; `state` `[N, h]` is what the slots begin with.

        A tick's product has as many rows as the tick has samples, whatever the number of slots.
        """
        entry, last = self._enter(steps.observation), state.clone()
        before = torch.empty(len(entry), self.width, device=self._device)
        after = torch.empty_like(before)
        begin = 0
        for size in steps.sizes:
            end = begin + size
            slot = steps.slot[begin:end]
            torch.mul(last.index_select(0, slot), steps.goes_on[begin:end, None], out=before[begin:end])
            after[begin:end] = torch.gru_cell(entry[begin:end], before[begin:end], *self._unit)
            last.index_copy_(0, slot, after[begin:end])
            begin = end
        return Walk(self._leave(after), before, last)

    def infer(self, *blocks: Tensor) -> Tensor:
        """Outputs `[b, o]` for rows in some blocks `[_, d]`, none of which has a past."""
        rows = torch.cat(blocks)
        return self.step(rows, torch.zeros(len(rows), self.width, device=self._device))[0]

    def _enter(self, x: Tensor) -> Tensor:
        for i, layer in enumerate(self._entry):
            x = functional.linear(x, self._leaf[f"layer{i}.weight"], self._leaf[f"layer{i}.bias"])
            x = activate_(layer.activation, x)
        return x

    def _leave(self, states: Tensor) -> Tensor:
        head = functional.linear(states, self._leaf["head.weight"], self._leaf["head.bias"])
        return activate_(self._head.activation, head)


def recurrent_policy(
    observations: int, actions: int, hidden: Sequence[int], activation: Activation, device: torch.device
) -> RecurrentNetwork:
    """The policy's network: a mean in [-1, 1] that depends on what was seen before; `log_std` is a parameter of it."""
    head = mean_layer(hidden[-1], actions)
    return RecurrentNetwork(observations, hidden, activation, head, {"log_std": (actions,)}, device)


def recurrent_value(
    observations: int, hidden: Sequence[int], activation: Activation, device: torch.device
) -> RecurrentNetwork:
    """The value network: the expected reward of an observation, given those before."""
    return RecurrentNetwork(observations, hidden, activation, value_layer(hidden[-1]), {}, device)
