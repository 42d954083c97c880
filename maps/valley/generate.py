"""Writes the sources of the valley: junctions, streets, buildings, stops and demand, as netconvert and SUMO read them.

`python maps/valley/generate.py` writes them beside this file; the same program writes the same bytes.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from xml.sax.saxutils import quoteattr

HERE = Path(__file__).parent
SEED = 1

COLUMNS = (100, 300, 500, 700, 900, 1100, 1300)
"""x of the streets that lead north, metres."""
SOUTH_ROWS = (60, 200, 340)
"""y of the streets along the river on the flat bank, metres; the last is the quay."""
NORTH_ROWS = (480, 660, 840)
"""The same on the hill."""
CLIMBS = (100, 300, 700, 1100, 1300)
"""x of the streets that climb the hill."""
BRIDGES = (300, 700, 1100)
"""x of the bridges over the river."""
AVENUE = 700
"""x of the street with tram and bicycle lanes."""
ROUNDABOUT = (1100, 340)
RADIUS_M = 24.0
RIVER = (372.0, 448.0)
"""y of the banks, metres."""
SLOPE = 0.06
BRIDGE_TOP_M = 2.0
BYPASS_M = 13.0
"""Height of the bypass, which crosses the climbing streets on a bridge of its own."""
BYPASS_Y = 570.0


def height_m(y: float) -> float:
    """Height of the ground: the southern bank is flat, the northern one rises from the quay on."""
    return round(SLOPE * max(0.0, y - NORTH_ROWS[0]), 2)


@dataclass
class Net:
    """Junctions and streets."""

    nodes: dict[str, tuple[float, float, float, str]] = field(default_factory=dict)
    edges: list[str] = field(default_factory=list)
    ids: list[str] = field(default_factory=list)

    def node(self, name: str, x: float, y: float, z: float, kind: str = "priority") -> str:
        """Adds a junction."""
        self.nodes[name] = (x, y, z, kind)
        return name

    def one_way(self, name: str, start: str, end: str, kind: str, shape: list[tuple[float, float, float]]) -> None:
        """Adds one direction of a street."""
        points = " ".join(f"{x:.2f},{y:.2f},{z:.2f}" for x, y, z in shape)
        drawn = f" shape={quoteattr(points)}" if points else ""
        self.edges.append(f'<edge id="{name}" from="{start}" to="{end}" type="{kind}"{drawn}/>')
        self.ids.append(name)

    def street(self, name: str, a: str, b: str, kind: str, between: Sequence[tuple[float, float, float]]) -> None:
        """Adds both directions of a street, with points between its ends."""

        def ends(node: str) -> tuple[float, float, float]:
            x, y, z, _ = self.nodes[node]
            return x, y, z

        shape = [ends(a), *between, ends(b)] if between else []
        self.one_way(name, a, b, kind, shape)
        self.one_way(f"-{name}", b, a, kind, shape[::-1])


def at(x: int, y: int) -> str:
    """Name of the junction there."""
    return f"n{x}_{y}"


def kind_of(x: int, vertical: bool, y: int) -> str:
    """Kind of a street."""
    if vertical and x == AVENUE:
        return "avenue"
    return "collector" if y in (SOUTH_ROWS[-1], NORTH_ROWS[0]) or (vertical and x in BRIDGES) else "residential"


def build_net() -> Net:
    """The whole net."""
    net = Net()
    signals = {(AVENUE, y) for y in (200, 340, 480, 660)} | {(300, 340), (300, 480)}
    for x in COLUMNS:
        for y in (*SOUTH_ROWS, *NORTH_ROWS):
            if (x, y) != ROUNDABOUT:
                net.node(at(x, y), x, y, height_m(y), "traffic_light" if (x, y) in signals else "priority")
    ring = roundabout(net)
    end = {(*ROUNDABOUT, side): ring[side] for side in ring}

    def junction(x: int, y: int, side: str) -> str:
        return end.get((x, y, side), at(x, y))

    for y in (*SOUTH_ROWS, *NORTH_ROWS):
        for west, east in pairwise(COLUMNS):
            kind = kind_of(west, False, y)
            net.street(f"e{west}_{y}", junction(west, y, "east"), junction(east, y, "west"), kind, [])
    for rows in (SOUTH_ROWS, NORTH_ROWS):
        for x in COLUMNS:
            for low, high in pairwise(rows):
                if rows is SOUTH_ROWS or x in CLIMBS:
                    kind = kind_of(x, True, low)
                    net.street(f"n{x}_{low}", junction(x, low, "north"), junction(x, high, "south"), kind, [])
    for x in BRIDGES:
        low, high = SOUTH_ROWS[-1], NORTH_ROWS[0]
        middle = (low + high) / 2
        shape = [(x, middle - 16.0, BRIDGE_TOP_M), (x, middle, BRIDGE_TOP_M + 0.4), (x, middle + 16.0, BRIDGE_TOP_M)]
        net.street(f"bridge{x}", junction(x, low, "north"), junction(x, high, "south"), kind_of(x, True, low), shape)
    first, last, y = COLUMNS[0], COLUMNS[-1], NORTH_ROWS[1]
    net.street("bypass", at(first, y), at(last, y), "bypass", [(x, y_m, BYPASS_M) for x, y_m in bypass_line()[1:-1]])
    return net


def bypass_line() -> list[tuple[float, float]]:
    """x and y of the bypass from west to east: straight, with two bends of a parabola's shape."""
    y, bend_m = float(NORTH_ROWS[1]), 80.0
    ends = [(float(COLUMNS[0]), y), (220.0, BYPASS_Y), (1180.0, BYPASS_Y), (float(COLUMNS[-1]), y)]
    line = [ends[0]]
    for before, corner, after in zip(ends, ends[1:], ends[2:], strict=False):

        def towards(
            other: tuple[float, float], corner: tuple[float, float] = corner, most_m: float = bend_m
        ) -> tuple[float, float]:
            share = most_m / math.dist(corner, other)
            return corner[0] + share * (other[0] - corner[0]), corner[1] + share * (other[1] - corner[1])

        begin, end = towards(before), towards(after)
        for part in range(11):
            t = part / 10
            weights = ((1 - t) ** 2, 2 * t * (1 - t), t**2)
            x_m, y_m = (
                sum(weight * point[axis] for weight, point in zip(weights, (begin, corner, end), strict=True))
                for axis in (0, 1)
            )
            line.append((round(x_m, 2), round(y_m, 2)))
    return [*line, ends[-1]]


