"""Stable-Baselines3 takes over a run that has no checkpoint yet, dies after its own commit, and continues from it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import psutil

CARAWARE = Path(__file__).parents[2] / "target" / "release" / "caraware"
MODULE = "caraware.examples.sb3_takeover"
SETTINGS = {
    "traffic.cavs": 6,
    "traffic.others": 3,
    "traffic.pedestrians": 3,
    "episode.ticks": 400,
    "episode.training_episodes": 3,
    "episode.evaluation_interval": 0,
    "episode.final_evaluations": 1,
    "episode.evaluation_ticks": 100,
    "trainer.horizon": 600,
    "trainer.batch_size": 300,
    # The first checkpoint is that of the handover.
    "trainer.checkpoint_interval": 1000,
    "trainer.supervised": "false",
    "fanout.enabled": "false",
    "run.real_time_factor": 20,
}


def _until(condition: Callable[[], bool], run: subprocess.Popen[str], what: str) -> None:
    """Wait until the condition holds; fail if the run ends before, or after two minutes."""
    ends = time.monotonic() + 120
    while not condition():
        assert run.poll() is None, (what, run.stdout.read() if run.stdout else "")
        assert time.monotonic() < ends, what
        time.sleep(0.02)


def _learner(run: subprocess.Popen[str]) -> psutil.Process | None:
    """The process of the module that is the trainer of the run."""
    for process in psutil.Process(run.pid).children(recursive=True):
        if MODULE in process.cmdline():
            return process
    return None


def _hand_over(place: str, environment: dict[str, str]) -> bool:
    """Hand the run over to the module; False while its trainer is still starting. No checkpoint may exist before."""
    assert not list(Path(place, "runs", "taken").glob("checkpoints/update-*"))
    command: list[str | Path] = [CARAWARE, "handover", "taken", "--set", f"trainer.module={MODULE}"]
    ran = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, timeout=120)
    said = ran.stdout + ran.stderr
    if "still starting" in said or "no run" in said:
        return False
    assert ran.returncode == 0, said
    return True


def test_a_takeover_before_the_first_checkpoint_survives_a_kill() -> None:
    with tempfile.TemporaryDirectory(prefix="cw-") as short:
        directory = Path(short, "runs", "taken")
        environment = os.environ | {"CARAWARE_RUNTIME_DIR": f"{short}/r", "CARAWARE_PYTHON": sys.executable}
        settings = [word for key, value in SETTINGS.items() for word in ("--set", f"{key}={value}")]
        run = subprocess.Popen(
            [CARAWARE, "train", "town", "--name", "taken", "--quiet", *settings],
            cwd=short,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

        def learners() -> list[str]:
            file = directory / "commits.json"
            return [entry["learner"] for entry in json.loads(file.read_text())["commits"]] if file.exists() else []

        try:
            _until(lambda: _hand_over(short, environment), run, "a handover")
            # The old trainer left a checkpoint, which did not exist when its successor got ready.
            assert list(directory.glob("checkpoints/update-*"))
            _until(lambda: learners()[-1:] == [MODULE], run, "a commit of the successor")
            learner = _learner(run)
            assert learner is not None
            learner.kill()
            said, _ = run.communicate(timeout=180)
        finally:
            if run.poll() is None:
                run.terminate()
                run.wait(60)
        log = (directory / "logs" / "trainer.log").read_text()
        assert run.returncode == 0, said + log
        report = json.loads((directory / "report.json").read_text())
        assert (report["restarts"], len(report["handovers"])) == (1, 1)
        assert (report["lost_ticks"], report["duplicated_ticks"]) == (0, 0)
        # Its networks are the old trainer's both times.
        assert log.count("takes over at tick") == 2
        assert log.count("with the networks of update-") == 2, log
