"""Draws the figures of `docs/sensor-models.md` from sensor samples.

cargo run --release --example sensor_plots -- DIR
.venv/bin/python docs/images/sensor_plots.py DIR

A figure whose tables are not in DIR is left as it is.
"""

import csv
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

HERE = Path(__file__).parent
# The order of `ipc_schema::pointcloud::Tag`.
TAGS = {
    "ground": "0.8",
    "building": "tab:brown",
    "wall": "tab:olive",
    "structure": "rosybrown",
    "vehicle": "tab:blue",
    "two-wheeler": "tab:cyan",
    "person": "tab:red",
    "barrier": "tab:orange",
    "furniture": "goldenrod",
    "pole": "tab:purple",
    "vegetation": "tab:green",
    "parked vehicle": "slateblue",
    "load": "tab:pink",
    "mesh": "0.5",
}
IMU = {
    "accel_mps2": ("tab:blue", "accelerometer", "Allan deviation, m/s²"),
    "gyro_radps": ("tab:orange", "gyroscope", "Allan deviation, rad/s"),
}


def allan_deviation(values: np.ndarray, period_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Overlapping Allan deviation (IEEE Std 952, annex C): averaging times (s) and deviations, 20 a decade."""
    angle = np.concatenate([[0.0], np.cumsum(values)]) * period_s
    longest = len(values) // 9
    counts = np.unique(np.geomspace(1, longest, int(20 * np.log10(longest))).astype(int))
    deviations = []
    for count in counts:
        second = angle[2 * count :] - 2.0 * angle[count:-count] + angle[: -2 * count]
        deviations.append(np.sqrt(np.mean(second**2) / 2.0) / (count * period_s))
    return counts * period_s, np.array(deviations)


def allan(directory: Path) -> None:
    """Accelerometer and gyroscope at rest: white noise falls with a slope of -1/2, a walking bias rises with +1/2."""
    with open(directory / "imu_model.csv", newline="", encoding="utf-8") as file:
        models = {row["sensor"]: row for row in csv.DictReader(file)}
    samples = np.genfromtxt(directory / "imu.csv", delimiter=",", names=True)
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for axis, (name, (colour, title, label)) in zip(axes, IMU.items(), strict=True):
        period_s, density, walk = (float(models[name][column]) for column in ("period_s", "density", "walk"))
        time_s, deviation = allan_deviation(samples[name], period_s)
        white, bias = density / np.sqrt(time_s), walk * np.sqrt(time_s / 3.0)
        axis.loglog(time_s, deviation, ".", color=colour, markersize=4, label="samples")
        axis.loglog(time_s, np.hypot(white, bias), color="black", linewidth=1, label="model")
        axis.loglog(time_s, white, "--", color="tab:gray", linewidth=1, label=f"N/√τ, N = {density:.2g}")
        axis.loglog(time_s, bias, ":", color="tab:gray", linewidth=1, label=f"K√(τ/3), K = {walk:.2g}")
        lowest = np.hypot(white, bias).min()
        axis.set(xlabel="averaging time τ, s", ylabel=label, title=title, ylim=(lowest / 3.0, white[0] * 2.0))
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    figure.savefig(HERE / "sensor_allan.png", dpi=110)


def gnss(directory: Path) -> None:
    """A drive between houses: fixes with each kind of error."""
    with open(directory / "gnss.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    with open(directory / "houses.csv", newline="", encoding="utf-8") as file:
        houses = [[float(value) for value in row.values()] for row in csv.DictReader(file)]
    kinds = list(dict.fromkeys(row["error"] for row in rows))
    figure, axes = plt.subplots(1, len(kinds), figsize=(13, 3.9), layout="constrained", sharex=True, sharey=True)
    for axis, kind in zip(axes, kinds, strict=True):
        mine = [row for row in rows if row["error"] == kind]
        x, y, fix_x, fix_y, satellites = (
            np.array([float(row[name]) for row in mine]) for name in ("x_m", "y_m", "fix_x_m", "fix_y_m", "satellites")
        )
        for x_min, y_min, x_max, y_max, height in houses:
            axis.add_patch(Rectangle((x_min, y_min), x_max - x_min, y_max - y_min, color="0.85", zorder=0))
            axis.annotate(
                f"{height:.0f} m", ((x_min + x_max) / 2, (y_min + y_max) / 2), ha="center", va="center", fontsize=7
            )
        axis.plot(x, y, color="black", linewidth=1, label="truth")
        dots = axis.scatter(fix_x, fix_y, c=satellites, s=7, cmap="viridis", vmin=4, vmax=11, label="fixes")
        title = f"{kind}: {np.sqrt(np.mean((fix_x - x) ** 2 + (fix_y - y) ** 2)):.1f} m rms"
        most = max(sum(row["error"] == other for row in rows) for other in kinds)
        if len(mine) < most:
            title += f", no fix for {1 - len(mine) / most:.0%}"
        axis.set(xlabel="x, m", aspect="equal", title=title)
        axis.grid(alpha=0.3)
    axes[0].set(ylabel="y, m")
    axes[0].legend(fontsize=8, loc="upper left")
    figure.colorbar(dots, ax=axes, label="satellites in use")
    figure.savefig(HERE / "sensor_gnss.png", dpi=110)


def sky(directory: Path) -> None:
    """The sky at two places: what houses hide, and by which way each satellite is received. North is up."""
    with open(directory / "horizons.csv", newline="", encoding="utf-8") as file:
        horizons = list(csv.DictReader(file))
    with open(directory / "satellites.csv", newline="", encoding="utf-8") as file:
        satellites = list(csv.DictReader(file))
    places = list(dict.fromkeys(row["place"] for row in horizons))
    figure, axes = plt.subplots(1, len(places), figsize=(10, 4.6), layout="constrained", subplot_kw={"polar": True})
    marks = {"direct": ("o", "tab:green"), "reflected": ("D", "tab:orange"), "hidden": ("x", "tab:red")}
    for axis, place in zip(axes, places, strict=True):
        edge = sorted(
            (float(row["azimuth_deg"]) % 360.0, float(row["elevation_deg"]))
            for row in horizons
            if row["place"] == place
        )
        azimuth, elevation = np.array([*edge, (edge[0][0] + 360.0, edge[0][1])]).T
        axis.fill_between(np.radians(azimuth), 90.0 - elevation, 90.0, color="0.85", linewidth=0, zorder=0)
        for signal, (marker, colour) in marks.items():
            mine = [row for row in satellites if row["place"] == place and row["signal"] == signal]
            where = [np.radians(float(row["azimuth_deg"])) for row in mine]
            axis.scatter(
                where,
                [90.0 - float(row["elevation_deg"]) for row in mine],
                marker=marker,
                color=colour,
                label=signal,
                zorder=3,
            )
        axis.set_theta_zero_location("N")
        axis.set_theta_direction(-1)
        axis.set(rlim=(0, 90), yticks=[0, 30, 60, 80], yticklabels=["90°", "60°", "30°", "10°"], title=place)
        axis.set_xticks(np.radians([0, 90, 180, 270]), ["N", "E", "S", "W"])
        axis.grid(alpha=0.3)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    figure.savefig(HERE / "sensor_sky.png", dpi=110)


def scan(directory: Path) -> None:
    """One rotation of a LIDAR from above: what each point lies on, and how strong it is."""
    points = np.genfromtxt(directory / "scan.csv", delimiter=",", names=True)
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 6), layout="constrained", sharex=True, sharey=True)
    tag = points["tag"].astype(int)
    handles = []
    for number, (name, colour) in enumerate(TAGS.items()):
        of_tag = tag == number
        if of_tag.any():
            size = 0.5 if name == "ground" else 2.0
            left.scatter(points["x_m"][of_tag], points["y_m"][of_tag], s=size, color=colour, linewidths=0)
            handles.append(Line2D([], [], marker="o", linestyle="", color=colour, markersize=5, label=name))
    left.legend(handles=handles, fontsize=8, loc="upper right")
    style = {"s": 1.0, "cmap": "magma_r", "linewidths": 0, "vmin": 0}
    dots = right.scatter(points["x_m"], points["y_m"], c=points["intensity"], **style)
    figure.colorbar(dots, ax=right, label="intensity")
    reach_m = 1.05 * np.percentile(np.hypot(points["x_m"], points["y_m"]), 98)
    for axis, title in ((left, "what was hit"), (right, "intensity")):
        axis.plot(0.0, 0.0, "k^", markersize=6, zorder=5)
        axis.set(xlabel="x (forward), m", aspect="equal", title=title)
        axis.set(xlim=(-reach_m, reach_m), ylim=(-reach_m, reach_m))
        axis.grid(alpha=0.3)
    left.set(ylabel="y (left), m")
    figure.savefig(HERE / "sensor_scan.png", dpi=110)


FIGURES = {allan: "imu.csv", gnss: "gnss.csv", sky: "satellites.csv", scan: "scan.csv"}


def main() -> None:
    """Draws every figure whose tables exist."""
    directory = Path(sys.argv[1])
    for draw, table in FIGURES.items():
        if (directory / table).exists():
            draw(directory)


if __name__ == "__main__":
    main()
