"""Stable-Baselines3 takes over a run that has no checkpoint yet, dies after its own commit, and continues."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from caraware.examples import sb3_takeover
from full_disk import FullDisk
from stable_baselines3 import PPO

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
    "trainer.plots": "false",
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
    """Hand the run over to the module; False while there is no run. No checkpoint may exist before."""
    assert not list(Path(place, "runs", "taken").glob("checkpoints/update-*"))
    command: list[str | Path] = [CARAWARE, "handover", "taken", "--set", f"trainer.module={MODULE}"]
    ran = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, timeout=120)
    said = ran.stdout + ran.stderr
    if "no run" in said:
        return False
    assert ran.returncode == 0, said
    return True


def _committed(directory: Path) -> tuple[str, int]:
    """The newest learner that committed, and its next tick."""
    file = directory / "commits.json"
    commits = json.loads(file.read_text())["commits"] if file.exists() else []
    return (commits[-1]["learner"], commits[-1]["positions"][0]["ticks"]) if commits else ("", 0)


def test_a_takeover_before_the_first_checkpoint_survives_a_kill_and_resumes() -> None:
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
        try:
            _until(lambda: _hand_over(short, environment), run, "a handover")
            # The old trainer left a checkpoint, which did not exist when its successor got ready.
            checkpoint = (directory / "checkpoints" / "latest").read_text().strip()
            _until(lambda: _committed(directory)[0] == MODULE, run, "a commit of the successor")
            learner, (_, killed_at) = _learner(run), _committed(directory)
            assert learner is not None
            learner.kill()
            _until(lambda: _committed(directory)[1] > killed_at, run, "a commit after the restart")
            # SIGTERM amid a rollout: ticks that no update has learnt from are not committed, and come again.
            learner, (_, asked_at) = _learner(run), _committed(directory)
            assert learner is not None
            learner.terminate()
            _until(lambda: _committed(directory)[1] > asked_at, run, "a commit after the second restart")
            run.send_signal(signal.SIGINT)
            said, _ = run.communicate(timeout=60)
        finally:
            if run.poll() is None:
                run.terminate()
                run.wait(60)
        log = directory / "logs" / "trainer.log"
        begun = f"with the networks of {checkpoint}"
        assert log.read_text().count(begun) == 3, said + log.read_text()
        _, stopped_at = _committed(directory)

        resume: list[str | Path] = [CARAWARE, "train", "--resume", "taken", "--quiet"]
        ran = subprocess.run(resume, cwd=short, env=environment, capture_output=True, text=True, timeout=180)
        assert ran.returncode == 0, ran.stdout + ran.stderr + log.read_text()
        assert begun in log.read_text() and _committed(directory)[1] > stopped_at
        report = json.loads((directory / "report.json").read_text())
        assert report["result"] == "completed"
        assert (report["lost_ticks"], report["duplicated_ticks"]) == (0, 0)


def test_the_model_waits_for_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its commit comes after it: an error would lose the learner, and the next one would learn these ticks again."""
    disk = FullDisk(monkeypatch, times=2)
    model = PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8, device="cpu")
    file = sb3_takeover.save(model, tmp_path / "models", 7)
    assert disk.refused[".partial"] == 2
    assert PPO.load(file, device="cpu").n_steps == 8
    assert list(file.parent.iterdir()) == [file]
