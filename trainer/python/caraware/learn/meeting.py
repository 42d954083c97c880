"""Where the trainers that learn together meet: each announces itself in the store that `torchrun` keeps.

A group of `torch.distributed` cannot take a member back. When a trainer has died and its successor comes, the others
end as well, and the successors of all meet again, from the newest checkpoint that all have. Decision 51.
"""

import json
import logging
import os
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import timedelta
from typing import Any

log = logging.getLogger("caraware.train")

LOST_ANOTHER = 75
"""Exit code of a trainer that ends because that of another rank has been replaced: it is to be started again."""
AHEAD_OF_OTHERS = 76
"""Exit code of a successor whose other ranks have gone back to the learner before it: this rank has to, as well."""
MEET_WITHIN_S = 3600.0
"""For ranks whose simulation is slower to start."""
ANSWER_WITHIN = timedelta(minutes=5)
"""Longest wait for one answer of the store."""
POLL_S, WATCH_S = 0.1, 1.0
"""Time between two looks into the store, while the trainers meet and after that."""
REPLACED_WITHIN_S = 120.0
"""From a lost connection to the successor of the trainer that has died; without one the loss has another reason."""


class MeetingError(Exception):
    """The ranks cannot meet."""


@dataclass(frozen=True)
class Attendance:
    """What a trainer says of itself when it comes."""

    incarnation: int
    """Number of trainers of its rank before it, in this launch."""
    handovers: int
    """Completed handovers behind it, without those that fell back."""
    checkpoints: tuple[str, ...]
    """Names of its sound checkpoints."""


def newest_of_all(checkpoints: Sequence[Sequence[str]]) -> str | None:
    """The newest checkpoint that all have; None if they have none in common."""
    return max(set.intersection(*(set(names) for names in checkpoints)), default=None)


class Meeting:
    """The meeting of one trainer with those of the other ranks. A key of the store belongs to one rank."""

    def __init__(self, own: Attendance, stop_requested: Callable[[], bool] = lambda: False) -> None:
        """Its rank and the store are those that `torchrun` names. Raises `MeetingError`."""
        self.rank, self.ranks = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
        self._own, self._stop_requested = own, stop_requested
        attempt = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
        self._prefix = f"caraware/{attempt}/meeting"
        self._store = self._connect()
        self._parted = threading.Event()
        self.present: tuple[Attendance, ...] = ()
        """The trainers that have met, in the order of the ranks."""
        self.is_over = False
        """All ranks had written all their results before this trainer came: no other trainer comes."""

    def store(self) -> Any:
        """The part of the store in which this group exchanges its addresses, by a connection of its own."""
        from torch.distributed import PrefixStore  # type: ignore[attr-defined]  # torch lists it without exporting it

        return PrefixStore(self.name(), self._connect())

    def _connect(self) -> Any:
        """A connection to the store. Raises `MeetingError`."""
        from torch.distributed import TCPStore  # type: ignore[attr-defined]  # see `store`

        try:
            address, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
            return TCPStore(address, port, is_master=False, timeout=ANSWER_WITHIN)
        except RuntimeError as error:
            raise MeetingError(f"cannot reach torchrun: {str(error).splitlines()[0]}") from error

    def name(self) -> str:
        """A name that no other group of this launch has, once they have met."""
        return f"{self._prefix}/" + "-".join(str(each.incarnation) for each in self.present)

    def gather(self) -> None:
        """Wait until every rank has come and all see the same trainers. Raises `MeetingError`.

        Ends the process where this trainer is ahead of the others' handovers.
        """
        deadline = time.monotonic() + MEET_WITHIN_S
        try:
            self._set("attendance", json.dumps(asdict(self._own)))
            while not self._have_met():
                if self._stop_requested():
                    raise MeetingError("asked to stop before all ranks had come")
                if time.monotonic() > deadline:
                    raise MeetingError(f"not all ranks have come within {MEET_WITHIN_S:.0f} s")
                time.sleep(POLL_S)
        except RuntimeError as error:
            raise MeetingError(f"cannot reach torchrun: {str(error).splitlines()[0]}") from error
        if not self.is_over:
            threading.Thread(target=self._watch, name="ranks", daemon=True).start()

    def common_checkpoint(self) -> str | None:
        """The newest checkpoint that all ranks have; None if they begin at the beginning."""
        return newest_of_all([each.checkpoints for each in self.present])

    def continues(self) -> bool:
        """Whether any of those present has had a trainer before it."""
        return any(each.incarnation > 0 for each in self.present)

    def await_successor(self) -> None:
        """Wait for the successor of a trainer that has died, which ends this process; return if none comes in time."""
        deadline = time.monotonic() + REPLACED_WITHIN_S
        while time.monotonic() < deadline and not self._stop_requested():
            time.sleep(POLL_S)

    def note_end(self) -> None:
        """Note that all ranks have written all their results: no successor has to meet the others any more."""
        self._store.set(f"{self._prefix}/over", "yes")

    def part(self) -> None:
        """Stop watching: this trainer has done its work."""
        self._parted.set()

    def _have_met(self) -> bool:
        """Whether all ranks have written that they see the same trainers, or the launch is over."""
        if self._store.check([f"{self._prefix}/over"]):
            self.is_over = True
            return True
        present = self._all("attendance")
        if present is None:
            return False
        self.present = tuple(Attendance(**json.loads(text)) for text in present)
        seen = self.name()
        self._set("seen", seen)
        if self._all("seen") != [seen] * self.ranks:
            return False
        fewest = min(each.handovers for each in self.present)
        if self._own.handovers > fewest:
            log.warning("another rank has gone back to the learner before this one: so does this rank")
            _end(AHEAD_OF_OTHERS)
        return all(each.handovers == fewest for each in self.present)

    def _watch(self) -> None:
        """End the process when another trainer comes in the place of one that is here."""
        met = [each.incarnation for each in self.present]
        while not self._parted.wait(WATCH_S):
            try:
                texts = self._all("attendance")
            except RuntimeError:
                # `torchrun` has ended, and asks the supervisors to end.
                return
            if texts and met != [json.loads(text)["incarnation"] for text in texts]:
                log.warning("the trainer of another rank has been replaced: the successors of all ranks meet again")
                _end(LOST_ANOTHER)

    def _set(self, what: str, text: str) -> None:
        self._store.set(f"{self._prefix}/{what}/{self.rank}", text)

    def _all(self, what: str) -> list[str] | None:
        """What each rank has written; None while one has written nothing."""
        keys = [f"{self._prefix}/{what}/{rank}" for rank in range(self.ranks)]
        return [text.decode() for text in self._store.multi_get(keys)] if self._store.check(keys) else None


def _end(code: int) -> None:
    """End like a killed process: every file is whole at any moment, and torch would take seconds to tidy up."""
    logging.shutdown()
    os._exit(code)