def from_bypass_m(x: float, y: float) -> float:
    """Distance of a point from the bypass, metres."""
    line = bypass_line()
    away = []
    for (x0, y0), (x1, y1) in pairwise(line):
        along = ((x - x0) * (x1 - x0) + (y - y0) * (y1 - y0)) / math.dist((x0, y0), (x1, y1)) ** 2
        share = min(max(along, 0.0), 1.0)
        away.append(math.hypot(x - x0 - share * (x1 - x0), y - y0 - share * (y1 - y0)))
    return min(away)


def roundabout(net: Net) -> dict[str, str]:
    """A ring with an arm to each side; returns its junctions."""
    x, y = ROUNDABOUT
    sides = {"east": 0, "north": 90, "west": 180, "south": 270}
    for side, angle in sides.items():
        rad = math.radians(angle)
        net.node(f"ring_{side}", x + RADIUS_M * math.cos(rad), y + RADIUS_M * math.sin(rad), 0.0)
    names = list(sides)
    for side, following in zip(names, [*names[1:], names[0]], strict=True):
        begin = sides[side]
        arc = [begin + 90 * share / 6 for share in range(7)]
        shape = [
            (x + RADIUS_M * math.cos(math.radians(angle)), y + RADIUS_M * math.sin(math.radians(angle)), 0.0)
            for angle in arc
        ]
        net.one_way(f"ring_{side}", f"ring_{side}", f"ring_{following}", "ring", shape)
    return {side: f"ring_{side}" for side in sides}


def write(name: str, root: str, lines: list[str], comment: str) -> None:
    """Writes one file."""
    text = "\n".join(f"    {line}" for line in lines)
    head = f'<?xml version="1.0" encoding="UTF-8"?>\n<!-- Written by generate.py. {comment} -->\n'
    (HERE / name).write_text(f"{head}<{root}>\n{text}\n</{root}>\n", encoding="utf-8")


def write_net(net: Net) -> None:
    """Junctions and streets."""
    location = (
        '<location netOffset="0.00,0.00" convBoundary="0.00,0.00,1400.00,900.00" '
        'origBoundary="11.5700000,48.1400000,11.5888000,48.1481000" '
        'projParameter="+proj=tmerc +lat_0=48.14 +lon_0=11.57 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs"/>'
    )
    nodes = [
        f'<node id="{name}" x="{x:.2f}" y="{y:.2f}" z="{z:.2f}" type="{kind}"/>'
        for name, (x, y, z, kind) in net.nodes.items()
    ]
    write("valley.nod.xml", "nodes", [location, *nodes], "Junctions, metres: x east, y north, z up.")
    ring = [name for name in net.ids if name.startswith("ring_")]
    row = f'<roundabout nodes="{" ".join(ring)}" edges="{" ".join(ring)}"/>'
    write("valley.edg.xml", "edges", [*net.edges, row], "Streets; the opposite direction begins with a minus.")


def blocks() -> list[tuple[float, float, float, float]]:
    """Corners of the land between the streets: x and y from, x and y to."""
    found = []
    for rows in (SOUTH_ROWS, NORTH_ROWS):
        for low, high in pairwise(rows):
            columns = COLUMNS if rows is SOUTH_ROWS else CLIMBS
            found += [(west, low, east, high) for west, east in pairwise(columns)]
    return [(float(x0), float(y0), float(x1), float(y1)) for x0, y0, x1, y1 in found]


