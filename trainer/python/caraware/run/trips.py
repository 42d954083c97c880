"""How the trips of heroes ended, counted from the flags of the tick after."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from caraware.ipc.stream import Observation
from caraware.tasks.contract import Task
from caraware.tasks.ends import END_NAMES, OFF_ROAD, name_of

Trips = Counter[str]
"""Trips by the name of their end."""


def has_trips(task: Task) -> bool:
    """Whether trajectories of a task are trips of a driver, which can fail beside the road."""
    return any(end.name == END_NAMES[OFF_ROAD] for end in task.ends)


@dataclass
class TripCounts:
    """Trips that ended in training and in evaluations."""

    training: Trips = field(default_factory=Counter)
    evaluation: Trips = field(default_factory=Counter)

    def add(self, obs: Observation) -> None:
        """Count the trips that the flags of one tick end."""
        ended = np.flatnonzero(obs.terminated | obs.truncated)
        if not len(ended):
            return
        counts = self.evaluation if obs.evaluation else self.training
        reasons = obs.ended_by
        for slot in ended:
            counts[name_of(int(reasons[slot]))] += 1


class EndedTrips:
    """The trips of training that ended since the last update."""

    def __init__(self) -> None:
        self._reported: Trips = Counter()

    def take(self, counts: Iterable[Trips]) -> dict[str, int]:
        """Those that ended since the last call, by the name of their end, of all environments together."""
        total: Trips = Counter(sum_of(counts))
        ended, self._reported = total - self._reported, total
        return dict(ended)


def sum_of(counts: Iterable[Trips]) -> dict[str, int]:
    """All together."""
    total: Trips = Counter()
    for each in counts:
        total += each
    return dict(sorted(total.items()))
