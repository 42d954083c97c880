"""Metrics of what follows an action: a tick is measured when the next one has come."""

from dataclasses import dataclass

import numpy as np
import torch

from caraware.ipc.arrays import FloatArray, UInt64Array
from caraware.ipc.stream import Observation
from caraware.report.evaluation import EvaluatedRows
from caraware.tasks.contract import Task, TaskOutcome, TaskRows, TaskStep


@dataclass(frozen=True)
class FollowedTick(EvaluatedRows):
    """The rows of a tick with their metrics; those are valid whose vehicle held its slot at the tick after, too."""

    id_hash: UInt64Array
    """u64 `[n]`."""
    metrics: dict[str, FloatArray]
    """By name: values `[v]` on the valid rows."""


class FollowedTicks:
    """Measures each tick by the one after it, in a task whose world waits for actions."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self._before: tuple[int, FollowedTick, TaskRows] | None = None

    def add(self, obs: Observation) -> FollowedTick | None:
        """Take a tick; the one before it, if it has one in the same episode."""
        before = self._before
        rows = TaskRows(torch.nan_to_num(obs.observation).clone(), obs.truth.clone())
        kept = FollowedTick(obs.episode, obs.vehicle.copy(), obs.valid.copy(), obs.id_hash.copy(), {})
        self._before = (obs.tick, kept, rows)
        if before is None or before[0] + 1 != obs.tick or before[1].episode != obs.episode:
            return None
        _, past, past_rows = before
        wide = min(len(past.vehicle), len(obs.vehicle))
        stays = past.valid[:wide] & obs.valid[:wide] & (past.vehicle[:wide] == obs.vehicle[:wide])
        at = torch.from_numpy(np.flatnonzero(stays))
        none = torch.zeros(len(at), dtype=torch.bool)
        after = TaskRows(rows.observation[at], rows.truth[at])
        step = TaskStep(past_rows.observation[at], past_rows.truth[at], TaskOutcome(after, none, none))
        values = self._task.measure(step, torch.zeros(len(at), self._task.actions.size))
        metrics: dict[str, FloatArray] = {name: value.double().numpy() for name, value in values.items()}
        return FollowedTick(past.episode, past.vehicle[:wide], stays, past.id_hash[:wide], metrics)
