"""`caraware report RUN…`: what runs have reached, with plots and a comparison, as Markdown or as one HTML file."""

from __future__ import annotations

import argparse
import base64
import html
import io
import json
import re
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import markdown
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from caraware import _native
from caraware.report.evaluation import ESTIMATORS
from caraware.report.statistics import mean_interval
from caraware.tasks.metrics import interval_key, mean_key

ROWS = {
    "result": "result",
    "mode": "mode",
    "seed": "seed",
    "configuration (BLAKE3)": "config_hash",
    "observation hash (BLAKE3)": "observation_hash",
    "ticks": "ticks",
    "vehicle-steps": "vehicle_steps",
    "simulated time (s)": "simulated_s",
    "wall time (s)": "wall_s",
    "environment steps": "env_steps",
    "environment steps before the evaluation": "evaluated_at_env_steps",
    "environment steps per second": "env_steps_per_s",
    "simulated seconds per wall second": "real_time_factor",
    "restarts": "restarts",
    "lost ticks": "lost_ticks",
    "dropped messages": "drops",
}
"""Rows of the table of results and their keys in `report.json`."""

COLOURS = ("#1a5276", "#e69f00", "#009e73", "#cc79a7", "#555555", "#56b4e9")
"""Of the curves of runs, in their order; they begin again after the last."""

STYLE = """body { font: 16px/1.5 sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em; color: #222; }
table { border-collapse: collapse; display: block; overflow-x: auto; }
th, td { border-bottom: 1px solid #ccc; padding: 0.2em 0.8em; text-align: left; vertical-align: top; }
img { max-width: 100%; } code { background: #f3f3f3; }"""


class ReportError(Exception):
    """A run has no report, or its report cannot be read."""


@dataclass(frozen=True)
class Curve:
    """Values over environment steps."""

    steps: list[int]
    values: list[float]


class FinishedRun:
    """The results of one run, from the files in its directory."""

    def __init__(self, directory: Path) -> None:
        """Read `report.json` and `config.toml`. Raises `ReportError`."""
        self.directory = directory
        try:
            self.report: dict[str, Any] = json.loads((directory / "report.json").read_text(encoding="utf-8"))
            self.config: dict[str, Any] = tomllib.loads((directory / "config.toml").read_text(encoding="utf-8"))
            self.name = str(self.report["name"])
        except (OSError, ValueError, KeyError) as error:
            raise ReportError(f"{directory}: no report of a run that has ended: {error}") from error
        version = self.report.get("layout_version")
        if version != _native.LAYOUT_VERSION:
            raise ReportError(
                f"{directory}: its layout has version {version}, this program reads {_native.LAYOUT_VERSION}: "
                "use the program that made the run"
            )

    @property
    def settings(self) -> dict[str, str]:
        """Every setting by its key, such as `run.seed`."""
        return {f"{table}.{key}": str(value) for table, keys in self.config.items() for key, value in keys.items()}

    @property
    def estimates(self) -> dict[str, tuple[float, float | None]]:
        """Mean and half the 95 % interval of the task's metric by estimator."""
        metric = str(self.report["metric"])
        found: dict[str, tuple[float, float | None]] = {}
        for name in ESTIMATORS:
            mean = self.report.get(mean_key(name, metric))
            if mean is not None:
                found[name] = (float(mean), self.report.get(interval_key(name, metric)))
        return found

    @cached_property
    def _events(self) -> EventAccumulator:
        events = EventAccumulator(str(self.directory / "tensorboard"), size_guidance={"scalars": 0})
        if (self.directory / "tensorboard").is_dir():
            events.Reload()
        return events

    def curve(self, tag: str) -> Curve | None:
        """The course of a figure of the training; None if the trainer did not record it."""
        if not (self.directory / "tensorboard").is_dir() or tag not in self._events.Tags()["scalars"]:
            return None
        points = self._events.Scalars(tag)
        return Curve([int(point.step) for point in points], [float(point.value) for point in points])


@dataclass(frozen=True)
class Plot:
    """A picture of the document."""

    name: str
    title: str
    png: bytes


