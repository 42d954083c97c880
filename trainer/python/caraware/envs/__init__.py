"""Standard faces of a simulation for other learners: Gymnasium, PettingZoo, Stable-Baselines3.

`make` starts a simulation; a face is put on it, or on the `Channel` of a trainer that the supervisor started.
docs/environments.md says which face is for what. Importing this package registers the ids of
`caraware.envs.registration` with Gymnasium, where Gymnasium is installed.
"""

import os
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from caraware.envs.parallel import CarAwareParallelEnv
    from caraware.envs.rewards import Reward
    from caraware.envs.sb3 import CarAwareVecEnv
    from caraware.envs.simulation import Simulation, SimulationError, make
    from caraware.envs.single import CarAwareEnv
    from caraware.envs.slots import RunEndedError
    from caraware.envs.transition import Transition
    from caraware.envs.vector import CarAwareVectorEnv

_MODULE_OF = {
    "CarAwareEnv": "single",
    "CarAwareParallelEnv": "parallel",
    "CarAwareVecEnv": "sb3",
    "CarAwareVectorEnv": "vector",
    "Reward": "rewards",
    "RunEndedError": "slots",
    "Simulation": "simulation",
    "SimulationError": "simulation",
    "Transition": "transition",
    "make": "simulation",
}

__all__ = [
    "CarAwareEnv",
    "CarAwareParallelEnv",
    "CarAwareVecEnv",
    "CarAwareVectorEnv",
    "Reward",
    "RunEndedError",
    "Simulation",
    "SimulationError",
    "Transition",
    "make",
]


def __getattr__(name: str) -> object:
    """Imports a face when it is asked for: a user needs one of three libraries, and `caraware.envs.outside` none."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


# The process that keeps a trainer's place (`caraware.envs.outside.LINE`) starts faster without Gymnasium.
if "CARAWARE_OUTSIDE" not in os.environ and find_spec("gymnasium") is not None:
    from caraware.envs.registration import register_environments

    register_environments()
