"""Signs of life of a trainer that waits for the trainers of other ranks: a thread notes on its board that it waits.

The trainers of other ranks wait for one that hangs, and must not be taken to hang themselves. Decision 51.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

LOOK_S = 0.05
"""Time between two looks of the thread: as long as other processes of a run wait between theirs."""


class Board(Protocol):
    """Where a trainer notes what it does: its place in a run, or its channel."""

    def note_waiting_for_ranks(self) -> None:
        """Note that it lives, and waits for the trainers of other ranks."""

    def note_working(self) -> None:
        """Note that it works."""


class WaitNotes:
    """Notes on a board while a thread of this process waits for other ranks.

    A process that hangs elsewhere, or is stopped as a whole, leaves no note. Nor does a wait that is over at the next
    look, like those between the gradient steps of an update.
    """

    def __init__(self, board: Board | None = None) -> None:
        """Without a board nothing is noted."""
        self.board = board
        self._lock = threading.Lock()
        self._waits = self._begun = 0
        if board is not None:
            threading.Thread(target=self._note, name="waiting", daemon=True).start()

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Note that this thread waits until the block ends."""
        with self._lock:
            self._waits += 1
            self._begun += 1
        try:
            yield
        finally:
            with self._lock:
                self._waits -= 1

    def _note(self) -> None:
        newest, noted = None, False
        while self.board is not None:
            time.sleep(LOOK_S)
            with self._lock:
                before, newest = newest, self._begun if self._waits else None
            waits_still = newest is not None and newest == before
            if waits_still:
                self.board.note_waiting_for_ranks()
            elif noted:
                self.board.note_working()
            noted = waits_still
