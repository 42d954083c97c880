"""Checkpoints: a round trip, bit-exact resumption, and damage that is refused."""

import gc
import json
import math
import os
import random
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from caraware.learn.config import MapBounds, TrainerConfig
from caraware.learn.ppo import Ppo
from caraware.learn.rollout import Rollout
from caraware.report.evaluation import Estimate, EvaluationResult
from caraware.report.metrics import TrainingPoint, TrainingPoints
from caraware.run.checkpoint import (
    Keeping,
    TrainingHistory,
    load_checkpoint,
    load_history,
    mark_best,
    remove_partial,
    save_checkpoint,
)
from caraware.run.manifest import (
    CheckpointError,
    Counters,
    best_checkpoint,
    newest_sound_checkpoint,
    read_manifest,
)
from synthetic import FIELDS, SIZE_M, latest_checkpoint, locating_ppo, run_file, street_ticks
from torch import Tensor


def fresh(**trainer: object) -> Ppo:
    config = TrainerConfig.from_run(run_file("x", **trainer))
    return locating_ppo(config, FIELDS, MapBounds(0.0, 0.0, SIZE_M, SIZE_M))


def train(ppo: Ppo, from_update: int, to_update: int) -> None:
    """Updates `from_update` to `to_update` of the same stream of ticks."""
    rollout, done = Rollout(256, FIELDS, bootstrap=False), 0
    for obs in street_ticks(4 * to_update, 64, 5.0, seed=8):
        rollout.add(obs)
        if rollout.full():
            horizon = rollout.take()
            if done >= from_update:
                ppo.learn(horizon)
            done += 1


def everything(ppo: Ppo) -> list[Tensor]:
    tensors = [*ppo.updater.parameters().values(), *ppo.updater.moments().values()]
    return [*tensors, ppo.sampling_generators()["sampling"].get_state(), ppo.shuffling.get_state()]


def counters(ppo: Ppo) -> Counters:
    return Counters(updates=ppo.updates, env_steps=256 * ppo.updates, episode=3, committed_tick=4 * ppo.updates - 1)


def save(folder: Path, ppo: Ppo, keep: int = 5) -> Path:
    return save_checkpoint(folder, ppo, counters(ppo), "abc", Keeping(keep))


def test_resuming_is_bit_exact(tmp_path: Path) -> None:
    uninterrupted, first, second = fresh(), fresh(), fresh(seed=1)
    train(uninterrupted, 0, 7)
    train(first, 0, 3)
    written = save(tmp_path, first)
    assert load_checkpoint(written, second) == counters(first)
    train(second, 3, 7)
    assert second.updates == uninterrupted.updates == 7
    for left, right in zip(everything(second), everything(uninterrupted), strict=True):
        assert torch.equal(left, right)


def test_the_directory_has_every_file(tmp_path: Path) -> None:
    ppo = fresh()
    train(ppo, 0, 2)
    written = save(tmp_path, ppo)
    assert written == latest_checkpoint(tmp_path) == tmp_path / "update-000002"
    assert {file.name for file in written.iterdir()} == {
        "manifest.json",
        "parameters.safetensors",
        "optimiser.safetensors",
        "random.safetensors",
    }
    manifest = read_manifest(written)
    assert manifest.counters.committed_tick == 7
    assert (manifest.config_sha256, manifest.torch_version) == ("abc", torch.__version__)
    assert not list(tmp_path.glob("*.partial"))


def test_a_checkpoint_before_the_first_update_can_be_resumed(tmp_path: Path) -> None:
    written, loaded = save(tmp_path, fresh()), fresh(seed=9)
    load_checkpoint(written, loaded)
    train(loaded, 0, 1)
    reference = fresh()
    train(reference, 0, 1)
    assert torch.equal(everything(loaded)[0], everything(reference)[0])


def test_only_the_newest_are_kept(tmp_path: Path) -> None:
    ppo = fresh()
    for update in range(4):
        train(ppo, update, update + 1)
        save(tmp_path, ppo, keep=2)
    assert sorted(p.name for p in tmp_path.glob("update-*")) == ["update-000003", "update-000004"]


@pytest.mark.parametrize("name", ["parameters.safetensors", "optimiser.safetensors", "random.safetensors"])
def test_one_flipped_bit_is_refused_by_name(tmp_path: Path, name: str) -> None:
    written = save(tmp_path, fresh())
    content = bytearray((written / name).read_bytes())
    content[-1] ^= 1
    (written / name).write_bytes(content)
    with pytest.raises(CheckpointError, match=f"{name}: is damaged") as caught:
        load_checkpoint(written, fresh())
    assert caught.value.file == written / name


def test_a_missing_file_is_refused_by_name(tmp_path: Path) -> None:
    written = save(tmp_path, fresh())
    (written / "optimiser.safetensors").unlink()
    with pytest.raises(CheckpointError, match=r"optimiser\.safetensors: cannot be read"):
        load_checkpoint(written, fresh())


