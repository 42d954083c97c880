"""A run of heroes, whose world waits for the actions of every tick, is handed from learner to learner and back."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

CARAWARE = Path(__file__).parents[2] / "target" / "release" / "caraware"
SLOW_DRIVER = """
import sys
import time
from pathlib import Path

import numpy as np

from caraware.ipc.channel import Channel
from caraware.run.process import HandoverRole, StopSignal, SuccessorClaims, run_process


def drive(run_file: Path, stop: StopSignal, role: HandoverRole) -> None:
    if role.gets_ready and not role.wait_for_turn(SuccessorClaims(task="driving", environments=1)):
        return
    channel = Channel(str(run_file))
    while not (stop.requested or stop.leave_requested):
        for obs in channel.receive(0.2):
            time.sleep(0.05)
            channel.publish_actions(obs, np.zeros((len(obs.valid), 2), np.float32))
            channel.consumed(obs.tick)


sys.exit(run_process(sys.argv[1:], drive))
"""
OURS, SCRIPT, OTHER = "caraware.train", "caraware.driving.trips", "caraware.examples.sb3_takeover"
SETTINGS = {
    "traffic.heroes": 4,
    "traffic.others": 3,
    "traffic.pedestrians": 2,
    "task.time_limit_s": 10,
    "observation.fields": "driving",
    "episode.ticks": 200,
    "episode.training_episodes": 8,
    "episode.evaluation_interval": 3,
    "episode.evaluation_ticks": 40,
    "episode.final_evaluations": 1,
    # Stable-Baselines3 continues from an MLP.
    "trainer.network": "mlp",
    "trainer.hidden": "[16]",
    "trainer.horizon": 200,
    "trainer.batch_size": 100,
    "trainer.checkpoint_interval": 1,
    "trainer.plots": "false",
    "fanout.enabled": "false",
    "run.real_time_factor": 12,
}


class DrivingRun:
    """A run that is paused while its learner is replaced, so that none comes too late."""

    def __init__(self, place: str, changes: dict[str, Any] | None = None) -> None:
        """A run in a directory; `changes` to the settings."""
        self.directory, self._place = Path(place, "runs", "drive"), place
        self._environment = os.environ | {
            "CARAWARE_RUNTIME_DIR": f"{place}/r",
            "CARAWARE_PYTHON": sys.executable,
            "CARAWARE_DRIVER": "scripted",
            "PYTHONPATH": os.pathsep.join(filter(None, [place, os.environ.get("PYTHONPATH")])),
        }
        settings = SETTINGS | (changes or {})
        words = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
        self.process = subprocess.Popen(
            [CARAWARE, "train", "driving", "--name", "drive", "--quiet", *words],
            cwd=place,
            env=self._environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def command(self, *words: str) -> str:
        """What a command of caraware prints, which succeeds."""
        ran = subprocess.run(
            [CARAWARE, *words], cwd=self._place, env=self._environment, capture_output=True, text=True, timeout=120
        )
        assert ran.returncode == 0, ran.stdout + ran.stderr + self.log()
        return ran.stdout

    def tick(self, process: str) -> int:
        """How many ticks a process has finished."""
        (status,) = json.loads(self.command("ps", "drive", "--json"))
        (tick,) = (each["tick"] for each in status["processes"] if each["process"] == process)
        return int(tick)

    def commits(self) -> list[tuple[str, int]]:
        """Which learner has learnt up to which tick, in order."""
        file = self.directory / "commits.json"
        commits = json.loads(file.read_text())["commits"] if file.exists() else []
        return [(commit["learner"], commit["positions"][0]["ticks"]) for commit in commits]

    def until(self, condition: Callable[[], bool], what: str) -> None:
        """Wait until the condition holds; fail if the run ends before, or after two minutes."""
        ends = time.monotonic() + 120
        while not condition():
            assert self.process.poll() is None, (what, self.log())
            assert time.monotonic() < ends, (what, self.log())
            time.sleep(0.02)

    def hand_over(self, module: str) -> None:
        """Replace the learner, and let the successor drive on."""
        self.command("control", "pause", "--run", "drive")
        self.command("handover", "drive", "--set", f"trainer.module={module}")
        self.command("control", "resume", "--run", "drive")

    def log(self) -> str:
        """What its learners have logged."""
        file = self.directory / "logs" / "trainer.log"
        return file.read_text() if file.exists() else ""

    def report(self) -> dict[str, Any]:
        """The report, after the run's end."""
        said, _ = self.process.communicate(timeout=120)
        assert self.process.returncode == 0, said + self.log()
        report: dict[str, Any] = json.loads((self.directory / "report.json").read_text())
        return report


def test_a_driving_run_goes_to_a_script_to_another_learner_and_back() -> None:
    with tempfile.TemporaryDirectory(prefix="cw-") as short:
        run = DrivingRun(short)
        try:
            run.until(lambda: bool(run.commits()), "a first commit")
            run.hand_over(SCRIPT)
            _, begun = run.commits()[-1]
            # The script commits what it has driven when it leaves, in mid-episode.
            run.until(lambda: run.tick("trainer") > begun + 30, "ticks that the script drove")
            run.hand_over(OTHER)
            run.until(lambda: run.commits()[-1][0] == OTHER, "a commit of the other learner")
            run.hand_over(OURS)
            report, log = run.report(), run.log()
        finally:
            if run.process.poll() is None:
                run.process.terminate()
                run.process.wait(60)
        commits = run.commits()
    assert [learner for learner, _ in commits] == ["ppo", SCRIPT, OTHER, "ppo"]
    ends = [ticks for _, ticks in commits]
    assert ends == sorted(set(ends))
    # Each began where the commits of the one before it end.
    assert [handover["first_tick"] for handover in report["handovers"]] == ends[:-1]
    assert (report["result"], report["restarts"]) == ("completed", 0)
    assert (report["lost_ticks"], report["duplicated_ticks"]) == (0, 0)
    # Our learner has all ticks of the run, of which others have learnt some.
    assert report["trainer"]["received_ticks"] == report["ticks"]
    assert report["trainer"]["duplicated_ticks"] == 0
    # The other learner had driven on after its last commit: no update can learn from actions that it did not draw.
    assert "were driven by another policy, and are not learnt from" in log
    assert report["dynamics"]["heroes"]["episodes"] >= 8


def test_a_run_that_is_resumed_before_its_slow_successor_has_caught_up_continues() -> None:
    """The run is resumed while the successor still answers ticks that the world has gone on from."""
    with tempfile.TemporaryDirectory(prefix="cw-") as short:
        Path(short, "slow_driver.py").write_text(SLOW_DRIVER)
        # No update comes, so that the successor begins at the first tick.
        run = DrivingRun(short, {"trainer.horizon": 100_000, "trainer.batch_size": 1_000})
        try:
            run.until(lambda: bool(run.log()), "a trainer")
            run.until(lambda: run.tick("trainer") > 40, "ticks before the handover")
            run.hand_over("slow_driver")
            resumed_at = run.tick("traffic-bridge")
            run.until(lambda: run.tick("trainer") > resumed_at + 20, "ticks that the successor drove")
        finally:
            run.process.terminate()
            run.process.wait(60)
