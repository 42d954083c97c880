"""Draws articulated.png: a truck with its semi-trailer, an articulated bus and a tram in a turn, from recorded runs.

python docs/images/draw_articulated.py
"""

import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import sumo  # type: ignore[import-untyped]  # the wheel of SUMO has no stubs
from caraware.data import open_recording
from numpy.typing import NDArray

HERE = Path(__file__).parent
RADIUS_M = 15.0
"""Of the bend, in the middle of the lane."""
SIDE_M = 1.6
"""From the line of an edge to the middle of its lane, to the right."""
NODES = f"""<nodes>
    <node id="west" x="0" y="0"/><node id="begin" x="105" y="0"/>
    <node id="end" x="{105 + RADIUS_M - SIDE_M}" y="{RADIUS_M - SIDE_M}"/>
    <node id="north" x="{105 + RADIUS_M - SIDE_M}" y="120"/>
</nodes>"""
EDGES = """<edges>
    <edge id="in" from="west" to="begin" numLanes="1" speed="8"/>
    <edge id="bend" from="begin" to="end" numLanes="1" speed="8" shape="{shape}"/>
    <edge id="out" from="end" to="north" numLanes="1" speed="8"/>
</edges>"""
ROUTES = """<routes>
    <vType id="it" vClass="{vehicle_class}" length="{length_m}" guiShape="{shape}"/>
    <vehicle id="it" type="it" depart="0"><route edges="in bend out"/></vehicle>
</routes>"""
SCENARIO = """<configuration>
    <net-file value="bend.net.xml"/><route-files value="bend.rou.xml"/><end value="60"/><step-length value="0.1"/>
</configuration>"""
SHOWN = (
    ("semi-trailer truck, 16.5 m", "trailer", 16.5, "truck/semitrailer"),
    ("articulated bus, 18 m", "bus", 18.0, "bus/flexible"),
    ("tram, 30 m", "tram", 30.0, "rail/railcar"),
)
APART_M = 21.0
"""Between two poses that are drawn."""
BODIES = ("#1f4fa8", "#d98200", "#00916e")
ORIGIN = ("map.origin_latitude_deg=52.0", "map.origin_longitude_deg=10.0")
Array = NDArray[Any]


def recorded(directory: Path, vehicle_class: str, length_m: float, shape: str) -> list[Array]:
    """The states of each tick in which there is the vehicle, on its way through the bend."""
    turns, radius_m = np.linspace(0, np.pi / 2, 31), RADIUS_M - SIDE_M
    points = zip(105 + radius_m * np.sin(turns), radius_m * (1 - np.cos(turns)), strict=True)
    texts = {
        "bend.nod.xml": NODES,
        "bend.edg.xml": EDGES.format(shape=" ".join(f"{x:.3f},{y:.3f}" for x, y in points)),
        "bend.rou.xml": ROUTES.format(vehicle_class=vehicle_class, length_m=length_m, shape=shape),
        "bend.sumocfg": SCENARIO,
    }
    for name, text in texts.items():
        (directory / name).write_text(text, encoding="utf-8")
    netconvert = str(Path(sumo.SUMO_HOME) / "bin" / "netconvert")
    files = ["--node-files", "bend.nod.xml", "--edge-files", "bend.edg.xml", "-o", "bend.net.xml"]
    environment = {**os.environ, "SUMO_HOME": sumo.SUMO_HOME}
    subprocess.run([netconvert, *files], cwd=directory, check=True, env=environment)
    settings = ["traffic.cav_share=1.0", "fanout.enabled=false", *ORIGIN]
    overrides = [part for setting in settings for part in ("--set", setting)]
    command = [
        "caraware",
        "simulate",
        "bend.sumocfg",
        "--record",
        "--name",
        vehicle_class,
        *overrides,
    ]
    subprocess.run(command, cwd=directory, check=True)
    recording = open_recording(directory / "runs" / vehicle_class)
    ticks = [message.section("states").copy() for message in recording.messages("world")]
    return [states for states in ticks if len(states)]


def outline(state: np.void) -> Array:
    """f64 [5, 2]: the closed outline of a body (m, world)."""
    rear, front, side = (
        -state["rear_overhang_m"],
        state["length_m"] - state["rear_overhang_m"],
        state["width_m"] / 2,
    )
    corners = np.array(
        [[rear, -side], [front, -side], [front, side], [rear, side], [rear, -side]],
        np.float64,
    )
    cos, sin = np.cos(state["yaw_rad"]), np.sin(state["yaw_rad"])
    turned: Array = corners @ np.array([[cos, sin], [-sin, cos]]) + [
        state["x_m"],
        state["y_m"],
    ]
    return turned


def front_m(state: np.void) -> Array:
    """The middle of the front of a body (m, world)."""
    corners = outline(state)
    middle: Array = (corners[1] + corners[2]) / 2
    return middle


def draw(axes: Any, title: str, ticks: list[Array]) -> None:
    """One vehicle: its bodies every `APART_M`, the path of its front and that of the end of its last body."""
    fronts = np.array([front_m(states[0]) for states in ticks])
    ends = np.array([outline(states[-1])[[0, 3]].mean(0) for states in ticks])
    axes.plot(*fronts.T, color="#e8175d", linewidth=1, label="front")
    axes.plot(*ends.T, color="#8a8f98", linewidth=1, linestyle="--", label="rear end")
    way_m = np.concatenate([[0.0], np.hypot(*np.diff(fronts, axis=0).T).cumsum()])
    for at_m in np.arange(way_m[0] + 66.0, way_m[-1], APART_M):
        states = ticks[int(np.searchsorted(way_m, at_m))]
        for place, state in enumerate(states):
            axes.fill(
                *outline(state).T,
                color=BODIES[place % len(BODIES)],
                alpha=0.28,
                linewidth=0,
            )
            axes.plot(*outline(state).T, color=BODIES[place % len(BODIES)], linewidth=0.7)
    axes.set(title=title, aspect="equal", xlim=(62, 130), ylim=(-8, 60), xlabel="x (m)")
    axes.title.set_fontsize(10)


def main() -> None:
    """Simulates each vehicle and writes the picture beside this file."""
    figure, columns = plt.subplots(1, len(SHOWN), figsize=(11, 4.1), sharey=True, layout="constrained")
    for axes, (title, vehicle_class, length_m, shape) in zip(columns, SHOWN, strict=True):
        with tempfile.TemporaryDirectory() as directory:
            draw(axes, title, recorded(Path(directory), vehicle_class, length_m, shape))
    columns[0].set_ylabel("y (m)")
    columns[0].legend(fontsize=8, loc="upper left")
    figure.savefig(HERE / "articulated.png", dpi=110)


if __name__ == "__main__":
    main()
