"""`caraware report`: its figures are those of the runs' own files, and its HTML stands alone."""

from __future__ import annotations

import base64
import io
import json
import math
import re
import subprocess
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest
from caraware.report.document import FinishedRun, differences, seeds_apart
from caraware.run.checkpoint import load_history
from PIL import Image
from recorded_run import CARAWARE, TRAINED, recorded_run


class Page(HTMLParser):
    """The pictures and the cells of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.rows: list[list[str]] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag == "img":
            self.sources.append(str(dict(attrs)["src"]))
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_data(self, data: str) -> None:
        if self.rows and self.rows[-1] and data.strip():
            self.rows[-1][-1] += data


@pytest.fixture(scope="module")
def run_dirs(trained_run: Path) -> Iterator[list[Path]]:
    with recorded_run("train", TRAINED | {"run.seed": 4}, name="other") as other:
        yield [trained_run, other]


def _report(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([CARAWARE, "report", *arguments], capture_output=True, text=True, timeout=300)


def test_the_markdown_has_the_figures_of_both_reports(run_dirs: list[Path], tmp_path: Path) -> None:
    ran = _report(*run_dirs, "--output", tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.strip() == str(tmp_path / "report.md")
    text = (tmp_path / "report.md").read_text()
    reports = [json.loads((directory / "report.json").read_text()) for directory in run_dirs]
    for report in reports:
        assert report["observation_hash"] in text and report["name"].replace("_", r"\_") in text
        assert f"{report['ppo_mean_error_m']:.3f} ± {report['ppo_ci95_m']:.3f} m" in text
    # The mean over two seeds, and the interval of Student's t with one degree of freedom.
    first, second = (report["ekf_mean_error_m"] for report in reports)
    half = 12.7062 * abs(first - second) / 2
    assert f"- EKF: {(first + second) / 2:.3f} ± {half:.3f} m" in text
    assert re.search(r"^\| `run.seed` \| 3 \| 4 \|$", text, re.MULTILINE)
    pictures = re.findall(r"\]\((\w+\.png)\)", text)
    assert pictures == ["error.png", "reward_mean.png", "sigma.png", "env_steps_per_s.png"]
    for picture in pictures:
        assert Image.open(tmp_path / picture).size == (960, 480)


def test_the_html_stands_alone(run_dirs: list[Path], tmp_path: Path) -> None:
    ran = _report(run_dirs[0], "--format", "html", "--output", tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    page = Page()
    page.feed((tmp_path / "report.html").read_text())
    assert len(page.sources) == 4 and not {"script", "link"} & set(page.tags)
    for source in page.sources:
        assert Image.open(io.BytesIO(base64.b64decode(source.removeprefix("data:image/png;base64,")))).format == "PNG"
    report = json.loads((run_dirs[0] / "report.json").read_text())
    cells = dict(row for row in page.rows if len(row) == 2)
    assert cells["seed"] == "3" and cells["result"] == "completed" and cells["ticks"] == str(report["ticks"])
    assert float(cells["sim-core"]) == pytest.approx(report["processes"]["sim-core"]["cpu_s"], rel=1e-4)


def test_curves_are_those_that_the_trainer_kept(run_dirs: list[Path]) -> None:
    run = FinishedRun(run_dirs[0])
    history = load_history(Path(run.report["checkpoint"]))
    assert len(history.training) > 1
    training, sigma = run.curve("error/training_m"), run.curve("update/sigma")
    assert training is not None and sigma is not None and run.curve("nothing") is None
    assert training.steps == [point.env_steps for point in history.training]
    assert training.values == pytest.approx([point.metrics["error_m"] for point in history.training], rel=1e-6)
    assert sigma.values == pytest.approx([point.sigma for point in history.training], rel=1e-6)


def test_runs_are_compared_by_what_they_differ_in(run_dirs: list[Path]) -> None:
    runs = [FinishedRun(directory) for directory in run_dirs]
    assert differences(runs) == [["run.seed", "3", "4"]]
    ((group, lines),) = seeds_apart(runs)
    assert [run.name for run in group] == ["a.run_3", "other"] and len(lines) >= 4
    # A run with another setting is of no group, and neither is a second one of the same seed.
    runs[1].config["trainer"]["learning_rate"] *= 2
    assert [row[0] for row in differences(runs)] == ["run.seed", "trainer.learning_rate"]
    assert list(seeds_apart(runs)) == [] and list(seeds_apart([runs[0], runs[0]])) == []
    assert all(math.isfinite(mean) for mean, _ in runs[0].estimates.values())


def test_a_directory_of_another_layout_is_refused_with_both_versions(run_dirs: list[Path], tmp_path: Path) -> None:
    for name in ("report.json", "config.toml"):
        (tmp_path / name).write_text((run_dirs[0] / name).read_text())
    report = json.loads((tmp_path / "report.json").read_text())
    (tmp_path / "report.json").write_text(json.dumps(report | {"layout_version": 999}))
    ran = _report(tmp_path)
    assert ran.returncode == 2, ran.stderr
    assert "version 999" in ran.stderr and f"reads {report['layout_version']}" in ran.stderr


def test_a_directory_without_a_report_is_refused(tmp_path: Path) -> None:
    ran = _report(tmp_path)
    assert ran.returncode == 2 and str(tmp_path) in ran.stderr and "Traceback" not in ran.stderr
