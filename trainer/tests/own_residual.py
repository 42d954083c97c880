"""Networks of a user's own, which `trainer.network` names in the tests of ranks."""

from torch import Tensor, nn


class Residual(nn.Module):
    """A hidden layer with a way around it; each row by itself."""

    def __init__(self, inputs: int, outputs: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.enter = nn.Linear(inputs, hidden[0])
        self.norm = nn.LayerNorm(hidden[0])
        self.inner = nn.Linear(hidden[0], hidden[0])
        self.leave = nn.Linear(hidden[0], outputs)

    def forward(self, rows: Tensor) -> Tensor:
        """Rows `[b, inputs]` to `[b, outputs]`."""
        entered = self.enter(rows).relu()
        out: Tensor = self.leave(entered + self.inner(self.norm(entered)).relu())
        return out


class Normalising(nn.Sequential):
    """A hidden layer whose outputs depend on all rows of a minibatch."""

    def __init__(self, inputs: int, outputs: int, hidden: tuple[int, ...]) -> None:
        super().__init__(nn.Linear(inputs, hidden[0]), nn.BatchNorm1d(hidden[0]), nn.Linear(hidden[0], outputs))
