"""Measures the viewer with a crowd on loopback: frames drawn per second, their age, and memory over time.

.venv/bin/python viewer/tests/measure_crowd.py --vehicles 10000 --seconds 1800

A publisher stands in for `fanout` at its default rates, with frames of the length that `fanout` sends for so many
vehicles: of more than fit into a frame, the same ones in every tick. `--city` measures a real run instead: a generated
city, simulated in real time, all its vehicles sensing.

`--browser` opens the page in a headless Chromium, which draws in software, or by a graphics card with
`--renderer vulkan`. It counts the pictures that differ from the one before. Those of the publisher hold the number of
their tick, as a row of dots above the map, so that their age is known when they are on the screen.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import struct
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import frames
import numpy as np
import zenoh
from browser import RENDERERS, Browser, DrawnFrame
from numpy.typing import NDArray
from ports import free_port

from caraware_viewer import memory
from caraware_viewer.link import RunKey

ROOT = Path(__file__).parents[2]
CARAWARE = ROOT / "target" / "release" / "caraware"
RUN = RunKey("crowd", 0)
MAX_ROWS, MAX_SLOTS = 5920, 2300
"""Rows of `world` and slots of `observation` (9 fields, 10 samples of the IMU) that fit into a frame."""
SIDE_M, SPACING_M = 5000.0, 250.0
RATE_HZ, STATUS_TICKS = 10.0, 5

CODE_BITS = 15
CODE_X_M = np.linspace(0.1 * SIDE_M, 0.9 * SIDE_M, CODE_BITS + 2)
"""Places of the dots that hold a tick: the first and the last are always there, between them one for each bit."""
CODE_Y_M = 1.012 * SIDE_M
RENDERER = """
(() => {
  const gl = document.createElement("canvas").getContext("webgl");
  return gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info").UNMASKED_RENDERER_WEBGL);
})()
"""
"""The name of what draws."""
TITLE_PX, DARK = 30, 105
"""Height of the bars above the map, and the brightness that dots have and roads have not."""


def code_points_m(tick: int) -> NDArray[np.float64]:
    """Positions `[CODE_BITS + 2, 2]` of the road users that hold a tick: a bit that is 0 stands on the first dot."""
    is_set = [True, *(bool(tick >> bit & 1) for bit in range(CODE_BITS)), True]
    return np.column_stack([np.where(is_set, CODE_X_M, CODE_X_M[0]), np.full(CODE_BITS + 2, CODE_Y_M)])


def tick_in(picture: NDArray[np.uint8]) -> int | None:
    """The tick that a picture `[height, width, 3]` holds; None if it has no whole row of dots (yet)."""
    height, width, _ = picture.shape
    bright = picture[TITLE_PX : height // 2, : int(5 / 11 * width)].astype(int) @ [299, 587, 114] > 1000 * DARK
    for row in np.flatnonzero(bright.any(axis=1)):
        columns = np.flatnonzero(bright[row : row + 4].any(axis=0))
        if columns[-1] - columns[0] < 0.5 * bright.shape[1]:
            continue
        # A dot has three pixels, so the first and the last column are one beside a middle.
        middles = np.linspace(columns[0] + 1, columns[-1] - 1, CODE_BITS + 2)[1:-1]
        is_set = np.abs(middles[:, None] - columns[None, :]).min(axis=1) < 1.6
        return int(sum(1 << bit for bit in np.flatnonzero(is_set)))
    return None


def grid_map() -> dict[str, object]:
    """A city of straight roads with a building in each block."""
    lines = np.arange(0.0, SIDE_M + 1, SPACING_M)
    both = [[[at, 0, 0], [at, SIDE_M, 0]] for at in lines] + [[[0, at, 0], [SIDE_M, at, 0]] for at in lines]
    common = {"kind": "car", "inside": False, "width_m": 6.4, "right": "solid", "left": "solid"}
    lanes = [{"id": str(i), "points_m": points} | common for i, points in enumerate(both)]
    square = np.array([[40, 40], [210, 40], [210, 210], [40, 210]])
    corners = [(square + np.array([x, y])).tolist() for x in lines[:-1] for y in lines[:-1]]
    buildings = [{"points_m": points, "base_m": 0.0, "height_m": 12.0} for points in corners]
    scene = {"lanes": lanes, "areas": [], "buildings": buildings, "obstacles": [], "signals": []}
    bounds = {"bounds_m": [0.0, 0.0, SIDE_M, SIDE_M]}
    return {"run": RUN.run, "mode": "train", "tick_s": 0.1, "map": bounds, "scene": scene}


def publish(port: int, vehicles: int, stop: float) -> None:
    """Publishes ticks at `RATE_HZ` until the time `stop`, or until a signal. Its first line is the time of tick 0."""
    config = zenoh.Config()
    for key, value in {
        "mode": "peer",
        "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    session = zenoh.open(config)
    key, document = f"{RUN.prefix}/map", json.dumps(grid_map())
    queryable = session.declare_queryable(key, lambda query: query.reply(key, document))
    token = session.liveliness().declare_token(f"{RUN.prefix}/alive")
    random = np.random.default_rng(1)
    rows, slots = min(vehicles, MAX_ROWS), min(vehicles, MAX_SLOTS)
    along, road = random.uniform(0, SIDE_M, rows), SPACING_M * random.integers(0, int(SIDE_M / SPACING_M), rows)
    ids = random.integers(1, 2**62, rows).astype(np.uint64)
    kinds = np.zeros(rows)
    code = slice(rows - CODE_BITS - 2, rows)
    kinds[code] = 1
    begun = time.time()
    print(begun, flush=True)
    tick = 0
    while time.time() < stop:
        at_m = np.column_stack([(along + 1.2 * tick) % SIDE_M, road])
        truth = at_m[:slots].astype(np.float32)
        at_m[code] = code_points_m(tick)
        sent = {"world": frames.world(tick, rows, kind=kinds, id_hash=ids, x_m=at_m[:, 0], y_m=at_m[:, 1])}
        fixes = truth + random.normal(0, 5, truth.shape)
        sent["observation"] = frames.observation(tick, truth, fixes, id_hash=ids[:slots])
        sent["prediction"] = frames.prediction(tick, truth + 1)
        if tick % STATUS_TICKS == 0:
            users = {"cav": rows, "other": 0, "person": 0, "hero": 0}
            sent["status"] = json.dumps({"tick": tick, "real_time_factor": 1.0, "road_users": users}).encode()
        for topic, payload in sent.items():
            sequence = tick // STATUS_TICKS if topic == "status" else tick
            session.put(f"{RUN.prefix}/{topic}", payload, attachment=struct.pack("<QQ", sequence, time.time_ns()))
        tick += 1
        time.sleep(max(0.0, begun + tick / RATE_HZ - time.time()))
    queryable.undeclare()
    token.undeclare()
    session.close()


def descendants(pid: int) -> Iterator[int]:
    """Processes that a process has started, and theirs."""
    for entry in Path("/proc").iterdir():
        try:
            parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
        except (OSError, ValueError, IndexError):
            continue
        if parent == pid:
            yield int(entry.name)
            yield from descendants(int(entry.name))


def sample(viewer: int, browser: Browser | None, at_s: float) -> dict[str, float]:
    """Memory of each process, MB."""
    server = max((memory.resident_mb(pid) for pid in descendants(viewer)), default=float("nan"))
    row: dict[str, float] = {
        "s": round(at_s),
        "viewer_mb": round(memory.resident_mb(viewer)),
        "server_mb": round(server),
    }
    if browser is not None:
        pages = [memory.resident_mb(pid) for pid in descendants(browser.pid)]
        row["page_mb"] = round(max(pages, default=float("nan")))
    return row


def drawn_figures(drawn: list[DrawnFrame], seconds: float, first_tick_s: float) -> dict[str, float]:
    """Pictures per second, and the ages of the ticks that they hold: none if `first_tick_s` is not-a-number."""
    has_code = np.isfinite(first_tick_s)
    ticks = [(frame.at_s, tick) for frame in drawn if has_code and (tick := tick_in(frame.picture())) is not None]
    ages_ms = [1e3 * (at_s - first_tick_s - tick / RATE_HZ) for at_s, tick in ticks]
    row = {"drawn_per_s": round(len(drawn) / seconds, 2)}
    if ages_ms:
        row["ticks_per_s"] = round(len({tick for _, tick in ticks}) / seconds, 2)
        row["age_ms"], row["age_95_ms"] = round(np.median(ages_ms)), round(np.quantile(ages_ms, 0.95))
    return row


def stand_in_for_a_browser(url: str, seconds: float) -> None:
    """Reports the pace of a fast page: without an open page the viewer draws a tick every five seconds."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        urllib.request.urlopen(urllib.request.Request(f"{url}pace", b"0.016", method="POST"), timeout=60).close()
        time.sleep(1.0)


