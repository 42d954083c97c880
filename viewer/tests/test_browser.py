"""The whole chain: a run on the town, `caraware view --web`, and the page in a real browser.

`CARAWARE_SCREENSHOT=docs/images/viewer.png pytest viewer/tests/test_browser.py` makes the README's picture.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
import recordings
from browser import Browser
from numpy.typing import NDArray
from PIL import Image
from ports import free_port

from caraware_viewer import plots, scene, space, static_map, top

ROOT = Path(__file__).parents[2]
COMMAND = ROOT / "target" / "release" / "caraware"
PICTURE = os.environ.get("CARAWARE_SCREENSHOT")
SIZE = (1000, 600)
# Paced, so that the browser's software renderer keeps up and the filter runs. Small batches make the learner update
# after seconds.
SETTINGS = (
    "run.real_time_factor=1.0",
    "lidar.vehicles=4",
    "trainer.horizon=1024",
    "trainer.batch_size=256",
    *(f"fanout.{topic}_hz=2" for topic in ("world", "observation", "prediction", "pointcloud", "status")),
)
PICTURE_LIMIT_S = 300.0

Picture = NDArray[np.uint8]


@contextlib.contextmanager
def started(arguments: list[str], log: Path, environment: dict[str, str]) -> Iterator[subprocess.Popen[bytes]]:
    """Starts a process; at the end it gets SIGINT, and must end."""
    with log.open("wb") as output:
        process = subprocess.Popen(arguments, stdout=output, stderr=output, env=environment, cwd=ROOT)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(180)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            raise


def wait_for_line(log: Path, pattern: str, process: subprocess.Popen[bytes], timeout_s: float) -> str:
    """Waits for a line in the log; returns the first group of the pattern."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        found = re.search(pattern, log.read_text(errors="replace"))
        if found:
            return found[1]
        assert process.poll() is None, log.read_text(errors="replace")
        time.sleep(0.1)
    raise TimeoutError(f"{pattern!r} is not in: {log.read_text(errors='replace')}")


def part(picture: Picture, left: float, right: float, upper: float = 0.08, lower: float = 0.95) -> Picture:
    """A region of the picture, by fractions of its size. The blueprint's columns are as 5 : 3 : 3."""
    height, width, _ = picture.shape
    return picture[int(upper * height) : int(lower * height), int(left * width) : int(right * width)]


def map_of(picture: Picture) -> Picture:
    return part(picture, 0.0, 5 / 11)


def hud_of(picture: Picture) -> Picture:
    return part(picture, 5 / 11, 8 / 11, 0.08, 0.5)


def space_of(picture: Picture) -> Picture:
    return part(picture, 5 / 11, 8 / 11, 0.65, 0.95)


def plots_of(picture: Picture) -> Picture:
    return part(picture, 8 / 11, 1.0)


def of_color(region: Picture, rgb: list[int] | tuple[int, ...], tolerance: int = 20) -> NDArray[np.bool_]:
    """Pixels near a colour."""
    near: NDArray[np.bool_] = (np.abs(region.astype(int) - np.array(rgb)) <= tolerance).all(axis=-1)
    return near


def rgb(rgba: int) -> tuple[int, ...]:
    return tuple((int(rgba) >> shift) & 0xFF for shift in (24, 16, 8))


CAV = rgb(top.KIND_COLORS[0])


def missing(picture: Picture) -> list[str]:
    """What the picture does not show (yet)."""
    seen = {
        "roads": of_color(map_of(picture), static_map.ROAD_COLOR, 5).sum() > 3000,
        "sidewalks": of_color(map_of(picture), static_map.WALK_COLOR, 6).sum() > 500,
        "buildings": of_color(map_of(picture), static_map.BUILDING_COLOR, 6).sum() > 3000,
        "connected vehicles": of_color(map_of(picture), CAV).sum() > 60,
        "GNSS fixes": of_color(map_of(picture), top.GNSS_COLOR).sum() > 20,
        "predictions": of_color(map_of(picture), top.PREDICTION_COLOR).sum() > 20,
        "estimates": of_color(map_of(picture), top.ESTIMATE_COLOR).sum() > 10,
        "text": (hud_of(picture).min(axis=-1) > 170).sum() > 800,
        "vehicles in 3-D": of_color(space_of(picture), CAV, 60).sum() > 30,
        "error of GNSS": of_color(plots_of(picture), top.GNSS_COLOR).sum() > 20,
        "error of the policy": of_color(plots_of(picture), top.PREDICTION_COLOR).sum() > 20,
        "error of the filter": of_color(plots_of(picture), top.ESTIMATE_COLOR).sum() > 10,
        "real-time factor": of_color(plots_of(picture), plots.SERIES[plots.REAL_TIME][1]).sum() > 10,
    }
    return [what for what, there in seen.items() if not there]


