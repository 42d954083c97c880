"""Adam (Kingma & Ba, arXiv 1412.6980, algorithm 1) over one flat vector of parameters.

By torch's fused step, one pass over the four vectors instead of seven. `torch.optim.Adam(fused=True)` takes the same,
but importing it pulls in torch's compiler: seconds before the first tick.
"""

import torch
from torch import Tensor

from caraware.learn.flat import FlatParameters

BETA_MEAN, BETA_SQUARE = 0.9, 0.999
EPSILON = 1e-5
"""Larger than the paper's 1e-8: gradients of 1e-5 and below are noise here."""


class Adam:
    """Optimiser state of one network. `mean` and `square` are the running moments of the gradient, `steps` counts."""

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
