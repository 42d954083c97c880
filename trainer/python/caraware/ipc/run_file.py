"""The run file: what `caraware` writes for the processes of a run, as parsed JSON."""

from typing import Any

ConfigTable = dict[str, Any]
"""A table of the configuration, such as `run["config"]["trainer"]`: values by key."""

RunFile = dict[str, Any]
"""`caraware` has validated it; readers take what they need of it and check its type there (`caraware.run.config`)."""


class ConfigError(Exception):
    """A value in the run file that the trainer cannot use; `help` says what to write instead."""

    def __init__(self, message: str, help: str) -> None:
        super().__init__(message)
        self.help = help