def unmoved(before: Picture, after: Picture) -> list[str]:
    """What has not moved between two pictures."""
    moved = {
        "vehicles": (of_color(map_of(before), CAV) ^ of_color(map_of(after), CAV)).sum() > 30,
        "text": (hud_of(before) != hud_of(after)).any(axis=-1).sum() > 20,
        "plots": (plots_of(before) != plots_of(after)).any(axis=-1).sum() > 50,
    }
    return [what for what, has in moved.items() if not has]


def wait_for_picture(browser: Browser, find_missing: Callable[[Picture], list[str]], what: str) -> Picture:
    """Takes pictures until nothing is missing."""
    deadline = time.monotonic() + PICTURE_LIMIT_S
    while True:
        picture = browser.screenshot()
        absent = find_missing(picture)
        if not absent:
            return picture
        if time.monotonic() > deadline:
            path = Path(os.environ.get("TMPDIR", "/tmp")) / "caraware-viewer-failed.png"
            Image.fromarray(picture).save(path)
            pytest.fail(f"{what} after {PICTURE_LIMIT_S:g} s: {', '.join(absent)}; the picture is {path}")
        time.sleep(0.5)


def test_a_browser_shows_the_run_and_it_moves(tmp_path: Path) -> None:
    assert COMMAND.exists(), "run `make build` first"
    environment = os.environ | {
        "CARAWARE_RUNTIME_DIR": f"/tmp/caraware-t{os.getpid()}",
        "CARAWARE_PYTHON": sys.executable,
    }
    settings = [
        part for setting in (*SETTINGS, f"fanout.listen=tcp/127.0.0.1:{free_port()}") for part in ("--set", setting)
    ]
    run = [str(COMMAND), "train", "town", *settings, "--runs", str(tmp_path / "runs")]
    recorded = tmp_path / "run.rrd"
    view = [str(COMMAND), "view", "--web", "--web-port", str(free_port()), "--save", str(recorded), "--lidar", "all"]
    with started(run, tmp_path / "run.log", environment) as running:
        wait_for_line(tmp_path / "run.log", r"(error \d)", running, 300)
        with started(view, tmp_path / "view.log", environment) as viewing:
            url = wait_for_line(tmp_path / "view.log", r"open (http://\S+) in a browser", viewing, 120)
            with Browser(*SIZE) as browser:
                browser.open(f"{url}?renderer=webgl")
                browser.wait_for("window._handle !== undefined", 180)
                first = wait_for_picture(browser, missing, "not in the picture")
                second = wait_for_picture(
                    browser, lambda picture: missing(picture) + unmoved(first, picture), "not moving"
                )
                hosts = {urlsplit(address).hostname for address in browser.requests}
            assert viewing.poll() is None
        assert viewing.returncode == 130, (tmp_path / "view.log").read_text()
        assert running.poll() is None, "the run ended with its viewer"
    assert hosts <= {"127.0.0.1", None}, "the page sent requests to other hosts"
    if PICTURE:
        Image.fromarray(second).quantize(192, dither=Image.Dither.NONE).save(ROOT / PICTURE, optimize=True)
    check_recording(recorded)


def check_recording(path: Path) -> None:
    """The recording of the same run has data of every entity, over simulated time."""
    found = recordings.read(path)
    figures = [
        plots.POLICY_ERROR,
        plots.EKF_ERROR,
        plots.GNSS_ERROR,
        plots.STD,
        plots.REWARD,
        plots.STEPS,
        plots.REAL_TIME,
    ]
    drawn = [
        top.OUTLINES,
        top.NAMES,
        top.GNSS,
        top.PREDICTIONS,
        top.SIGNALS,
        top.CLOUD,
        top.RING,
        space.CLOUD,
        space.VEHICLES,
    ]
    for entity in (*figures, *drawn, scene.HUD):
        assert len({at for at, _ in found[entity].rows if at > 0}) >= 2, entity
    for entity in (
        static_map.ROADS,
        static_map.MARKINGS,
        static_map.CROSSINGS,
        static_map.BUILDINGS,
        static_map.SPACE_BUILDINGS,
    ):
        assert found[entity].rows[0][0] == recordings.ALWAYS, entity
    factor = [row["Scalars:scalars"][0] for _, row in found[plots.REAL_TIME].rows if "Scalars:scalars" in row]
    assert 0.5 < np.median(factor) < 1.5
