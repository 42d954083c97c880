"""Which manoeuvre a hero drives: how it turns at a junction, and who has the right of way there.

All of it is read from the fields of `observation.fields = "driver"` at the last tick before the stop line. A manoeuvre
lasts from the stop line for `JUNCTION_M`; what happens elsewhere happens `BETWEEN`.
"""

import math
from dataclasses import dataclass, field

from torch import Tensor

from caraware.tasks.fields import Fields

JUNCTION_M = 30.0
"""Driven from the stop line: the junction and the merge behind it."""
BETWEEN = "between junctions"
NEEDED = (
    "junction_1_gap",
    "junction_1_priority",
    "light_1_gap",
    "route_x_20",
    "route_y_20",
    "route_x_40",
    "route_y_40",
)
AT_M = 0.05
"""Nearer to the stop line a hero has reached it."""
NEXT_M = 5.0
"""The gap to the next stop line grows by more than this where one is passed."""
SAME_M = 1.0
"""A light whose stop line is this near to a junction's is that of the junction."""
TURN_RAD, U_TURN_RAD = math.radians(30), math.radians(135)


@dataclass
class Manoeuvres:
    """The manoeuvres of one trip."""

    passed: dict[str, int] = field(default_factory=dict)
    """Stop lines passed, by manoeuvre."""
    now: str = BETWEEN
    _since_m: float = 0.0
    _ahead: tuple[float, str] | None = None

    def add(self, fields: Fields, row: Tensor, driven_m: float) -> None:
        """Take a tick: its row of the observation `[d]`, and the metres since the tick before."""
        if not all(map(fields.has, NEEDED)):
            return
        self._since_m += driven_m
        if self.now != BETWEEN and self._since_m > JUNCTION_M:
            self.now = BETWEEN
        gap_m = float(fields.si_tensor(row, "junction_1_gap"))
        if self._ahead is not None and not AT_M <= gap_m <= self._ahead[0] + NEXT_M:
            self.now, self._since_m = self._ahead[1], 0.0
            self.passed[self.now] = self.passed.get(self.now, 0) + 1
            self._ahead = None
        # On the junction the gap is 0, and the route ahead does not show the whole turn any more.
        if AT_M <= gap_m < NEXT_M:
            self._ahead = gap_m, _manoeuvre(fields, row, gap_m)


def _manoeuvre(fields: Fields, row: Tensor, gap_m: float) -> str:
    """The name of what is ahead of the stop line."""
    x_m, y_m = (fields.si_tensor(row, f"route_{axis}_40") - fields.si_tensor(row, f"route_{axis}_20") for axis in "xy")
    turn_rad = math.atan2(float(y_m), float(x_m))
    has_light = abs(float(fields.si_tensor(row, "light_1_gap")) - gap_m) < SAME_M
    has_priority = float(fields.si_tensor(row, "junction_1_priority")) > 0.5
    if abs(turn_rad) > U_TURN_RAD:
        turn = "U-turn"
    elif abs(turn_rad) < TURN_RAD:
        turn = "straight on"
    else:
        turn = "left turn" if turn_rad > 0 else "right turn"
    right = {
        (True, True): "green",
        (True, False): "green, yielding",
        (False, True): "right of way",
        (False, False): "yielding",
    }[has_light, has_priority]
    return f"{turn}, {right}"
