"""What a face needs to know of a run: its task, the columns of its observation, and how far it runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor

from caraware.ipc.arrays import Float32Array
from caraware.ipc.run_file import BlackoutPolicy, ConfigTable, RunFile, is_population, setting
from caraware.tasks.contract import Sampling, Task
from caraware.tasks.fields import Fields
from caraware.tasks.messages import Messages, speech_width
from caraware.tasks.table import task_of_run


@dataclass(frozen=True)
class FaceSettings:
    """The settings of one run that a face reads."""

    task: Task
    tick_s: float
    fields: Fields
    width: int
    """Numbers of a row that a policy sees: of the fields, or in the messages task of what a station knows."""
    slots: int | None
    """Vehicles with a slot at a time; None in a scenario, which does not say."""
    episode_ticks: int
    """Length of an episode; a scenario may end before."""
    credit_ticks: int
    """Ticks after which the simulation gets credit. It is a window ahead, so half of one is soon enough, and it is not
    woken for each tick: that costs more than all of a step here."""
    dark_is_nan: bool

    @classmethod
    def from_run(cls, run: RunFile) -> FaceSettings:
        """Read the run file."""
        config = run["config"]
        task = task_of_run(run)
        window_ticks = setting(run, "run.window_ticks", int)
        return cls(
            task=task,
            tick_s=setting(run, "run.tick_s", float),
            fields=(fields := Fields.from_run(run)),
            width=speech_width(task.actions.size) if isinstance(task, Messages) else fields.width,
            slots=_slots(config, is_population(run)),
            episode_ticks=setting(run, "episode.ticks", int),
            credit_ticks=1 if task.sampling is Sampling.EACH_TICK else max(1, window_ticks // 2),
            dark_is_nan=setting(run, "blackout.policy", BlackoutPolicy) is BlackoutPolicy.NAN,
        )

    @property
    def ticks_per_s(self) -> int:
        """Ticks of a simulated second, at least 1: the frame rate of a video in real time."""
        return max(1, round(1 / self.tick_s))

    def observation_space(self) -> Box:
        """Of one vehicle: f32 `[d]`."""
        return Box(-1.0 if isinstance(self.task, Messages) else self.fields.low, 1.0, (self.width,), np.float32)

    def action_space(self) -> Box:
        """Of one vehicle: f32 `[a]`, each in the range of the task's actions."""
        actions = self.task.actions
        return Box(actions.low, actions.high, (actions.size,), np.float32)

    def answer(self, action: Float32Array, rows: int, observation: Tensor) -> Float32Array:
        """Actions `[N, a]` on rows `[rows, d]` as the simulation takes them: f32 `[rows, a]`."""
        answer = np.zeros((rows, self.task.actions.size), np.float32)
        used = min(rows, len(action))
        answer[:used] = self.task.answer(torch.from_numpy(action[:used].astype(np.float64)), observation[:used]).numpy()
        return answer


def _slots(config: ConfigTable, population: bool) -> int | None:
    traffic = config["traffic"]
    if config["task"]["kind"] == "driving":
        return len(traffic["hero_ids"]) or int(traffic["heroes"])
    if not population:
        return None
    smartphones = int(traffic["pedestrians"]) if config["gnss"]["pedestrians"] else 0
    return int(traffic["cavs"]) + smartphones
