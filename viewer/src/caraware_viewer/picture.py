"""The newest state of a run, from its frames, and the vehicles that the views follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from caraware_viewer import wire
from caraware_viewer.documents import RoadUserCounts, RunStatus
from caraware_viewer.pairing import Distances

_FULL = 5920
"""Bodies that fit into a frame of `world` (docs/fanout.md): so many are a sample, unless there are no more."""


@dataclass
class Picture:
    """The newest state of a run; any part may be missing."""

    wanted: Sequence[str] = ()
    """SUMO ids of the vehicles to follow; empty: a hero, else a vehicle with a LIDAR, a camera or a radar (in this
    order), else the first with sensors.
    Where messages are shown, it is one with a radio."""
    world: wire.World | None = None
    observation: wire.Observation | None = None
    neighbours: wire.Neighbours | None = None
    distances: Distances | None = None
    """Of the newest tick that has an observation and, if there is a policy, its prediction."""
    names: dict[int, str] = field(default_factory=dict)
    """SUMO id of each road user, by the hash of the id."""
    status: RunStatus = field(default_factory=RunStatus)
    signals: dict[int, str] = field(default_factory=dict)
    """State of each traffic light, a letter for each link, by the hash of its id."""
    lights: dict[int, str] = field(default_factory=dict)
    """The same by the index of the traffic light (`SignalMeta.signal`)."""
    routes: dict[int, NDArray[np.void]] = field(default_factory=dict)
    """Points of each hero's route, `ROUTE_POINT [n]`, by the hero's index."""
    thinned: str = ""
    """What is left out of a crowd."""
    collisions: int = 0
    """Contacts seen since the viewer joined."""
    _last_default: int | None = None
    _routes_of: int | None = None
    _names_of: tuple[int, int] | None = None

    def enter_neighbours(self, frame: wire.Neighbours) -> None:
        """Enters what road users know from messages. A vehicle without a radio is no longer followed by default."""
        self.neighbours = frame
        row = None if self._last_default is None else self.row(self._last_default)
        if row is not None and frame.slot_of(int(row["vehicle"])) is None:
            self._last_default = None

    def enter_names(self, frame: wire.Table) -> None:
        """Enters rows of the table of road users; a new episode empties it."""
        episode = (frame.header.run_id, frame.header.episode)
        if episode != self._names_of:
            self.names.clear()
            self._names_of = episode
        for row in frame.rows:
            self.names[int(row["id_hash"])] = wire.decode_text(row["id"], int(row["id_len"]))

    def enter_routes(self, frame: wire.Table) -> None:
        """Enters routes, each of which is whole in a frame; a new episode has other heroes."""
        if frame.header.episode != self._routes_of:
            self.routes.clear()
            self._routes_of = frame.header.episode
        for vehicle in np.unique(frame.rows["vehicle"]):
            points = frame.rows[frame.rows["vehicle"] == vehicle]
            self.routes[int(vehicle)] = points[np.argsort(points["index"])]

    def road_users(self) -> dict[int, int]:
        """Number of road users by kind. Of a crowd the frame has a sample: then the status counts them all."""
        if self.world is None:
            return {}
        kinds = self.world.road_users["kind"]
        counts = {kind: int((kinds == kind).sum()) for kind in (wire.CAV, wire.OTHER, wire.PERSON, wire.HERO)}
        # The status may be of half a second before, or of the episode before: it counts for a full frame alone.
        if len(self.world.states) < _FULL:
            return counts
        users = self.status.get("road_users") or RoadUserCounts()
        counted = {
            wire.CAV: users.get("cav", 0),
            wire.OTHER: users.get("other", 0),
            wire.PERSON: users.get("person", 0),
            wire.HERO: users.get("hero", 0),
        }
        return max(counted, counts, key=lambda each: sum(each.values()))

    def shown_routes(self) -> list[NDArray[np.void]]:
        """Routes of the heroes that are on the road."""
        if self.world is None or not self.routes:
            return []
        states = self.world.states
        heroes = {int(vehicle) for vehicle in states["vehicle"][states["kind"] == wire.HERO]}
        return [points for vehicle, points in self.routes.items() if vehicle in heroes]

    def name(self, id_hash: int) -> str:
        """SUMO id of a road user, or four digits of its hash until the id is known."""
        return self.names.get(id_hash, f"#{id_hash & 0xFFFF:04x}")

    @property
    def driving(self) -> bool:
        """True in a run with heroes, where predictions are actions."""
        return self.world is not None and bool((self.world.states["kind"] == wire.HERO).any())

    def followed(self) -> list[int]:
        """Hashes of the ids of the followed vehicles that are on the road, the main one first."""
        if self.world is None:
            return []
        states = self.world.states
        present = {int(id_hash) for id_hash in states["id_hash"]}
        if self.wanted:
            of_name = {name: id_hash for id_hash, name in self.names.items()}
            return [of_name[name] for name in self.wanted if of_name.get(name) in present]
        if self._last_default not in present:
            self._last_default = self._default_vehicle(states)
        return [] if self._last_default is None else [self._last_default]

    def _default_vehicle(self, states: NDArray[np.void]) -> int | None:
        """A hero, else a vehicle with a LIDAR, a camera or a radar, else the first with sensors.

        Without observations, the first CAV.
        """
        heroes = states["id_hash"][states["kind"] == wire.HERO]
        if len(heroes):
            return int(heroes[0])
        present = set(self._with_radio(states)["id_hash"].tolist())
        if self.observation is not None:
            valid = self.observation.valid
            bits = [wire.sensor_bit(kind) for kind in ("lidar", "camera", "radar")]
            for chosen in (*(valid & (self.observation.sensors & bit != 0) for bit in bits), valid):
                sensing = [int(h) for h in self.observation.id_hash[chosen] if int(h) in present]
                if sensing:
                    return sensing[0]
            return None
        states = self._with_radio(states)
        cavs = states["id_hash"][states["kind"] == wire.CAV]
        return int(cavs[0]) if len(cavs) else None

    def _with_radio(self, states: NDArray[np.void]) -> NDArray[np.void]:
        """Those of the road users that have a radio, if messages are shown and any has."""
        if self.neighbours is None:
            return states
        found = states[np.isin(states["vehicle"], self.neighbours.vehicle[self.neighbours.radio[:, 0] != 0])]
        return found if len(found) else states

    def row(self, id_hash: int) -> np.void | None:
        """State of a road user; `None` if it is not on the road."""
        if self.world is None:
            return None
        found = np.flatnonzero(self.world.states["id_hash"] == id_hash)
        return self.world.states[found[0]] if len(found) else None

    def slot(self, id_hash: int) -> int | None:
        """Slot of a vehicle in the newest observation; `None` if it has none."""
        if self.observation is None:
            return None
        taken = self.observation.vehicle != wire.EMPTY_SLOT
        found = np.flatnonzero(taken & (self.observation.id_hash == id_hash))
        return int(found[0]) if len(found) else None
