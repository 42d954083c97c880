"""Draws the frames of one run, as a few batched entities whatever the number of vehicles."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from caraware_viewer import cloud, detail, geometry, memory, messages, plots, space, top, wire
from caraware_viewer.canvas import Canvas
from caraware_viewer.course import Course
from caraware_viewer.detail import Detail, Region
from caraware_viewer.display import SERVER_MEMORY_MIB
from caraware_viewer.documents import RoadUserCounts, RunMap, RunStatus
from caraware_viewer.hud import ViewerFigures, hanging, hud
from caraware_viewer.legend import draw_legend, rows_of
from caraware_viewer.link import WHOLE_COURSE, Sample
from caraware_viewer.mounted import CAMERA, LIDAR, RADAR, names_on
from caraware_viewer.pairing import Pairing, distances, mean_m
from caraware_viewer.picture import Picture
from caraware_viewer.sights import Sights
from caraware_viewer.static_map import draw_map
from caraware_viewer.wire import FrameError

HUD = "hud"

_CONTACT_S = 5.0
"""Simulated time for which a contact stays on the map."""
_MEMORY_INTERVAL_S = 2.0
_MAPS_KEPT = 6
"""Times that the map fits into what rerun's server keeps."""
_REPEATS_KEPT = 3
"""Times that map and curves are sent again within what rerun's server keeps, so that a new browser finds them."""
_AGES = 20_000
"""Newest frames whose ages count in the summary."""
_RATE_FRAMES = 20
"""Number of frames over which the rate of drawing is measured."""


class AnotherRunError(FrameError):
    """A frame of a new run of the same name, whose map the viewer does not have."""


@dataclass
class Tally:
    """What the viewer has drawn since it started."""

    frames: int = 0
    begun_s: float = 0.0
    ended_s: float = 0.0
    ages_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_AGES))
    memory_mb: float = float("nan")
    display_mb: float = float("nan")

    def add(self, now_s: float, age_ms: float, figures: ViewerFigures) -> None:
        """Adds a frame, `age_ms` old once it is handed to rerun."""
        self.begun_s = self.begun_s if self.frames else now_s
        self.frames, self.ended_s = self.frames + 1, now_s
        self.ages_ms.append(age_ms)
        self.memory_mb = float(np.fmax(self.memory_mb, figures.memory_mb))
        self.display_mb = float(np.fmax(self.display_mb, figures.display_mb))

    def text(self) -> str:
        """One line for the end of the viewer."""
        if self.frames < 2:
            return ""
        parts = [
            f"drew {self.frames} frames, {(self.frames - 1) / max(self.ended_s - self.begun_s, 1e-9):.1f} per second"
        ]
        ages_ms = [age for age in self.ages_ms if np.isfinite(age)]
        if ages_ms:
            parts.append(f"{np.median(ages_ms):.0f} ms old (95 %: {np.quantile(ages_ms, 0.95):.0f} ms)")
        parts.append(f"memory at most {self.memory_mb:.0f} MB")
        if np.isfinite(self.display_mb):
            parts.append(f"rerun {self.display_mb:.0f} MB")
        return ", ".join(parts)


