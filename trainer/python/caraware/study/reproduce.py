"""`caraware reproduce TABLE`: measures a table of the docs again; it fails where a figure leaves its interval.

`docs/figures.toml` holds, for each figure, the interval that the docs quote. docs/reproduce.md lists the tables.
"""

import argparse
import math
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from caraware.report.statistics import mean_interval
from caraware.study.tables import TABLES, Measured, Options, StudyError

FIGURES = Path(__file__).parents[4] / "docs" / "figures.toml"


class FiguresError(Exception):
    """The file of expected figures lacks a table or a figure, or an interval in it is none."""


@dataclass(frozen=True)
class ExpectedFigure:
    """A figure as the docs quote it."""

    low: float
    high: float

    def holds(self, value: float) -> bool:
        """Whether a measured mean lies in the interval; not-a-number never does."""
        return self.low <= value <= self.high


def expected_figures(file: Path, table: str) -> dict[str, ExpectedFigure]:
    """The figures of a table by name. Raises `FiguresError`."""
    try:
        entries = tomllib.loads(file.read_text())[table]
    except OSError as error:
        raise FiguresError(f"{file} cannot be read: {error}") from error
    except KeyError as error:
        raise FiguresError(f"{file} has no table [{table}]") from error
    figures: dict[str, ExpectedFigure] = {}
    for name, interval in entries.items():
        ends = [float(end) for end in interval] if isinstance(interval, list) else []
        if len(ends) != 2 or not all(map(math.isfinite, ends)) or ends[0] >= ends[1]:
            raise FiguresError(f"{file}: {table}.{name} = {interval} is not [low, high]")
        figures[name] = ExpectedFigure(*ends)
    return figures


def compare(measured: Measured, expected: Mapping[str, ExpectedFigure]) -> list[str]:
    """Why the table does not hold: a line for each figure that is missing, unknown or outside its interval."""
    wrong = [f"{name} was not measured" for name in expected if name not in measured]
    for name, values in measured.items():
        if name not in expected:
            wrong.append(f"{name} has no interval in the file of figures")
            continue
        mean, figure = mean_interval(values).mean, expected[name]
        if not figure.holds(mean):
            wrong.append(f"{name} is {mean:.3f}, outside {figure.low:g} … {figure.high:g}")
    return wrong


def parser() -> argparse.ArgumentParser:
    """The command line."""
    listed = "\n".join(f"  {name:12} {table.title} ({table.page})" for name, table in TABLES.items())
    parser = argparse.ArgumentParser(
        prog="caraware reproduce",
        description="Measures a table of the docs again; fails where a figure leaves its interval.",
        epilog=f"tables:\n{listed}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("table", choices=list(TABLES), metavar="TABLE", help="one of those below")
    parser.add_argument(
        "--runs",
        type=Path,
        default=Path("runs/reproduce"),
        help="directory of the runs; those there are kept",
    )
    parser.add_argument("--seeds", type=int, default=5, help="whole runs, each with a seed of its own (default 5)")
    parser.add_argument("--figures", type=Path, default=FIGURES, help="the file with the intervals")
    return parser


def main(arguments: Sequence[str]) -> int:
    """0 where every figure lies in its interval, 1 where one does not, 2 for a wrong command."""
    options = parser().parse_args(arguments)
    if options.seeds < 1:
        parser().error("--seeds: give at least 1")
    try:
        expected = expected_figures(options.figures, options.table)
    except FiguresError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        measured = TABLES[options.table].measure(Options(options.runs, range(1, options.seeds + 1)))
    except StudyError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    for name, values in measured.items():
        quoted = expected.get(name)
        interval = f"{quoted.low:g} … {quoted.high:g}" if quoted else "none"
        mean = str(mean_interval(values)) if len(values) > 1 else f"{values[0]:.3f}"
        print(f"{name:36} {mean}   n = {len(values)}   interval {interval}")
    wrong = compare(measured, expected)
    for line in wrong:
        print(f"error: {line}", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
