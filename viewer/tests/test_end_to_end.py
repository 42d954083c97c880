"""The command against a real zenoh session that plays the fan-out."""

from __future__ import annotations

import json
import os
import socket
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

from caraware_viewer import scene
from caraware_viewer.link import LatestFrames, RunKey

RUN = RunKey("a run/with #odd? $name*", 0)
MAP = {"run": RUN.run, "tick_s": 0.1, "map": {"bounds_m": [0.0, 0.0, 220.0, 200.0]}}
STATUS = {"tick": 2, "training": {"updates": 3, "policy_std": 0.5, "reward": 0.25}, "processes": []}
TRUTH = np.array([[10.0, 20.0], [30.0, 40.0]], np.float32)
GNSS_OFFSET_M = np.array([3.0, 4.0], np.float32)


class StandIn:
    """Listens, answers for the map, announces the run and publishes."""

    def __init__(self, port: int) -> None:
        config = zenoh.Config()
        settings = {
            "mode": "peer",
            "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
        }
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        self.endpoint = f"tcp/127.0.0.1:{port}"
        key = f"{RUN.prefix}/map"
        self._map = self.session.declare_queryable(key, lambda query: query.reply(key, json.dumps(MAP)))
        self.token = self.session.liveliness().declare_token(f"{RUN.prefix}/alive")

    def put(self, topic: str, payload: bytes) -> None:
        self.session.put(f"{RUN.prefix}/{topic}", payload)

    def publish(self, tick: int) -> None:
        self.put("world", frames.world(tick))
        self.put("observation", frames.observation(tick, TRUTH, TRUTH + GNSS_OFFSET_M))
        self.put("prediction", frames.prediction(tick, TRUTH + 1))
        self.put("status", json.dumps(STATUS).encode())


@pytest.fixture
def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@pytest.fixture
def fanout(free_port: int) -> Iterator[StandIn]:
    stand_in = StandIn(free_port)
    yield stand_in
    stand_in.session.close()


def viewer(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "caraware_viewer", *arguments]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ | {"RUST_LOG": "error"})


def rerun(*arguments: str) -> str:
    command = [sys.executable, "-m", "rerun", "rrd", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=30).stdout


def test_a_run_becomes_a_recording(fanout: StandIn, tmp_path: Path) -> None:
    file = tmp_path / "run.rrd"
    process = viewer(fanout.endpoint, "--run", RUN.run, "--save", str(file))
    assert process.stderr is not None
    assert "watching run" in process.stderr.readline()
    for tick in range(5):
        fanout.publish(tick)
        fanout.put("world", b"garbage")
        time.sleep(0.1)
    fanout.publish(5)
    fanout.token.undeclare()
    assert process.wait(timeout=20) == 0
    output = process.stderr.read()
    assert "has ended" in output
    assert output.count("shorter than its 72 bytes of header") == 1

    rerun("verify", str(file))
    listing = rerun("print", "-vv", str(file))
    drawn = [scene.VEHICLES, scene.GNSS, scene.PREDICTIONS, scene.LINKS, scene.POLICY_ERROR, scene.GNSS_ERROR]
    for path in [*drawn, scene.BOUNDS, scene.POLICY_STD, scene.REWARD]:
        assert f"/{path}" in listing, path
    assert scene.TIMELINE in listing


def stand_in_process(port: int) -> subprocess.Popen[str]:
    code = f"import test_end_to_end as t, time; s = t.StandIn({port}); print('up', flush=True); time.sleep(60)"
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parent
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "up\n"
    return process


def test_a_killed_fan_out_ends_the_run(free_port: int, tmp_path: Path) -> None:
    fanout = stand_in_process(free_port)
    process = viewer(f"tcp/127.0.0.1:{free_port}", "--save", str(tmp_path / "run.rrd"))
    assert process.stderr is not None
    assert "watching run" in process.stderr.readline()
    fanout.kill()
    assert process.wait(timeout=20) == 0
    fanout.wait()


def test_nothing_there_is_said_with_the_endpoint(free_port: int) -> None:
    process = viewer(f"tcp/127.0.0.1:{free_port}", "--timeout", "1", "--save", "unused.rrd")
    _, output = process.communicate(timeout=20)
    assert process.returncode == 1
    assert f"nothing answers at tcp/127.0.0.1:{free_port} within 1 s" in output
    assert "fanout.listen" in output
    assert "Traceback" not in output


def test_another_run_is_said_with_those_there(fanout: StandIn) -> None:
    process = viewer(fanout.endpoint, "--run", "other", "--timeout", "1", "--save", "unused.rrd")
    _, output = process.communicate(timeout=20)
    assert process.returncode == 1
    assert "no run called 'other'" in output
    assert RUN.run in output
    assert "Traceback" not in output


def test_what_is_no_endpoint_is_a_usage_error() -> None:
    process = viewer("localhost:7447")
    _, output = process.communicate(timeout=20)
    assert process.returncode == 2
    assert "tcp/HOST:PORT" in output


@pytest.mark.parametrize("name", ["town-1", "a/b", "#?$*", "ü €", "", "%", "100%"])
def test_any_name_makes_a_key_and_comes_back(name: str) -> None:
    key = RunKey(name, 3)
    assert str(zenoh.KeyExpr(f"{key.prefix}/alive")) == f"{key.prefix}/alive"
    assert RunKey.of_alive_key(f"{key.prefix}/alive") == key


def test_only_the_newest_frame_of_a_topic_is_kept() -> None:
    latest = LatestFrames()
    for payload in (b"1", b"2", b"3"):
        latest.store("world", payload)
    latest.store("status", b"s")
    assert latest.take(0) == {"world": b"3", "status": b"s"}
    assert latest.take(0) == {}
    assert latest.skipped["world"] == 2


def test_a_close_ends_the_wait() -> None:
    latest = LatestFrames()
    threading.Timer(0.05, latest.close).start()
    begun = time.monotonic()
    assert latest.take(20) == {}
    assert time.monotonic() - begun < 10
    assert latest.closed
