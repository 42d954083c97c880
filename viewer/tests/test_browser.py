"""The whole chain: a run on the town, `caraware view --web`, and the page in a real browser.

`CARAWARE_SCREENSHOT=docs/images/viewer.png pytest viewer/tests/test_browser.py -k train` makes the README's picture,
and with `CARAWARE_SCREENSHOT_MODE` that of another mode, or of `sights`, `planes` or `messages`.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
import recordings
from browser import Browser
from numpy.typing import NDArray
from PIL import Image
from ports import free_port

from caraware_viewer import course, messages, plots, scene, sights, space, static_map, top, views

ROOT = Path(__file__).parents[2]
COMMAND = ROOT / "target" / "release" / "caraware"
PICTURE = os.environ.get("CARAWARE_SCREENSHOT")
PICTURE_MODE = os.environ.get("CARAWARE_SCREENSHOT_MODE", "train")
SIZE = (1500, 900) if PICTURE else (1000, 640)
"""Of the window: a picture for the documentation is as large as users' windows, a small one is drawn sooner."""
# Paced, so that the browser's software renderer keeps up and the filter runs. Small batches make the learner update
# after seconds.
SETTINGS = (
    "run.real_time_factor=1.0",
    "trainer.horizon=512",
    "trainer.batch_size=128",
    *(f"fanout.{topic}_hz=1" for topic in ("world", "observation", "prediction", "pointcloud", "status")),
)
PICTURE_LIMIT_S = 400.0

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


@dataclass(frozen=True)
class Mode:
    """A mode of a run, how it is started, and what its picture must show."""

    name: str
    arguments: tuple[str, ...]
    plots: tuple[str, ...]
    """Roots of the plots, from top to bottom."""
    positions: tuple[list[int], ...]
    """Colours of the positions in the top view."""


MODES = (
    Mode(
        "train",
        ("train", "town", "--set", "lidar.vehicles=4"),
        ("learning/m", "learning/reward", "learning/sigma", plots.ERRORS, plots.STEPS),
        (top.GNSS_COLOR, top.PREDICTION_COLOR, top.ESTIMATE_COLOR),
    ),
    Mode(
        "drive",
        ("train", "driving", "--set", "collision.detect=true"),
        ("learning/ends", "learning/mps", "learning/m", "learning/reward", plots.SPEED),
        (top.GNSS_COLOR, top.ROUTE_COLOR),
    ),
    Mode(
        "simulate",
        ("simulate", "town"),
        (plots.SPEED, plots.ERRORS, plots.ROAD_USERS, plots.REAL_TIME),
        (top.GNSS_COLOR,),
    ),
    Mode(
        "play",
        ("play", "town-1"),
        (plots.SPEED, plots.ERRORS, plots.ROAD_USERS, plots.REAL_TIME),
        (top.GNSS_COLOR, top.PREDICTION_COLOR),
    ),
)


def part(picture: Picture, left: float, right: float, upper: float = 0.08, lower: float = 0.95) -> Picture:
    """A region of the picture, by fractions of its size. The blueprint's columns are as 5 : 3.4 : 2.6."""
    height, width, _ = picture.shape
    return picture[int(upper * height) : int(lower * height), int(left * width) : int(right * width)]


def map_of(picture: Picture) -> Picture:
    return part(picture, 0.0, 5 / 11, 0.06, 0.86)


def legend_of(picture: Picture) -> Picture:
    return part(picture, 0.0, 5 / 11, 0.85, 1.0)


def hud_of(picture: Picture) -> Picture:
    return part(picture, 5 / 11, 8.4 / 11, 0.06, 0.43)


def space_of(picture: Picture) -> Picture:
    return part(picture, 5 / 11, 8.4 / 11, 0.52, 0.95)


def plots_of(picture: Picture) -> Picture:
    return part(picture, 8.4 / 11, 1.0)