def _metric(name: str) -> _native.Metric:
    return next(metric for metric in _native.METRICS if metric.name == name)


def _number(value: object) -> str:
    if value is None:
        return "–"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _cell(text: str) -> str:
    """A text that a table of Markdown shows as it is."""
    return re.sub(r"([\\|`*_\[\]])", r"\\\1", html.escape(text, quote=False))


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(line) + " |" for line in lines]


def _results(runs: Sequence[FinishedRun]) -> list[str]:
    """What every run has reached, a column for each."""
    rows = [
        [label, *(_cell(_number(run.report.get(key))) for run in runs)]
        for label, key in ROWS.items()
        if any(run.report.get(key) is not None for run in runs)
    ]
    for name, label in ESTIMATORS.items():
        if any(name in run.estimates for run in runs):
            rows.append([label, *(_estimate(run, name) for run in runs)])
    return _table(["", *(_cell(run.name) for run in runs)], rows)


def _estimate(run: FinishedRun, name: str) -> str:
    if name not in run.estimates:
        return "–"
    mean, half = run.estimates[name]
    unit = _metric(str(run.report["metric"])).unit
    return f"{mean:.3f} {unit}" if half is None else f"{mean:.3f} ± {half:.3f} {unit}"


def seeds_apart(runs: Sequence[FinishedRun]) -> Iterator[tuple[list[FinishedRun], list[str]]]:
    """Groups of at least two runs that differ in nothing but the seed, each with its lines of a list.

    A line has the mean over the runs of an estimator that all of them have, with the 95 % interval of Student's t.
    """
    groups: dict[str, list[FinishedRun]] = {}
    for run in runs:
        same = {key: value for key, value in run.settings.items() if key != "run.seed"}
        groups.setdefault(json.dumps([run.report["mode"], same], sort_keys=True), []).append(run)
    for group in groups.values():
        if len({run.settings.get("run.seed") for run in group}) < 2:
            continue
        unit, lines = _metric(str(group[0].report["metric"])).unit, []
        for name, label in ESTIMATORS.items():
            if all(name in run.estimates for run in group):
                lines.append(f"- {label}: {mean_interval([run.estimates[name][0] for run in group])} {unit}")
        if lines:
            yield group, lines


def differences(runs: Sequence[FinishedRun]) -> list[list[str]]:
    """The settings in which the runs differ: the key, and the value of each run."""
    keys = sorted({key for run in runs for key in run.settings})
    rows = [[key, *(run.settings.get(key, "–") for run in runs)] for key in keys]
    return [row for row in rows if len(set(row[1:])) > 1]


def plots(runs: Sequence[FinishedRun]) -> list[Plot]:
    """The courses of the task's metric, the reward, the exploration and the speed, all runs in each picture."""
    drawn = []
    for metric in {str(run.report["metric"]): None for run in runs}:
        quantity, unit = metric.rsplit("_", 1)
        spec, of_metric = _metric(metric), [run for run in runs if run.report["metric"] == metric]
        pair = {"training": f"{quantity}/training_{unit}", "evaluation": f"{quantity}/evaluation_{unit}"}
        drawn.append(_plot(quantity, f"{spec.label.capitalize()} of the policy [{spec.unit}]", of_metric, pair))
    for tag, title in (
        ("update/reward_mean", "Mean reward of a sample [-]"),
        ("update/sigma", "Standard deviation of the policy, in actions [-]"),
        ("speed/env_steps_per_s", "Environment steps per second [1/s]"),
    ):
        drawn.append(_plot(tag.rsplit("/", 1)[1], title, runs, {"": tag}))
    return [plot for plot in drawn if plot is not None]


