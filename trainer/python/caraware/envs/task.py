"""What actions mean in a run, and what a face needs to know of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from gymnasium.spaces import Box

from caraware import rewards
from caraware.envs.fields import Fields


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
    episode_ticks: int | None
    """Length of an episode; None in a scenario, which runs to its end."""
    dark_is_nan: bool
    reward: str
    reward_scale_m: float

    @classmethod
    def from_run(cls, run: dict) -> Task:
        """Read the run file."""
        config = run["config"]
        population = "population" in run.get("source", {"population": None})
        return cls(
            drives=config["task"]["kind"] == "driving",
            tick_s=float(config["run"]["tick_s"]),
            fields=Fields.from_run(run),
            bounds_m=tuple(float(value) for value in run["map"]["bounds_m"]),
            slots=_slots(config, population),
            episode_ticks=int(config["episode"]["ticks"]) if population else None,
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

    def to_world_m(self, action: np.ndarray) -> np.ndarray:
        """Actions `[..., 2]` as positions in world metres: ±1 is the edge of the map."""
        low, high = np.array(self.bounds_m[:2]), np.array(self.bounds_m[2:])
        return low + (np.asarray(action, np.float64) + 1) / 2 * (high - low)

    def answer(self, action: np.ndarray, rows: int) -> np.ndarray:
        """Actions `[N, 2]` as the simulation takes them: f32 `[rows, 2]`, those of the driving task within ±1."""
        answer = np.zeros((rows, 2), np.float32)
        used = min(rows, len(action))
        answer[:used] = np.clip(action[:used], -1.0, 1.0) if self.drives else self.to_world_m(action[:used])
        return answer

    def check_reward(self) -> None:
        """Raises `caraware.rewards.UnknownReward` for a name that there is not."""
        rewards.by_name(self.reward)


def _slots(config: dict, population: bool) -> int | None:
    traffic = config["traffic"]
    if config["task"]["kind"] == "driving":
        return len(traffic.get("hero_ids", ())) or int(traffic["heroes"])
    if not population:
        return None
    smartphones = int(traffic["pedestrians"]) if config["gnss"].get("pedestrians") else 0
    return int(traffic["cavs"]) + smartphones