@pytest.mark.parametrize("content", ["", "{}", "[1]", '{"schema_version": 99}'])
def test_a_broken_manifest_is_refused(tmp_path: Path, content: str) -> None:
    written = save(tmp_path, fresh())
    (written / "manifest.json").write_text(content)
    with pytest.raises(CheckpointError, match=r"manifest\.json"):
        load_checkpoint(written, fresh())


def test_another_size_is_refused_with_both_sizes(tmp_path: Path) -> None:
    written = save(tmp_path, fresh())
    config = TrainerConfig.from_run(run_file("x"))
    with pytest.raises(CheckpointError, match=f"observation_size is {FIELDS}, this run's is 9"):
        load_checkpoint(written, locating_ppo(config, 9, MapBounds(0.0, 0.0, 1.0, 1.0)))
    with pytest.raises(CheckpointError, match="hidden"):
        load_checkpoint(written, fresh(hidden=[16, 16]))
    with pytest.raises(CheckpointError, match="activation is relu, this run's is tanh"):
        load_checkpoint(written, fresh(activation="tanh"))


def test_a_refused_checkpoint_changes_nothing(tmp_path: Path) -> None:
    written, ppo = save(tmp_path, fresh(seed=3)), fresh()
    (written / "random.safetensors").write_bytes(b"x")
    before = [tensor.clone() for tensor in everything(ppo)]
    with pytest.raises(CheckpointError):
        load_checkpoint(written, ppo)
    assert all(torch.equal(a, b) for a, b in zip(before, everything(ppo), strict=True))


def test_the_manifest_is_plain_json(tmp_path: Path) -> None:
    manifest = json.loads((save(tmp_path, fresh()) / "manifest.json").read_text())
    assert manifest["schema_version"] == 2
    assert all(len(digest) == 64 for digest in manifest["files"].values())
    assert {"counters", "schedules", "config_sha256", "torch_version", "manifest_sha256"} < set(manifest)
    assert set(manifest["schedules"]) == {"progress", "learning_rate", "clip_epsilon", "entropy_scale"}


def test_schedules_continue_where_the_newest_update_left_them(tmp_path: Path) -> None:
    ppo = fresh(learning_rate=0.01, learning_rate_decay=0.5, clip_epsilon=0.2, clip_epsilon_final=0.1)
    ppo.progress = 0.25
    train(ppo, 0, 3)
    schedules = read_manifest(save(tmp_path, ppo)).schedules
    assert schedules["progress"] == 0.25
    assert schedules["learning_rate"] == pytest.approx(0.0025)
    assert schedules["clip_epsilon"] == pytest.approx(0.175)


def test_the_best_and_every_nth_outlive_the_newest(tmp_path: Path) -> None:
    ppo = fresh()
    for update in range(1, 8):
        train(ppo, update, update + 1)
        written = save_checkpoint(tmp_path, ppo, counters(ppo), "abc", Keeping(newest=1, every=3))
        if update == 2:
            mark_best(written)
    names = sorted(path.name for path in tmp_path.glob("update-*"))
    assert names == ["update-000002", "update-000003", "update-000006", "update-000007"]
    assert best_checkpoint(tmp_path) == tmp_path / "update-000002"
    mark_best(written)
    save_checkpoint(tmp_path, ppo, counters(ppo), "abc", Keeping(newest=1))
    assert [path.name for path in tmp_path.glob("update-*")] == ["update-000007"]


