"""The learned estimator: it starts as the filter, sees neither truth nor future, learns, and resumes after a stop."""

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from caraware.baselines.ekf import Ekf
from caraware.baselines.lanes import LaneMap, Pieces, read_pieces
from caraware.baselines.map_ekf import MapEkf, lanes_of_net
from caraware.baselines.noise import SensorNoise
from caraware.baselines.samples import read_samples
from caraware.fusion.carrier import COLUMNS, Carried, Carrier
from caraware.fusion.estimating import Estimating
from caraware.fusion.learner import FusionConfig, FusionLearner
from caraware.fusion.loop import Beginning, FusionLoop, Recording
from caraware.fusion.past import Episode
from caraware.fusion.train import begin, player
from caraware.ipc.commits import CommitLog
from caraware.learn.config import ConfigError
from caraware.run.checkpoint import Keeping, load_checkpoint, save_checkpoint
from caraware.run.config import RunConfig
from caraware.run.continuation import Continuation
from caraware.run.learner import Learner
from caraware.run.manifest import CheckpointError, Counters, newest_sound_checkpoint
from caraware.run.player import PlayLoop
from full_disk import FullDisk, partial_files
from synthetic import SyntheticChannel
from synthetic_vehicle import Track, VehicleObservation, observations, sensor_tables, town_track, vehicle_run

NET = """<net><edge id="a"><lane id="a_0" speed="13.9" length="200" shape="0,{y} 100,{y} 200,{y}"/>
<lane id="a_1" allow="pedestrian" speed="1" length="200" shape="0,0 200,0"/></edge>
<edge id="b"><lane id="b_0" disallow="pedestrian" speed="8.3" length="200" shape="{x},0 {x},200"/></edge></net>"""
STREET_M = 80.0
SIZE = 11
"""Of the observation, which the estimator does not read."""