def _plot(name: str, title: str, runs: Sequence[FinishedRun], tags: Mapping[str, str]) -> Plot | None:
    """A picture with the curves of `tags`, by what the legend adds to the name of the run; None without a curve."""
    figure = Figure(figsize=(8, 4), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    is_empty = True
    for place, run in enumerate(runs):
        for number, (added, tag) in enumerate(tags.items()):
            curve = run.curve(tag)
            if curve is None:
                continue
            is_empty = False
            # Evaluations are few points, so they have marks.
            style = {"linestyle": "-", "marker": "o", "markersize": 4} if number else {"alpha": 0.55 if added else 1.0}
            label = f"{run.name}, {added}" if added else run.name
            axes.plot(curve.steps, curve.values, color=COLOURS[place % len(COLOURS)], label=label, **style)
    if is_empty:
        return None
    axes.set_title(title, loc="left", fontweight="bold")
    axes.set_xlabel("environment steps (one vehicle, one tick)")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize=9)
    png = io.BytesIO()
    figure.savefig(png, format="png")
    return Plot(f"{name}.png", title, png.getvalue())


def as_markdown(runs: Sequence[FinishedRun], pictures: Sequence[Plot]) -> str:
    """The document; its pictures are files beside it."""
    lines = [f"# {', '.join(_cell(run.name) for run in runs)}", "", "## Results", "", *_results(runs), ""]
    lines += ["Intervals are of 95 %, over the seeds of the evaluation.", ""]
    groups = list(seeds_apart(runs))
    if groups:
        lines += ["## Over seeds", ""]
    for group, listed in groups:
        names = ", ".join(_cell(run.name) for run in group)
        lines += [f"{len(group)} runs that differ in nothing but the seed ({names}), mean ± 95 %:", "", *listed, ""]
    differing = differences(runs)
    if len(runs) > 1:
        lines += ["## Settings that differ", ""]
        head = ["setting", *(_cell(run.name) for run in runs)]
        rows = [[f"`{row[0]}`", *(_cell(value) for value in row[1:])] for row in differing]
        lines += [*_table(head, rows), ""] if rows else ["None.", ""]
    if pictures:
        lines += ["## Course of the training", ""]
    for plot in pictures:
        lines += [f"![{plot.title}]({plot.name})", ""]
    lines += ["## Processes", ""]
    processes = sorted({name for run in runs for name in run.report["processes"]})
    head = ["processor time (s)", *(_cell(run.name) for run in runs)]
    lines += _table(
        head,
        [[name, *(_number(run.report["processes"].get(name, {}).get("cpu_s")) for run in runs)] for name in processes],
    )
    return "\n".join(lines) + "\n"


def as_html(runs: Sequence[FinishedRun], pictures: Sequence[Plot]) -> str:
    """The document as one file that holds its pictures."""
    body = markdown.markdown(as_markdown(runs, pictures), extensions=["tables"])
    for plot in pictures:
        body = body.replace(f'src="{plot.name}"', f'src="data:image/png;base64,{base64.b64encode(plot.png).decode()}"')
    title = html.escape(", ".join(run.name for run in runs))
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{title}</title>\n'
        f"<style>\n{STYLE}\n</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _directory(argument: Path, runs: Path) -> Path:
    return argument if argument.is_dir() or not (runs / argument).is_dir() else runs / argument


def parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="caraware report",
        description="Writes what runs have reached, with plots and a comparison of several.",
    )
    parser.add_argument("run", nargs="+", type=Path, help="a run's name or directory")
    parser.add_argument("--format", choices=["md", "html"], default="md", help="Markdown and pictures, or one file")
    parser.add_argument("--output", type=Path, help="directory to write to [default: report in the first run's]")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="directory that holds run directories")
    return parser


def main(arguments: Sequence[str]) -> int:
    """Write the document; 2 for input that cannot be used."""
    options = parser().parse_args(arguments)
    try:
        runs = [FinishedRun(_directory(argument, options.runs)) for argument in options.run]
        pictures = plots(runs)
        directory: Path = options.output or runs[0].directory / "report"
        directory.mkdir(parents=True, exist_ok=True)
        path = directory / f"report.{options.format}"
        if options.format == "html":
            path.write_text(as_html(runs, pictures), encoding="utf-8")
        else:
            for plot in pictures:
                (directory / plot.name).write_bytes(plot.png)
            path.write_text(as_markdown(runs, pictures), encoding="utf-8")
    except (ReportError, OSError) as error:
        print(f"caraware report: {error}", file=sys.stderr)
        return 2
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
