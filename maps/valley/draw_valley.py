"""Draws a built valley, its streets in the colour of their height, into valley.png: `draw_valley.py VALLEY.net.xml`."""

import sys
import xml.etree.ElementTree as ET
from itertools import pairwise
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection, PolyCollection

HERE = Path(__file__).parent


def points(shape: str) -> "np.ndarray[tuple[int, int], np.dtype[np.float64]]":
    """Points [n, 3] of a SUMO shape attribute, metres; flat ones have no height."""
    corners = [[float(value) for value in corner.split(",")] for corner in shape.split()]
    return np.array([[*corner, 0.0][:3] for corner in corners])


def main(net_path: str) -> None:
    """Draw the net of `net_path` and the polygons beside this script."""
    figure, axes = plt.subplots(figsize=(11, 7), dpi=100)
    axes.set_facecolor("#e3e6d8")
    for poly in ET.parse(HERE / "valley.poly.xml").getroot().findall("poly"):
        color = "#8cb4dc" if poly.get("type") == "water" else "#b9a490"
        axes.add_collection(PolyCollection([points(poly.attrib["shape"])[:, :2]], facecolors=color, zorder=1))
    segments, heights_m, widths = [], [], []
    for edge in ET.parse(net_path).getroot().findall("edge"):
        for lane in edge.findall("lane"):
            line = points(lane.attrib["shape"])
            if lane.get("allow") == "pedestrian" or edge.get("function") in ("walkingarea", "crossing"):
                continue
            for a, b in pairwise(line):
                segments.append([a[:2], b[:2]])
                heights_m.append((a[2] + b[2]) / 2)
                widths.append(1.0 if lane.get("allow") == "bicycle" else 2.0)
    order = np.argsort(heights_m)
    lines = LineCollection([segments[place] for place in order], cmap="viridis", zorder=3)
    lines.set_array(np.array(heights_m)[order])
    lines.set_linewidth([widths[place] for place in order])
    axes.add_collection(lines)
    figure.colorbar(lines, ax=axes, label="height of the street, m", shrink=0.7)
    axes.set(xlim=(70, 1330), ylim=(30, 870), aspect="equal", xlabel="east, m", ylabel="north, m")
    figure.tight_layout()
    figure.savefig(HERE / "valley.png")


if __name__ == "__main__":
    main(sys.argv[1])
