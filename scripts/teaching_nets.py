"""Writes nets for teaching drivers: `teaching_nets.py DIRECTORY [FIRST] [LAST]`, one `net_SEED.net.xml` for each seed.

Each is a grid of streets, displaced at random: streets bend, climb and end at junctions of several kinds, with and
without precedence, signals, zebra crossings and roundabouts, and have one or two lanes a direction. The same seed and
version of SUMO write the same net. None of the project's own maps is among them. docs/driving.md says what was
taught on them.
"""

import argparse
import math
import random
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import sumo

RING_M = (18.0, 26.0)
"""Least and greatest radius of a roundabout."""
STEEPEST = 0.05
"""Of a street, as a fraction."""
BEND_MPS2 = 4.0
"""Greatest lateral acceleration in a bend at the speed limit: SUMO's vehicles do not slow down for bends."""

MAIN_MPS = 13.89
"""Speed limit of the streets of kind `main`."""

Point = tuple[float, float, float]


@dataclass
class Net:
    """Rows of the files that netconvert reads, and where the junctions are."""

    rng: random.Random
    places: dict[str, Point] = field(default_factory=dict)
    nodes: list[str] = field(default_factory=list)
    edges: list[str] = field(default_factory=list)
    rings: dict[str, float] = field(default_factory=dict)
    """Radius of each junction that is a roundabout."""
    side_mps: float = 8.33
    """Speed limit of the streets of kind `side`."""

    def node(self, name: str, at: Point, kind: str) -> None:
        """A junction."""
        self.places[name] = at
        x, y, z = at
        self.nodes.append(f'<node id="{name}" x="{x:.2f}" y="{y:.2f}" z="{z:.2f}" type="{kind}"/>')

    def one_way(self, name: str, ends: tuple[str, str], kind: str, line: Sequence[Point]) -> None:
        """A direction of a street, along a line between its ends."""
        shape = " ".join(f"{x:.2f},{y:.2f},{z:.2f}" for x, y, z in line)
        self.edges.append(f'<edge id="{name}" from="{ends[0]}" to="{ends[1]}" type="{kind}" shape="{shape}"/>')

    def street(self, name: str, ends: tuple[str, str], kind: str) -> None:
        """Both directions of a street that bends to one side, or to one and then the other."""
        ends, line = self.arms(ends), []
        (x0, y0, z0), (x1, y1, z1) = (self.places[end] for end in ends)
        length = math.dist((x0, y0), (x1, y1))
        bends, aside = self.rng.choice((1, 1, 2)), length * self.rng.choice((0.0, 0.0, 0.08, 0.14, 0.2))
        radius = (MAIN_MPS if kind == "main" else self.side_mps) ** 2 / BEND_MPS2
        aside = self.rng.choice((-1, 1)) * min(aside, (0.7 * length) ** 2 / (2.5 * math.pi**2 * radius))
        pieces = max(2, round(length / 6))
        for piece in range(pieces + 1):
            share = piece / pieces
            # Straight at both ends, so that junctions keep their shape.
            inner = min(max((share - 0.15) / 0.7, 0.0), 1.0)
            by = aside / bends * math.sin(math.pi * bends * inner) * math.sin(math.pi * inner)
            x = x0 + share * (x1 - x0) - by * (y1 - y0) / length
            y = y0 + share * (y1 - y0) + by * (x1 - x0) / length
            line.append((x, y, z0 + share * (z1 - z0)))
        self.one_way(name, ends, kind, line)
        self.one_way(f"-{name}", (ends[1], ends[0]), kind, line[::-1])

    def arms(self, ends: tuple[str, str]) -> tuple[str, str]:
        """The junctions of a street: that of the ring at a roundabout."""

        def at(end: str, other: str) -> str:
            if end not in self.rings:
                return end
            (x, y, _), (to_x, to_y, _) = self.places[end], self.places[other]
            side = round(math.degrees(math.atan2(to_y - y, to_x - x)) / 90) % 4
            return f"{end}_{side}"

        return at(*ends), at(ends[1], ends[0])

    def roundabout(self, name: str, at: Point) -> None:
        """A ring of four junctions that is driven anticlockwise."""
        x, y, z = at
        radius = self.rings[name]
        self.places[name] = at

        def on_ring(degrees: float) -> Point:
            return (x + radius * math.cos(math.radians(degrees)), y + radius * math.sin(math.radians(degrees)), z)

        for side in range(4):
            self.node(f"{name}_{side}", on_ring(90 * side), "priority")
        names = [f"{name}_{side}" for side in range(4)]
        for side in range(4):
            line = [on_ring(90 * side + 15 * step) for step in range(7)]
            self.one_way(f"ring_{names[side]}", (names[side], names[(side + 1) % 4]), "ring", line)
        ring = " ".join(names)
        edges = " ".join(f"ring_{node}" for node in names)
        self.edges.append(f'<roundabout nodes="{ring}" edges="{edges}"/>')


