"""Plots figures over simulated time."""

from __future__ import annotations

from caraware_viewer.canvas import Canvas
from caraware_viewer.documents import RunStatus
from caraware_viewer.pairing import Distances, mean_m
from caraware_viewer.top import ESTIMATE_COLOR, GNSS_COLOR, PREDICTION_COLOR

ERRORS = "plots/error_m"
POLICY_ERROR, EKF_ERROR, GNSS_ERROR = f"{ERRORS}/policy", f"{ERRORS}/ekf", f"{ERRORS}/raw_gnss"
STD, REWARD, STEPS, REAL_TIME = "plots/std", "plots/reward", "plots/steps_per_s", "plots/real_time_factor"

SERIES = {
    POLICY_ERROR: ("policy", PREDICTION_COLOR),
    EKF_ERROR: ("EKF", ESTIMATE_COLOR),
    GNSS_ERROR: ("raw GNSS", GNSS_COLOR),
    STD: ("σ", [120, 200, 255]),
    REWARD: ("reward", [255, 210, 90]),
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
    """Plots the progress of learning and the speed; before the first update the policy has no figures."""
    training = status.get("training") or {}
    if training.get("updates"):
        canvas.scalar(STD, training["policy_std"])
        canvas.scalar(REWARD, training["reward"])
    canvas.scalar(STEPS, steps_per_s)
    canvas.scalar(REAL_TIME, status.get("real_time_factor"))
