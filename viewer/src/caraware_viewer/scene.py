"""Draws the frames of one run, as a few batched entities whatever the number of vehicles."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from caraware_viewer import cloud, geometry, plots, space, top, wire
from caraware_viewer.canvas import Canvas
from caraware_viewer.documents import RoadUserCounts, RunMap, RunStatus
from caraware_viewer.hud import ViewerFigures, hud
from caraware_viewer.link import CLOUD_PREFIX, Sample
from caraware_viewer.pairing import Pairing, distances, mean_m
from caraware_viewer.picture import Picture
from caraware_viewer.static_map import draw_map
from caraware_viewer.wire import FrameError

HUD = "hud"

_CONTACT_S = 5.0
"""Simulated time for which a contact stays on the map."""
_RATE_FRAMES = 20
"""Number of frames over which the rate of drawing is measured."""


class AnotherRunError(FrameError):
    """A frame of a new run of the same name, whose map the viewer does not have."""


class Scene:
    """Draws the frames of one run into a rerun recording."""

    def __init__(
        self,
        recording: rr.RecordingStream,
        run_map: RunMap,
        wanted: list[str] | None = None,
        lidar: str = "interest",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        try:
            self._canvas = Canvas(recording, float(run_map["tick_s"]))
        except (KeyError, TypeError, ValueError) as error:
            raise FrameError(f"the map cannot be read: {error!r}") from error
        self._map = run_map
        self._lidar = lidar
        self._clock = clock
        self._picture = Picture(wanted or [])
        self._pairing = Pairing()
        self._clouds: dict[int, wire.PointCloud] = {}
        self._contacts: list[tuple[int, NDArray[np.float64]]] = []
        self._drawn_at: deque[float] = deque(maxlen=_RATE_FRAMES)
        self._age_ms = float("nan")
        self.lost = 0
        """Samples that were lost on the network, as the link counts them."""
        self.refused = 0
        """Samples that were refused."""
        self._stop_lines = _stop_lines(run_map)
        draw_map(self._canvas, run_map)
        plots.name_series(self._canvas)

    def cloud_vehicles(self) -> list[str]:
        """SUMO ids of the vehicles whose point clouds are shown."""
        if self._lidar == "off":
            return []
        return [self._picture.names[h] for h in self._picture.followed() if h in self._picture.names]

    def draw(self, topic: str, sample: Sample) -> None:
        """Draws a sample. Raises `wire.FrameError` if the sample must be refused."""
        if topic == "status":
            self._draw_status(sample.payload)
            return
        self._check_run(wire.decode_header(sample.payload))
        match topic:
            case "world":
                self._draw_world(wire.decode_world(sample.payload), sample)
            case "observation":
                self._draw_observation(wire.decode_observation(sample.payload))
            case "prediction":
                self._draw_pair(self._pairing.prediction(wire.decode_prediction(sample.payload)))
            case "vehicles":
                self._picture.enter_names(wire.decode_table(sample.payload, wire.VEHICLE_META))
            case "signals":
                self._draw_signals(wire.decode_table(sample.payload, wire.SIGNAL_META))
            case "event":
                self._draw_event(wire.decode_table(sample.payload, wire.COLLISION))
            case _ if topic.startswith(CLOUD_PREFIX):
                self._draw_cloud(wire.decode_cloud(sample.payload))

    def _check_run(self, header: wire.Header) -> None:
        expected = self._map.get("run_id")
        if expected is not None and header.run_id != int(expected, 16):
            raise AnotherRunError(f"a frame of run {header.run_id:#018x}, but the map is of {expected}")

    def _draw_world(self, world: wire.World, sample: Sample) -> None:
        before, self._picture.world = self._picture.world, world
        if before is not None and before.header.episode != world.header.episode:
            self._contacts.clear()
            self._clouds.clear()
        self._set_tick(world.header)
        self._drawn_at.append(self._clock())
        self._age_ms = sample.age_ms()
        followed = self._picture.followed()
        rows = [row for row in map(self._picture.row, followed) if row is not None]
        top.draw_road_users(self._canvas, world.states, self._picture.names, followed)
        top.draw_followed(self._canvas, rows)
        space.draw_space(self._canvas, world.states, rows[0] if rows else None)
        self._draw_contacts(world.header)
        text = hud(self._picture, self._map, followed, self._figures())
        self._canvas.log(HUD, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))

    def _figures(self) -> ViewerFigures:
        times = self._drawn_at
        rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else float("nan")
        return ViewerFigures(rate, self._age_ms, self.lost, self.refused)

    def _draw_observation(self, observation: wire.Observation) -> None:
        self._picture.observation = observation
        self._set_tick(observation.header)
        top.draw_observation(self._canvas, observation)
        pair = self._pairing.observation(observation)
        if pair is None:
            # Only the fixes have errors until the prediction arrives, if the run has a policy at all.
            alone = distances(observation, None)
            if self._picture.distances is None or self._picture.distances.policy is None:
                self._picture.distances = alone
            self._canvas.scalar(plots.GNSS_ERROR, mean_m(alone.raw_gnss))
        else:
            self._draw_pair(pair)

    def _draw_pair(self, pair: tuple[wire.Observation, wire.Prediction] | None) -> None:
        if pair is None:
            return
        observation, prediction = pair
        self._set_tick(observation.header)
        driving = self._picture.driving
        if not driving:
            top.draw_estimates(self._canvas, top.PREDICTIONS, observation, prediction.position_m)
        if prediction.estimate_m is not None:
            top.draw_estimates(self._canvas, top.ESTIMATES, observation, prediction.estimate_m)
        self._picture.distances = distances(observation, prediction, driving=driving)
        plots.plot_errors(self._canvas, self._picture.distances)

    def _draw_signals(self, frame: wire.Table) -> None:
        for row in frame.rows:
            self._picture.signals[int(row["id_hash"])] = wire.decode_text(row["state"], min(int(row["links"]), 128))
        self._set_tick(frame.header)
        lights = [
            (position_m, letters[link])
            for id_hash, letters in self._picture.signals.items()
            for link, position_m in self._stop_lines.get(id_hash, [])
            if link < len(letters)
        ]
        top.draw_signals(self._canvas, lights)

    def _draw_event(self, frame: wire.Table) -> None:
        self._picture.collisions += len(frame.rows)
        self._contacts += [(frame.header.tick, position_m) for position_m in frame.rows["position_m"]]

    def _draw_contacts(self, header: wire.Header) -> None:
        oldest = header.tick - _CONTACT_S / float(self._map["tick_s"])
        if self._contacts:
            self._contacts = [(tick, at) for tick, at in self._contacts if tick >= oldest]
            top.draw_contacts(self._canvas, np.array([at[:2] for _, at in self._contacts]).reshape(-1, 2))

    def _draw_cloud(self, seen: wire.PointCloud) -> None:
        id_hash = int(seen.scan["id_hash"])
        followed = self._picture.followed()
        if id_hash not in followed:
            return
        self._clouds = {h: c for h, c in self._clouds.items() if h in followed} | {id_hash: seen}
        self._set_tick(seen.header)
        placed = {h: self._placed(c) for h, c in self._clouds.items()}
        rings = [
            geometry.ring_m(c.scan["position_m"], float(c.scan["range_m"]))
            for h, c in self._clouds.items()
            if self._lidar == "all" or len(placed[h][0])
        ]
        points_m = np.concatenate([points for points, _ in placed.values()])
        top.draw_clouds(self._canvas, points_m, np.concatenate([colors for _, colors in placed.values()]), rings)
        if followed[0] in placed:
            space.draw_cloud(self._canvas, *placed[followed[0]])

    def _placed(self, seen: wire.PointCloud) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
        """World positions and colours of the points to show."""
        points = seen.points if self._lidar == "all" else cloud.points_of_interest(seen.points)
        row = self._picture.row(int(seen.scan["id_hash"]))
        velocity_mps, yaw_rate_radps = (np.zeros(3), 0.0) if row is None else _motion(row)
        return cloud.in_world_m(seen.scan, points, velocity_mps, yaw_rate_radps), cloud.colors(points)

    def _draw_status(self, payload: bytes) -> None:
        try:
            status: RunStatus = json.loads(payload)
            tick = int(status["tick"])
            self._picture.status = status
            self._canvas.set_tick(tick)
            plots.plot_status(self._canvas, status, _steps_per_s(status))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise FrameError(f"a status of {len(payload)} bytes cannot be read: {error!r}") from error

    def _set_tick(self, header: wire.Header) -> None:
        self._canvas.set_tick(header.tick, header.episode)


def _steps_per_s(status: RunStatus) -> float | None:
    """Vehicle-steps per second: vehicles with sensors times ticks per second."""
    if status.get("ticks_per_s") is None:
        return None
    users = status.get("road_users") or RoadUserCounts()
    return float(status["ticks_per_s"]) * (users.get("cav", 0) + users.get("hero", 0))


def _stop_lines(run_map: RunMap) -> dict[int, list[tuple[int, list[float]]]]:
    """Links of each traffic light and the positions of their stop lines, by the hash of its id."""
    try:
        scene = run_map.get("scene")
        lights = [] if scene is None else scene.get("signals", [])
        return {
            int(light["id_hash"], 16): [(int(link["link"]), link["position_m"]) for link in light["links"]]
            for light in lights
        }
    except (KeyError, TypeError, ValueError) as error:
        raise FrameError(f"the map's traffic lights cannot be read: {error!r}") from error


def _motion(row: np.void) -> tuple[NDArray[np.float64], float]:
    """Velocity in the world, m/s, and yaw rate, rad/s."""
    forward, left, up = (float(value) for value in row["velocity_body_mps"])
    cos, sin = np.cos(row["yaw_rad"]), np.sin(row["yaw_rad"])
    velocity_mps = np.array([cos * forward - sin * left, sin * forward + cos * left, up])
    return velocity_mps, float(row["angular_rate_body_radps"][2])