def of_color(region: Picture, rgb: Sequence[int], tolerance: int = 20) -> NDArray[np.bool_]:
    """Pixels near a colour."""
    near: NDArray[np.bool_] = (np.abs(region.astype(int) - np.array(rgb)) <= tolerance).all(axis=-1)
    return near


def rgb(rgba: int) -> tuple[int, ...]:
    return tuple((int(rgba) >> shift) & 0xFF for shift in (24, 16, 8))


CAV, HERO = rgb(top.KIND_COLORS[0]), rgb(top.KIND_COLORS[3])
SERIES = {path: color for path, (_, color) in plots.SERIES.items()} | {
    course.training_path(name): course.COLORS[name] for name in course.COLORS if "_" in name or name in course.UNITLESS
}
SERIES |= {course.end_path(name): course.COLORS[name] for name in ("arrival", "collision", "off_road", "red_light")}


def drawn_in(region: Picture, root: str) -> int:
    """Pixels of the curves of a plot."""
    colors = [color for path, color in SERIES.items() if path == root or path.startswith(root + "/")]
    return sum(int(of_color(region, color).sum()) for color in colors)


def missing(picture: Picture, mode: Mode) -> list[str]:
    """What the picture does not show (yet)."""
    users = HERO if mode.name == "drive" else CAV
    seen = {
        "roads": of_color(map_of(picture), static_map.ROAD_COLOR, 5).sum() > 3000,
        "sidewalks": of_color(map_of(picture), static_map.WALK_COLOR, 6).sum() > 500,
        "buildings": of_color(map_of(picture), static_map.BUILDING_COLOR, 6).sum() > 3000,
        "vehicles": of_color(map_of(picture), users).sum() > 60,
        "scale": of_color(map_of(picture), static_map.SCALE_COLOR, 8).sum() > 50,
        "legend": all(of_color(legend_of(picture), color).sum() > 10 for color in (CAV, HERO, top.GNSS_COLOR)),
        "text": (hud_of(picture).min(axis=-1) > 170).sum() > 800,
        "vehicles in 3-D": of_color(space_of(picture), users, 60).sum() > 30,
        "solid ground in 3-D": of_color(space_of(picture), static_map.GROUND_COLOR, 5).sum() > 2000,
        "roads in 3-D": of_color(space_of(picture), static_map.ROAD_COLOR, 5).sum() > 500,
        "walks in 3-D": of_color(space_of(picture), static_map.WALK_COLOR, 5).sum() > 50,
    }
    for color in mode.positions:
        seen[f"positions of colour {color}"] = of_color(map_of(picture), color).sum() > 10
    height = picture.shape[0]
    edges = np.linspace(PLOTS_TOP_PX, height - PLOTS_BOTTOM_PX, len(mode.plots) + 1).astype(int)
    column = picture[:, int(8.4 / 11 * picture.shape[1]) :]
    for root, upper, lower in zip(mode.plots, edges[:-1], edges[1:], strict=True):
        # Below the title, and right of the legend.
        seen[f"curves of {root}"] = drawn_in(column[upper + 28 : lower, 20:], root) > 20
    return [what for what, there in seen.items() if not there]


PLOTS_TOP_PX, PLOTS_BOTTOM_PX = 0, 28
"""rerun's bars above and below the views."""


