"""Adam (Kingma & Ba, arXiv 1412.6980, algorithm 1), over one flat vector of parameters and over those of modules.

Both call the functions that `torch.optim.Adam` calls. That class itself imports torch's compiler when it is made, which
takes a second of a core: a third of the time in which a killed learner is replaced.
"""

from collections.abc import Iterable

import torch
from torch import Tensor, nn
from torch.optim.adam import adam

from caraware.learn.flat import FlatParameters

BETA_MEAN, BETA_SQUARE = 0.9, 0.999
EPSILON = 1e-5
"""Larger than the paper's 1e-8: gradients of 1e-5 and below are noise here."""


class Adam:
    """Optimiser state of one network. `mean` and `square` are the running moments of the gradient, `steps` counts.

    By torch's fused step: one pass over the four vectors instead of seven.
    """

    def __init__(self, parameters: FlatParameters) -> None:
        self.mean = torch.zeros_like(parameters.values)
        self.square = torch.zeros_like(parameters.values)
        self.steps = torch.zeros((), dtype=torch.int64)
        self._parameters = parameters

    def state(self) -> dict[str, Tensor]:
        """The tensors of a checkpoint by name; filling them restores the state."""
        return {"mean": self.mean, "square": self.square, "steps": self.steps}

    def step(self, learning_rate: float) -> None:
        """Move the parameters against their gradient."""
        self.steps += 1
        torch._fused_adam_(
            [self._parameters.values],
            [self._parameters.gradient],
            [self.mean],
            [self.square],
            [],
            [self.steps.to(self.mean.device, torch.float32)],
            lr=learning_rate,
            beta1=BETA_MEAN,
            beta2=BETA_SQUARE,
            weight_decay=0.0,
            eps=EPSILON,
            amsgrad=False,
            maximize=False,
        )


class ModuleAdam:
    """Optimiser state of modules whose gradients come from autograd: the same bits as `torch.optim.Adam`.

    Parameters are real and their gradients dense. `means` and `squares` are the running moments of each
    parameter's gradient, `steps` counts its steps.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], epsilon: float = 1e-8) -> None:
        self._parameters, self._epsilon = list(parameters), epsilon
        self.means = [torch.zeros_like(parameter) for parameter in self._parameters]
        self.squares = [torch.zeros_like(parameter) for parameter in self._parameters]
        self.steps = [torch.tensor(0.0) for _ in self._parameters]

    def zero_grad(self) -> None:
        """Forget all gradients."""
        for parameter in self._parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self, learning_rate: float) -> None:
        """Move each parameter that has a gradient against it."""
        columns = (self._parameters, self.means, self.squares, self.steps)
        rows = [row for row in zip(*columns, strict=True) if row[0].grad is not None]
        adam(
            [parameter for parameter, *_ in rows],
            [parameter.grad for parameter, *_ in rows if parameter.grad is not None],
            [mean for _, mean, _, _ in rows],
            [square for _, _, square, _ in rows],
            [],
            [steps for *_, steps in rows],
            lr=learning_rate,
            beta1=BETA_MEAN,
            beta2=BETA_SQUARE,
            weight_decay=0.0,
            eps=self._epsilon,
            amsgrad=False,
            maximize=False,
        )

    def restore(self, means: Iterable[Tensor], squares: Iterable[Tensor], steps: float) -> None:
        """Continue with moments of the parameters' shapes, after as many steps of each."""
        for own, stored in ((self.means, means), (self.squares, squares)):
            for moment, value in zip(own, stored, strict=True):
                moment.copy_(value.view_as(moment))
        for count in self.steps:
            count.fill_(steps)
