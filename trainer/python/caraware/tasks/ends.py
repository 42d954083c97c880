"""Why the trip of a hero ended: the bits of an observation's flags, and their names (docs/driving.md)."""

from collections.abc import Mapping

from caraware import _native

COLLISION = _native.ENDED_BY_COLLISION
OFF_ROAD = _native.ENDED_OFF_ROAD
RED_LIGHT = _native.ENDED_AT_RED
AGAINST_TRAFFIC = _native.ENDED_AGAINST_TRAFFIC
ARRIVAL = _native.ENDED_BY_ARRIVAL
BLOCKED = _native.ENDED_BLOCKED
TIME_LIMIT = _native.ENDED_BY_TIME

END_NAMES: Mapping[int, str] = {
    COLLISION: "collision",
    OFF_ROAD: "off-road",
    RED_LIGHT: "red light",
    AGAINST_TRAFFIC: "against traffic",
    ARRIVAL: "arrival",
    BLOCKED: "blocked",
    TIME_LIMIT: "time limit",
}
"""By bit. Where a trip ends for two reasons at once, the first counts."""
FAILURES = sum(bit for bit in END_NAMES if bit not in (ARRIVAL, TIME_LIMIT))
"""The bits of ends that are the driver's failure."""
RUN_ENDED = "end of the run's episode"
"""An end without a bit."""


def name_of(bits: int) -> str:
    """The name of an end: the first of its reasons in the order of `END_NAMES`."""
    return next((name for bit, name in END_NAMES.items() if bits & bit), RUN_ENDED)
