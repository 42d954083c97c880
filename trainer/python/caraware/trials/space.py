"""What a study varies: keys of the configuration with the values that they may take."""

import json
import math
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optuna.trial import Trial

LOGARITHMIC = ":log"
NUMBERS = ("integer", "float")
"""Kinds of keys that have ranges. In the values of others two dots are part of a path."""
SYNTAX = "write KEY=LOW..HIGH, KEY=LOW..HIGH:log, or KEY=A,B,C"


class SpaceError(ValueError):
    """A `--vary` that cannot be searched."""


@dataclass(frozen=True)
class KeyRange:
    """Numbers from one to another, both included."""

    low: float
    high: float
    is_integer: bool
    is_logarithmic: bool

    def suggest(self, trial: Trial, key: str) -> str:
        """The value of a trial, as `--set` takes it."""
        if self.is_integer:
            return str(trial.suggest_int(key, int(self.low), int(self.high), log=self.is_logarithmic))
        return repr(trial.suggest_float(key, self.low, self.high, log=self.is_logarithmic))


@dataclass(frozen=True)
class KeyChoices:
    """Values of any kind, as `--set` takes them."""

    values: tuple[str, ...]

    def suggest(self, trial: Trial, key: str) -> str:
        """The value of a trial."""
        return str(trial.suggest_categorical(key, self.values))


Space = dict[str, KeyRange | KeyChoices]
"""By key."""


def known_keys(program: Path) -> dict[str, dict[str, Any]]:
    """The keys of the configuration, by path, as `caraware keys --json` describes them."""
    text = subprocess.run([program, "keys", "--json"], check=True, capture_output=True, text=True).stdout
    return {key["path"]: key for key in json.loads(text)["keys"]}


def parse_space(varied: Sequence[str], known: Mapping[str, Mapping[str, Any]]) -> Space:
    """The space of some `--vary KEY=…`. Raises `SpaceError`, which names the argument and the way to write it."""
    space: Space = {}
    for text in varied:
        key, equals, values = text.partition("=")
        if not equals or not values:
            raise SpaceError(f"--vary {text}: {SYNTAX}")
        if key not in known:
            raise SpaceError(f"--vary {text}: there is no key `{key}`; `caraware keys` lists them")
        if key in space:
            raise SpaceError(f"--vary {text}: `{key}` is varied twice")
        is_range = ".." in values and known[key]["kind"] in NUMBERS
        space[key] = _range(text, values, known[key]) if is_range else _choices(text, values, known[key])
    if not space:
        raise SpaceError(f"nothing is varied: give --vary; {SYNTAX}")
    return space


def _choices(text: str, values: str, known: Mapping[str, Any]) -> KeyChoices:
    choices = _split(values)
    if len(choices) < 2:
        raise SpaceError(f"--vary {text}: one value is no choice; {SYNTAX}")
    allowed = known["choices"]
    if known["kind"] == "choice" and (wrong := [value for value in choices if value not in allowed]):
        raise SpaceError(f"--vary {text}: {wrong[0]!r} is not allowed; allowed are {known['allowed']}")
    if len(set(choices)) < len(choices):
        raise SpaceError(f"--vary {text}: a value is there twice")
    return KeyChoices(tuple(choices))


def _split(values: str) -> list[str]:
    """The parts between commas that are not within brackets: `[64, 64],[128]` has two."""
    parts, depth = [""], 0
    for letter in values:
        depth += (letter == "[") - (letter == "]")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts]


def _range(text: str, values: str, known: Mapping[str, Any]) -> KeyRange:
    is_logarithmic = values.endswith(LOGARITHMIC)
    ends = values.removesuffix(LOGARITHMIC).split("..")
    is_integer = known["kind"] == "integer"
    try:
        low, high = (float(int(end)) if is_integer else float(end) for end in ends)
    except ValueError:
        number = "an integer" if is_integer else "a number"
        raise SpaceError(f"--vary {text}: an end is not {number}; {SYNTAX}") from None
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise SpaceError(f"--vary {text}: the first end must be below the second")
    if is_logarithmic and low <= 0:
        raise SpaceError(f"--vary {text}: a logarithmic range begins above 0")
    least, most = known["min"], known["max"]
    if (least is not None and low < least) or (most is not None and high > most):
        raise SpaceError(f"--vary {text}: allowed is {known['allowed']}")
    return KeyRange(low, high, is_integer, is_logarithmic)
