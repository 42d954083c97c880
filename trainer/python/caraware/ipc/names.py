"""SUMO's ids of vehicles, from the hashes that observations carry."""

from __future__ import annotations

import json
from pathlib import Path

from caraware import _native
from caraware.ipc.run_file import RunFile, is_population

PREFIXES = ("cav.", "hero.", "person.")
"""Population control numbers the road users that it adds in an episode: `cav.0`, `cav.1`, …; none is reused."""
FIRST_NUMBERS, MOST_NUMBERS = 256, 1 << 16
"""Numbers looked through at first and at most."""
VEHICLE_IDS = "ids.jsonl"
"""File in the run directory: `traffic-bridge` writes each id of a scenario before it publishes its first step."""


class Names:
    """Finds the id that belongs to a hash: among the numbers of a population, or in the file of a scenario."""

    def __init__(self, run: RunFile) -> None:
        self._population = is_population(run)
        self._known: dict[int, str] = {_native.id_hash(name): name for name in run["config"]["traffic"]["hero_ids"]}
        self._numbers = 0
        self._file = Path(run.get("run_dir", "")) / VEHICLE_IDS
        self._read_bytes = 0

    def of(self, id_hash: int) -> str:
        """The id, or the hash as `0x…` of 16 digits where the id is not known."""
        id_hash = int(id_hash)
        while id_hash not in self._known and self._more():
            pass
        return self._known.get(id_hash, f"0x{id_hash:016x}")

    def _more(self) -> bool:
        """Looks at more ids; False if there are none."""
        return self._more_numbers() if self._population else self._more_lines()

    def _more_lines(self) -> bool:
        """Reads what has been added to the file since, in whole lines."""
        try:
            with self._file.open("rb") as stream:
                stream.seek(self._read_bytes)
                added = stream.read()
        except OSError:
            return False
        lines = added[: added.rfind(b"\n") + 1]
        self._read_bytes += len(lines)
        names = (_text(line) for line in lines.splitlines())
        self._known |= {_native.id_hash(name): name for name in names if name is not None}
        return bool(lines)

    def _more_numbers(self) -> bool:
        """Takes twice as many numbers; False if there are no more."""
        if self._numbers >= MOST_NUMBERS:
            return False
        first, self._numbers = self._numbers, max(FIRST_NUMBERS, 2 * self._numbers)
        for prefix in PREFIXES:
            names = (f"{prefix}{number}" for number in range(first, self._numbers))
            self._known |= {_native.id_hash(name): name for name in names}
        return True


def _text(line: bytes) -> str | None:
    """The id of a line; None for half a line that a killed process has left."""
    try:
        name = json.loads(line)
    except ValueError:
        return None
    return name if isinstance(name, str) else None
