"""What `gymnasium.make` and `gymnasium.make_vec` return for the ids of `caraware.envs.registration`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from caraware.envs.simulation import Simulation, make
from caraware.envs.single import CarAwareEnv
from caraware.envs.vector import CarAwareVectorEnv


class MadeEnv(CarAwareEnv):
    """`CarAwareEnv` on a simulation of its own, with one vehicle; `close()` ends it."""

    def __init__(
        self,
        config: str | Path,
        vehicles: str,
        set: Mapping[str, Any] | None = None,
        seed: int = 1,
        **arguments: Any,
    ) -> None:
        """`config`, `set` and `seed` are those of `make`, and so are its errors; `arguments` are `CarAwareEnv`'s.

        `vehicles` is the key of the setting that says how many vehicles have a slot: 1, unless `set` has it.
        """
        simulation = _simulation(config, vehicles, 1, set, seed)
        try:
            super().__init__(simulation, **arguments)
        except BaseException:
            simulation.close()
            raise


class MadeVectorEnv(CarAwareVectorEnv):
    """`CarAwareVectorEnv` on a simulation of its own, with `num_envs` vehicles at a time; `close()` ends it."""

    def __init__(
        self,
        num_envs: int,
        config: str | Path,
        vehicles: str,
        set: Mapping[str, Any] | None = None,
        seed: int = 1,
        **arguments: Any,
    ) -> None:
        """`config`, `set` and `seed` are those of `make`, and so are its errors; `arguments` are `CarAwareVectorEnv`'s.

        `vehicles` is the key of the setting that says how many vehicles have a slot: `num_envs`, unless `set` has it.
        """
        simulation = _simulation(config, vehicles, num_envs, set, seed)
        try:
            super().__init__(simulation, num_envs, **arguments)
        except BaseException:
            simulation.close()
            raise


def _simulation(
    config: str | Path, vehicles: str, number: int, settings: Mapping[str, Any] | None, seed: int
) -> Simulation:
    """A scenario decides itself how many vehicles there are."""
    population = {} if str(config).endswith(".sumocfg") else {vehicles: number}
    return make(config, population | dict(settings or {}), seed)
