"""Draws the figures of `docs/vehicle-model.md` from the responses of the vehicle models.

cargo run --release --example response > response.csv
.venv/bin/python docs/images/draw_vehicle_model.py response.csv
"""

import csv
import sys
from collections import defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

HERE = Path(__file__).parent
COLOUR = {"kinematic": "tab:gray", "dynamic": "tab:blue", "rigid_body": "tab:orange"}
LINE = {"dry": "-", "wet": "--", "snow": ":"}
TEXT = ("figure", "model", "surface")
Rows = dict[tuple[str, str], dict[str, list[float]]]


def read(path: str) -> dict[str, Rows]:
    """Figure -> (model, surface) -> column -> values."""
    figures: dict[str, Rows] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    with open(path, newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            columns = figures[row["figure"]][row["model"], row["surface"]]
            for name in row.keys() - set(TEXT):
                columns[name].append(float(row[name]))
    return figures


def lines(axis: Axes, rows: Rows, x: str, y: str, scale: float = 1.0, surfaces: tuple[str, ...] = ("dry",)) -> None:
    """One line for each model and surface; the kinematic model knows no surface."""
    for (model, surface), columns in rows.items():
        if surface not in surfaces or (model == "kinematic" and surface != "dry"):
            continue
        label = model if len(surfaces) == 1 or model == "kinematic" else f"{model}, {surface}"
        values = [scale * value for value in columns[y]]
        axis.plot(columns[x], values, color=COLOUR[model], linestyle=LINE[surface], label=label)
    axis.grid(alpha=0.3)


def circle(rows: Rows) -> None:
    """Steady state: lateral acceleration and slip of the centre of gravity against the road-wheel angle."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    lines(left, rows, "road_wheel_angle_rad", "lateral_mps2", surfaces=("dry", "snow"))
    left.set(xlabel="road-wheel angle, rad", ylabel="lateral acceleration, m/s²", ylim=(0, 12), title="20 m/s, held")
    left.legend(fontsize=8)
    lines(right, rows, "lateral_mps2", "roll_rad", 57.2958)
    right.set(xlabel="lateral acceleration, m/s²", ylabel="roll, degrees", xlim=(0, 9), title="20 m/s, held, dry")
    figure.savefig(HERE / "vehicle_circle.png", dpi=110)


def step(rows: Rows) -> None:
    """Step steer: yaw, slip and roll."""
    figure, axes = plt.subplots(2, 2, figsize=(10, 6), layout="constrained", sharex=True)
    panels = [
        ("yaw_rate_radps", 1.0, "yaw rate, rad/s"),
        ("lateral_mps2", 1.0, "lateral acceleration, m/s²"),
        ("slip_rad", 57.2958, "slip at the centre of gravity, degrees"),
        ("roll_rad", 57.2958, "roll, degrees"),
    ]
    for axis, (name, scale, label) in zip(axes.flat, panels, strict=True):
        lines(axis, rows, "t_s", name, scale)
        axis.set(ylabel=label)
    axes[0][0].legend(fontsize=8)
    for axis in axes[1]:
        axis.set(xlabel="time, s")
    figure.suptitle("0.03 rad from 0.5 s on, 20 m/s")
    figure.savefig(HERE / "vehicle_step.png", dpi=110)


def brake(rows: Rows) -> None:
    """Full braking: speed over distance, pitch over time."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    lines(left, rows, "x_m", "speed_mps", surfaces=("dry", "wet", "snow"))
    left.set(xlabel="distance, m", ylabel="speed, m/s", title="full braking")
    left.legend(fontsize=8)
    lines(right, rows, "t_s", "pitch_rad", 57.2958)
    right.set(xlabel="time, s", ylabel="pitch, degrees (positive nose up)", xlim=(0, 6), title="full braking, dry")
    figure.savefig(HERE / "vehicle_brake.png", dpi=110)


def main() -> None:
    """Draws all figures."""
    figures = read(sys.argv[1])
    for draw in (circle, step, brake):
        draw(figures[draw.__name__])


if __name__ == "__main__":
    main()
