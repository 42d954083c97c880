"""The ids under which Gymnasium makes environments: `gymnasium.make("CarAware/Town-v0")`.

`import caraware.envs` registers them; so does the id in the form `caraware.envs:CarAware/Town-v0`.
"""

from gymnasium.envs.registration import register, registry

IDS = {
    "CarAware/Town-v0": {"config": "town", "vehicles": "traffic.cavs"},
    "CarAware/Driving-v0": {"config": "driving", "vehicles": "traffic.heroes"},
}
"""Defaults of `caraware.envs.made` by id: the localisation task in the town, and the driving task there."""


def register_environments() -> None:
    """Registers every id that is not registered yet."""
    for id, defaults in IDS.items():
        if id not in registry:
            register(
                id,
                entry_point="caraware.envs.made:MadeEnv",
                vector_entry_point="caraware.envs.made:MadeVectorEnv",
                kwargs=dict(defaults),
            )