def write_buildings() -> int:
    """Houses along the streets; returns their number."""
    rng, lines, count = random.Random(SEED), [], 0
    setback, depth = 13.0, 13.0
    for x0, y0, x1, y1 in blocks():
        for front in (y0 + setback, y1 - setback - depth):
            x = x0 + setback + 4.0
            while x < x1 - setback - 14.0:
                width, gap = rng.uniform(10.0, 20.0), rng.choice([0.0, 3.0, 6.0, 18.0])
                east = min(x + width, x1 - setback - 4.0)
                is_under_bypass = from_bypass_m((x + east) / 2, front + depth / 2) < 25.0
                is_at_ring = math.hypot((x + east) / 2 - ROUNDABOUT[0], front - ROUNDABOUT[1]) < RADIUS_M + 22.0
                storeys = rng.choice([2, 3, 3, 4, 5])
                if not is_under_bypass and not is_at_ring:
                    count += 1
                    top = 3.1 * storeys + 1.5
                    lines += outline(f"house_{count:03d}", x, front, east, front + depth, top)
                x = east + gap
    for name, x0, y0, x1, y1, top in (
        ("church", 540.0, 110.0, 566.0, 150.0, 24.0),
        ("depot", 150.0, 105.0, 230.0, 150.0, 9.0),
    ):
        lines += outline(name, x0, y0, x1, y1, top)
    south, north = RIVER
    lines.append(
        f'<poly id="river" type="water" color="140,180,220" fill="true" layer="-2" '
        f'shape="-40,{south} 1440,{south} 1440,{north} -40,{north}"/>'
    )
    comment = "Buildings and the river. `height` is above the ground, metres."
    write("valley.poly.xml", "additional", lines, comment)
    return count + 2


def outline(name: str, x0: float, y0: float, x1: float, y1: float, top_m: float) -> list[str]:
    """A building."""
    shape = f"{x0:.2f},{y0:.2f} {x1:.2f},{y0:.2f} {x1:.2f},{y1:.2f} {x0:.2f},{y1:.2f}"
    return [
        f'<poly id="{name}" type="building" color="190,170,150" fill="true" layer="1" shape="{shape}">',
        f'    <param key="height" value="{top_m:.1f}"/>',
        "</poly>",
    ]


TRAM_STOPS = ("n700_60", "n700_200", "bridge700", "n700_480", "n700_660")
"""Streets with a stop of the tram in each direction."""

FLOWS = (("car", 30, 60), ("van", 6, 90), ("truck", 3, 200), ("bus", 2, 300), ("bicycle", 12, 60))
"""Type, number of flows, and seconds from one vehicle of a flow to the next."""


def write_demand(net: Net) -> None:
    """Stops and an hour of flows."""
    stops = []
    for edge in TRAM_STOPS:
        for name in (edge, f"-{edge}"):
            stops.append(f'<busStop id="stop_{name}" lane="{name}_2" startPos="40" endPos="75" friendlyPos="true"/>')
    write("valley.stops.add.xml", "additional", stops, "Stops of the tram, on the lane that it shares with cars.")
    rng = random.Random(SEED + 1)
    streets = [name for name in net.ids if not name.startswith("ring_")]
    flows = []
    track = [f"n700_{y}" for y in SOUTH_ROWS[:-1]] + ["bridge700"] + [f"n700_{y}" for y in NORTH_ROWS[:-1]]
    for name, edges in (("north", track), ("south", [f"-{edge}" for edge in reversed(track)])):
        halts = "".join(f'<stop busStop="stop_{edge}" duration="15"/>' for edge in edges)
        flows.append(
            f'<flow id="tram_{name}" type="tram" begin="0" end="3600" period="150"><route edges="{" ".join(edges)}"/>'
            f"{halts}</flow>"
        )
    for kind, count, period in (
        ("car", 30, 60),
        ("van", 6, 90),
        ("truck", 3, 200),
        ("bus", 2, 300),
        ("bicycle", 12, 60),
    ):
        for number in range(count):
            start, end = rng.sample([name for name in streets if kind != "bicycle" or "bypass" not in name], 2)
            begin = rng.uniform(0.0, period)
            flows.append(
                f'<flow id="{kind}{number}" type="{kind}" begin="{begin:.1f}" end="3600" period="{period}" '
                f'from="{start}" to="{end}" departLane="best" departSpeed="max"/>'
            )
    walked = [name for name in streets if "bypass" not in name and "bridge" not in name]
    for number in range(12):
        start, end = rng.sample(walked, 2)
        flows.append(
            f'<personFlow id="walker{number}" type="walker" begin="{rng.uniform(0.0, 60.0):.1f}" end="3600" '
            f'period="60">'
            f'<walk from="{start}" to="{end}"/></personFlow>'
        )
    # SUMO wants departures in order.
    flows.sort(key=lambda line: float(line.split('begin="')[1].split('"')[0]))
    write("valley.rou.xml", "routes", flows, "An hour of traffic: trams, cars, vans, trucks, buses, bicycles, walkers.")


def main() -> None:
    """Writes all files."""
    net = build_net()
    write_net(net)
    write_buildings()
    write_demand(net)


if __name__ == "__main__":
    main()
