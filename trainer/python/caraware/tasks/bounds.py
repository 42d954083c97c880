"""The box of the map, which the positions of the localisation task span."""

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from caraware.ipc.run_file import ConfigError, RunFile


@dataclass(frozen=True)
class MapBounds:
    """The box of the map in world metres (ENU). Actions in [-1, 1] span it."""

    x_min_m: float
    y_min_m: float
    x_max_m: float
    y_max_m: float

    @classmethod
    def from_run(cls, run: RunFile) -> "MapBounds":
        """Read `run["map"]["bounds_m"]` = [x_min, y_min, x_max, y_max]. Raises `ConfigError`."""
        bounds = run.get("map", {}).get("bounds_m")
        if not isinstance(bounds, list) or len(bounds) != 4 or not all(isinstance(v, int | float) for v in bounds):
            raise ConfigError(f"`map.bounds_m` is {bounds}", "four numbers: [x_min, y_min, x_max, y_max] in metres")
        box = cls(*(float(v) for v in bounds))
        if not (box.x_min_m < box.x_max_m and box.y_min_m < box.y_max_m):
            raise ConfigError(f"`map.bounds_m` = {bounds} is an empty box", "[x_min, y_min, x_max, y_max]")
        return box

    def to_world_m(self, action: Tensor) -> Tensor:
        """Map actions `[..., 2]` to world metres. Affine and unclipped: ±1 is the edge, beyond it lies outside."""
        half, centre = _half_and_centre_m(self, action.dtype, action.device)
        return action * half + centre


@lru_cache(maxsize=16)
def _half_and_centre_m(box: MapBounds, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Half the extent of a box and its centre, `[2]` each (m): kept, because they take longer than their use."""
    # A tensor made in inference mode could not be used in training later.
    with torch.inference_mode(False):
        half = torch.tensor([box.x_max_m - box.x_min_m, box.y_max_m - box.y_min_m], dtype=dtype, device=device) / 2
        centre = torch.tensor([box.x_max_m + box.x_min_m, box.y_max_m + box.y_min_m], dtype=dtype, device=device) / 2
    return half, centre
