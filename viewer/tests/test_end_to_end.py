"""The command line, against a real zenoh session that stands in for the fan-out."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import frames
import numpy as np
import pytest
import zenoh
from ports import free_port

from caraware_viewer import canvas, course, plots, scene, static_map, top
from caraware_viewer.link import LatestFrames, RunKey, Sample, encoded

RUN = RunKey("a run/with #odd? $name*", 0)
MAP = {"run": RUN.run, "tick_s": 0.1, "map": {"bounds_m": [0.0, 0.0, 220.0, 200.0]}}
STATUS = {"tick": 2, "real_time_factor": 2.0, "training": {"updates": 3, "policy_std": 0.5, "reward": 0.25}}
COURSE = {"updates": [{"env_steps": 8, "tick": 1, "training": {"reward": 0.25}}], "evaluations": []}
TRUTH = np.array([[10.0, 20.0], [30.0, 40.0]], np.float32)
VEHICLE = "flow#1/car *?$ ü"
PATIENCE_S = 120.0
"""Longest wait, for a machine whose cores are busy with other work."""
GNSS_OFFSET_M = np.array([3.0, 4.0], np.float32)


class StandIn:
    """Listens, answers queries for the map, declares the liveliness token and publishes."""

    def __init__(self, port: int) -> None:
        config = zenoh.Config()
        settings = {
            "mode": "peer",
            "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "transport/shared_memory/enabled": False,
        }
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        self.endpoint = f"tcp/127.0.0.1:{port}"
        self.sent = 0
        key = f"{RUN.prefix}/map"
        self._map = self.session.declare_queryable(key, lambda query: query.reply(key, json.dumps(MAP)))
        learning = f"{RUN.prefix}/learning"
        self._learning = self.session.declare_queryable(
            learning, lambda query: query.reply(learning, json.dumps(COURSE))
        )
        self.token = self.session.liveliness().declare_token(f"{RUN.prefix}/alive")

    def put(self, topic: str, payload: bytes) -> None:
        attachment = struct.pack("<QQ", self.sent, time.time_ns())
        # Without this a busy machine drops what it cannot send at once, as the fan-out may.
        block = zenoh.CongestionControl.BLOCK
        self.session.put(f"{RUN.prefix}/{topic}", payload, attachment=attachment, congestion_control=block)
        self.sent += 1

    def publish_until_clouds_are_wanted(self) -> None:
        """Publishes until the viewer subscribes to a point cloud, which it does once it knows the vehicle's id."""
        clouds = self.session.declare_publisher(f"{RUN.prefix}/pointcloud/{encoded(VEHICLE)}")
        for tick in range(int(PATIENCE_S / 0.1)):
            self.publish(tick)
            if clouds.matching_status:
                return
            time.sleep(0.1)
        raise TimeoutError("the viewer did not subscribe to the point cloud")

    def publish(self, tick: int) -> None:
        self.put("vehicles", frames.vehicles(tick, {100: VEHICLE}))
        self.put("world", frames.world(tick))
        self.put("observation", frames.observation(tick, TRUTH, TRUTH + GNSS_OFFSET_M))
        self.put("prediction", frames.prediction(tick, TRUTH + 1))
        self.put("status", json.dumps(STATUS).encode())
        points = {"position_m": [[1, 2, 3]], "tag": [4]}
        self.put(f"pointcloud/{encoded(VEHICLE)}", frames.pointcloud(tick, points, id_hash=100))


@pytest.fixture
def fanout() -> Iterator[StandIn]:
    stand_in = StandIn(free_port())
    yield stand_in
    stand_in.session.close()


def viewer(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "caraware_viewer", *arguments]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ | {"RUST_LOG": "error"})


def rerun(*arguments: str) -> str:
    command = [sys.executable, "-m", "rerun", "rrd", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE_S).stdout


def put_garbage_until(fanout: StandIn, refused: threading.Event) -> None:
    """Puts garbage until the viewer has refused some: a newer sample may replace one before the viewer takes it."""
    while not refused.wait(0.05):
        fanout.put("world", b"garbage")


def test_a_run_becomes_a_recording(fanout: StandIn, tmp_path: Path) -> None:
    file = tmp_path / "run.rrd"
    process = viewer(fanout.endpoint, "--run", RUN.run, "--save", str(file))
    assert process.stderr is not None
    assert "watching run" in process.stderr.readline()
    fanout.publish_until_clouds_are_wanted()
    # The viewer reports the first sample that it refuses, and only that one.
    refusal = threading.Event()
    garbage = threading.Thread(target=put_garbage_until, args=(fanout, refusal))
    garbage.start()
    assert "shorter than its 96 bytes of header" in process.stderr.readline()
    refusal.set()
    garbage.join()
    fanout.put("world", b"garbage")
    # The newest sample of each topic is drawn, also if the run ends at once.
    fanout.publish(1000)
    fanout.token.undeclare()
    assert process.wait(timeout=PATIENCE_S) == 0
    output = process.stderr.read()
    assert "has ended" in output
    assert "96 bytes" not in output

    rerun("verify", str(file))
    listing = rerun("print", "-vv", str(file))
    drawn = [top.OUTLINES, top.GNSS, top.PREDICTIONS, top.CLOUD, plots.POLICY_ERROR, plots.GNSS_ERROR, scene.HUD]
    for path in [*drawn, static_map.BOUNDS, course.REWARD, plots.REAL_TIME]:
        assert f"/{path}" in listing, path
    assert canvas.TIMELINE in listing


