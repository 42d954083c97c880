"""Fields of an observation by name: their places in a row and their ranges (docs/driving.md, configs/README.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import torch
from torch import Tensor

from caraware.ipc.arrays import Float32Array, Float64Array
from caraware.ipc.run_file import RunFile, config_table, setting


class ObservationScale(StrEnum):
    """Values of `observation.scale`."""

    ZERO_TO_ONE = "zero_to_one"
    MINUS_ONE_TO_ONE = "minus_one_to_one"


LOWER_END = {ObservationScale.ZERO_TO_ONE: 0.0, ObservationScale.MINUS_ONE_TO_ONE: -1.0}


class UnknownFieldError(KeyError):
    """The observation has no such field, or its range is not known here."""


@dataclass(frozen=True)
class Fields:
    """The columns of an observation row of one run."""

    names: tuple[str, ...]
    """In the order of the columns of one tick; with a history, the newest tick comes last."""
    history: int
    low: float
    """Lower end of the normalised range; the upper one is 1."""
    _ranges: dict[str, tuple[float, float]]

    @classmethod
    def from_run(cls, run: RunFile) -> Fields:
        """The fields that the run file names."""
        names = tuple(config_table(run, "observation")["fields"])
        low = LOWER_END[setting(run, "observation.scale", ObservationScale)]
        return cls(names, setting(run, "observation.history", int), low, _ranges(run))

    @property
    def width(self) -> int:
        """Numbers in a row."""
        return len(self.names) * self.history

    def has(self, name: str) -> bool:
        """Whether the observation has field `name`, with a known range."""
        return name in self.names and name in self._ranges

    def si(self, observation: Float32Array, name: str) -> Float64Array:
        """Field `name` of rows `[..., d]` in SI units, `[...]`; of the newest tick. Clipped at the field's range."""
        low, high = self._range(name)
        unit = (observation[..., self._place(name)].astype(np.float64) - self.low) / (1.0 - self.low)
        return low + unit * (high - low)

    def si_tensor(self, observation: Tensor, name: str) -> Tensor:
        """The same of a tensor, f64 `[...]`."""
        low, high = self._range(name)
        unit = (observation[..., self._place(name)].double() - self.low) / (1.0 - self.low)
        return low + unit * (high - low)

    def si_columns(self, observation: Tensor, names: Sequence[str]) -> Tensor:
        """Several fields of a tensor at once, f64 `[..., names]`."""
        places = [self._place(name) for name in names]
        low, high = torch.tensor([self._range(name) for name in names], dtype=torch.float64).T.to(observation.device)
        unit = (observation[..., places].double() - self.low) / (1.0 - self.low)
        values: Tensor = low + unit * (high - low)
        return values

    def range(self, name: str) -> tuple[float, float]:
        """Lower and upper end of field `name` in SI units. Raises `UnknownFieldError`."""
        return self._range(name)

    def _place(self, name: str) -> int:
        return (self.history - 1) * len(self.names) + self.names.index(name)

    def _range(self, name: str) -> tuple[float, float]:
        if not self.has(name):
            known = ", ".join(field for field in self.names if field in self._ranges)
            raise UnknownFieldError(f"no field {name!r} with a known range in the observation; there are: {known}")
        return self._ranges[name]


def _ranges(run: RunFile) -> dict[str, tuple[float, float]]:
    """Lower and upper end of every field in SI units, as the run file names them."""
    return {field["name"]: (field["range"][0], field["range"][1]) for field in run["observation_fields"]}
