"""Puts the frames of one tick together, so that a vehicle is never drawn at one tick and its fix at another.

`world`, `observation`, `prediction` and `neighbours` of a tick are published together, but on topics of different
priority, and a slow display skips frames: each topic's newest frame may be of another tick.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Generic, TypeVar

TICK_TOPICS = ("world", "observation", "prediction", "neighbours")
"""The topics of a tick, in the order in which they are drawn."""
EVERY_RUNS_TOPICS = ("world", "observation", "prediction")
"""Those that a viewer always subscribes to."""

_PATIENCE_S = 0.2
"""Longest wait for the topics of a tick that are missing: one is switched off, has a lower rate, or was lost."""
_MAX_SETS = 8
_REMEMBERED_SETS = 16

Frame = TypeVar("Frame")
Tick = tuple[int, int]
"""Identity of the run, and tick."""


@dataclass
class _Set(Generic[Frame]):
    born_s: float
    frames: dict[str, Frame] = field(default_factory=dict)


class TickSets(Generic[Frame]):
    """Collects frames by tick, and returns the newest tick of which every usual topic is there."""

    def __init__(
        self, clock: Callable[[], float] = time.monotonic, topics: Collection[str] = EVERY_RUNS_TOPICS
    ) -> None:
        """`topics` are waited for at first; later those that came with the newest sets."""
        self._clock, self._at_first = clock, frozenset(topics)
        self._sets: dict[Tick, _Set[Frame]] = {}
        self._taken: Tick | None = None
        self._usual: deque[frozenset[str]] = deque(maxlen=_REMEMBERED_SETS)
        self.skipped = 0
        """Frames that were never returned: of older ticks than one that was."""

    def add(self, topic: str, tick: Tick, frame: Frame) -> None:
        """Adds the frame of a topic of `TICK_TOPICS`. One of a tick that is over is dropped."""
        if self._taken is not None and tick[0] == self._taken[0] and tick[1] <= self._taken[1]:
            self.skipped += 1
            return
        self._sets.setdefault(tick, _Set(self._clock())).frames[topic] = frame
        while len(self._sets) > _MAX_SETS:
            self.skipped += len(self._sets.pop(next(iter(self._sets))).frames)

    def ready(self) -> bool:
        """True if `take` returns a set."""
        return self._newest_ready() is not None

    def take(self, *, at_once: bool = False) -> dict[str, Frame]:
        """The frames of the newest tick that is complete or has waited long enough, and of no other; may be empty.

        Older ticks are dropped. With `at_once` the newest tick is returned as it is.
        """
        tick = next(reversed(self._sets), None) if at_once else self._newest_ready()
        if tick is None:
            return {}
        for older in list(self._sets):
            found = self._sets.pop(older)
            if older == tick:
                break
            self.skipped += len(found.frames)
        self._taken = tick
        self._usual.append(frozenset(found.frames))
        return {topic: found.frames[topic] for topic in TICK_TOPICS if topic in found.frames}

    def _newest_ready(self) -> Tick | None:
        usual = frozenset().union(*self._usual) if self._usual else self._at_first
        now_s = self._clock()
        for tick in reversed(self._sets):
            found = self._sets[tick]
            if usual <= found.frames.keys() or now_s - found.born_s >= _PATIENCE_S:
                return tick
        return None
