"""Minari exports, read by Minari's own loader and checked as its own tests check data sets."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import minari  # type: ignore[import-untyped]  # it has no types
import numpy as np
import pytest
from caraware import _native
from caraware.data import Recording, RecordingError, open_recording
from caraware.data.export.__main__ import export
from caraware.data.export.rows import table
from caraware.data.names import RoadUsers
from recorded_run import TRAINED, assert_has_card, recorded_run, unseen

NAME = "a_run_3-v0"
DRIVING = {
    "traffic.cavs": 0,
    "traffic.heroes": 4,
    "traffic.others": 10,
    "task.time_limit_s": 6,
    "record.channels": '["observation", "prediction", "world", "traffic-meta"]',
}


@pytest.fixture(scope="module")
def localisation(trained_run: Path) -> Path:
    return trained_run


@pytest.fixture(scope="module")
def driving() -> Iterator[Path]:
    with recorded_run("train", TRAINED | DRIVING, preset="driving", name="a.run_3") as run_dir:
        yield run_dir


def _load(run_dir: Path, directory: Path, monkeypatch: pytest.MonkeyPatch, jobs: int = 1) -> minari.MinariDataset:
    """Export a run, and let Minari find the data set by its name."""
    assert export(run_dir, "minari", directory, jobs, unseen) == 4
    assert_has_card(directory, run_dir)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(directory))
    assert list(minari.list_local_datasets(compatible_minari_version=True)) == [NAME]
    return minari.load_dataset(NAME)


def _check(dataset: minari.MinariDataset) -> None:
    """The rules of `check_data_integrity` of Minari's own tests."""
    episodes = list(dataset.iterate_episodes())
    assert [episode.id for episode in episodes] == list(range(dataset.total_episodes))
    assert sum(len(episode) for episode in episodes) == dataset.total_steps
    for episode, about in zip(episodes, dataset.storage.get_episode_metadata(dataset.episode_indices), strict=True):
        steps = len(episode)
        assert about["total_steps"] == steps > 0
        assert len(episode.observations) == steps + 1
        assert len(episode.actions) == len(episode.terminations) == len(episode.truncations) == steps
        assert all(len(values) == steps + 1 for values in episode.infos.values())
        assert all(dataset.observation_space.contains(row) for row in episode.observations)
        assert all(dataset.action_space.contains(row) for row in episode.actions)
        # A trajectory ends with its last step and nowhere before, in one of two ways.
        ended = episode.terminations.astype(int) + episode.truncations
        assert ended[-1] == 1 and not ended[:-1].any()


def _rows(recording: Recording) -> dict[tuple[int, str], dict[str, Any]]:
    """The rows of the Parquet export that are valid, by tick and vehicle."""
    users = RoadUsers(recording)
    rows = [row for episode in recording.episodes() for row in table(recording, episode, users).to_pylist()]
    return {(row["tick"], row["id"]): row for row in rows if row["is_valid"]}


def test_every_valid_row_is_one_step_and_minari_loads_them(
    localisation: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, recording = _load(localisation, tmp_path, monkeypatch, jobs=2), open_recording(localisation)
    _check(dataset)
    rows, steps = _rows(recording), 0
    messages = {message.tick: message for message in recording.messages("observation")}
    abouts = dataset.storage.get_episode_metadata(dataset.episode_indices)
    kinds = set()
    for episode, about in zip(dataset.iterate_episodes(), abouts, strict=True):
        seen = {row["episode"] for row in (rows[tick, about["vehicle"]] for tick in episode.infos["tick"].tolist())}
        assert seen == {about["episode"]}
        for place, tick in enumerate(episode.infos["tick"][:-1].tolist()):
            row = rows.pop((tick, about["vehicle"]))
            slot = row["slot"]
            assert np.array_equal(episode.observations[place], messages[tick].section("observation")[slot])
            assert episode.actions[place].tolist() == [row["predicted_x_m"], row["predicted_y_m"]]
            assert episode.rewards[place] == np.float32(row["reward"])
            assert episode.infos["truth"][place, 0] == np.float32(row["truth_x_m"])
            steps += 1
            # How the slot continues a tick later, in the bits of the message.
            last = place == len(episode) - 1
            if tick + 1 not in messages:
                assert last and episode.truncations[place]
                continue
            flags = int(messages[tick + 1].section("flags")[slot])
            assert episode.terminations[place] == bool(flags & _native.TERMINATED)
            if last:
                assert flags & (_native.TERMINATED | _native.TRUNCATED)
                assert np.array_equal(episode.observations[place + 1], episode.observations[place])
                kinds.add("terminated" if episode.terminations[place] else "truncated")
    assert rows == {} and steps == dataset.total_steps > 1000
    assert kinds == {"truncated"}  # vehicles of the town do not arrive
    evaluation = dataset.filter_episodes(lambda episode: len(episode) > 100)
    assert 0 < evaluation.total_episodes < dataset.total_episodes
    assert len(evaluation.sample_episodes(2)) == 2


def test_an_export_that_continues_makes_the_same_data_set(
    localisation: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = [episode.rewards.sum() for episode in _load(localisation, tmp_path, monkeypatch)]
    (tmp_path / "episode-00001.minari").rename(tmp_path / ".episode-00001.minari.partial")
    assert export(localisation, "minari", tmp_path, 1, unseen) == 1
    assert [episode.rewards.sum() for episode in minari.load_dataset(NAME)] == before
    assert not list(tmp_path.glob(".*"))


def test_heroes_have_the_rewards_and_ends_of_their_task(
    driving: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, recording = _load(driving, tmp_path, monkeypatch), open_recording(driving)
    _check(dataset)
    assert dataset.action_space.low.tolist() == [-1, -1]
    rows, ends = _rows(recording), []
    abouts = dataset.storage.get_episode_metadata(dataset.episode_indices)
    for episode, about in zip(dataset.iterate_episodes(), abouts, strict=True):
        answered = [rows[tick, about["vehicle"]] for tick in episode.infos["tick"][:-1].tolist()]
        assert episode.actions.tolist() == [[row["action_0"], row["action_1"]] for row in answered]
        # Ten metres along the route earn at most 1; how far a hero moves bounds it.
        moved_m = np.hypot(*np.diff(episode.infos["truth"][:, :2], axis=0).T)
        assert np.all(episode.rewards[:-1] <= moved_m[:-1] / 10 + 0.05)
        ends.append(about["ended_by"])
        expected = {"arrival": 10.0, "time limit": 0.0, "end of the run's episode": 0.0}.get(about["ended_by"], -10.0)
        assert episode.rewards[-1] == expected
        assert episode.terminations[-1] == (abs(expected) > 0)
    assert {"off-road", "time limit", "end of the run's episode"} <= set(ends)
    assert sum(len(episode) for episode in dataset) == len(rows)


def test_a_recording_without_predictions_is_refused(tmp_path: Path) -> None:
    # No process of a simulation predicts.
    with recorded_run("simulate", TRAINED) as run_dir, pytest.raises(RecordingError, match="prediction"):
        export(run_dir, "minari", tmp_path, 1, unseen)


def test_a_task_whose_rewards_do_not_follow_from_what_was_published_is_refused(tmp_path: Path) -> None:
    speaking = TRAINED | {
        "task.kind": "messages",
        "v2x.share": 1.0,
        "v2x.perception_range_m": 60.0,
        "v2x.inclusion": "policy",
        "trainer.actions_per_observation": 1,
        "trainer.supervised": "false",
    }
    with recorded_run("train", speaking) as run_dir, pytest.raises(RecordingError, match="'messages'"):
        export(run_dir, "minari", tmp_path, 1, unseen)
