"""What actions mean in a run, and what a face needs to know of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from gymnasium.spaces import Box

from caraware.envs.fields import Fields
from caraware.ipc.arrays import Float32Array, Float64Array
from caraware.ipc.run_file import ConfigTable, RunFile


@dataclass(frozen=True)
class Task:
    """The task of one run."""

    drives: bool
    """Actions are steering and acceleration, and the world waits for them; else they are positions."""
    tick_s: float
    fields: Fields
    bounds_m: tuple[float, float, float, float]
    """The box of the map, which positions −1 … 1 span: x_min, y_min, x_max, y_max (m, world)."""
    slots: int | None
    """Vehicles with a slot at a time; None in a scenario, which does not say."""
    episode_ticks: int
    """Length of an episode; a scenario may end before."""
    credit_ticks: int
    """Ticks after which the simulation gets credit. It is a window ahead, so half of one is soon enough, and it is not
    woken for each tick: that costs more than all of a step here."""
    dark_is_nan: bool
    reward: str
    reward_scale_m: float

    @classmethod
    def from_run(cls, run: RunFile) -> Task:
        """Read the run file."""
        config = run["config"]
        x_min, y_min, x_max, y_max = (float(value) for value in run["map"]["bounds_m"])
        population = "population" in run.get("source", {"population": None})
        drives = config["task"]["kind"] == "driving"
        return cls(
            drives=drives,
            tick_s=float(config["run"]["tick_s"]),
            fields=Fields.from_run(run),
            bounds_m=(x_min, y_min, x_max, y_max),
            slots=_slots(config, population),
            episode_ticks=int(config["episode"]["ticks"]),
            credit_ticks=1 if drives else max(1, int(config["run"].get("window_ticks", 1)) // 2),
            dark_is_nan=config.get("blackout", {}).get("policy") == "nan",
            reward=config["trainer"].get("reward", "bounded_inverse"),
            reward_scale_m=float(config["trainer"].get("reward_scale_m", 5.0)),
        )

    def observation_space(self) -> Box:
        """Of one vehicle: f32 `[d]`."""
        return Box(self.fields.low, 1.0, (self.fields.width,), np.float32)

    def action_space(self) -> Box:
        """Of one vehicle: f32 `[2]`, each from −1 to 1."""
        return Box(-1.0, 1.0, (2,), np.float32)

    def to_world_m(self, action: Float32Array) -> Float64Array:
        """Actions `[..., 2]` as positions in world metres: ±1 is the edge of the map."""
        centre, half = self._box_m
        position_m: Float64Array = action * half + centre
        return position_m

    @cached_property
    def _box_m(self) -> tuple[Float64Array, Float64Array]:
        """Centre and half the size of the map's box, f64 `[2]` each."""
        low, high = np.array(self.bounds_m[:2]), np.array(self.bounds_m[2:])
        return (low + high) / 2, (high - low) / 2

    def answer(self, action: Float32Array, rows: int) -> Float32Array:
        """Actions `[N, 2]` as the simulation takes them: f32 `[rows, 2]`, those of the driving task within ±1."""
        answer = np.zeros((rows, 2), np.float32)
        used = min(rows, len(action))
        answer[:used] = np.clip(action[:used], -1.0, 1.0) if self.drives else self.to_world_m(action[:used])
        return answer


def _slots(config: ConfigTable, population: bool) -> int | None:
    traffic = config["traffic"]
    if config["task"]["kind"] == "driving":
        return len(traffic.get("hero_ids", ())) or int(traffic["heroes"])
    if not population:
        return None
    smartphones = int(traffic["pedestrians"]) if config["gnss"].get("pedestrians") else 0
    return int(traffic["cavs"]) + smartphones
