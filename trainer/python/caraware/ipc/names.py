"""SUMO's ids of vehicles, from the hashes that observations carry."""

from __future__ import annotations

from caraware import _native
from caraware.ipc.run_file import RunFile, is_population

PREFIXES = ("cav.", "hero.", "person.")
"""Population control numbers the road users that it adds in an episode: `cav.0`, `cav.1`, …; none is reused."""
FIRST_NUMBERS, MOST_NUMBERS = 256, 1 << 16
"""Numbers looked through at first and at most."""


class Names:
    """Finds the id that belongs to a hash, among those that the run gives; in a scenario only heroes are known so."""

    def __init__(self, run: RunFile) -> None:
        self._population = is_population(run)
        self._known: dict[int, str] = {_native.id_hash(name): name for name in run["config"]["traffic"]["hero_ids"]}
        self._numbers = 0

    def of(self, id_hash: int) -> str:
        """The id, or the hash as `0x…` of 16 digits where the id is not known."""
        id_hash = int(id_hash)
        while id_hash not in self._known and self._more():
            pass
        return self._known.setdefault(id_hash, f"0x{id_hash:016x}")

    def _more(self) -> bool:
        """Takes twice as many numbers; False if there are no more."""
        if not self._population or self._numbers >= MOST_NUMBERS:
            return False
        first, self._numbers = self._numbers, max(FIRST_NUMBERS, 2 * self._numbers)
        for prefix in PREFIXES:
            names = (f"{prefix}{number}" for number in range(first, self._numbers))
            self._known |= {_native.id_hash(name): name for name in names}
        return True
