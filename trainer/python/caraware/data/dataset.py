"""A torch data set over the rows of recordings: what a vehicle observed in a tick, and where it was."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from caraware import _native
from caraware.data.recording import Recording
from caraware.ipc.arrays import Int64Array


class TickDataset(Dataset[dict[str, Tensor]]):
    """Every valid vehicle-tick of some recordings: a dict with a tensor for each section.

    The default sections are `observation` (f32 [d], normalised) and `truth` (f32 [4]: x, y in m, yaw in rad, speed in
    m/s). Rows are read from memory maps when they are asked for, so a data set may be larger than memory, and worker
    processes share its pages.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        sections: Sequence[str] = ("observation", "truth"),
        *,
        evaluation: bool | None = None,
    ) -> None:
        """`evaluation` selects evaluation episodes (True), training episodes (False), or both (None)."""
        self.recordings, self.sections = list(recordings), tuple(sections)
        self._rows = [_valid_rows(recording, evaluation) for recording in self.recordings]
        self._ends = np.cumsum([len(rows) for rows in self._rows])

    def __len__(self) -> int:
        """Number of vehicle-ticks."""
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        """Vehicle-tick `index`. Raises `IndexError` beyond the last."""
        return {name: part[0] for name, part in self.batch([index]).items()}

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, Tensor]]:
        """Some vehicle-ticks at once, as torch's loader asks for them."""
        batch = self.batch(indices)
        return [{name: part[place] for name, part in batch.items()} for place in range(len(indices))]

    def batch(self, indices: Sequence[int]) -> dict[str, Tensor]:
        """Some vehicle-ticks, [b, …] for each section. Raises `IndexError` beyond the last."""
        wanted = np.asarray(indices, np.int64)
        if len(wanted) and not (wanted.min() >= 0 and wanted.max() < len(self)):
            raise IndexError(f"vehicle-ticks are numbered from 0 to {len(self) - 1}")
        files = np.searchsorted(self._ends, wanted, side="right")
        begins = np.concatenate([[0], self._ends])
        places = [self._rows[file][place - begins[file]] for file, place in zip(files, wanted, strict=True)]
        return {
            name: torch.from_numpy(
                np.stack(
                    [
                        self.recordings[file].rows("observation", name)[row]
                        for file, row in zip(files, places, strict=True)
                    ]
                )
            )
            for name in self.sections
        }


def _valid_rows(recording: Recording, evaluation: bool | None) -> Int64Array:
    """Rows of the valid vehicle-ticks of the chosen episodes."""
    is_valid = (recording.rows("observation", "flags") & _native.VALID) != 0
    if evaluation is not None:
        offsets = recording.offsets("observation", "flags")
        of_message = (recording.headers()["flags"] & 1).astype(bool) == evaluation
        is_valid &= np.repeat(of_message, np.diff(offsets))
    return np.flatnonzero(is_valid)
