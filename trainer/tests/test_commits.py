"""The record of commits: whichever learners take turns, every tick is in exactly one committed update."""

import errno
import json
import logging
import os
import random
import shutil
from pathlib import Path
from typing import Any

import pytest
from caraware.examples import minimal_learner
from caraware.ipc.channel import Channel
from caraware.ipc.commits import COMMITS, Commit, CommitLog, CommitLogError, CommittedPosition, EpisodeStarts
from caraware.learn.config import MapBounds, TrainerConfig
from caraware.run.checkpoint import Keeping, TrainingHistory, load_checkpoint, load_history, save_checkpoint
from caraware.run.continuation import Continuation, own_checkpoints, remove_uncommitted
from caraware.run.manifest import CheckpointError, Counters, newest_sound_checkpoint
from full_disk import FullDisk, partial_files
from synthetic import FIELDS, SIZE_M, locating_ppo, run_file


def at(ticks: int) -> dict[int, CommittedPosition]:
    return {0: CommittedPosition(ticks, ticks // 100, ticks // 100 * 100)}


def checkpoint(folder: Path, updates: int, ticks: int) -> Path:
    """Of our PPO, which has learnt so many ticks."""
    ppo = locating_ppo(TrainerConfig.from_run(run_file("x")), FIELDS, MapBounds(0.0, 0.0, SIZE_M, SIZE_M))
    ppo.updates = updates
    counters = Counters(updates, ticks, 0, ticks - 1, ticks // 100, ticks // 100 * 100)
    return save_checkpoint(folder, ppo, counters, "abc", Keeping(9), TrainingHistory(received_ticks=ticks))


def test_commits_in_a_row_are_one_and_learners_take_turns(tmp_path: Path) -> None:
    log = CommitLog(run_file(str(tmp_path)))
    assert (log.commits(), log.positions()) == ([], (CommittedPosition(),))
    for learner, ticks in (("ppo", 100), ("ppo", 250), ("other", 300), ("ppo", 420)):
        log.record(learner, at(ticks))
    assert [(commit.learner, commit.positions[0].ticks) for commit in log.commits()] == [
        ("ppo", 250),
        ("other", 300),
        ("ppo", 420),
    ]
    assert log.positions() == (CommittedPosition(420, 4, 400),)
    assert log.own("other") == Commit("other", (CommittedPosition(300, 3, 300),))
    assert log.own("third") is None
    assert not list(tmp_path.glob(".*"))


def test_a_run_that_begins_with_a_checkpoint_begins_there_in_each_environment(tmp_path: Path) -> None:
    run = run_file(str(tmp_path))
    run["config"]["run"]["envs"] = 3
    start = {"committed_ticks": 40, "episode": 2, "episode_tick": 30}
    run["beginning"] = {"checkpoint": "c", **start, "others": [start | {"committed_ticks": 50}]}
    log = CommitLog(run)
    assert [position.ticks for position in log.positions()] == [40, 50, 0]
    log.record("ppo", {1: CommittedPosition(70, 3, 60)})
    assert [position.ticks for position in log.positions()] == [40, 70, 0]


def test_a_learner_that_begins_earlier_takes_its_commits_back(tmp_path: Path) -> None:
    log = CommitLog(run_file(str(tmp_path)))
    for learner, ticks in (("ppo", 100), ("other", 200), ("ppo", 300)):
        log.record(learner, at(ticks))
    log.begin("ppo", at(200))
    assert [(commit.learner, commit.positions[0].ticks) for commit in log.commits()] == [("ppo", 100), ("other", 200)]
    log.begin("ppo", at(150))
    assert log.positions()[0].ticks == 150
    # Its checkpoint was renamed, but it died before the record of it.
    log.begin("ppo", at(180))
    assert (log.commits()[-1].learner, log.positions()[0].ticks) == ("ppo", 180)


def test_a_commit_waits_for_space_and_leaves_nothing_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    record = CommitLog(run_file(str(tmp_path)))
    record.record("ppo", at(100))
    disk, before = FullDisk(monkeypatch, times=3), record.file.read_bytes()

    def stop_requested() -> bool:
        """Asked after every attempt that failed."""
        assert (record.file.read_bytes(), partial_files(tmp_path)) == (before, [])
        return False

    with caplog.at_level(logging.WARNING):
        record.record("other", at(200), stop_requested)
    assert disk.refused == {".commits.json.partial": 3}
    assert [(commit.learner, commit.positions[0].ticks) for commit in record.commits()] == [
        ("ppo", 100),
        ("other", 200),
    ]
    assert not partial_files(tmp_path)
    assert [entry.getMessage().split(":")[0] for entry in caplog.records] == [
        "the disk is full",
        "there is space again",
    ]
    disk.refused.clear()
    record.begin("ppo", at(150))
    assert record.positions()[0].ticks == 150
    assert disk.refused == {".commits.json.partial": 3}


def test_a_stop_ends_the_wait_of_a_commit_which_does_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record = CommitLog(run_file(str(tmp_path)))
    record.record("ppo", at(100))
    disk = FullDisk(monkeypatch, times=10**9)
    with pytest.raises(OSError) as caught:
        record.record("ppo", at(200), lambda: disk.refused.total() >= 4)
    assert (caught.value.errno, disk.refused.total()) == (errno.ENOSPC, 4)
    assert record.positions()[0].ticks == 100
    assert not partial_files(tmp_path)


class Attachment:
    """The end of shared memory that a commit is published at."""

    def __init__(self) -> None:
        self.committed_ticks: list[int] = []

    def committed(self, tick: int) -> None:
        """Remember the commit."""
        self.committed_ticks.append(tick)


def test_the_commit_of_any_learner_is_published_once_there_is_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    attachment, channel = Attachment(), object.__new__(Channel)
    channel.learner, channel._commits = "other", CommitLog(run_file(str(tmp_path)))
    channel._environment, channel._starts = 0, EpisodeStarts()
    channel._attachment = attachment  # type: ignore[assignment]
    disk = FullDisk(monkeypatch, times=2)

    def stop_requested() -> bool:
        assert attachment.committed_ticks == [], "the journal keeps what no record counts"
        return False

    channel.commit(49, stop_requested)
    assert (disk.refused.total(), attachment.committed_ticks, channel.own_tick()) == (2, [49], 49)


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "another version"])
def test_a_damaged_record_is_refused_with_its_name(tmp_path: Path, damage: str) -> None:
    log = CommitLog(run_file(str(tmp_path)))
    log.record("ppo", at(123))
    text = log.file.read_text()
    damaged = {
        "cut": text[:40],
        "flipped": text.replace("123", "122", 1),
        "empty": "",
        "another version": text.replace('"schema_version": 1', '"schema_version": 9'),
    }
    log.file.write_text(damaged[damage])
    with pytest.raises(CommitLogError, match=COMMITS):
        log.positions()


def test_a_learner_that_returns_continues_behind_the_commits_of_the_others(tmp_path: Path) -> None:
    folder, log = tmp_path / "checkpoints", CommitLog(run_file(str(tmp_path)))
    first = checkpoint(folder, 1, 100)
    log.record("ppo", at(100))
    # It wrote this one, but was killed before the commit, and another learner has learnt these ticks.
    never = checkpoint(folder, 2, 200)
    assert next(own_checkpoints(folder, log, "ppo")) == never, "no other learner has learnt since"
    log.record("other", at(250))
    assert list(own_checkpoints(folder, log, "ppo")) == [first]
    remove_uncommitted(folder, log, "ppo")
    assert not never.exists() and first.exists()
    found = Continuation.find(folder, log, "ppo")
    assert (found.checkpoint, found.first_tick()) == (first, 250)
    loaded = locating_ppo(TrainerConfig.from_run(run_file("x")), FIELDS, MapBounds(0.0, 0.0, SIZE_M, SIZE_M))
    counters, history = found.follow(load_checkpoint(first, loaded), load_history(first))
    assert (counters.committed_tick, counters.next_episode, counters.next_episode_tick) == (249, 2, 200)
    assert history.received_ticks == 250, "the others have received what this one has not"
    # Its own commit counts again; a damaged one is skipped, and what the others have learnt stays learnt.
    newest = checkpoint(folder, 3, 400)
    log.record("ppo", at(400))
    assert Continuation.find(folder, log, "ppo").first_tick() == 400
    (newest / "manifest.json").unlink()
    found = Continuation.find(folder, log, "ppo")
    assert (found.checkpoint, found.first_tick()) == (first, 250)


def test_a_learner_without_a_checkpoint_of_its_own_begins_behind_the_others(tmp_path: Path) -> None:
    folder, log = tmp_path / "checkpoints", CommitLog(run_file(str(tmp_path)))
    checkpoint(folder, 7, 100)
    log.record("ppo", at(100))
    found = Continuation.find(folder, log, "fusion")
    assert (found.checkpoint, found.first_tick(), found.updates) == (None, 100, 7)
    counters, _ = found.follow(Counters(0, 0, 0, -1), TrainingHistory())
    assert (counters.updates, counters.committed_tick) == (7, 99), "names of checkpoints stay in order"


def _cut(file: Path, rng: random.Random) -> None:
    os.truncate(file, rng.randrange(file.stat().st_size))


def _flip(file: Path, rng: random.Random) -> None:
    content = bytearray(file.read_bytes())
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    file.write_bytes(content)


def _remove(file: Path, rng: random.Random) -> None:
    file.unlink()


def _swap(file: Path, rng: random.Random) -> None:
    """With the file of this name in another checkpoint, of the same size in the case of parameters."""
    shutil.copyfile(file.parent.with_name("update-000001") / file.name, file)


def _pipe(file: Path, rng: random.Random) -> None:
    file.unlink()
    os.mkfifo(file)


def _device(file: Path, rng: random.Random) -> None:
    file.unlink()
    file.symlink_to("/dev/zero")


def _directory(file: Path, rng: random.Random) -> None:
    file.unlink()
    file.mkdir()


@pytest.fixture(scope="module")
def two_checkpoints(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("corpus") / "checkpoints"
    checkpoint(folder, 1, 100)
    later = checkpoint(folder, 2, 200)
    # Parameters of the two differ, as after an update.
    assert later.name == "update-000002"
    return folder


FILES = ["manifest.json", "parameters.safetensors", "optimiser.safetensors", "random.safetensors"]
FILES += ["course.json", "points.safetensors"]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("harm", [_cut, _flip, _remove, _pipe, _device, _directory])
@pytest.mark.parametrize("name", FILES)
def test_no_damage_to_a_file_is_loaded_or_waited_for(
    two_checkpoints: Path, tmp_path: Path, name: str, harm: Any, seed: int
) -> None:
    folder = tmp_path / "checkpoints"
    shutil.copytree(two_checkpoints, folder)
    harm(folder / "update-000002" / name, random.Random(f"{name} {seed}"))
    assert newest_sound_checkpoint(folder) == folder / "update-000001"
    ppo = locating_ppo(TrainerConfig.from_run(run_file("x")), FIELDS, MapBounds(0.0, 0.0, SIZE_M, SIZE_M))
    with pytest.raises(CheckpointError):
        load_checkpoint(folder / "update-000002", ppo)
        load_history(folder / "update-000002")


def test_a_checkpoint_under_the_name_of_another_is_refused(two_checkpoints: Path, tmp_path: Path) -> None:
    folder = tmp_path / "checkpoints"
    shutil.copytree(two_checkpoints, folder)
    shutil.rmtree(folder / "update-000002")
    shutil.copytree(folder / "update-000001", folder / "update-000002")
    assert newest_sound_checkpoint(folder) == folder / "update-000001"


def test_a_file_of_another_checkpoint_is_refused(two_checkpoints: Path, tmp_path: Path) -> None:
    folder = tmp_path / "checkpoints"
    shutil.copytree(two_checkpoints, folder)
    _swap(folder / "update-000002" / "manifest.json", random.Random(0))
    assert newest_sound_checkpoint(folder) == folder / "update-000001"


def test_the_page_on_learners_shows_the_shortest_one() -> None:
    page = Path(__file__).parents[2] / "docs" / "learners.md"
    assert Path(str(minimal_learner.__file__)).read_text() in page.read_text()


def test_the_record_is_plain_json(tmp_path: Path) -> None:
    log = CommitLog(run_file(str(tmp_path)))
    log.record("ppo", at(250))
    written = json.loads(log.file.read_text())
    position = {"ticks": 250, "episode": 2, "episode_tick": 200}
    assert written["commits"] == [{"learner": "ppo", "positions": [position]}]
    assert written["schema_version"] == 1
