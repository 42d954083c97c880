"""The run file: what `caraware` writes for the processes of a run, as parsed JSON."""

from enum import Enum, StrEnum
from typing import Any, TypeVar

ConfigTable = dict[str, Any]
"""A table of the configuration, such as `run["config"]["trainer"]`: values by key."""

RunFile = dict[str, Any]
"""`caraware` has validated it; readers take what they need of it and check its type there (`setting`)."""

Setting = TypeVar("Setting", bound=int | float | str)


class BlackoutPolicy(StrEnum):
    """What the observation holds while a sensor is dark: values of `blackout.policy`."""

    HOLD = "hold"
    NAN = "nan"
    DROP = "drop"


class ConfigError(Exception):
    """A value in the run file that the trainer cannot use; `help` says what to write instead."""

    def __init__(self, message: str, help: str) -> None:
        super().__init__(message)
        self.help = help


def config_table(run: RunFile, name: str) -> ConfigTable:
    """Table `name` of the run's configuration. Raises `ConfigError`."""
    table = run.get("config", {}).get(name)
    if not isinstance(table, dict):
        raise ConfigError(f"the run file has no table `config.{name}`", "start the trainer through `caraware train`")
    return table


def setting(run: RunFile, key: str, kind: type[Setting]) -> Setting:
    """The value of `key`, such as `run.envs`, of the run's configuration. Raises `ConfigError`."""
    table, _, name = key.partition(".")
    values = config_table(run, table)
    if name not in values:
        raise ConfigError(f"the run file lacks the key `{key}`", "it is of another version of `caraware`")
    value: Setting = typed(key, values[name], kind)
    return value


def typed(key: str, value: object, kind: type) -> Any:
    """`value` of `key` as `kind`: an integer may stand for a float, a word for an enum. Raises `ConfigError`."""
    if issubclass(kind, Enum):
        if value not in (choices := [choice.value for choice in kind]):
            raise ConfigError(f"`{key}` is {value!r}", f"give one of: {', '.join(choices)}")
        return kind(value)
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if type(value) is kind:
        return value
    raise ConfigError(f"`{key}` is {value!r}", f"give a value of type {kind.__name__}")


def is_population(run: RunFile) -> bool:
    """Whether the run is on a map with population control, and not on a scenario of the user's."""
    return "population" in run["source"]


def sumo_begin_s(run: RunFile) -> float:
    """SUMO's clock at the begin of every episode, in s; add it to the time of a tick for SUMO's clock there."""
    return float(run["source"].get("scenario", {}).get("own", {}).get("begin_s", 0.0))
