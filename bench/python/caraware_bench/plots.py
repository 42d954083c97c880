"""Draws the pictures of `caraware bench`: `python -m caraware_bench.plots DIRECTORY < reports.json`.

The input is a list of reports (`bench/src/report.rs`); every curve becomes `DIRECTORY/<name>.png`.
"""

import json
import sys
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def draw(curve: dict[str, Any], path: Path) -> None:
    """Draw one curve (`name`, `title`, `x`, `y`, `logarithmic`, `lines`) into a PNG file."""
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for line in curve["lines"]:
        x, y = zip(*line["points"], strict=True)
        axes.plot(x, y, marker="o", markersize=4, label=line["name"])
    axes.set(title=curve["title"], xlabel=curve["x"], ylabel=curve["y"])
    for is_logarithmic, scale in zip(curve["logarithmic"], (axes.set_xscale, axes.set_yscale), strict=True):
        scale("log" if is_logarithmic else "linear")
    if not curve["logarithmic"][1]:
        axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    if len(curve["lines"]) > 1:
        axes.legend()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    """Draw every curve of the reports on standard input."""
    directory = Path(sys.argv[1])
    for report in json.load(sys.stdin):
        for curve in report["curves"]:
            path = directory / f"{curve['name']}.png"
            draw(curve, path)
            print(f"wrote {path}", file=sys.stderr)


if __name__ == "__main__":
    main()