def stand_in_process(port: int) -> subprocess.Popen[str]:
    code = f"import test_end_to_end as t, time; s = t.StandIn({port}); print('up', flush=True); time.sleep(600)"
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parent
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "up\n"
    return process


def test_a_killed_fan_out_ends_the_run(tmp_path: Path) -> None:
    port = free_port()
    fanout = stand_in_process(port)
    process = viewer(f"tcp/127.0.0.1:{port}", "--save", str(tmp_path / "run.rrd"))
    assert process.stderr is not None
    assert "watching run" in process.stderr.readline()
    fanout.kill()
    assert process.wait(timeout=PATIENCE_S) == 0
    fanout.wait()


def test_without_a_run_the_message_names_the_endpoint() -> None:
    port = free_port()
    process = viewer(f"tcp/127.0.0.1:{port}", "--timeout", "1", "--save", "unused.rrd")
    _, output = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert f"nothing answers at tcp/127.0.0.1:{port} within 1 s" in output
    assert "fanout.listen" in output
    assert "Traceback" not in output


def test_a_wrong_run_name_gives_the_names_of_the_runs(fanout: StandIn) -> None:
    process = viewer(fanout.endpoint, "--run", "other", "--timeout", "1", "--save", "unused.rrd")
    _, output = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "no run called 'other'" in output
    assert RUN.run in output
    assert "Traceback" not in output


def test_a_wrong_endpoint_is_a_usage_error() -> None:
    process = viewer("localhost:7447")
    _, output = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2
    assert "tcp/HOST:PORT" in output


def odd_names() -> list[str]:
    """Names that caused errors before, and random names over all of Unicode."""
    random = np.random.default_rng(5)
    codes = [random.integers(0, 0x10FFFF, size=int(random.integers(1, 12))) for _ in range(200)]
    drawn = ["".join(chr(int(code)) for code in row if not 0xD800 <= code < 0xE000) for row in codes]
    ascii_names = ["".join(chr(int(code)) for code in random.integers(0, 128, size=6)) for _ in range(200)]
    return ["town-1", "a/b", "#?$*", "ü €", "", "%", "100%", "~.-_", *drawn, *ascii_names]


def test_any_name_makes_a_key_and_comes_back() -> None:
    parts: dict[str, str] = {}
    for name in odd_names():
        key = RunKey(name, 3)
        assert str(zenoh.KeyExpr(f"{key.prefix}/alive")) == f"{key.prefix}/alive"
        assert RunKey.of_alive_key(f"{key.prefix}/alive") == key
        assert parts.setdefault(encoded(name), name) == name


def test_only_the_newest_sample_of_a_topic_is_kept() -> None:
    latest = LatestFrames()
    for payload in (b"1", b"2", b"3"):
        latest.store("world", Sample(payload))
    latest.add("world", Sample(b"older"))
    latest.add("status", Sample(b"s"))
    assert latest.take(0) == {"world": Sample(b"3"), "status": Sample(b"s")}
    assert latest.take(0) == {}
    assert latest.skipped["world"] == 2


def test_gaps_in_the_numbers_are_losses_and_a_jump_back_is_a_new_fan_out() -> None:
    latest = LatestFrames()
    for sequence in (5, 6, 9, 0, 1, 3):
        latest.store("world", Sample(b"", sequence))
    latest.store("status", Sample(b"", 100))
    latest.store("event", Sample(b""))
    assert latest.lost == 2 + 1


def test_an_implausible_age_is_unknown() -> None:
    now_ns = time.time_ns()
    assert 100 <= Sample(b"", 0, now_ns - 100_000_000).age_ms() < 50_000
    for sample in (Sample(b""), Sample(b"", 0, 0), Sample(b"", 0, now_ns + 3_600_000_000_000)):
        assert np.isnan(sample.age_ms())


def test_a_close_ends_the_wait() -> None:
    latest = LatestFrames()
    threading.Timer(0.05, latest.close).start()
    begun = time.monotonic()
    assert latest.take(600) == {}
    assert time.monotonic() - begun < 300
    assert latest.closed
