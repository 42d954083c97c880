"""The course of training since the start of the run, also for a viewer that joins late (topic `learning`)."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from caraware_viewer.canvas import Canvas
from caraware_viewer.top import ESTIMATE_COLOR, GNSS_COLOR, PREDICTION_COLOR
from caraware_viewer.wire import FrameError

ROOT = "learning"
REWARD, SIGMA = f"{ROOT}/reward/reward", f"{ROOT}/sigma/sigma"
ENDS = f"{ROOT}/ends"
"""Root of the shares of trips that ended in one way or another since the update before."""
MAX_POINTS = 2000
"""Most points of a curve; when more come, every second is dropped."""

_NAMES = {
    "error_m": "policy, training",
    "raw_gnss_error_m": "raw GNSS, training",
    "progress_mps": "progress",
    "route_offset_m": "beside the route",
    "lateral_error_m": "policy, training",
    "raw_gnss_lateral_error_m": "raw GNSS, training",
    "wrong_lane_percent": "policy, training",
    "raw_gnss_wrong_lane_percent": "raw GNSS, training",
    "awareness_percent": "awareness",
    "message_kbitps": "messages",
    "end_of_the_run_s_episode": "end of the episode",
    "reward": "reward",
    "sigma": "σ",
}
_EVALUATED = {
    "ppo": "policy",
    "raw_gnss": "raw GNSS",
    "supervised": "regression",
    "ekf": "EKF",
    "map_ekf": "EKF with map",
}
COLORS: dict[str, list[int]] = {
    "error_m": PREDICTION_COLOR,
    "raw_gnss_error_m": GNSS_COLOR,
    "reward": [255, 210, 90],
    "sigma": [120, 200, 255],
    "progress_mps": [150, 230, 150],
    "route_offset_m": [255, 150, 200],
    "lateral_error_m": PREDICTION_COLOR,
    "raw_gnss_lateral_error_m": GNSS_COLOR,
    "wrong_lane_percent": PREDICTION_COLOR,
    "raw_gnss_wrong_lane_percent": GNSS_COLOR,
    "awareness_percent": [150, 230, 150],
    "message_kbitps": [255, 210, 90],
    "arrival": [150, 230, 150],
    "collision": [255, 90, 90],
    "off_road": [255, 170, 60],
    "red_light": [255, 120, 220],
    "against_traffic": [190, 130, 255],
    "blocked": [120, 200, 255],
    "time_limit": [255, 240, 140],
    "ppo": [255, 255, 255],
    "raw_gnss": [255, 170, 160],
    "supervised": [255, 210, 90],
    "ekf": ESTIMATE_COLOR,
}
UNITLESS = ("reward", "sigma")
_OTHER_COLOR = [160, 170, 185]


@dataclass(frozen=True)
class Point:
    """A value of a curve."""

    env_steps: int
    tick: int
    value: float


@dataclass
class Course:
    """Curves by path, merged from documents that overlap: the newest points, or the whole."""

    curves: dict[str, dict[int, Point]] = field(default_factory=dict)
    """Points by `env_steps`, ascending."""
    _drawn: dict[str, dict[int, Point]] = field(default_factory=dict)
    """Points that are drawn, by path and `env_steps`."""

    def merge(self, payload: bytes) -> None:
        """Adds the points of a document. Raises `wire.FrameError`."""
        try:
            document = json.loads(payload)
            newest = max((int(line["env_steps"]) for line in document["updates"]), default=None)
            for line in document["updates"]:
                self._add(line, {training_path(name): value for name, value in line["training"].items()})
                self._add(line, self._shares(line.get("ends", {})))
            for line in document["evaluations"]:
                # A line of an older trainer is of the localisation task.
                unit = _unit(line.get("metric", "error_m"))
                self._add(line, {evaluation_path(name, unit): value for name, value in line["evaluation"].items()})
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise FrameError(f"the course of training cannot be read: {error!r}") from error
        for path in self.curves:
            self._tidy(path, newest)

    def _add(self, line: Mapping[str, Any], values: Mapping[str, float]) -> None:
        """Adds the values of a line by the paths of their curves."""
        env_steps, tick = int(line["env_steps"]), int(line["tick"])
        for path, value in values.items():
            if math.isfinite(float(value)):
                self.curves.setdefault(path, {})[env_steps] = Point(env_steps, tick, float(value))

    def _shares(self, ends: Mapping[str, int]) -> dict[str, float]:
        """Percent of the ended trips, by path; 0 for an end that other updates have. Without a trip there is none."""
        if not ends:
            return {}
        known = {path for path in self.curves if path.startswith(ENDS)} | {end_path("arrival")}
        shares = {end_path(name): 100 * count / sum(ends.values()) for name, count in ends.items()}
        return dict.fromkeys(known, 0.0) | shares

    def _tidy(self, path: str, newest: int | None) -> None:
        """Sorts a curve and bounds it. A learner that continued from a checkpoint makes later points void."""
        steps = sorted(self.curves[path])
        if newest is not None:
            steps = [env_steps for env_steps in steps if env_steps <= newest or "/evaluation/" in path]
        if len(steps) > MAX_POINTS:
            steps = [*steps[:-1][::2], steps[-1]]
        self.curves[path] = {env_steps: self.curves[path][env_steps] for env_steps in steps}

    def draw(self, canvas: Canvas) -> None:
        """Draws the points that are not drawn yet."""
        for path, curve in self.curves.items():
            if path not in self._drawn:
                canvas.series(path, series_name(path), COLORS.get(path.rsplit("/", 1)[1], _OTHER_COLOR))
            drawn = self._drawn.setdefault(path, {})
            points = [point for point in curve.values() if drawn.get(point.env_steps) != point]
            canvas.curve(path, [point.tick for point in points], [point.value for point in points])
            drawn |= {point.env_steps: point for point in points}
            if len(drawn) > 2 * MAX_POINTS:
                self._drawn[path] = dict(curve)

    def repeat(self, canvas: Canvas) -> None:
        """Draws all points again on the live display, whose server drops the oldest data."""
        for path, curve in self.curves.items():
            points = list(curve.values())
            canvas.curve(path, [p.tick for p in points], [p.value for p in points], live_only=True)


def training_path(name: str) -> str:
    """Path of a figure of training: curves of one unit share a view."""
    if name in UNITLESS:
        return f"{ROOT}/{name}/{name}"
    return f"{ROOT}/{_unit(name)}/{name}"


def evaluation_path(estimator: str, metric: str) -> str:
    """Path of the mean of an evaluation."""
    return f"{ROOT}/{metric}/evaluation/{estimator}"


def end_path(name: str) -> str:
    """Path of the share of trips that ended so: `off-road` is `off_road`, because a path has no blanks."""
    return f"{ENDS}/{re.sub(r'[^a-z]+', '_', name.lower()).strip('_')}"


def series_name(path: str) -> str:
    """Name of a curve in the legend."""
    name = path.rsplit("/", 1)[1]
    if path.startswith(ENDS):
        return _NAMES.get(name, name.replace("_", " "))
    if "/evaluation/" in path:
        return f"{_EVALUATED.get(name, name)}, evaluation"
    return _NAMES.get(name, name)


def _unit(name: str) -> str:
    """Unit of a metric: the end of its name."""
    return name.rsplit("_", 1)[-1]