def types(rng: random.Random, side_mps: float) -> str:
    """Kinds of streets."""
    lanes, width = rng.choice((1, 1, 2)), rng.choice((3.2, 3.5))
    common = 'disallow="tram rail rail_urban rail_electric rail_fast ship pedestrian bicycle" sidewalkWidth="2.0"'
    rows = [
        f'<type id="main" priority="4" numLanes="{lanes}" speed="{MAIN_MPS}" width="{width}" {common}/>',
        f'<type id="side" priority="2" numLanes="1" speed="{side_mps}" width="3.5" {common}/>',
        f'<type id="ring" priority="6" numLanes="1" speed="8.33" width="4.5" {common}/>',
    ]
    return "\n".join(rows)


def draw(seed: int) -> tuple[Net, str, list[str]]:
    """The net of a seed, the kinds of its streets, and options of netconvert."""
    rng = random.Random(seed)
    net = Net(rng, side_mps=rng.choice((8.33, 11.11)))
    kinds = types(rng, net.side_mps)
    columns, rows = rng.choice(((6, 4), (5, 5), (7, 4)))
    apart, moved = rng.uniform(95.0, 170.0), rng.choice((0.0, 0.08, 0.16))
    junctions = rng.choice((("priority",), ("right_before_left",), ("priority", "right_before_left", "traffic_light")))
    hills, phase = rng.choice((0.0, STEEPEST)), rng.uniform(0, 2 * math.pi)
    wave = 2.5 * apart
    height = hills * wave / (2 * math.pi)
    main_rows, main_columns = {rng.randrange(rows)}, {rng.randrange(columns)}

    def name(column: int, row: int) -> str:
        return f"n{column}_{row}"

    inner = [(column, row) for column in range(1, columns - 1) for row in range(1, rows - 1)]
    for column, row in rng.sample(inner, rng.choice((0, 1, 2))):
        net.rings[name(column, row)] = rng.uniform(*RING_M)
    for column in range(columns):
        for row in range(rows):
            here = name(column, row)
            spread = 0.0 if here in net.rings else moved * apart
            x = column * apart + rng.uniform(-spread, spread)
            y = row * apart + rng.uniform(-spread, spread)
            at = (x, y, height * (math.sin(2 * math.pi * x / wave + phase) + math.cos(2 * math.pi * y / wave)) / 2)
            if here in net.rings:
                net.roundabout(here, at)
            else:
                is_main = row in main_rows or column in main_columns
                net.node(here, at, rng.choice(("priority", "traffic_light")) if is_main else rng.choice(junctions))
    for column in range(columns):
        for row in range(rows):
            here = name(column, row)
            for to_column, to_row, is_main in (
                (column + 1, row, row in main_rows),
                (column, row + 1, column in main_columns),
            ):
                if to_column == columns or to_row == rows:
                    continue
                there = name(to_column, to_row)
                on_edge = (row == to_row and row in (0, rows - 1)) or (
                    column == to_column and column in (0, columns - 1)
                )
                kept = is_main or on_edge or here in net.rings or there in net.rings or rng.random() < 0.85
                if kept:
                    net.street(f"{here}_{there}", (here, there), "main" if is_main else "side")
    options = [
        f"--junctions.limit-turn-speed={rng.choice((2.0, 2.0, 3.5))}",
        f"--default.junctions.radius={rng.choice((4, 6))}",
        f"--tls.layout={rng.choice(('incoming', 'opposites'))}",
    ]
    return net, kinds, options


def build(seed: int, directory: Path) -> Path:
    """Write the net of a seed below a directory. Raises `CalledProcessError` where netconvert fails."""
    net, kinds, options = draw(seed)
    out = directory / f"net_{seed}.net.xml"
    files = {"nod": ("nodes", "\n".join(net.nodes)), "edg": ("edges", "\n".join(net.edges)), "typ": ("types", kinds)}
    for suffix, (root, text) in files.items():
        (directory / f"net_{seed}.{suffix}.xml").write_text(f"<{root}>\n{text}\n</{root}>\n", encoding="utf-8")
    named = {"nod": "node-files", "edg": "edge-files", "typ": "type-files"}
    inputs = [f"--{option}={directory / f'net_{seed}.{suffix}.xml'}" for suffix, option in named.items()]
    fixed = [
        "--no-turnarounds",
        "--junctions.corner-detail=5",
        "--junctions.internal-link-detail=20",
        "--crossings.guess",
        "--walkingareas",
        "--tls.default-type=actuated",
        "--tls.green.time=12",
        "--tls.min-dur=6",
        "--tls.max-dur=20",
        "--proj.plain-geo=false",
    ]
    program = str(Path(sumo.SUMO_HOME) / "bin" / "netconvert")
    subprocess.run([program, *inputs, *options, *fixed, "-o", str(out)], check=True)
    for suffix in files:
        (directory / f"net_{seed}.{suffix}.xml").unlink()
    return out


def parser() -> argparse.ArgumentParser:
    """The arguments."""
    known = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    known.add_argument("directory", type=Path, help="where the nets are written; created if it does not exist")
    known.add_argument("first", type=int, nargs="?", default=1, help="first seed (default: %(default)s)")
    known.add_argument("last", type=int, nargs="?", default=12, help="last seed (default: %(default)s)")
    return known


def main(arguments: Sequence[str]) -> None:
    """Write the nets."""
    given = parser().parse_args(arguments)
    given.directory.mkdir(parents=True, exist_ok=True)
    for seed in range(given.first, given.last + 1):
        sys.stdout.write(f"{build(seed, given.directory)}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
