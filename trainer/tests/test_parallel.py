"""`torchrun -m caraware.parallel` over real runs: real SUMO, real processes, two supervisors."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from caraware.manifest import latest_checkpoint
from caraware.program import caraware_program
from safetensors.torch import load_file

SETTINGS = {
    "traffic.cavs": 4,
    "traffic.others": 2,
    "traffic.pedestrians": 2,
    "episode.ticks": 150,
    "episode.training_episodes": 2,
    "episode.evaluation_ticks": 50,
    "episode.final_evaluations": 1,
    "trainer.matmul_precision": "float32",
    "fanout.enabled": "false",
}
LARGEST_DIFFERENCE = 1e-3
"""Of a tensor, relative (L2): a few updates of 500 x 300 networks from scratch, float32 sums in another order. Adam's
first steps follow the sign of gradients, the smallest of which are rounding. Seen: 3e-4, and 5e-5 of weights."""
PATIENCE_S = 240


@pytest.fixture
def registry() -> Iterator[Path]:
    """A registry of runs, short enough for a socket's path, that must be empty in the end."""
    with tempfile.TemporaryDirectory(prefix="caraware") as folder:
        registry = Path(folder) / "r"
        yield registry
        assert not registry.exists(), "something is left of a run"


def start(folder: Path, registry: Path, words: list[str], horizon: int) -> subprocess.Popen:
    sizes = {"trainer.horizon": horizon, "trainer.batch_size": horizon // 2}
    settings = [f"--set={key}={value}" for key, value in (SETTINGS | sizes).items()]
    return subprocess.Popen(
        [*words, "town", "--runs", str(folder), *settings],
        env=os.environ | {"CARAWARE_RUNTIME_DIR": str(registry), "CARAWARE_PYTHON": sys.executable},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def two_ranks(folder: Path, registry: Path) -> subprocess.Popen:
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    return start(folder, registry, [*torchrun, "-m", "caraware.parallel", "--name=two"], 256)


def report(run: Path) -> dict:
    return json.loads((run / "report.json").read_text())


def parameters(run: Path) -> dict[str, torch.Tensor]:
    return load_file(latest_checkpoint(run / "checkpoints") / "parameters.safetensors")


def test_two_ranks_are_one_trainer_with_two_environments(tmp_path: Path, registry: Path) -> None:
    one = start(tmp_path, registry, [str(caraware_program()), "train", "--envs=2", "--name=one"], 512)
    said, _ = one.communicate(timeout=PATIENCE_S)
    assert one.returncode == 0, said
    two = two_ranks(tmp_path, registry)
    said, _ = two.communicate(timeout=PATIENCE_S)
    assert two.returncode == 0, said
    alone, ranks = report(tmp_path / "one"), [report(tmp_path / name) for name in ("two", "two-rank1")]
    hashes = [environment["observation_hash"] for environment in alone["environments"]]
    assert [rank["observation_hash"] for rank in ranks] == hashes
    assert alone["trainer"]["updates"] == ranks[0]["trainer"]["updates"] > 1
    assert ranks[0]["trainer"]["env_steps_of_all_ranks"] == alone["env_steps"]
    expected, found = parameters(tmp_path / "one"), parameters(tmp_path / "two")
    differences = {name: ((tensor - found[name]).norm() / tensor.norm()).item() for name, tensor in expected.items()}
    assert max(differences.values()) < LARGEST_DIFFERENCE, differences
    # Only rank 0 tells how it goes.
    assert "run two: results go to" in said
    assert "two-rank1" not in said


def test_a_killed_trainer_ends_all_ranks(tmp_path: Path, registry: Path) -> None:
    two = two_ranks(tmp_path, registry)
    log = tmp_path / "two-rank1" / "logs" / "trainer.log"
    deadline = time.monotonic() + PATIENCE_S
    while not (log.is_file() and "observations of" in log.read_text()):
        assert two.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    run_file = str(tmp_path / "two-rank1" / "run.json")
    [trainer] = [pid for pid, line in command_lines() if run_file in line and "caraware.train" in line]
    os.kill(trainer, signal.SIGKILL)
    said, _ = two.communicate(timeout=PATIENCE_S)
    assert two.returncode != 0
    assert "trainer ended with signal: 9" in said, said
    assert not [line for _, line in command_lines() if str(tmp_path) in line]


def command_lines() -> list[tuple[int, str]]:
    """Process ids and command lines of all processes."""
    lines = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            lines.append((int(folder.name), (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()))
        except OSError:
            continue
    return lines
