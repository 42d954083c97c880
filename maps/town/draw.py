"""Draws a built town (streets, crossings, signals, buildings) into town.png: `python draw.py TOWN.net.xml`."""

import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from numpy.typing import ArrayLike

Points = list[tuple[float, float]]

HERE = Path(__file__).parent
GROUND = {"park": "#b5d19c", "orchard": "#cbd8a0"}


def attribute(element: ET.Element, name: str) -> str:
    """An attribute that the element must have."""
    return element.attrib[name]


def points(shape: str) -> Points:
    """Corners [(x, y)] in metres of a SUMO shape attribute."""
    corners = (corner.split(",") for corner in shape.split())
    return [(float(corner[0]), float(corner[1])) for corner in corners]


def thick_line(shape: Points, width_m: float) -> Points:
    """Outline `[(x, y)]` of a lane in metres: its centre line, widened to both sides."""
    left: Points = []
    right: Points = []
    for i, (x, y) in enumerate(shape):
        (x0, y0), (x1, y1) = shape[max(i - 1, 0)], shape[min(i + 1, len(shape) - 1)]
        length = ((x1 - x0) ** 2 + (y1 - y0) ** 2) ** 0.5
        across_x, across_y = -(y1 - y0) / length * width_m / 2, (x1 - x0) / length * width_m / 2
        left.append((x + across_x, y + across_y))
        right.append((x - across_x, y - across_y))
    return left + right[::-1]


def stripes(shape: Points, width_m: float, stripe_m: float = 0.5) -> list[Points]:
    """Outlines of the zebra stripes of a crossing, one for each metre of its centre line."""
    (x0, y0), (x1, y1) = shape[0], shape[-1]
    length = ((x1 - x0) ** 2 + (y1 - y0) ** 2) ** 0.5
    ux, uy = (x1 - x0) / length, (y1 - y0) / length
    starts = [0.25 + i for i in range(int(length))]
    ends = [(s, min(s + stripe_m, length)) for s in starts]
    return [thick_line([(x0 + ux * a, y0 + uy * a), (x0 + ux * b, y0 + uy * b)], width_m) for a, b in ends]


def fill(
    axes: Axes, outlines: list[Points], color: ArrayLike, layer: int, edge: str | None = None, edge_width: float = 0.4
) -> None:
    """Fills polygons; a polygon of a higher layer covers those of lower layers."""
    polygons = PolyCollection(outlines, facecolors=color, zorder=layer)
    if edge is not None:
        polygons.set_edgecolor(edge)
        polygons.set_linewidth(edge_width)
    axes.add_collection(polygons)


def draw_net(axes: Axes, net: ET.Element) -> None:
    """Draws the carriageways, sidewalks, crossings and signals of a net."""
    road: list[Points] = []
    walk: list[Points] = []
    zebra: list[Points] = []
    middle: list[Points] = []
    for edge in net.findall("edge"):
        for lane in edge.findall("lane"):
            shape, width_m = points(attribute(lane, "shape")), float(lane.get("width", 3.2))
            match edge.get("function"), lane.get("allow") == "pedestrian":
                case "crossing", _:
                    zebra += stripes(shape, width_m)
                case "walkingarea", _:
                    walk.append(shape)
                case None, True:
                    walk.append(thick_line(shape, width_m))
                case None, False:
                    road.append(thick_line(shape, width_m))
                    if attribute(edge, "id").startswith("-"):
                        middle.append(thick_line(shape, width_m)[: len(shape)])
    junctions = [j for j in net.findall("junction") if j.get("type") != "internal"]
    road += [points(attribute(j, "shape")) for j in junctions]
    signals = [
        (float(attribute(j, "x")), float(attribute(j, "y"))) for j in junctions if j.get("type") == "traffic_light"
    ]
    fill(axes, road, "#5c6066", 2, edge="#5c6066")
    fill(axes, walk, "#c9c5bd", 3, edge="#c9c5bd")
    fill(axes, zebra, "#f4f4f0", 4)
    axes.add_collection(LineCollection(middle, colors="#e8e4d4", linewidths=0.6, linestyles=(0, (5, 5)), zorder=3))
    east_m, north_m = zip(*signals, strict=True)
    axes.plot(east_m, north_m, "o", ms=8, mfc="#d62f2f", mec="white", zorder=8, ls="none", label="signals")


def draw_polygons(axes: Axes, additional: ET.Element) -> None:
    """Draws the buildings, the higher the darker, and the park and orchard."""
    for poly in additional.findall("poly"):
        outline = points(attribute(poly, "shape"))
        if poly.get("type") != "building":
            fill(axes, [outline], GROUND[attribute(poly, "type")], 1)
            continue
        height = poly.find("param[@key='height']")
        assert height is not None, f"the building {poly.get('id')} has no height"
        height_m = float(attribute(height, "value"))
        color = plt.get_cmap("copper_r")(0.15 + height_m / 32)
        fill(axes, [outline], [color], 5, edge="#4a3a30", edge_width=0.5)


def main(net_path: str) -> None:
    """Draws the net of `net_path` and the polygons beside this script."""
    figure, axes = plt.subplots(figsize=(8, 7.8), dpi=110)
    axes.set_facecolor("#e3e6d8")
    draw_net(axes, ET.parse(net_path).getroot())
    draw_polygons(axes, ET.parse(HERE / "town.poly.xml").getroot())
    axes.set(xlim=(0, 258), ylim=(0, 252), aspect="equal", xlabel="east, m", ylabel="north, m")
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), frameon=False)
    figure.tight_layout()
    figure.savefig(HERE / "town.png")


if __name__ == "__main__":
    main(sys.argv[1])