def unmoved(before: Picture, after: Picture, mode: Mode) -> list[str]:
    """What has not moved between two pictures."""
    users = HERO if mode.name == "drive" else CAV
    moved = {
        "vehicles": (of_color(map_of(before), users) ^ of_color(map_of(after), users)).sum() > 30,
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


def wait_for_view(view: list[str], log: Path, find_missing: Callable[[Picture], list[str]], name: str) -> None:
    """Starts a viewer, opens its page and waits until nothing is missing in it; `name` is that of its picture."""
    with started(view, log, environment()) as viewing:
        url = wait_for_line(log, r"open (http://\S+) in a browser", viewing, 120)
        with Browser(*SIZE) as browser:
            browser.open(f"{url}?renderer=webgl")
            browser.wait_for("window._handle !== undefined", 180)
            picture = wait_for_picture(browser, find_missing, "not in the picture")
    assert viewing.returncode == 130, log.read_text()
    keep_picture(picture, name)


def keep_picture(picture: Picture, name: str) -> None:
    """Writes the picture where `CARAWARE_SCREENSHOT` says, if it is the one that is asked for."""
    if PICTURE and name == PICTURE_MODE:
        Image.fromarray(picture).quantize(192, dither=Image.Dither.NONE).save(ROOT / PICTURE, optimize=True)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the runs are; it has the run `town-1`, of which a policy can be played."""
    assert COMMAND.exists(), "run `make build` first"
    directory = tmp_path_factory.mktemp("runs")
    settings = [
        "episode.ticks=40",
        "episode.training_episodes=1",
        "episode.final_evaluations=1",
        "episode.evaluation_ticks=20",
        "trainer.horizon=512",
        "trainer.batch_size=128",
        f"fanout.listen=tcp/127.0.0.1:{free_port()}",
    ]
    arguments = [str(COMMAND), "train", "town", "--name", "town-1", "--runs", str(directory)]
    arguments += [part for setting in settings for part in ("--set", setting)]
    subprocess.run(arguments, env=environment(), cwd=ROOT, check=True, timeout=600, stdout=subprocess.DEVNULL)
    return directory


def environment() -> dict[str, str]:
    return os.environ | {"CARAWARE_RUNTIME_DIR": f"/tmp/caraware-t{os.getpid()}", "CARAWARE_PYTHON": sys.executable}


@pytest.mark.parametrize("mode", MODES, ids=[mode.name for mode in MODES])
def test_a_browser_shows_every_panel_of_a_mode_and_it_moves(mode: Mode, runs: Path, tmp_path: Path) -> None:
    settings = [
        part for setting in (*SETTINGS, f"fanout.listen=tcp/127.0.0.1:{free_port()}") for part in ("--set", setting)
    ]
    run = [str(COMMAND), *mode.arguments, *settings, "--runs", str(runs)]
    recorded = tmp_path / "run.rrd"
    view = [str(COMMAND), "view", "--web", "--web-port", str(free_port()), "--save", str(recorded), "--lidar", "all"]
    with started(run, tmp_path / "run.log", environment()) as running:
        wait_for_line(tmp_path / "run.log", READY[mode.name], running, 300)
        with started(view, tmp_path / "view.log", environment()) as viewing:
            url = wait_for_line(tmp_path / "view.log", r"open (http://\S+) in a browser", viewing, 120)
            with Browser(*SIZE) as browser:
                browser.open(f"{url}?renderer=webgl")
                browser.wait_for("window._handle !== undefined", 180)
                first = wait_for_picture(browser, lambda picture: missing(picture, mode), "not in the picture")
                second = wait_for_picture(
                    browser,
                    lambda picture: missing(picture, mode) + unmoved(first, picture, mode),
                    "not moving",
                )
                hosts = {urlsplit(address).hostname for address in browser.requests}
            assert viewing.poll() is None
        assert viewing.returncode == 130, (tmp_path / "view.log").read_text()
        assert running.poll() is None, "the run ended with its viewer"
    assert hosts <= {"127.0.0.1", None}, "the page sent requests to other hosts"
    keep_picture(second, mode.name)
    if mode.name == "train":
        check_recording(recorded)
        # A saved run looks as it did live, with a time line below.
        view = [str(COMMAND), "view", str(recorded), "--web", "--web-port", str(free_port())]
        wait_for_view(view, tmp_path / "saved.log", lambda picture: missing(picture, mode), "saved")


TITLES = {
    mode.name: [plot.title for plot in views.PLOTS if plot.path in mode.plots and mode.name in plot.modes]
    for mode in MODES
}
"""Titles of the plots of a mode."""
READY = {"train": r"(error \d)", "drive": r"(progress \d)", "simulate": r"(sensing)", "play": r"(policy \d)"}
"""What the progress line shows once a picture can be whole."""


def check_recording(path: Path) -> None:
    """The recording of the same run has data of every entity, over simulated time."""
    found = recordings.read(path)
    figures = [
        plots.POLICY_ERROR,
        plots.EKF_ERROR,
        plots.GNSS_ERROR,
        course.REWARD,
        course.SIGMA,
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
        static_map.SPACE_GROUND,
        static_map.SPACE_ROADS,
        static_map.SPACE_BUILDINGS,
    ):
        assert found[entity].rows[0][0] == recordings.ALWAYS, entity
    arranged = recordings.layouts(path)
    names = {name for value in arranged["ViewBlueprint:display_name"] for name in value}
    assert names >= {"Top view", "Run and vehicle", "Around the followed vehicle", *TITLES["train"]}
    # One theme: every view of the opened file has the background that the page has.
    backgrounds = {
        color for kind in ("Background", "PlotBackground") for value in arranged[f"{kind}:color"] for color in value
    }
    assert backgrounds == {top.rgba(views.BACKGROUND)}
    factor = [row["Scalars:scalars"][0] for _, row in found[plots.REAL_TIME].rows if "Scalars:scalars" in row]
    assert 0.5 < np.median(factor) < 1.5


def cameras_of(picture: Picture) -> Picture:
    """The column of images. With it the blueprint's columns are as 5 : 3.4 : 2.6 : 2.6."""
    return part(picture, 8.4 / 13.6, 11 / 13.6)


def without_sights(picture: Picture) -> list[str]:
    """What the picture does not show of a camera."""
    shown = cameras_of(picture)[~of_color(cameras_of(picture), views.BACKGROUND, 12)]
    seen = {
        "an image": len(shown) > 8_000,
        "colours of an image": len(np.unique(shown // 32, axis=0)) > 8,
        "3-D view beside it": (part(picture, 5 / 13.6, 8.4 / 13.6, 0.52, 0.95).std(axis=(0, 1)) > 5).any(),
    }
    return [what for what, there in seen.items() if not there]


def test_a_browser_shows_what_the_sensors_of_the_followed_vehicle_see(runs: Path, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    settings = ("suite=paper:4", "fanout.image_hz=2", "fanout.radar_hz=2", f"fanout.listen={endpoint}", *SETTINGS)
    run = [str(COMMAND), "simulate", "town", *(part for setting in settings for part in ("--set", setting))]
    recorded = tmp_path / "run.rrd"
    view = [str(COMMAND), "view", endpoint, "--web", "--web-port", str(free_port()), "--save", str(recorded)]
    with started([*run, "--runs", str(runs)], tmp_path / "run.log", environment()) as running:
        wait_for_line(tmp_path / "run.log", READY["simulate"], running, 300)
        refused = subprocess.run(
            [str(COMMAND), "view", endpoint, "--save", str(tmp_path / "none.rrd"), "--camera", "cav.0@rear"],
            env=environment(),
            capture_output=True,
            text=True,
            timeout=120,
        )
        assert refused.returncode == 1, refused.stderr
        assert "--camera cav.0@rear: there is no such camera; names behind the id: @camera" in refused.stderr
        wait_for_view(view, tmp_path / "view.log", without_sights, "sights")
    found = recordings.read(recorded)
    images = [row["Image:format"][0] for _, row in found[f"{sights.OF_FOLLOWED}/image"].rows if row.get("Image:format")]
    assert {(image["width"], image["height"]) for image in images} == {(84, 84)} and len(images) >= 2
    assert found[f"{sights.OF_FOLLOWED}/boxes"].rows
    detected = [row["Points3D:positions"] for _, row in found[space.RADAR].rows if row.get("Points3D:positions")]
    assert detected and np.isfinite(np.array(detected[-1])).all()
    names = {name for value in recordings.layouts(recorded)["ViewBlueprint:display_name"] for name in value}
    assert "Camera of the followed vehicle" in names


EYES = """
[[suite]]
name = "eyes"
first = 2

[[suite.sensor]]
kind = "camera"
name = "heat"
infrared = true
width = 160
height = 96
rgb = false
semantic = false

[[suite.sensor]]
kind = "camera"
name = "motion"
flow = true
width = 160
height = 96
rgb = false
semantic = false
depth = false
binary = false

[[suite.sensor]]
kind = "camera"
name = "events"
events = true
width = 160
height = 96
rgb = true
"""


def without_planes(picture: Picture) -> list[str]:
    """What the picture does not show of temperatures, motion and events, which are in this order one below another."""
    column = cameras_of(picture)
    heat, motion, events = (third[~of_color(third, views.BACKGROUND, 12)] for third in np.array_split(column, 3))
    spread = motion.max(axis=-1).astype(int) - motion.min(axis=-1)
    seen = {
        "greys of temperatures": (np.ptp(heat.astype(int), axis=-1) <= 8).sum() > 4_000,
        "several temperatures": len(np.unique(heat[np.ptp(heat.astype(int), axis=-1) <= 8] // 16, axis=0)) >= 5,
        "colours of motion": (spread > 60).sum() > 300,
        "brighter pixels": of_color(events, (255, 40, 40), 60).sum() > 5,
        "darker pixels": of_color(events, (60, 90, 255), 60).sum() > 5,
    }
    return [what for what, there in seen.items() if not there]


def test_a_browser_shows_temperatures_motion_and_events(runs: Path, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = tmp_path / "eyes.toml"
    config.write_text(EYES, encoding="utf-8")
    settings = ("weather.sunlight=1.0", "fanout.image_hz=2", f"fanout.listen={endpoint}", *SETTINGS)
    run = [str(COMMAND), "simulate", str(config), *(part for setting in settings for part in ("--set", setting))]
    view = [str(COMMAND), "view", endpoint, "--web", "--web-port", str(free_port())]
    view += [part for name in ("heat", "motion", "events") for part in ("--camera", f"cav.0@{name}")]
    with started([*run, "--runs", str(runs)], tmp_path / "run.log", environment()) as running:
        wait_for_line(tmp_path / "run.log", READY["simulate"], running, 300)
        wait_for_view(view, tmp_path / "view.log", without_planes, "planes")


def without_messages(picture: Picture) -> list[str]:
    """What the picture does not show of messages."""
    cam, cpm = (rgb(int(messages.SOURCE_COLORS[source])) for source in (1, 2))
    seen = {
        "objects known by CAM": of_color(map_of(picture), cam).sum() > 20,
        "objects known by CPM": of_color(map_of(picture), cpm).sum() > 5,
        "stations that have just sent": of_color(map_of(picture), messages.SENDER_COLOR, 40).sum() > 20,
        "known objects in 3-D": of_color(space_of(picture), cam, 40).sum() > 20,
        "the legend of messages": of_color(legend_of(picture), cam).sum() > 5,
    }
    return [what for what, there in seen.items() if not there]


def test_a_browser_shows_what_a_vehicle_knows_from_messages(runs: Path, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    settings = ("v2x.share=0.7", "v2x.perception_range_m=50.0", f"fanout.listen={endpoint}", *SETTINGS)
    run = [str(COMMAND), "simulate", "town", *(part for setting in settings for part in ("--set", setting))]
    view = [str(COMMAND), "view", endpoint, "--web", "--web-port", str(free_port()), "--messages"]
    with started([*run, "--runs", str(runs)], tmp_path / "run.log", environment()) as running:
        wait_for_line(tmp_path / "run.log", READY["simulate"], running, 300)
        wait_for_view(view, tmp_path / "view.log", without_messages, "messages")
