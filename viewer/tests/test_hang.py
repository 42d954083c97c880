"""A process of a real run hangs: the viewer names it, although no tick comes any more."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import recordings
import rerun as rr
from ports import free_port
from test_browser import COMMAND, environment, started, wait_for_line

from caraware_viewer.documents import RunStatus
from caraware_viewer.hud import hanging
from caraware_viewer.link import RunLink, connect, find_run
from caraware_viewer.scene import HUD, Scene

PATIENCE_S = 120.0


def test_the_text_names_a_process_that_hangs_and_no_other(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    settings = ["run.real_time_factor=5", "run.stall_s=3", f"fanout.listen={endpoint}"]
    run = [str(COMMAND), "simulate", "town", "--name", "hanging", "--runs", str(tmp_path)]
    run += [part for setting in settings for part in ("--set", setting)]
    log, file = tmp_path / "run.log", tmp_path / "run.rrd"
    with started(run, log, environment()) as running:
        wait_for_line(log, r"(sensing)", running, PATIENCE_S)
        core = sim_core()
        session = connect(endpoint, PATIENCE_S)
        with RunLink(session, find_run(session, endpoint, "hanging", PATIENCE_S, 0)) as link:
            recording = rr.RecordingStream("caraware")
            recording.set_sinks(rr.FileSink(str(file)))
            scene = Scene(recording, link.map(PATIENCE_S), lidar="off")
            os.kill(core, signal.SIGSTOP)
            try:
                status = draw_until_a_process_hangs(link, scene)
            finally:
                os.kill(core, signal.SIGCONT)
            recording.disconnect()
    assert [process["name"] for process in hanging(status)] == ["sim-core"]
    waiting = {process["name"]: process["waits_for"] for process in status["processes"]}
    assert waiting["sensor-daemon"] == "sim-core"
    text = recordings.read(file)[HUD].newest("TextDocument:text")[0]
    assert "| hangs | sim-core: no sign of life for " in text


def sim_core() -> int:
    """The process id of the run's `sim-core`."""
    command = [str(COMMAND), "ps", "--json"]
    table = subprocess.run(
        command,
        env=environment(),
        capture_output=True,
        text=True,
        check=True,
        timeout=PATIENCE_S,
    ).stdout
    (run,) = json.loads(table)
    (process,) = (process for process in run["processes"] if process["process"] == "sim-core")
    return int(process["pid"])


def draw_until_a_process_hangs(link: RunLink, scene: Scene) -> RunStatus:
    """Draws what arrives, as the viewer does, until a status names a process that hangs; returns that status."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        for topic, sample in link.frames.take(0.1).items():
            scene.draw(topic, sample)
            if topic == "status":
                status: RunStatus = json.loads(sample.payload)
                if hanging(status):
                    return status
    raise TimeoutError("no process was named")