def publisher(port: int, vehicles: int, seconds: float) -> subprocess.Popen[str]:
    """A process that publishes the crowd."""
    command = [sys.executable, __file__, "--publish", str(port), "--vehicles", str(vehicles)]
    return subprocess.Popen([*command, "--seconds", str(seconds + 180)], stdout=subprocess.PIPE, text=True)


def city(port: int, vehicles: int, seconds: float, directory: Path) -> subprocess.Popen[str]:
    """A run on a generated city in real time. The frames that reach viewers are those of `fanout`."""
    generate = [str(CARAWARE), "generate", "city", "--vehicles", str(vehicles), "--duration-s", str(seconds + 300)]
    subprocess.run(generate, cwd=directory, check=True, stdout=subprocess.DEVNULL)
    settings = ("run.real_time_factor=1", f"fanout.listen=tcp/127.0.0.1:{port}", f"traffic.max_road_users={vehicles}")
    command = [str(CARAWARE), "simulate", "city/city.sumocfg", "--quiet", "--name", "crowd"]
    command += [word for value in settings for word in ("--set", value)]
    return subprocess.Popen(command, cwd=directory, text=True)


def measure(options: argparse.Namespace) -> None:
    """Prints a row for each interval, then what the viewer says at its end, and the machine's load."""
    port = free_port()
    with tempfile.TemporaryFile("w+") as log, tempfile.TemporaryDirectory() as place, ExitStack() as stack:
        if options.city:
            source = city(port, options.vehicles, options.seconds, Path(place))
        else:
            source = publisher(port, options.vehicles, options.seconds)
        first_tick_s = float(source.stdout.readline()) if source.stdout else float("nan")
        command = [sys.executable, "-m", "caraware_viewer", f"tcp/127.0.0.1:{port}", "--web", "--timeout", "120"]
        command += ["--rate", str(options.rate), "--web-port", str(free_port())]
        viewer = subprocess.Popen(command, stderr=log)
        try:
            browser, opened = None, None
            begun = time.monotonic()
            while opened is None and time.monotonic() - begun < 180:
                log.seek(0)
                opened = re.search(r"open (http://\S+) in", log.read())
                time.sleep(0.2)
            assert opened is not None, "the viewer did not start"
            if options.browser:
                width, height = options.size
                browser = stack.enter_context(Browser(width, height, options.renderer))
                browser.open(f"{opened[1]}?renderer=webgl")
                browser.wait_for("window._handle !== undefined", 180)
                print(f"drawn by {browser.evaluate(RENDERER)}", flush=True)
            begun = time.monotonic()
            while time.monotonic() - begun < options.seconds:
                row: dict[str, float] = {}
                if browser is None:
                    stand_in_for_a_browser(opened[1], options.interval)
                else:
                    row = drawn_figures(browser.drawn(options.interval), options.interval, first_tick_s)
                print(json.dumps(sample(viewer.pid, browser, time.monotonic() - begun) | row), flush=True)
        finally:
            viewer.send_signal(signal.SIGINT)
            viewer.wait(60)
            # Where SIGINT is ignored, as in a script's background, it is so in the children of Python too.
            source.terminate()
            source.wait(120)
        log.seek(0)
        print(log.read().splitlines()[-1])
    print(f"load of the machine {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vehicles", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--interval", type=float, default=10.0, help="seconds of a row")
    parser.add_argument("--city", action="store_true", help="a real run on a generated city")
    parser.add_argument("--browser", action="store_true")
    parser.add_argument("--renderer", choices=RENDERERS, default="software")
    parser.add_argument("--size", type=int, nargs=2, default=(1000, 640), help="pixels of the page")
    parser.add_argument("--rate", type=float, default=10.0, help="`caraware-viewer --rate`")
    parser.add_argument("--publish", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.publish:
        publish(options.publish, options.vehicles, time.time() + options.seconds)
    else:
        measure(options)