def flip_a_bit(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 4
    file.write_bytes(content)


def replace_in(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def replace_hash(checkpoint: Path) -> None:
    replace_in(checkpoint / "manifest.json", read_manifest(checkpoint).files["parameters.safetensors"], 64 * "0")


DAMAGES: dict[str, tuple[Callable[[Path], object], str | None]] = {
    "a flipped bit": (lambda c: flip_a_bit(c / "parameters.safetensors"), "parameters.safetensors: is damaged"),
    "a flipped bit of moments": (
        lambda c: flip_a_bit(c / "optimiser.safetensors"),
        "optimiser.safetensors: is damaged",
    ),
    "a truncated file": (lambda c: os.truncate(c / "random.safetensors", 100), "random.safetensors: is damaged"),
    "an empty file": (lambda c: os.truncate(c / "parameters.safetensors", 0), "parameters.safetensors: is damaged"),
    "a missing file": (lambda c: (c / "random.safetensors").unlink(), "random.safetensors: cannot be read"),
    "a missing manifest": (lambda c: (c / "manifest.json").unlink(), "manifest.json: cannot be read"),
    "a truncated manifest": (lambda c: os.truncate(c / "manifest.json", 80), "manifest.json: is not a manifest"),
    "another tick": (
        lambda c: replace_in(c / "manifest.json", '_tick": 11', '_tick": 12'),
        "manifest.json: is damaged",
    ),
    "another hash": (replace_hash, "manifest.json: is damaged"),
    "another schema": (
        lambda c: replace_in(c / "manifest.json", '_version": 2', '_version": 1'),
        "this trainer reads 2",
    ),
    "half-written": (lambda c: c.rename(c.with_name(f".{c.name}.partial")), None),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_refused_with_the_reason_and_the_one_before_is_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: str
) -> None:
    ppo = fresh()
    train(ppo, 0, 2)
    before = save(tmp_path, ppo)
    train(ppo, 2, 3)
    newest = save(tmp_path, ppo)
    assert newest_sound_checkpoint(tmp_path) == newest
    harm, reason = DAMAGES[damage]
    harm(newest)
    assert newest_sound_checkpoint(tmp_path) == before
    assert reason is None or (reason in caplog.text and "the one before it is used" in caplog.text)
    if reason is not None:
        loaded = fresh(seed=5)
        with pytest.raises(CheckpointError):
            load_checkpoint(newest, loaded)
        load_checkpoint(before, loaded)


def test_eighty_damaged_files_are_refused_with_their_name_or_load_what_was_saved(tmp_path: Path) -> None:
    written = save(tmp_path, fresh())
    expected = everything(fresh())[0]
    draw = random.Random(1)
    originals = {file: file.read_bytes() for file in sorted(written.iterdir())}
    refused = 0
    for number in range(80):
        file = sorted(originals)[number % len(originals)]
        content = bytearray(originals[file])
        place = draw.randrange(len(content))
        match number // len(originals) % 4:
            case 0:
                content[place] ^= 1 << draw.randrange(8)
            case 1:
                del content[place:]
            case 2:
                del content[place : place + draw.randrange(1, 40)]
            case _:
                content[place:place] = draw.randbytes(draw.randrange(1, 40))
        file.write_bytes(content)
        loaded = fresh(seed=5)
        try:
            load_checkpoint(written, loaded)
        except CheckpointError as error:
            refused += 1
            assert error.file == file and file.name in str(error), error
            assert newest_sound_checkpoint(tmp_path) is None
        else:
            # A damage that changes nothing that counts, such as a byte of a name.
            assert torch.equal(everything(loaded)[0], expected)
        file.write_bytes(originals[file])
    assert refused >= 70, refused


def test_the_newest_sound_checkpoint_is_found_past_damaged_ones(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    ppo = fresh()
    assert newest_sound_checkpoint(tmp_path) is None
    for update in range(1, 4):
        train(ppo, update, update + 1)
        save(tmp_path, ppo)
    (tmp_path / "update-000003" / "manifest.json").unlink()
    file = tmp_path / "update-000002" / "random.safetensors"
    file.write_bytes(file.read_bytes()[:-1])
    (tmp_path / ".update-000004.partial").mkdir()
    remove_partial(tmp_path)
    assert newest_sound_checkpoint(tmp_path) == tmp_path / "update-000001"
    assert "update-000003" in caplog.text and "random.safetensors: is damaged" in caplog.text
    assert not list(tmp_path.glob(".*"))


def test_the_course_of_training_comes_back_exactly(tmp_path: Path) -> None:
    estimates = {"ppo": Estimate(4.5, 0.1), "raw_gnss": Estimate(7.0, 0.2)}
    evaluation = EvaluationResult(7, 1, 2, 300, estimates, metric="error_m")
    points = [
        TrainingPoint(7, 0.3, 0.1, {"error_m": 5.25, "raw_gnss_error_m": math.pi}, 1e4),
        TrainingPoint(2**40, 0.1, 0.2, {"error_m": math.nan, "raw_gnss_error_m": 6.0}, 0.0),
    ]
    course = TrainingHistory(11, 1, 2, 6, 40, [evaluation], TrainingPoints(points))
    ppo = fresh()
    written = save_checkpoint(tmp_path, ppo, Counters(1, 7, 0, 9), "0", Keeping(3), course)
    found = load_history(written)
    assert (found.evaluations, found.training[0]) == (course.evaluations, points[0])
    assert repr(found) == repr(course)
    assert load_checkpoint(written, fresh()) == Counters(1, 7, 0, 9)
    assert load_history(save(tmp_path / "bare", ppo)) == TrainingHistory()


def test_checkpoints_of_a_growing_course_leave_nothing_in_memory(tmp_path: Path) -> None:
    ppo, points = fresh(), TrainingPoints()

    def save_next(number: int) -> None:
        points.append(TrainingPoint(number, 0.3, 0.1, {"error_m": 5.0}, 1.0))
        course = TrainingHistory(11, 1, 2, 6, 40, [], points)
        save_checkpoint(tmp_path, ppo, Counters(number, 7, 0, 9), "0", Keeping(2), course)

    for number in range(1, 11):
        save_next(number)
    gc.collect()
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    for number in range(11, 61):
        save_next(number)
    gc.collect()
    kept_bytes = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    # safetensors keeps some numbers of each.
    assert kept_bytes < 50 * 1500


def test_a_checkpoint_takes_the_place_of_one_with_its_name(tmp_path: Path) -> None:
    ppo = fresh()
    train(ppo, 0, 1)
    damaged = save(tmp_path, ppo)
    (damaged / "manifest.json").write_text("damaged")
    assert save(tmp_path, ppo) == damaged
    assert read_manifest(damaged).counters == counters(ppo)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["latest", damaged.name]