class Scene:
    """Draws the frames of one run into a rerun recording."""

    def __init__(
        self,
        recording: rr.RecordingStream | None,
        run_map: RunMap,
        wanted: list[str] | None = None,
        lidar: str = "interest",
        clock: Callable[[], float] = time.monotonic,
        *,
        live: rr.RecordingStream | None = None,
        region: Region | None = None,
        messages: bool = False,
        cameras: Sequence[str] | None = None,
        radars: Sequence[str] | None = None,
    ) -> None:
        """`recording` keeps the history of the run, and `live` shows its present; either may be missing.

        With `messages` the legend names what is drawn of frames of `neighbours`. `cameras` and `radars` name those that
        are shown, as `ID` or `ID@SENSOR`; without them they are those of the followed vehicle.
        """
        try:
            self._canvas = Canvas(recording, float(run_map["tick_s"]), live)
            x_min, y_min, x_max, y_max = (float(value) for value in run_map["map"]["bounds_m"])
        except (KeyError, TypeError, ValueError) as error:
            raise FrameError(f"the map cannot be read: {error!r}") from error
        self._map = run_map
        self._lidar = lidar
        self._clock = clock
        self._picture = Picture(wanted or [])
        self._pairing = Pairing()
        self._clouds: dict[int, wire.PointCloud] = {}
        self._contacts: list[tuple[int, NDArray[np.float64]]] = []
        self._course = Course()
        self._region, self._extent_m = region, max(x_max - x_min, y_max - y_min)
        self._detail: Detail | None = None
        self._routes_drawn = self._contacts_drawn = False
        self._notes: list[str] = []
        self.display_pid: int | None = None
        """rerun's process, whose memory the HUD shows."""
        self._memory_mb = (float("nan"), float("nan"))
        self._memory_at_s = float("-inf")
        self._repeated_bytes = 0
        self._drawn_at: deque[float] = deque(maxlen=_RATE_FRAMES)
        self._age_ms = float("nan")
        self._tally = Tally()
        self.lost = 0
        """Samples that were lost on the network, as the link counts them."""
        self.refused = 0
        """Samples that were refused."""
        self.skipped = 0
        """Frames that were not drawn because newer ones had arrived, as the link counts them."""
        self._stop_lines = _stop_lines(run_map)
        self._paint = draw_map(self._canvas, run_map)
        self._sights = Sights(self._canvas, run_map, cameras, radars)
        legend = rows_of(messages=messages, radars=self._sights.has_radars)
        self.legend_rows = len(legend)
        draw_legend(self._canvas, legend)
        plots.name_series(self._canvas)
        self.server_mib = SERVER_MEMORY_MIB + _MAPS_KEPT * self._canvas.live_bytes / 2**20
        """What rerun's server has to keep, so that a new browser finds the map in it."""

    def sensor_topics(self) -> set[str]:
        """Topics of the mounted sensors that are shown: point clouds of the followed vehicles, images, detections."""
        followed = self._picture.followed()
        names = [self._picture.names[id_hash] for id_hash in followed if id_hash in self._picture.names]
        main = self._picture.names.get(followed[0]) if followed else None
        clouds = [] if self._lidar == "off" else names
        scanned = {LIDAR.topic_of(name) for carrier in clouds for name in names_on(LIDAR, carrier, self._map)}
        return scanned | self._sights.topics(main)

    @property
    def camera_titles(self) -> dict[str, str]:
        """Title of each camera's view by its path, of those that have an image."""
        return {path: title for path, title in self._sights.titles.items() if path in self._canvas.figures}

    def take_notes(self) -> list[str]:
        """What the user should know about the chosen sensors, since the last call."""
        notes, self._notes = self._notes, []
        return notes

    def draw(self, topic: str, sample: Sample) -> None:
        """Draws a sample. Raises `wire.FrameError` if the sample must be refused."""
        if topic == "status":
            self._draw_status(sample.payload)
            return
        if topic in ("learning", WHOLE_COURSE):
            self._course.merge(sample.payload)
            self._course.draw(self._canvas)
            return
        self._check_run(wire.decode_header(sample.payload))
        match topic:
            case "world":
                self._draw_world(wire.decode_world(sample.payload), sample)
            case "observation":
                self._draw_observation(wire.decode_observation(sample.payload))
            case "prediction":
                self._draw_pair(self._pairing.prediction(wire.decode_prediction(sample.payload)))
            case "neighbours":
                self._draw_neighbours(wire.decode_neighbours(sample.payload))
            case "vehicles":
                self._picture.enter_names(wire.decode_table(sample.payload, wire.VEHICLE_META))
            case "signals":
                self._draw_signals(wire.decode_table(sample.payload, wire.SIGNAL_META))
            case "routes":
                self._picture.enter_routes(wire.decode_table(sample.payload, wire.ROUTE_POINT))
            case "event":
                self._draw_event(wire.decode_table(sample.payload, wire.COLLISION))
            case _ if LIDAR.has(topic):
                self._draw_cloud(wire.decode_cloud(sample.payload))
            case _ if CAMERA.has(topic):
                seen = wire.decode_image(sample.payload)
                self._set_tick(seen.header)
                self._sights.draw_image(topic, seen, self._main)
            case _ if RADAR.has(topic):
                detected = wire.decode_detections(sample.payload)
                self._set_tick(detected.header)
                self._sights.draw_detections(topic, detected, self._main)

    @property
    def figures(self) -> frozenset[str]:
        """Paths that have data: the layout shows the views of these."""
        return frozenset(self._canvas.figures)

    def summary(self) -> str:
        """What was drawn, how fast, how old, and in how much memory; empty if nothing was drawn."""
        return self._tally.text()

    @property
    def followed(self) -> list[int]:
        """Hashes of the ids of the followed vehicles that are on the road, the main one first."""
        return self._picture.followed()

    @property
    def driving(self) -> bool:
        """True in a run with heroes."""
        return self._picture.driving

    @property
    def _main(self) -> int | None:
        """Hash of the id of the main followed vehicle; `None` without one."""
        return next(iter(self._picture.followed()), None)

    def _check_run(self, header: wire.Header) -> None:
        expected = self._map.get("run_id")
        if expected is not None and header.run_id != int(expected, 16):
            raise AnotherRunError(f"a frame of run {header.run_id:#018x}, but the map is of {expected}")

    def _draw_world(self, world: wire.World, sample: Sample) -> None:
        before, self._picture.world = self._picture.world, world
        is_new_episode = before is not None and before.header.episode != world.header.episode
        if is_new_episode:
            self._contacts.clear()
            self._clear_clouds()
            # Its vehicles are counted anew.
            self._picture.neighbours = None
        self._set_tick(world.header)
        self._drawn_at.append(self._clock())
        self._age_ms = sample.age_ms()
        followed = self._picture.followed()
        self._sights.forget_departed(world, self._main, is_new_episode=is_new_episode)
        rows = [row for row in map(self._picture.row, followed) if row is not None]
        if not set(self._clouds) <= {int(row["id_hash"]) for row in rows}:
            self._clear_clouds()
        self._detail = detail.choose(world.states, rows[0] if rows else None, self._extent_m, self._region)
        self._picture.thinned = _left_out(self._detail, world.header.rows, sum(self._picture.road_users().values()))
        top.draw_road_users(self._canvas, world.states, self._detail, self._picture.names, followed)
        top.draw_followed(self._canvas, rows)
        space.draw_space(self._canvas, world.states, rows[0] if rows else None)
        self._draw_contacts(world.header)
        self._draw_routes(rows[0] if rows else None)
        if rows:
            self._paint.follow(np.array([rows[0]["x_m"], rows[0]["y_m"]]))
            self._canvas.scalar(plots.SPEED, float(np.hypot(*rows[0]["velocity_body_mps"][:2])))
        figures = self._figures()
        self._tally.add(self._drawn_at[-1], sample.age_ms(), figures)
        self._draw_hud(figures)
        if self._canvas.live_bytes - self._repeated_bytes > self.server_mib * 2**20 / _REPEATS_KEPT:
            self._canvas.repeat_static()
            self._course.repeat(self._canvas)
            self._repeated_bytes = self._canvas.live_bytes

    def _draw_hud(self, figures: ViewerFigures) -> None:
        text = hud(self._picture, self._map, self._picture.followed(), figures)
        self._canvas.log(HUD, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))

    def _figures(self) -> ViewerFigures:
        times = self._drawn_at
        rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else float("nan")
        now_s = self._clock()
        if now_s - self._memory_at_s > _MEMORY_INTERVAL_S:
            self._memory_at_s = now_s
            self._memory_mb = (memory.resident_mb(), memory.resident_mb(self.display_pid))
        return ViewerFigures(rate, self._age_ms, self.lost, self.refused, self.skipped, *self._memory_mb)

    def _shown(self, observation: wire.Observation) -> NDArray[np.bool_]:
        """Slots `[n]` whose positions are drawn."""
        if self._detail is None or not self._detail.thinned:
            return np.ones(observation.header.rows, np.bool_)
        shown: NDArray[np.bool_] = np.isin(observation.id_hash, self._detail.positioned)
        return shown

    def _draw_observation(self, observation: wire.Observation) -> None:
        self._picture.observation = observation
        self._notes += self._sights.reasons(self._picture)
        self._set_tick(observation.header)
        top.draw_observation(self._canvas, observation, self._shown(observation))
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
        has_positions = self._map.get("task", "localisation") == "localisation" and not self._picture.driving
        if has_positions:
            top.draw_estimates(self._canvas, top.PREDICTIONS, observation, prediction.answer, self._shown(observation))
        if prediction.estimate_m is not None:
            top.draw_estimates(
                self._canvas, top.ESTIMATES, observation, prediction.estimate_m, self._shown(observation)
            )
        self._picture.distances = distances(observation, prediction, has_positions=has_positions)
        plots.plot_errors(self._canvas, self._picture.distances)

    def _draw_neighbours(self, neighbours: wire.Neighbours) -> None:
        self._picture.enter_neighbours(neighbours)
        if self._picture.world is None:
            return
        self._set_tick(neighbours.header)
        rows = [row for row in map(self._picture.row, self._picture.followed()) if row is not None]
        messages.draw_messages(self._canvas, neighbours, self._picture.world.states, rows[0] if rows else None)

    def _draw_signals(self, frame: wire.Table) -> None:
        for row in frame.rows:
            letters = wire.decode_text(row["state"], min(int(row["links"]), 128))
            self._picture.signals[int(row["id_hash"])] = self._picture.lights[int(row["signal"])] = letters
        self._set_tick(frame.header)
        lights = [
            (position_m, letters[link])
            for id_hash, letters in self._picture.signals.items()
            for link, position_m in self._stop_lines.get(id_hash, [])
            if link < len(letters)
        ]
        top.draw_signals(self._canvas, lights)
        space.draw_signals(self._canvas, lights)

    def _draw_event(self, frame: wire.Table) -> None:
        self._picture.collisions += len(frame.rows)
        self._contacts += [(frame.header.tick, position_m) for position_m in frame.rows["position_m"]]

    def _draw_contacts(self, header: wire.Header) -> None:
        oldest = header.tick - _CONTACT_S / float(self._map["tick_s"])
        self._contacts = [(tick, at) for tick, at in self._contacts if tick >= oldest]
        if not self._contacts and not self._contacts_drawn:
            return
        self._contacts_drawn = bool(self._contacts)
        positions_m = np.array([at for _, at in self._contacts]).reshape(-1, 3)
        top.draw_contacts(self._canvas, positions_m[:, :2])
        space.draw_contacts(self._canvas, positions_m)

    def _draw_routes(self, followed: np.void | None) -> None:
        """Draws the routes of the heroes on the road, and the traffic lights that control them."""
        routes = self._picture.shown_routes()
        if not routes and not self._routes_drawn:
            return
        self._routes_drawn = bool(routes)
        lights = []
        for points in routes:
            for point in points[points["signal"] != wire.NO_SIGNAL]:
                letters, link = self._picture.lights.get(int(point["signal"]), ""), int(point["link"])
                if link < len(letters):
                    lights.append(([float(point["x_m"]), float(point["y_m"])], letters[link]))
        if followed is not None:
            routes.sort(key=lambda points: int(points["vehicle"][0]) != int(followed["vehicle"]))
        lines = [np.column_stack([points["x_m"], points["y_m"]]) for points in routes]
        top.draw_routes(self._canvas, lines, lights)
        space.draw_routes(self._canvas, lines, 0.0 if followed is None else float(followed["z_m"]))

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

    def _clear_clouds(self) -> None:
        """Draws no points where some were."""
        if self._clouds:
            self._clouds.clear()
            points_m, colors = np.empty((0, 3), np.float32), np.empty(0, np.uint32)
            top.draw_clouds(self._canvas, points_m, colors, [])
            space.draw_cloud(self._canvas, points_m, colors)

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
            # Where a process hangs, no tick comes that would draw the text.
            if hanging(status):
                self._draw_hud(self._figures())
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise FrameError(f"a status of {len(payload)} bytes cannot be read: {error!r}") from error

    def _set_tick(self, header: wire.Header) -> None:
        self._canvas.set_tick(header.tick, header.episode)


def _left_out(chosen: Detail, sent: int, there: int) -> str:
    """What is left out of a crowd, for the HUD: `sent` of the road users that are `there` are in the frame."""
    parts = [f"{sent} of {there} road users"] if there > sent else []
    if not chosen.shaped.all():
        parts.append(f"{int(chosen.shaped.sum())} as boxes, the others as dots")
    if chosen.thinned:
        parts.append(f"fixes and estimates of {len(chosen.positioned)}")
    return " · ".join(parts)


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