def net_file(folder: Path) -> Path:
    """A street to the east at y = 80 m, one to the north at x = 80 m, a sidewalk at y = 0."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "net.net.xml"
    file.write_text(NET.format(x=STREET_M, y=STREET_M))
    return file


def street_run(folder: Path, slow_m: float = 0.0, **trainer: object) -> dict[str, Any]:
    tables = sensor_tables(gnss__correlated_std_m=[slow_m, slow_m, 0.0])
    run = vehicle_run(str(folder), tables, hidden=[16], epochs=4, learning_rate=2e-3, **trainer)
    run["config"]["fusion"] = {"map": True, "segment_ticks": 32, "truncation_ticks": 16}
    run["scene_files"] = {"net_file": str(net_file(folder))}
    return run


def street_track(ticks: int, vehicles: int, seed: int) -> Track:
    """Half of the vehicles drive to the east on one street, half to the north on the other, straight on."""
    track = town_track(ticks, vehicles, seed)
    rng = np.random.default_rng(seed)
    east = np.arange(vehicles) % 2 == 0
    along = rng.uniform(0, 30, vehicles) + np.cumsum(track.speed_mps, 0) * 0.01
    still = np.zeros_like(along)
    return Track(
        np.where(east, along, STREET_M),
        np.where(east, STREET_M, along),
        np.where(east, still, math.pi / 2),
        track.speed_mps,
        track.accel_mps2,
        still,
        track.accel_mps2,
    )


def street_ticks(
    run: dict[str, Any], episodes: int, vehicles: int = 6, ticks: int = 40
) -> Iterator[VehicleObservation]:
    """Training episodes, then one for evaluation."""
    for episode in range(episodes + 1):
        for obs in observations(street_track(ticks, vehicles, episode), run["config"], seed=episode):
            yield replace(
                obs,
                tick=episode * ticks + obs.tick,
                episode=episode,
                evaluation=episode == episodes,
                episode_last=obs.tick == ticks - 1,
                last=episode == episodes and obs.tick == ticks - 1,
            )


def learner_of(run: dict[str, Any]) -> FusionLearner:
    return begin(run, SIZE, Continuation())[1]


def estimates(run: dict[str, Any], learner: FusionLearner, ticks: list[VehicleObservation]) -> torch.Tensor:
    noise = SensorNoise.from_run(run)
    assert noise is not None
    estimating = Estimating(learner, learner.carrier(noise))
    return torch.stack([estimating.step(obs)[0] for obs in ticks])


def shaken(learner: FusionLearner) -> FusionLearner:
    """The same learner with random parameters, whose network differs from the filter."""
    generator = torch.Generator().manual_seed(1)
    learner.parameters.values.add_(0.1 * torch.randn(learner.parameters.values.shape, generator=generator))
    return learner


@pytest.mark.parametrize("has_map", [True, False])
def test_before_it_learns_it_is_the_filter_with_the_map_that_it_has(tmp_path: Path, has_map: bool) -> None:
    run = street_run(tmp_path, slow_m=2.0)
    run["config"]["fusion"]["map"] = has_map
    noise = SensorNoise.from_run(run)
    assert noise is not None
    dark = np.zeros((80, 6), np.uint32)
    dark[30:60, ::2] = 1
    ticks = list(observations(town_track(80, 6, 1), run["config"], dark=dark))
    lanes, expected = lanes_of_net(net_file(tmp_path)), []
    assert lanes is not None
    ekf = MapEkf(noise, lanes) if has_map else Ekf(noise)
    for obs in ticks:
        ekf.step(read_samples(obs, noise.convention))
        expected.append(ekf.position_m.copy())
    assert np.abs(estimates(run, learner_of(run), ticks).numpy() - np.array(expected)).max() < 1e-3


def test_it_sees_neither_truth_nor_future(tmp_path: Path) -> None:
    run = street_run(tmp_path)
    ticks = list(observations(town_track(60, 5, 2), run["config"]))
    learner = shaken(learner_of(run))
    seen = estimates(run, learner, ticks)
    lied = [replace(obs, truth=obs.truth + 100.0) for obs in ticks]
    assert torch.equal(estimates(run, learner, lied), seen)
    later = [obs if obs.tick < 40 else replace(obs, gnss_m=obs.gnss_m + 50.0) for obs in ticks]
    changed = estimates(run, learner, later)
    assert torch.equal(changed[:40], seen[:40])
    assert not torch.equal(changed[40:], seen[40:])


def test_the_carrier_has_the_distance_of_vehicles_and_the_pull_of_fixes(tmp_path: Path) -> None:
    run = street_run(tmp_path)
    noise = SensorNoise.from_run(run)
    assert noise is not None
    carrier, before = Carrier(noise, (110.0, 110.0)), torch.zeros(4, 2)
    for obs in observations(town_track(30, 4, 3), run["config"]):
        c = Carried.of(carrier.step(obs))
        assert c.running.all()
        assert bool(c.begins.all()) == (obs.tick == 0)
        if obs.tick:
            assert torch.allclose(before + c.step_m + c.pull_m, c.filter_m, atol=1e-4)
            assert torch.allclose(c.innovation_m, obs.gnss_m[:, :2] - 110.0 - before - c.step_m, atol=1e-4)
        before = c.filter_m
    assert float(c.gain.max()) < 0.2


def test_the_raster_finds_what_a_search_of_all_pieces_finds(tmp_path: Path) -> None:
    pieces = read_pieces(net_file(tmp_path))
    assert len(pieces) == 3
    assert sorted(set(pieces.speed_limit_mps.tolist())) == pytest.approx([8.3, 13.9])
    weights = (4.0, 25.0)
    rng = np.random.default_rng(1)
    x, y = torch.tensor(rng.uniform(60, 100, (2, 400)), dtype=torch.float32)
    yaw = torch.tensor(rng.uniform(-math.pi, math.pi, 400), dtype=torch.float32)
    match = LaneMap(pieces, weights).match(x.expand(2, -1), y.expand(2, -1), yaw.expand(2, -1))
    p = {name: column.numpy()[:, None] for name, column in vars(pieces).items()}
    along = (x.numpy() - p["x_m"]) * np.cos(p["heading_rad"]) + (y.numpy() - p["y_m"]) * np.sin(p["heading_rad"])
    along = np.clip(along, 0, p["length_m"])
    dx = p["x_m"] + along * np.cos(p["heading_rad"]) - x.numpy()
    dy = p["y_m"] + along * np.sin(p["heading_rad"]) - y.numpy()
    turned = (p["heading_rad"] - yaw.numpy() + math.pi) % (2 * math.pi) - math.pi
    allowed = (np.abs(turned) < math.radians(75)) & (np.hypot(dx, dy) < 15)
    for question, weight in enumerate(weights):
        cost = np.where(allowed, dx**2 + dy**2 + (weight * turned) ** 2, np.inf)
        best = cost.argmin(0)
        rows = np.arange(400)
        ahead = dx[best, rows] * np.cos(yaw.numpy()) + dy[best, rows] * np.sin(yaw.numpy())
        same = np.abs(match.ahead_m[question].numpy() - np.where(allowed.any(0), ahead, 0)) < 1e-2
        # Cells and headings are rounded to their middles, which decides near ties otherwise.
        assert same.mean() > 0.85
        assert (match.found[question].numpy() == allowed.any(0)).mean() > 0.85


def test_without_a_map_no_lane_is_found() -> None:
    match = LaneMap(Pieces.none(), (4.0,)).match(*torch.zeros(3, 1, 5))
    assert all((column == 0).all() for column in vars(match).values())


def test_it_learns_streets_and_beats_the_filter_on_vehicles_it_has_not_seen(tmp_path: Path) -> None:
    run = street_run(tmp_path, slow_m=3.0)
    run["config"]["fusion"] |= {"segment_ticks": 100, "truncation_ticks": 50}
    learner = learner_of(run)
    for seed in range(3):
        learner.learn(recorded(run, learner, seed), progress=0.0)
    unseen = recorded(run, learner, seed=3)
    with torch.no_grad():
        offset_m, _ = learner.estimator.unroll(unseen.table, learner.estimator.begin(24))
    filter_m = Carried.of(unseen.table).filter_m - unseen.truth_m
    assert float((filter_m + offset_m).norm(dim=-1).mean()) < 0.8 * float(filter_m.norm(dim=-1).mean())


def recorded(run: dict[str, Any], learner: FusionLearner, seed: int) -> Episode:
    noise, centre_m, recording = SensorNoise.from_run(run), learner.estimator.centre_m, Recording()
    assert noise is not None
    carrier = Carrier(noise, (float(centre_m[0]), float(centre_m[1])))
    for obs in observations(street_track(100, 24, seed), run["config"], seed=seed):
        recording.add(carrier.step(obs), obs.truth[:, :2] - centre_m, torch.ones(24))
    return recording.episode()


def test_a_run_from_the_first_tick_to_the_report(tmp_path: Path) -> None:
    run = street_run(tmp_path)
    channel = SyntheticChannel(run, street_ticks(run, episodes=2))
    config, learner, beginning = begin(run, SIZE, Continuation())
    assert FusionLoop(channel, config, learner, beginning, lambda: False).run()
    part = json.loads((tmp_path / "parts" / "trainer.json").read_text())
    assert (part["updates"], part["env_steps"], part["untrained_env_steps"]) == (2, 2 * 40 * 6, 0)
    assert (part["lost_ticks"], part["duplicated_ticks"]) == (0, 0)
    assert part["seeds_m"][0]["ekf"] == pytest.approx(part["ekf_mean_error_m"])
    assert part["seeds_m"][0]["ppo"] == pytest.approx(part["ppo_mean_error_m"])
    assert channel.is_done
    assert set(channel.predictions) == set(range(3 * 40))
    assert channel.committed_up_to == 2 * 40 - 1


def test_an_episode_without_a_tick_that_counts_teaches_nothing(tmp_path: Path) -> None:
    """As where the first vehicles of a scenario depart after its first episode."""
    run = street_run(tmp_path)
    ticks = (
        replace(obs, valid=np.zeros_like(obs.valid)) if obs.episode == 0 else obs
        for obs in street_ticks(run, episodes=2)
    )
    config, learner, beginning = begin(run, SIZE, Continuation())
    channel = SyntheticChannel(run, ticks)
    assert FusionLoop(channel, config, learner, beginning, lambda: False).run()
    part = json.loads((tmp_path / "parts" / "trainer.json").read_text())
    assert (part["updates"], part["lost_ticks"], part["duplicated_ticks"]) == (1, 0, 0)
    assert channel.committed_up_to == 2 * 40 - 1


def test_a_full_disk_is_waited_for_and_a_stop_ends_the_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run_it(folder: Path, stop_requested: Callable[[], bool]) -> SyntheticChannel:
        run = street_run(folder, checkpoint_interval=1)
        channel = SyntheticChannel(run, street_ticks(run, episodes=2))
        config, learner, beginning = begin(run, SIZE, Continuation())
        assert FusionLoop(channel, config, learner, beginning, stop_requested).run()
        return channel

    disk = FullDisk(monkeypatch, times=2)
    assert run_it(tmp_path / "waits", lambda: False).committed_up_to == 2 * 40 - 1
    assert {".commits.json.partial", ".latest.partial", ".trainer.json.partial", "manifest.json"} < set(disk.refused)
    assert CommitLog(street_run(tmp_path / "waits")).positions()[0].ticks == 2 * 40
    disk.refused.clear()
    disk.fill()
    with pytest.raises(OSError, match="No space left"):
        run_it(tmp_path / "stops", lambda: disk.refused.total() >= 3)
    assert not partial_files(tmp_path)


def test_stopped_and_continued_it_ends_with_the_same_bytes_and_the_same_report(tmp_path: Path) -> None:
    def final(folder: Path, *limits: int) -> tuple[torch.Tensor, dict[str, Any]]:
        run = street_run(folder, checkpoint_interval=1)
        for limit in limits:
            config, learner, beginning = begin(run, SIZE, Continuation(newest_sound_checkpoint(folder / "checkpoints")))
            ticks = (obs for obs in street_ticks(run, episodes=3) if obs.tick > beginning.counters.committed_tick)
            channel = SyntheticChannel(run, ticks)
            stop = lambda channel=channel, limit=limit: channel.consumed_up_to >= limit  # noqa: E731
            FusionLoop(channel, config, learner, beginning, stop).run()
        assert learner.updates == 3
        part = json.loads((folder / "parts" / "trainer.json").read_text())
        return learner.parameters.values, part

    whole, cut = final(tmp_path / "whole", 10**6), final(tmp_path / "cut", 55, 110, 10**6)
    assert torch.equal(whole[0], cut[0])
    # The successor's ledger begins with the ticks of the checkpoint.
    assert cut[1] == whole[1]
    assert (cut[1]["received_ticks"], cut[1]["lost_ticks"]) == (4 * 40, 0)


def test_a_simulation_that_resumes_from_its_checkpoint_begins_with_the_next_episode(tmp_path: Path) -> None:
    run = street_run(tmp_path, checkpoint_interval=1)
    config, learner, beginning = begin(run, SIZE, Continuation())
    channel = SyntheticChannel(run, street_ticks(run, episodes=2))
    FusionLoop(channel, config, learner, beginning, lambda: channel.consumed_up_to >= 45).run()
    newest = newest_sound_checkpoint(tmp_path / "checkpoints")
    run["beginning"] = {"checkpoint": str(newest)}
    _, resumed, beginning = begin(run, SIZE, Continuation())
    counters = beginning.counters
    assert (counters.committed_tick, counters.next_episode, counters.next_episode_tick) == (39, 1, 40)
    assert torch.equal(resumed.parameters.values, learner.parameters.values)


def test_it_plays(tmp_path: Path) -> None:
    run = street_run(tmp_path / "run")
    learner = shaken(learner_of(run))
    written = save_checkpoint(tmp_path / "c", learner, Counters(4, 0, 0, 39), "0", Keeping(1))
    played = street_run(tmp_path / "play")
    played["beginning"] = {"checkpoint": str(written)}
    config = RunConfig.from_run(played)
    ticks = list(street_ticks(played, episodes=1))
    channel = SyntheticChannel(played, iter(ticks), group=3)
    PlayLoop(channel, config, player(played, config, SIZE), lambda: False).run()
    assert channel.is_done
    part = json.loads((tmp_path / "play" / "parts" / "trainer.json").read_text())
    assert (part["updates"], part["policy_std"]) == (4, 0.0)
    expected = estimates(run, learner, ticks)
    shown = torch.stack([channel.predictions[obs.tick] for obs in ticks])
    torch.testing.assert_close(shown, expected)


def test_a_checkpoint_of_one_learner_is_refused_by_the_other(tmp_path: Path) -> None:
    run = street_run(tmp_path)
    written = save_checkpoint(tmp_path / "c", learner_of(run), Counters(1, 0, 0, 39), "0", Keeping(1))
    with pytest.raises(CheckpointError, match="its learner is fusion, this run's is ppo"):
        load_checkpoint(written, Learner.begin(RunConfig.from_run(run), SIZE))
    (written / "manifest.json").write_text(json.dumps({"format": "caraware-fusion-1", "files": {}}))
    with pytest.raises(CheckpointError, match="earlier format, which is not read any more"):
        load_checkpoint(written, learner_of(run))


def test_a_damaged_checkpoint_is_refused_and_the_one_before_it_used(tmp_path: Path) -> None:
    run = street_run(tmp_path)
    learner = shaken(learner_of(run))
    for updates in (1, 2):
        save_checkpoint(tmp_path / "c", learner, Counters(updates, 0, 0, -1), "0", Keeping(5))
    file = tmp_path / "c" / "update-000002" / "parameters.safetensors"
    file.write_bytes(file.read_bytes()[:-1] + b"\x01")
    with pytest.raises(CheckpointError, match="damaged"):
        load_checkpoint(file.parent, learner)
    newest = newest_sound_checkpoint(tmp_path / "c")
    assert newest is not None
    fresh = learner_of(run)
    assert Beginning.load(newest, fresh).counters.updates == fresh.updates == 1
    assert torch.equal(fresh.parameters.values, learner.parameters.values)
    wider = street_run(tmp_path)
    wider["config"]["trainer"]["hidden"] = [8]
    with pytest.raises(CheckpointError, match=r"16.*8"):
        load_checkpoint(newest, learner_of(wider))


def test_pieces_of_an_episode_hold_every_row_once() -> None:
    ticks, slots = 10, 3
    table = torch.arange(ticks * slots * COLUMNS, dtype=torch.float32).view(ticks, slots, COLUMNS)
    pieces = Episode(table, table[..., :2], torch.ones(ticks, slots)).pieces(4)
    assert pieces.table.shape == (4, 3 * slots, COLUMNS)
    assert torch.equal(pieces.table[:, slots : 2 * slots], table[4:8])
    assert pieces.valid.sum() == ticks * slots


def test_ticks_that_do_not_divide_are_refused() -> None:
    with pytest.raises(ConfigError, match="segment_ticks"):
        FusionConfig.from_run({"config": {"fusion": {"map": True, "segment_ticks": 100, "truncation_ticks": 64}}})
