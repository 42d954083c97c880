"""Playing a checkpoint with a channel of prepared ticks."""

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from caraware.baselines import Ekf, SensorNoise
from caraware.baselines.samples import read_samples
from caraware.learn.memory import Memory
from caraware.learn.recurrent import RecurrentPpo
from caraware.run.config import RunConfig
from caraware.run.learner import Learner
from caraware.run.player import LIVE, PlayLoop, PlayTally
from full_disk import FullDisk, partial_files
from synthetic import SyntheticChannel
from synthetic_vehicle import VehicleObservation, observations, sensor_tables, town_track, vehicle_run

TICKS, VEHICLES = 40, 5


def ticks(first: int = 0, episodes: int = 2) -> Iterator[VehicleObservation]:
    """Episodes, each with its own seed."""
    for episode in range(episodes):
        for obs in observations(town_track(TICKS, VEHICLES, episode), seed=episode):
            tick = episode * TICKS + obs.tick
            if tick >= first:
                ends = obs.tick == TICKS - 1
                yield replace(
                    obs,
                    tick=tick,
                    episode=episode,
                    evaluation=True,
                    episode_last=ends,
                    last=ends and episode == episodes - 1,
                    truncated=np.full(VEHICLES, obs.tick == 0 and episode > 0),
                )


def run(folder: Path) -> dict[str, Any]:
    played = vehicle_run(str(folder))
    return played


def loop_over(folder: Path, stream: Iterator[VehicleObservation], stop_at: int | None = None) -> SyntheticChannel:
    played = run(folder)
    folder.mkdir(exist_ok=True)
    channel = SyntheticChannel(played, stream)
    config = RunConfig.from_run(played)
    size = next(ticks()).observation.shape[1]
    stop = lambda: stop_at is not None and channel.consumed_up_to >= stop_at  # noqa: E731
    PlayLoop(channel, config, Learner.begin(config, size).for_play(), stop).run()
    return channel


def part(folder: Path) -> dict[str, Any]:
    written: dict[str, Any] = json.loads((folder / "parts" / "trainer.json").read_text())
    return written


def test_errors_are_those_of_predictions_filter_and_fix(tmp_path: Path) -> None:
    channel = loop_over(tmp_path, ticks())
    noise = SensorNoise.from_run({"config": sensor_tables()})
    assert noise is not None
    error_m: dict[str, list[float]] = {"ppo": [], "ekf": [], "raw_gnss": []}
    for obs in ticks():
        if obs.tick % TICKS == 0:
            ekf = Ekf(noise)
        ekf.step(read_samples(obs, noise.convention))
        truth = np.asarray(obs.truth)[:, :2]
        for name, estimate in (
            ("ppo", np.asarray(channel.predictions[obs.tick])),
            ("ekf", ekf.position_m),
            ("raw_gnss", np.asarray(obs.gnss_m)[:, :2]),
        ):
            error_m[name] += list(np.hypot(*(estimate - truth)[obs.valid].T))
    report = part(tmp_path)
    for name, values in error_m.items():
        assert report[f"{name}_mean_error_m"] == pytest.approx(np.mean(values), rel=1e-5)
        assert report[f"{name}_ci95_m"] > 0
    assert (report["evaluation_seeds"], report["vehicles"], report["env_steps"]) == (2, VEHICLES, len(values))
    assert channel.is_done
    assert channel.committed_up_to == channel.consumed_up_to == 2 * TICKS - 1
    assert not (tmp_path / "checkpoints").exists()


def test_the_table_has_a_row_for_every_vehicle(tmp_path: Path) -> None:
    loop_over(tmp_path, ticks())
    table = json.loads((tmp_path / LIVE).read_text())["table"]
    assert (table["metric"], table["episode"], len(table["vehicles"])) == ("error_m", 1, VEHICLES)
    for row in table["vehicles"]:
        assert set(row["now"]) == set(row["mean"]) == {"ppo", "ekf", "raw_gnss"}
        assert all(math.isfinite(value) for value in [*row["now"].values(), *row["mean"].values()])


def test_a_successor_continues_the_counts_of_the_file(tmp_path: Path) -> None:
    """In a successor the filter starts again; errors of policy and fix are the same."""
    loop_over(tmp_path / "whole", ticks())
    loop_over(tmp_path / "cut", ticks(), stop_at=50)
    tally = PlayTally.read(tmp_path / "cut" / LIVE)
    assert 50 <= tally.tick < 2 * TICKS - 1
    loop_over(tmp_path / "cut", ticks(first=tally.tick + 1))
    one, two = part(tmp_path / "whole"), part(tmp_path / "cut")
    for key in ("env_steps", "vehicles", "evaluation_seeds"):
        assert one[key] == two[key]
    for key in ("ppo_mean_error_m", "raw_gnss_mean_error_m", "ppo_ci95_m"):
        assert two[key] == pytest.approx(one[key], rel=1e-6)


def test_a_play_waits_while_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    loop_over(tmp_path / "whole", ticks())
    full = tmp_path / "full"
    full.mkdir()
    # The first attempt at the table fails, and removes the device in the place of its file.
    (full / f".{LIVE}.partial").symlink_to("/dev/full")
    disk = FullDisk(monkeypatch, times=2)
    channel = loop_over(full, ticks())
    assert disk.refused == {".trainer.json.partial": 2}
    assert channel.committed_up_to == 2 * TICKS - 1
    assert part(full) == part(tmp_path / "whole")
    assert f"there is space again: {full / LIVE} is written" in caplog.messages
    assert not partial_files(full)


def test_a_policy_with_memory_plays_without_that_of_the_checkpoint(tmp_path: Path) -> None:
    played = vehicle_run(str(tmp_path), network="gru")
    config, shown = RunConfig.from_run(played), []
    for group in (1, 8):
        channel = SyntheticChannel(played, ticks(), group)
        learner = Learner.begin(config, next(ticks()).observation.shape[1])
        assert isinstance(learner.ppo, RecurrentPpo)
        all_vehicles = torch.arange(VEHICLES)
        width = learner.ppo.memories[0].state.shape[1]
        known = Memory(torch.tensor(-1), all_vehicles, torch.ones(VEHICLES, width))
        learner.ppo.memories = [known]
        PlayLoop(channel, config, learner.for_play(), lambda: False).run()
        (tmp_path / LIVE).unlink()
        shown.append(channel.predictions)
    assert all(torch.equal(shown[0][tick], shown[1][tick]) for tick in range(2 * TICKS))
    seen = next(ticks()).observation
    first_m = learner.ppo.predict_m([seen])[0]
    torch.testing.assert_close(shown[0][0], first_m)


def test_a_file_that_is_no_table_is_no_predecessor(tmp_path: Path) -> None:
    (tmp_path / LIVE).write_text("{")
    assert PlayTally.read(tmp_path / LIVE) == PlayTally()
