"""Draws what cameras and radars send: of those that the options name, else of those of the followed vehicle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caraware_viewer import detections, image, space, wire
from caraware_viewer.canvas import Canvas
from caraware_viewer.documents import RunMap
from caraware_viewer.mounted import CAMERA, OFF, RADAR, MountedKind, carrier_of, names_on
from caraware_viewer.picture import Picture

OF_FOLLOWED = "cameras/followed"
"""Path of the camera of the followed vehicle."""
FULL_SAMPLE = 5_920
"""Road users in a frame that may leave some out."""
_ROADSIDE = 1 << 30
"""Bit of `vehicle` of a carrier beside the road."""
_PATIENCE_FRAMES = 20
"""Observations without a message of a chosen sensor after which the viewer says what may be the reason."""


class Sights:
    """The newest messages of the shown cameras and radars."""

    def __init__(
        self, canvas: Canvas, run_map: RunMap, cameras: Sequence[str] | None, radars: Sequence[str] | None
    ) -> None:
        """`cameras` and `radars` name sensors as `ID` or `ID@SENSOR`; `None`: those of the followed vehicle."""
        self._canvas, self._map = canvas, run_map
        self._chosen = {kind: _chosen(names) for kind, names in ((CAMERA, cameras), (RADAR, radars))}
        self._paths = {
            CAMERA.topic_of(name): f"cameras/{place}" for place, name in enumerate(self._chosen[CAMERA] or ())
        }
        self.titles = {OF_FOLLOWED: "Camera of the followed vehicle"} | {
            f"cameras/{place}": name for place, name in enumerate(self._chosen[CAMERA] or ())
        }
        """Title of the view of each path that may have images."""
        self._images: dict[str, wire.CameraImage] = {}
        self._scans: dict[str, wire.RadarDetections] = {}
        self._waited: dict[str, int] = {}

    @property
    def has_radars(self) -> bool:
        """True if the run has radars, and they are shown."""
        units = self._map.get("sensor_units") or []
        return self._chosen[RADAR] != () and any(unit["kind"] == RADAR.kind for unit in units)

    def topics(self, followed: str | None) -> set[str]:
        """The topics to subscribe to; `followed` is the id of the followed vehicle, if it is known."""
        return {topic for kind in self._chosen for topic in self._topics_of(kind, followed)}

    def _topics_of(self, kind: MountedKind, followed: str | None) -> list[str]:
        names = self._chosen[kind]
        if names is None:
            names = () if followed is None else tuple(names_on(kind, followed, self._map))
        return [kind.topic_of(name) for name in names]

    def draw_image(self, topic: str, seen: wire.CameraImage, followed: int | None) -> None:
        """Draws an image, if its camera is shown; `followed` is the hash of the followed vehicle's id."""
        is_chosen = self._chosen[CAMERA] is not None
        if not is_chosen and int(seen.head["id_hash"]) != followed:
            return
        path = self._paths.get(topic) if is_chosen else OF_FOLLOWED
        if path is None:
            return
        self._waited[topic] = 0
        image.draw_image(self._canvas, path, seen)
        self._images[path] = seen

    def draw_detections(self, topic: str, seen: wire.RadarDetections, followed: int | None) -> None:
        """Draws the newest detections of every shown radar."""
        if self._chosen[RADAR] is None and int(seen.scan["id_hash"]) != followed:
            return
        self._waited[topic] = 0
        self._scans[topic] = seen
        self._draw_scans()

    def _draw_scans(self) -> None:
        scans = list(self._scans.values())
        points_m = [np.empty((0, 3), np.float32), *map(detections.in_world_m, scans)]
        velocities_mps = [np.empty(0, np.float32), *(scan.detections["radial_velocity_mps"] for scan in scans)]
        space.draw_detections(self._canvas, np.concatenate(points_m), detections.colors(np.concatenate(velocities_mps)))

    def forget_departed(self, world: wire.World, followed: int | None, *, is_new_episode: bool) -> None:
        """Draws nothing in the place of what the sensors of carriers that have left saw."""
        present = set(world.states["id_hash"].tolist())

        def has_left(head: np.void, kind: MountedKind) -> bool:
            id_hash = int(head["id_hash"])
            if int(head["vehicle"]) & _ROADSIDE:
                return False
            if is_new_episode or (self._chosen[kind] is None and id_hash != followed):
                return True
            # A frame of a crowd is a sample.
            return id_hash not in present and len(world.states) < FULL_SAMPLE

        for path, seen in list(self._images.items()):
            if has_left(seen.head, CAMERA):
                image.draw_nothing(self._canvas, path, (int(seen.head["height"]), int(seen.head["width"])))
                del self._images[path]
        left = [topic for topic, scan in self._scans.items() if has_left(scan.scan, RADAR)]
        for topic in left:
            del self._scans[topic]
        if left:
            self._draw_scans()

    def reasons(self, picture: Picture) -> list[str]:
        """Counts an observation. For each chosen sensor that is silent for long it returns the likely reason once."""
        found = []
        for kind, names in self._chosen.items():
            for name in names or ():
                waited = self._waited.get(kind.topic_of(name), 0) + 1
                self._waited[kind.topic_of(name)] = waited
                if waited == _PATIENCE_FRAMES:
                    found.append(f"--{kind.kind} {name}: {self._reason(kind, carrier_of(name), picture)}")
        return found

    def _reason(self, kind: MountedKind, carrier: str, picture: Picture) -> str:
        of_name = {name: id_hash for id_hash, name in picture.names.items()}
        if any(roadside["name"] == carrier for roadside in self._map.get("roadsides") or []):
            return f"no message of this {kind.kind} comes"
        if carrier not in of_name or picture.row(of_name[carrier]) is None:
            return f"{carrier} is not on the road"
        observation, slot = picture.observation, picture.slot(of_name[carrier])
        bit = wire.sensor_bit(kind.kind)
        if observation is None or (slot is not None and observation.sensors[slot] & bit):
            return f"no message of this {kind.kind} comes"
        carrying = observation.id_hash[(observation.vehicle != wire.EMPTY_SLOT) & (observation.sensors & bit != 0)]
        others = ", ".join(picture.name(int(id_hash)) for id_hash in carrying[:8]) or "none at the moment"
        return f"{carrier} carries no {kind.kind} that delivers; vehicles that do: {others}"


def _chosen(names: Sequence[str] | None) -> tuple[str, ...] | None:
    if names is None:
        return None
    return tuple(dict.fromkeys(name for name in names if name != OFF))
