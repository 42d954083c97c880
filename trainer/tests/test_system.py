"""The trainer's end of a real run: real SUMO, real processes, real shared memory."""

import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
CARAWARE = ROOT / "target" / "release" / "caraware"

NOISELESS = {
    "gnss.noise_std_deg": 0.0,
    "traffic.cavs": 6,
    "traffic.others": 2,
    "traffic.pedestrians": 2,
    "episode.ticks": 100,
    "episode.training_episodes": 3,
    "episode.evaluation_ticks": 20,
    "episode.final_evaluations": 1,
    "trainer.horizon": 500,
    "trainer.batch_size": 250,
    "trainer.actions_per_observation": 1,
    "fanout.enabled": "false",
}


def run_with(tmp_path: Path, module: str, more: dict[str, object] | None = None) -> subprocess.CompletedProcess[str]:
    """A run whose trainer is a module of this directory."""
    values = NOISELESS | {"trainer.module": module} | (more or {})
    settings = [f"--set={key}={value}" for key, value in values.items()]
    command: list[str | Path] = [CARAWARE, "train", "town", "--name", "probe", *settings]
    with tempfile.TemporaryDirectory(prefix="caraware") as short:
        path = os.pathsep.join(filter(None, (str(Path(__file__).parent), os.environ.get("PYTHONPATH"))))
        environment = os.environ | {"PYTHONPATH": path, "CARAWARE_RUNTIME_DIR": short}
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The findings of the probe in one run."""
    tmp_path = tmp_path_factory.mktemp("probe")
    finished = run_with(tmp_path, "probe")
    assert finished.returncode == 0, finished.stdout + finished.stderr
    seen: dict[str, Any] = json.loads((tmp_path / "runs" / "probe" / "parts" / "trainer.json").read_text())
    return seen


def test_observation_action_reward_and_truth_belong_to_the_same_vehicle_and_tick(found: dict[str, Any]) -> None:
    # Three episodes of 100 ticks with six vehicles, and the evaluation's 20 ticks; a vehicle may enter a tick late.
    assert found["samples"] >= 1500
    assert found["foreign_samples"] == 0
    # Without noise the observed position is the true one; single precision over 260 m is 0.02 mm.
    assert found["largest_position_error_m"] < 1e-3
    assert found["largest_batch_error_m"] < 1e-3
    assert found["largest_reward_error"] < 1e-5


def test_the_observation_lies_in_shared_memory_and_cannot_be_written(found: dict[str, Any]) -> None:
    assert found["in_shared_memory"]
    assert found["differing_sections"] == []
    assert found["in_the_block"]
    assert not found["writable"]
    assert found["refused_writes"] == 2 * found["ticks"]


def test_every_tick_arrives_once_in_order(found: dict[str, Any]) -> None:
    assert found["consecutive"]
    assert found["ticks"] == 3 * 100 + 20
    assert found["distinct_vehicles"]


def test_a_trainer_that_is_no_module_ends_the_run_with_its_log(tmp_path: Path) -> None:
    finished = run_with(tmp_path, "no_such_trainer")
    assert finished.returncode == 1
    assert "no_such_trainer" in finished.stderr and "its log is" in finished.stderr


def test_a_lent_tensor_has_the_numbers_of_a_kept_observation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = {}
    for way in ("lent", "received"):
        monkeypatch.setenv("LEASE", way)
        (tmp_path / way).mkdir()
        finished = run_with(tmp_path / way, "lease_probe")
        assert finished.returncode == 0, finished.stdout + finished.stderr
        part = tmp_path / way / "runs" / "probe" / "parts" / "trainer.json"
        found[way] = json.loads(part.read_text())
    lent = found["lent"]
    assert len(lent["digests"]) == 320
    assert lent["digests"] == found["received"]["digests"]
    assert lent["in_shared_memory"] and lent["refused_writes"] == 320
    assert lent["nothing_after_the_last"] and lent["kept"]
    # A tensor for each place in shared memory, not for each tick.
    assert lent["places"] < 100


def test_an_episode_whose_first_tick_is_lent_begins_for_what_is_received(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LEASE", "mixed")
    finished = run_with(tmp_path, "lease_probe")
    assert finished.returncode == 0, finished.stdout + finished.stderr
    part = tmp_path / "runs" / "probe" / "parts" / "trainer.json"
    assert json.loads(part.read_text())["bounds"] == [[0, True], [1, True]]


def test_what_arrived_belongs_to_the_observation_and_comes_again_to_a_successor(tmp_path: Path) -> None:
    more: dict[str, object] = {"v2x.share": 1.0, "v2x.perception_range_m": 40.0, "traffic.cavs": 12}
    more["episode.training_episodes"] = 2
    finished = run_with(tmp_path, "neighbours_probe", more)
    assert finished.returncode == 0, finished.stdout + finished.stderr
    run = tmp_path / "runs" / "probe"
    found = json.loads((run / "parts" / "trainer.json").read_text())
    # The first trainer committed tick 50 and died at tick 80.
    assert (found["first_tick"], found["last_tick"]) == (51, 2 * 100 + 20 - 1)
    assert found["consecutive"] and found["same_vehicles"]
    assert (found["again"], found["different"]) == (30, 0)
    assert found["known"] > 1000
    assert found["self_known"] == 0
    # Without errors of the fix: those of compass and units, and the centre is up to some metres before the rear axle.
    assert found["compared"] > 50
    assert found["farthest_m"] < 4.0
    report = json.loads((run / "report.json").read_text())
    assert report["v2x"]["redelivered_ticks"] >= 1
    assert report["v2x"]["cams"] > 100


def test_images_belong_to_the_observation_and_come_again_to_a_successor(tmp_path: Path) -> None:
    more: dict[str, object] = {"camera.vehicles": 5, "camera.observed": "semantic", "camera.width": 40}
    more |= {"camera.height": 24, "traffic.cavs": 8, "episode.training_episodes": 2}
    finished = run_with(tmp_path, "images_probe", more)
    assert finished.returncode == 0, finished.stdout + finished.stderr
    run = tmp_path / "runs" / "probe"
    found = json.loads((run / "parts" / "trainer.json").read_text())
    # The first trainer committed tick 50 and died at tick 80.
    assert (found["first_tick"], found["last_tick"]) == (51, 2 * 100 + 20 - 1)
    assert found["consecutive"]
    assert (found["again"], found["different"]) == (30, 0)
    assert found["shape"] == [5, 1, 24, 40]
    assert found["shown"] == found["valid"] > 500
    # Watchers may miss images; those that they get are the same.
    assert found["watched"] > 20 and found["unlike"] == 0
