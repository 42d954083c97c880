"""Plots the figures of the present over simulated time; `course` has those of the whole run."""

from __future__ import annotations

from caraware_viewer.canvas import Canvas
from caraware_viewer.documents import RunStatus
from caraware_viewer.pairing import Distances, mean_m
from caraware_viewer.top import ESTIMATE_COLOR, GNSS_COLOR, PREDICTION_COLOR

ERRORS = "plots/error_m"
POLICY_ERROR, EKF_ERROR, GNSS_ERROR = f"{ERRORS}/policy", f"{ERRORS}/ekf", f"{ERRORS}/raw_gnss"
SPEED, STEPS, REAL_TIME = "plots/speed_mps", "plots/steps_per_s", "plots/real_time_factor"
ROAD_USERS = "plots/road_users"
VEHICLES, PERSONS = f"{ROAD_USERS}/vehicles", f"{ROAD_USERS}/persons"

SERIES: dict[str, tuple[str, list[int]]] = {
    POLICY_ERROR: ("policy", PREDICTION_COLOR),
    EKF_ERROR: ("EKF", ESTIMATE_COLOR),
    GNSS_ERROR: ("raw GNSS", GNSS_COLOR),
    SPEED: ("followed vehicle", [255, 79, 216]),
    VEHICLES: ("vehicles", [63, 167, 255]),
    PERSONS: ("pedestrians", [242, 193, 78]),
    STEPS: ("steps/s", [150, 230, 150]),
    REAL_TIME: ("× real time", [255, 150, 200]),
}


def name_series(canvas: Canvas) -> None:
    """Sets the names and colours of all figures."""
    for path, (name, color) in SERIES.items():
        canvas.series(path, name, color)


def plot_errors(canvas: Canvas, distances: Distances) -> None:
    """Plots the mean errors of one tick."""
    canvas.scalar(POLICY_ERROR, mean_m(distances.policy))
    canvas.scalar(EKF_ERROR, mean_m(distances.ekf))
    canvas.scalar(GNSS_ERROR, mean_m(distances.raw_gnss))


def plot_status(canvas: Canvas, status: RunStatus, steps_per_s: float | None) -> None:
    """Plots the speed of the simulation, and its size."""
    training = status.get("training") or {}
    if training.get("updates"):
        canvas.scalar(STEPS, steps_per_s)
    canvas.scalar(REAL_TIME, status.get("real_time_factor"))
    users = status.get("road_users")
    if users:
        canvas.scalar(VEHICLES, float(users.get("cav", 0) + users.get("other", 0) + users.get("hero", 0)))
        canvas.scalar(PERSONS, float(users.get("person", 0)))
