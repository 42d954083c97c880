"""What is drawn: a few batched entities, whatever the number of vehicles. World metres, x east, y up on the screen.

rerun's 2-D views count y downwards and its 2-D boxes cannot turn: outlines are line strips with y negated.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from caraware_viewer import wire
from caraware_viewer.pairing import Pairing, gnss_error_m, policy_errors

VEHICLES = "top/vehicles"
GNSS = "top/gnss"
PREDICTIONS = "top/predictions"
LINKS = "top/prediction_errors"
BOUNDS = "top/map/bounds"
POLICY_ERROR = "plots/error_m/policy"
GNSS_ERROR = "plots/error_m/raw_gnss"
POLICY_STD = "plots/policy/std"
REWARD = "plots/policy/reward"

TIMELINE = "sim_time"
"""Simulated time since the start of the run; episodes follow one another."""

KIND_COLORS = np.array([0x3FA7FFFF, 0xB8BDC7FF, 0xF2C14EFF], dtype=np.uint32)
"""RGBA by `VehicleState.kind`: connected vehicle, other vehicle, pedestrian."""
GNSS_COLOR = [235, 94, 85]
PREDICTION_COLOR = [94, 214, 125]
LINK_COLOR = [94, 214, 125, 110]
BOUNDS_COLOR = [70, 74, 84]

_CORNERS = np.array([[0, 1], [1, 1], [1, -1], [0, -1], [0, 1]], dtype=np.float64)
"""Closed outline of a box: 0 … 1 from rear to front, ±1 from right to left."""


def outlines_m(states: NDArray[np.void]) -> NDArray[np.float32]:
    """Closed outlines `[n, 5, 2]` of road users seen from above, world metres."""
    rear_m = np.where(states["kind"] == wire.PERSON, states["length_m"] / 2, states["rear_overhang_m"])
    along_m = _CORNERS[:, 0] * states["length_m"][:, None] - rear_m[:, None]
    across_m = _CORNERS[:, 1] * states["width_m"][:, None] / 2
    cos, sin = np.cos(states["yaw_rad"])[:, None], np.sin(states["yaw_rad"])[:, None]
    x_m = states["x_m"][:, None] + cos * along_m - sin * across_m
    y_m = states["y_m"][:, None] + sin * along_m + cos * across_m
    return np.stack([x_m, y_m], axis=-1).astype(np.float32)


def on_screen(points_m: NDArray[np.floating]) -> NDArray[np.float32]:
    """World x, y `[…, 2]` in rerun's 2-D view, where y counts downwards."""
    return (np.asarray(points_m) * np.array([1.0, -1.0])).astype(np.float32)


class Scene:
    """Draws the frames of one run into a rerun recording."""

    def __init__(self, recording: rr.RecordingStream, run_map: dict[str, Any]) -> None:
        self._recording = recording
        self._tick_s = float(run_map["tick_s"])
        self._pairing = Pairing()
        self._draw_static(run_map["map"]["bounds_m"])

    def draw(self, topic: str, frame: bytes) -> None:
        """Draws a frame; raises `wire.FrameError` if it is not what it says it is."""
        match topic:
            case "world":
                self._draw_world(wire.decode_world(frame))
            case "observation":
                self._draw_observation(wire.decode_observation(frame))
            case "prediction":
                self._draw_pair(self._pairing.prediction(wire.decode_prediction(frame)))
            case "status":
                self._draw_status(frame)

    def _draw_static(self, bounds_m: list[float]) -> None:
        x_min, y_min, x_max, y_max = bounds_m
        corners = np.array([[x_min, y_min], [x_max, y_min], [x_max, y_max], [x_min, y_max], [x_min, y_min]])
        self._log(BOUNDS, rr.LineStrips2D([on_screen(corners)], colors=BOUNDS_COLOR), static=True)
        series = {POLICY_ERROR: ("policy", PREDICTION_COLOR), GNSS_ERROR: ("raw GNSS", GNSS_COLOR)}
        for path, (name, color) in series.items():
            self._log(path, rr.SeriesLines(names=name, colors=color), static=True)

    def _draw_world(self, world: wire.World) -> None:
        self._at(world.header)
        kinds = np.minimum(world.states["kind"], wire.PERSON)
        strips = on_screen(outlines_m(world.states))
        self._log(VEHICLES, rr.LineStrips2D(strips, colors=KIND_COLORS[kinds], radii=rr.Radius.ui_points(1.0)))

    def _draw_observation(self, observation: wire.Observation) -> None:
        self._at(observation.header)
        fixes_m = on_screen(observation.gnss_m[observation.valid, :2])
        self._log(GNSS, rr.Points2D(fixes_m, colors=GNSS_COLOR, radii=rr.Radius.ui_points(2.0)))
        self._log_scalar(GNSS_ERROR, gnss_error_m(observation))
        self._draw_pair(self._pairing.observation(observation))

    def _draw_pair(self, pair: tuple[wire.Observation, wire.Prediction] | None) -> None:
        if pair is None:
            return
        errors = policy_errors(*pair)
        self._at(pair[0].header)
        predicted, truth = on_screen(errors.predicted_m), on_screen(errors.truth_m)
        self._log(PREDICTIONS, rr.Points2D(predicted, colors=PREDICTION_COLOR, radii=rr.Radius.ui_points(2.5)))
        self._log(LINKS, rr.LineStrips2D(np.stack([predicted, truth], axis=1), colors=LINK_COLOR))
        self._log_scalar(POLICY_ERROR, errors.policy_m)

    def _draw_status(self, frame: bytes) -> None:
        try:
            status = json.loads(frame)
            training = status["training"]
            tick = int(status["tick"])
        except (ValueError, KeyError, TypeError) as error:
            raise wire.FrameError(f"a status of {len(frame)} bytes is not what this viewer knows: {error!r}") from error
        if training and training["updates"]:
            self._at_tick(tick)
            self._log_scalar(POLICY_STD, training["policy_std"])
            self._log_scalar(REWARD, training["reward"])

    def _at(self, header: wire.Header) -> None:
        self._at_tick(header.tick)
        self._recording.set_time("episode", sequence=header.episode)

    def _at_tick(self, tick: int) -> None:
        self._recording.set_time("tick", sequence=tick)
        self._recording.set_time(TIMELINE, duration=(tick + 1) * self._tick_s)

    def _log_scalar(self, path: str, value: float | None) -> None:
        if value is not None and np.isfinite(value):
            self._log(path, rr.Scalars(value))

    def _log(self, path: str, archetype: rr.AsComponents, *, static: bool = False) -> None:
        rr.log(path, archetype, static=static, recording=self._recording)
