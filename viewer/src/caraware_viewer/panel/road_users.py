"""The map and the road users of a live run, for the page's own map: a viewer like any other, for which no run waits."""

from __future__ import annotations

import threading
import time
from typing import Any, TypedDict

import numpy as np

from caraware_viewer import wire
from caraware_viewer.documents import RunMap
from caraware_viewer.layout import SENSORS
from caraware_viewer.link import LinkError, RunKey, RunLink, connect
from caraware_viewer.picture import Picture

CONNECT_LIMIT_S = 5.0
"""Longest wait for a run's fan-out."""
IDLE_LIMIT_S = 15.0
"""A link that no page has read for this long is closed."""

_KINDS = {wire.CAV: "cav", wire.OTHER: "other", wire.PERSON: "person", wire.HERO: "hero"}


class MapLane(TypedDict):
    """A lane of the page's map."""

    edge: str
    kind: str
    inside: bool
    width_m: float
    points_m: list[list[float]]


class PanelMap(TypedDict):
    """What the page draws once."""

    bounds_m: list[float]
    lanes: list[MapLane]
    buildings: list[list[list[float]]]


class RoadUser(TypedDict):
    """A road user now."""

    id: str
    kind: str
    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    sensors: list[str] | None
    """The sensors that deliver; `None` if it has none, or no observation yet."""


class RoadUsers(TypedDict):
    """All road users at a tick."""

    tick: int
    episode: int
    users: list[RoadUser]


class LiveRun:
    """The link to one environment of one run."""

    def __init__(self, endpoint: str, key: RunKey) -> None:
        self.key = key
        session = connect(endpoint, CONNECT_LIMIT_S)
        try:
            self._link = RunLink(session, key)
            self.map = _panel_map(self._link.map(CONNECT_LIMIT_S))
        except BaseException:
            session.close()
            raise
        self._picture = Picture()

    @property
    def ended(self) -> bool:
        """True once the run has ended."""
        return self._link.frames.ended

    def users(self) -> RoadUsers:
        """The newest state. Raises `wire.FrameError`."""
        for topic, sample in self._link.frames.take(0.0).items():
            match topic:
                case "world":
                    self._picture.world = wire.decode_world(sample.payload)
                case "observation":
                    self._picture.observation = wire.decode_observation(sample.payload)
                case "vehicles":
                    self._picture.enter_names(wire.decode_table(sample.payload, wire.VEHICLE_META))
        world = self._picture.world
        if world is None:
            return RoadUsers(tick=0, episode=0, users=[])
        return RoadUsers(
            tick=world.header.tick,
            episode=world.header.episode,
            users=[self._user(state) for state in world.road_users if int(state["id_hash"]) in self._picture.names],
        )

    def close(self) -> None:
        """Closes the session."""
        self._link.__exit__()

    def _user(self, state: Any) -> RoadUser:
        id_hash = int(state["id_hash"])
        slot = self._picture.slot(id_hash)
        sensors = None
        if slot is not None and self._picture.observation is not None:
            delivering = int(self._picture.observation.sensors[slot])
            sensors = [sensor.name for sensor in SENSORS if delivering & sensor.bit]
        return RoadUser(
            id=self._picture.names[id_hash],
            kind=_KINDS.get(int(state["kind"]), "other"),
            x_m=round(float(state["x_m"]), 2),
            y_m=round(float(state["y_m"]), 2),
            yaw_rad=round(float(state["yaw_rad"]), 4),
            speed_mps=round(float(np.hypot(*state["velocity_body_mps"][:2])), 2),
            sensors=sensors,
        )


class LiveRuns:
    """The link of the run that the page shows; at most one is open. Safe to use from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: tuple[str, LiveRun] | None = None
        self._read_at = 0.0

    def map(self, endpoint: str, key: RunKey) -> PanelMap:
        """The map of a run. Raises `LinkError`."""
        with self._lock:
            return self._live(endpoint, key).map

    def users(self, endpoint: str, key: RunKey) -> RoadUsers:
        """The road users of a run. Raises `LinkError` and `wire.FrameError`."""
        with self._lock:
            return self._live(endpoint, key).users()

    def close_idle(self) -> None:
        """Closes a link that no page reads any more."""
        with self._lock:
            if time.monotonic() - self._read_at > IDLE_LIMIT_S:
                self._close()

    def close(self) -> None:
        """Closes the link."""
        with self._lock:
            self._close()

    def _live(self, endpoint: str, key: RunKey) -> LiveRun:
        self._read_at = time.monotonic()
        if self._open is not None and self._open[0] == endpoint and self._open[1].key == key:
            if not self._open[1].ended:
                return self._open[1]
            self._close()
            raise LinkError(f"run {key.run!r} has ended")
        self._close()
        live = LiveRun(endpoint, key)
        self._open = (endpoint, live)
        return live

    def _close(self) -> None:
        if self._open is not None:
            self._open[1].close()
            self._open = None


def _panel_map(run_map: RunMap) -> PanelMap:
    scene = run_map.get("scene") or {}
    lanes: list[Any] = list(scene.get("lanes", []))
    return PanelMap(
        bounds_m=run_map["map"]["bounds_m"],
        lanes=[
            MapLane(
                edge=lane["edge"],
                kind=lane["kind"],
                inside=lane["inside"],
                width_m=lane["width_m"],
                points_m=[point[:2] for point in lane["points_m"]],
            )
            for lane in lanes
        ],
        buildings=[[point[:2] for point in building["points_m"]] for building in scene.get("buildings", [])],
    )
