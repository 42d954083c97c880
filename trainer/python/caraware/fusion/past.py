"""The episodes that the estimator has learned from so far: it goes on learning from all of them.

A process that continues a run must draw from the same episodes to end in the same bytes. A checkpoint does not hold
them: each is a file of its own beside the checkpoints, written once, before anything is learned from it.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from caraware.ipc.storage import when_there_is_space, write_whole

log = logging.getLogger(__name__)

FOLDER = "episodes"
"""In the directory of a run."""
MOST_ROWS = 4_000_000
"""Rows that are kept, a tick of a vehicle each: half a gigabyte. Beyond that the oldest episodes are forgotten."""


@dataclass(frozen=True)
class Episode:
    """What one episode was: `T` ticks of `n` slots."""

    table: Tensor
    """f32 `[T, n, COLUMNS]`."""
    truth_m: Tensor
    """f32 `[T, n, 2]`: east and north from the map's centre."""
    valid: Tensor
    """f32 `[T, n]`: 1 for rows that count."""

    def pieces(self, ticks: int) -> "Episode":
        """The same cut into pieces of so many ticks, side by side; the end is filled with rows that do not count.

        Pieces without a row that counts are left out.
        """

        def cut(column: Tensor) -> Tensor:
            missing = -len(column) % ticks
            padded = torch.cat((column, column.new_zeros(missing, *column.shape[1:])))
            return torch.cat(padded.split(ticks), 1)

        whole = Episode(cut(self.table), cut(self.truth_m), cut(self.valid))
        return whole.of(torch.nonzero(whole.valid.sum(0) > 0)[:, 0])

    def of(self, slots: Tensor) -> "Episode":
        """Some slots of it."""
        return Episode(*(column.index_select(1, slots) for column in vars(self).values()))


class Past:
    """Episodes cut into pieces, in memory and in files numbered by the update that they came with."""

    def __init__(self, folder: Path | None = None, most_rows: int = MOST_ROWS) -> None:
        """Without a folder it is in memory alone."""
        self._folder, self._most_rows = folder, most_rows
        self._episodes: dict[int, Episode] = {}

    def add(self, number: int, pieces: Episode, stop_requested: Callable[[], bool] = lambda: False) -> None:
        """One more episode. It waits while the disk is full; raises `OSError`."""
        self._episodes[number] = pieces
        if self._folder is None:
            return self._forget()
        file, content = self._folder / _name(number), save({k: v.contiguous() for k, v in vars(pieces).items()})
        when_there_is_space(file, lambda: self._write(file, content), stop_requested)
        return self._forget()

    @staticmethod
    def _write(file: Path, content: bytes) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(file, content)

    def _forget(self) -> None:
        while len(self._episodes) > 1 and sum(e.valid.numel() for e in self._episodes.values()) > self._most_rows:
            del self._episodes[min(self._episodes)]

    def tidy(self) -> None:
        """Remove the files of forgotten episodes; what is committed must not need them any more."""
        for file in self._folder.glob("*.safetensors") if self._folder else ():
            if int(file.stem) < min(self._episodes, default=0):
                file.unlink(missing_ok=True)

    def load(self, run_dir: Path, updates: int) -> None:
        """What a run had learned from after so many updates; episodes whose files are missing or damaged are left out.

        Those of another run are copied.
        """
        for file in sorted((run_dir / FOLDER).glob("*.safetensors"), reverse=True):
            if int(file.stem) > updates:
                continue
            try:
                pieces = Episode(**load_file(file))
            except (OSError, SafetensorError, TypeError) as error:
                log.warning("%s is left out: %s", file, error)
                continue
            if self._folder is not None and file.parent != self._folder:
                self.add(int(file.stem), pieces)
            else:
                self._episodes[int(file.stem)] = pieces
        self._episodes = dict(sorted(self._episodes.items()))
        self._forget()

    def draw(self, count: int, generator: torch.Generator) -> Episode:
        """So many pieces of all episodes, or all of them, in random order."""
        episodes = list(self._episodes.values())
        ends = torch.tensor([e.table.shape[1] for e in episodes]).cumsum(0)
        drawn = torch.randperm(int(ends[-1]), generator=generator)[:count].sort().values
        owner = torch.bucketize(drawn, ends, right=True)
        starts = [0, *ends[:-1].tolist()]
        parts = [e.of(drawn[owner == i] - starts[i]) for i, e in enumerate(episodes) if (owner == i).any()]
        return Episode(*(torch.cat(columns, 1) for columns in zip(*(vars(p).values() for p in parts), strict=True)))


def _name(number: int) -> str:
    return f"{number:06d}.safetensors"
