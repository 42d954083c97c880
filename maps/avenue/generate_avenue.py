"""Writes the sources of the avenue: junctions, streets and buildings, as netconvert and SUMO read them.

`python maps/avenue/generate_avenue.py` writes them beside this file; the same program writes the same bytes.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

HERE = Path(__file__).parent
Point = tuple[float, float]

WIDTH_M, HEIGHT_M = 440.0, 320.0
"""Of the ring."""
CORNER_M = 70.0
"""Radius of the ring's corners."""
LANE_M = 3.5
NODES = {
    "south": (WIDTH_M / 2, 0.0),
    "east": (WIDTH_M, HEIGHT_M / 2),
    "north": (WIDTH_M / 2, HEIGHT_M),
    "west": (0.0, HEIGHT_M / 2),
    "centre": (WIDTH_M / 2, HEIGHT_M / 2),
}
STREETS = (
    ("ring_se", "south", "east", 3),
    ("ring_en", "east", "north", 3),
    ("ring_nw", "north", "west", 2),
    ("ring_ws", "west", "south", 2),
    ("cross_s", "south", "centre", 2),
    ("cross_n", "centre", "north", 1),
    ("cross_w", "west", "centre", 1),
    ("cross_e", "centre", "east", 2),
)
"""Name, ends, and lanes in each direction."""
SETBACK_M = 5.0
"""From the edge of the pavement to the houses."""
PAVEMENT_M = 2.0
HOUSE_M = (16.0, 12.0)
"""Along the street and away from it."""
GAP_M = 9.0
FREE_M = 32.0
"""Without houses, from each junction's middle."""
CORNERS = {
    ("south", "east"): (WIDTH_M, 0.0),
    ("east", "north"): (WIDTH_M, HEIGHT_M),
    ("north", "west"): (0.0, HEIGHT_M),
    ("west", "south"): (0.0, 0.0),
}


def shape(start: str, end: str) -> list[Point]:
    """The centre line of a street: straight, or around a corner of the ring in pieces of 7.5 degrees."""
    a, b = NODES[start], NODES[end]
    corner = CORNERS.get((start, end))
    if corner is None:
        return [a, b]
    towards_a, towards_b = direction(corner, a), direction(corner, b)
    middle = tuple(corner[i] + CORNER_M * (towards_a[i] + towards_b[i]) for i in range(2))
    arc = [
        tuple(middle[i] - CORNER_M * (math.cos(t) * towards_b[i] + math.sin(t) * towards_a[i]) for i in range(2))
        for t in (step * math.pi / 24 for step in range(13))
    ]
    return [a, *((x, y) for x, y in arc), b]


def direction(start: Point, end: Point) -> Point:
    """Of length 1."""
    length = math.dist(start, end)
    return (end[0] - start[0]) / length, (end[1] - start[1]) / length


def written(points: list[Point]) -> str:
    """As SUMO writes a shape."""
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in points)


def nodes() -> str:
    """Junctions, in metres: x east, y north."""
    location = (
        f'<location netOffset="0.00,0.00" convBoundary="0.00,0.00,{WIDTH_M:.2f},{HEIGHT_M:.2f}" '
        'origBoundary="10.5300000,52.2700000,10.5364500,52.2728800" '
        'projParameter="+proj=tmerc +lat_0=52.27 +lon_0=10.53 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs"/>'
    )
    lines = [location]
    lines += [f'<node id="{name}" x="{x:.1f}" y="{y:.1f}" type="traffic_light"/>' for name, (x, y) in NODES.items()]
    return document("nodes", lines)


def edges() -> str:
    """Streets, each with two directions; the id of the opposite one begins with `-`."""
    lines = []
    for name, start, end, lanes in STREETS:
        points = shape(start, end)
        for sign, a, b, way in (
            ("", start, end, points),
            ("-", end, start, points[::-1]),
        ):
            drawn = f' shape="{written(way)}"' if len(way) > 2 else ""
            lines.append(f'<edge id="{sign}{name}" from="{a}" to="{b}" type="street" numLanes="{lanes}"{drawn}/>')
    return document("edges", lines)


def buildings() -> str:
    """Houses on both sides of every street."""
    lines: list[str] = []
    for name, start, end, lanes in STREETS:
        points = shape(start, end)
        total = sum(math.dist(a, b) for a, b in pairwise(points))
        for side in (-1.0, 1.0):
            place = FREE_M + HOUSE_M[0] / 2
            while place < total - FREE_M - HOUSE_M[0] / 2:
                outline = house(points, place, side, lanes)
                number = len(lines)
                height = 6.0 + 3.0 * (number * 7 % 4)
                if is_free(outline, name):
                    lines.append(
                        f'<poly id="house_{number}" type="building" color="160,150,140" fill="1" layer="0" '
                        f'shape="{written(outline)}"><param key="height" value="{height:.1f}"/></poly>'
                    )
                place += HOUSE_M[0] + GAP_M
    return document("additional", lines)


def house(points: list[Point], place: float, side: float, lanes: int) -> list[Point]:
    """The outline of a house beside the place so many metres along a street."""
    for a, b in pairwise(points):
        length = math.dist(a, b)
        if place <= length:
            break
        place -= length
    along = direction(a, b)
    away = (-side * along[1], side * along[0])
    front = lanes * LANE_M + PAVEMENT_M + SETBACK_M
    foot = (a[0] + along[0] * place, a[1] + along[1] * place)
    corners = (
        (-HOUSE_M[0] / 2, front),
        (HOUSE_M[0] / 2, front),
        (HOUSE_M[0] / 2, front + HOUSE_M[1]),
        (-HOUSE_M[0] / 2, front + HOUSE_M[1]),
    )
    outline = [tuple(foot[i] + u * along[i] + v * away[i] for i in range(2)) for u, v in corners]
    return [(x, y) for x, y in (*outline, outline[0])]


def is_free(outline: list[Point], own: str) -> bool:
    """Whether no other street comes near a house."""
    for name, start, end, lanes in STREETS:
        if name == own:
            continue
        for a, b in pairwise(shape(start, end)):
            length = math.dist(a, b)
            steps = max(2, int(length / 2))
            for step in range(steps + 1):
                point = tuple(a[i] + (b[i] - a[i]) * step / steps for i in range(2))
                if min(math.dist(point, corner) for corner in outline) < lanes * LANE_M + PAVEMENT_M + 3.0:
                    return False
    return True


def document(tag: str, lines: list[str]) -> str:
    """A whole file."""
    body = "".join(f"    {line}\n" for line in lines)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<!-- Written by generate_avenue.py. -->\n<{tag}>\n{body}</{tag}>\n'


def main() -> None:
    """Write the three files."""
    for name, text in (("nod", nodes()), ("edg", edges()), ("poly", buildings())):
        (HERE / f"avenue.{name}.xml").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
