"""SUMO's ids and types of recorded road users, from the recorded announcements."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from caraware.data.recording import Recording, RecordingError
from caraware.ipc.layout import VEHICLE_CLASSES
from caraware.ipc.names import Names


class Kind(IntEnum):
    """Kind of a road user."""

    CAV = 0
    OTHER = 1
    PERSON = 2
    HERO = 3
    TRAILING = 4
    """Trailing body of an articulated vehicle, with the vehicle's hash."""


BODY_SHIFT = 25
"""First bit of `VehicleState.vehicle` that numbers the trailing bodies of a vehicle, from 1 on."""


def vehicle_class(state: np.void) -> str:
    """SUMO's vehicle class of a road user (`VehicleState`); of a trailing body that of its vehicle."""
    return VEHICLE_CLASSES[int(state["class"])]


@dataclass(frozen=True)
class RoadUser:
    """What SUMO says of a road user."""

    id: str
    type: str
    vehicle_class: str


class RoadUsers:
    """Road users by the hash of their id."""

    def __init__(self, recording: Recording) -> None:
        self._known: dict[int, RoadUser] = {}
        self._names: Names | None = None
        if "traffic-meta" in recording.channels:
            for row in recording.rows("traffic-meta", "vehicles"):
                text = bytes(row["id"])[: int(row["id_len"])].decode(errors="replace")
                known = RoadUser(text, _text(row["type_id"]), _text(row["vehicle_class"]))
                self._known[int(row["id_hash"])] = known
        try:
            self._names = Names(recording.run)
        except (RecordingError, KeyError):
            self._names = None

    def body_name(self, state: np.void) -> str:
        """SUMO's id of a road user (`VehicleState`); of a trailing body that of its vehicle, a slash and its place."""
        name, place = self.of(state["id_hash"]).id, int(state["vehicle"]) >> BODY_SHIFT
        return f"{name}/{place}" if place else name

    def of(self, id_hash: int) -> RoadUser:
        """The road user; one that was not announced has its hash as id, if its id is not known otherwise."""
        id_hash = int(id_hash)
        if id_hash not in self._known:
            name = self._names.of(id_hash) if self._names else f"0x{id_hash:016x}"
            self._known[id_hash] = RoadUser(name, "", "")
        return self._known[id_hash]


def _text(value: object) -> str:
    return bytes(value).rstrip(b"\0").decode(errors="replace")  # type: ignore[call-overload,no-any-return]  # numpy's void
