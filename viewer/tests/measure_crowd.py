"""Measures the viewer with a crowd on loopback: frames drawn per second, their age, and memory over time.

.venv/bin/python viewer/tests/measure_crowd.py --vehicles 10000 --seconds 1800

A publisher stands in for `fanout` at its default rates, with frames of the length that `fanout` sends for so many
vehicles: of more than fit into a frame, the same ones in every tick. `--browser` also opens the page in a headless
Chromium, and counts what it renders.
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
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import frames
import numpy as np
import zenoh
from browser import Browser
from ports import free_port

from caraware_viewer import memory
from caraware_viewer.link import RunKey

RUN = RunKey("crowd", 0)
MAX_ROWS, MAX_SLOTS = 6249, 2300
"""Rows of `world` and slots of `observation` (9 fields, 10 samples of the IMU) that fit into a frame."""
SIDE_M, SPACING_M = 5000.0, 250.0
RATE_HZ, STATUS_TICKS = 10.0, 5
COUNT_FRAMES = """window.rendered = 0;
const before = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = draw => before(time => { window.rendered++; draw(time); });"""


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
    """Publishes ticks at `RATE_HZ` until the time `stop`, or until a signal."""
    config = zenoh.Config()
    for key, value in {
        "mode": "peer",
        "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
        "scouting/multicast/enabled": False,
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
    begun = time.time()
    tick = 0
    while time.time() < stop:
        x_m = (along + 1.2 * tick) % SIDE_M
        sent = {"world": frames.world(tick, rows, kind=0, id_hash=ids, x_m=x_m, y_m=road)}
        truth = np.column_stack([x_m, road])[:slots].astype(np.float32)
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
    """Memory of each process, MB, and what the browser has rendered."""
    server = max((memory.resident_mb(pid) for pid in descendants(viewer)), default=float("nan"))
    row: dict[str, float] = {
        "s": round(at_s),
        "viewer_mb": round(memory.resident_mb(viewer)),
        "server_mb": round(server),
    }
    if browser is not None:
        pages = [memory.resident_mb(pid) for pid in descendants(browser.pid)]
        row["page_mb"] = round(max(pages, default=float("nan")))
        row["rendered"] = int(browser.evaluate("window.rendered") or 0)
    return row


def measure(vehicles: int, seconds: float, interval_s: float, with_browser: bool) -> None:
    """Prints a row for each interval, then what the viewer says at its end, and the machine's load."""
    port = free_port()
    publisher = subprocess.Popen(
        [sys.executable, __file__, "--publish", str(port), "--vehicles", str(vehicles), "--seconds", str(seconds + 120)]
    )
    command = [sys.executable, "-m", "caraware_viewer", f"tcp/127.0.0.1:{port}", "--web", "--timeout", "60"]
    with tempfile.TemporaryFile("w+") as log, ExitStack() as stack:
        viewer = subprocess.Popen([*command, "--web-port", str(free_port())], stderr=log)
        try:
            browser, opened = None, None
            begun = time.monotonic()
            while opened is None and time.monotonic() - begun < 120:
                log.seek(0)
                opened = re.search(r"open (http://\S+) in", log.read())
                time.sleep(0.2)
            assert opened is not None, "the viewer did not start"
            if with_browser:
                browser = stack.enter_context(Browser(1000, 640))
                browser.call("Page.addScriptToEvaluateOnNewDocument", source=COUNT_FRAMES)
                browser.open(f"{opened[1]}?renderer=webgl")
            begun = time.monotonic()
            while time.monotonic() - begun < seconds:
                time.sleep(interval_s)
                print(json.dumps(sample(viewer.pid, browser, time.monotonic() - begun)), flush=True)
        finally:
            viewer.send_signal(signal.SIGINT)
            viewer.wait(60)
            publisher.terminate()
            publisher.wait(60)
        log.seek(0)
        print(log.read().splitlines()[-1])
    print(f"load of the machine {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vehicles", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--interval", type=float, default=10.0)
    parser.add_argument("--browser", action="store_true")
    parser.add_argument("--publish", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.publish:
        publish(options.publish, options.vehicles, time.time() + options.seconds)
    else:
        measure(options.vehicles, options.seconds, options.interval, options.browser)
