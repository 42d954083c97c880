"""The training loop and its process, with a channel of prepared ticks."""

import contextlib
import json
import math
import os
import signal
import sys
import types
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from caraware import train
from caraware.ipc.commits import COMMITS, CommitLog
from caraware.learn.ppo import NonFiniteLoss, UpdateStats
from caraware.run.config import RunConfig
from caraware.run.learner import Learner
from caraware.run.loop import TrainingLoop
from caraware.run.manifest import best_checkpoint, newest_sound_checkpoint, read_manifest
from caraware.run.stream_position import TickLedger
from full_disk import FullDisk, partial_files
from safetensors.torch import load_file
from synthetic import SyntheticChannel, SyntheticObservation, latest_checkpoint, run_file, street_ticks, with_evaluation
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

PNG = b"\x89PNG"


def loop_over(
    tmp_path: Path, ticks: Iterator[SyntheticObservation], group: int = 8, run: dict[str, Any] | None = None
) -> SyntheticChannel:
    """Run the whole loop."""
    channel = SyntheticChannel(run or run_file(str(tmp_path)), ticks, group)
    TrainingLoop(channel, RunConfig.from_run(channel.run), lambda: False).run()
    return channel


def part(tmp_path: Path) -> dict[str, Any]:
    written: dict[str, Any] = json.loads((tmp_path / "parts" / "trainer.json").read_text())
    return written


def final_parameters(tmp_path: Path) -> dict[str, torch.Tensor]:
    return load_file(latest_checkpoint(tmp_path / "checkpoints") / "parameters.safetensors")


def test_a_run_from_the_first_tick_to_the_report(tmp_path: Path) -> None:
    run = run_file(str(tmp_path), plots=True)
    channel = loop_over(tmp_path, with_evaluation(100, 20, 16, 5.0, seed=1), run=run)
    report = part(tmp_path)
    assert (report["env_steps"], report["updates"], report["vehicles"]) == (1600, 6, 16)
    assert (report["received_ticks"], report["lost_ticks"], report["duplicated_ticks"]) == (140, 0, 0)
    assert report["untrained_env_steps"] == 1600 - 6 * 256
    assert [e["policy_version"] for e in report["evaluations"]] == [0, 6]
    assert [e["samples"] for e in report["evaluations"]] == [320, 320]
    assert report["ppo_mean_error_m"] == report["evaluations"][-1]["ppo_mean_error_m"]
    assert report["raw_gnss_mean_error_m"] == pytest.approx(5 * math.sqrt(math.pi / 2), rel=0.15)
    assert 0 < report["policy_std"] < 2
    assert channel.consumed_up_to == 139
    assert channel.committed_up_to == 20 + 6 * 16 - 1
    assert set(channel.predictions) == set(range(140))
    assert {"episode", "env_steps", "env_steps_per_s", "policy_std", "reward", "metrics"} < set(channel.reports[0])
    assert set(channel.reports[0]["metrics"]) == {"error_m", "raw_gnss_error_m"}
    for name in ("error.png", "sigma.png"):
        assert (tmp_path / "plots" / name).read_bytes().startswith(PNG)
    assert list((tmp_path / "tensorboard").glob("events*"))


def test_a_run_on_a_disk_that_is_full_at_every_file_waits_and_ends_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, full = tmp_path / "whole", tmp_path / "full"
    loop_over(whole, with_evaluation(100, 20, 16, 5.0, seed=1), run=run_file(str(whole)))
    disk = FullDisk(monkeypatch, times=2)
    loop_over(full, with_evaluation(100, 20, 16, 5.0, seed=1), run=run_file(str(full)))
    files = {".commits.json.partial", ".latest.partial", ".best.partial", ".trainer.json.partial", "manifest.json"}
    assert files < set(disk.refused)
    assert set(disk.refused.values()) == {2}
    one, two = final_parameters(whole), final_parameters(full)
    assert all(torch.equal(tensor, two[name]) for name, tensor in one.items())
    assert (full / COMMITS).read_bytes() == (whole / COMMITS).read_bytes()
    assert part(full)["ppo_mean_error_m"] == part(whole)["ppo_mean_error_m"]
    assert not partial_files(full)


def test_a_stop_ends_the_wait_for_space_of_a_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A wait that no stop ends would leave the supervisor nothing but SIGKILL."""
    disk = FullDisk(monkeypatch, times=0)
    record = CommitLog._write

    def fill(*arguments: Any) -> None:
        disk.fill()
        record(*arguments)

    monkeypatch.setattr(CommitLog, "_write", fill)
    channel = SyntheticChannel(run_file(str(tmp_path)), with_evaluation(100, 20, 16, 5.0, seed=1))
    config = RunConfig.from_run(channel.run)
    with pytest.raises(OSError, match="No space left"):
        TrainingLoop(channel, config, lambda: disk.refused.total() >= 3).run()
    assert set(disk.refused) == {".commits.json.partial"}
    assert channel.committed_up_to == -1
    assert latest_checkpoint(tmp_path / "checkpoints").exists()
    assert not partial_files(tmp_path)


def test_a_run_without_plots_draws_none(tmp_path: Path) -> None:
    loop_over(tmp_path, with_evaluation(100, 20, 16, 5.0, seed=1), run=run_file(str(tmp_path), plots=False))
    assert part(tmp_path)["updates"] == 6
    assert not (tmp_path / "plots").exists()


def test_an_evaluation_measures_policy_and_raw_gnss_on_the_same_valid_rows(tmp_path: Path) -> None:
    sent: list[SyntheticObservation] = []

    def ticks() -> Iterator[SyntheticObservation]:
        rng = np.random.default_rng(1)
        for obs in street_ticks(40, 8, 5.0, seed=1):
            sent.append(replace(obs, evaluation=True, valid=rng.random(8) < 0.6, last=obs.tick == 39))
            yield sent[-1]

    channel = loop_over(tmp_path, ticks())
    expected: dict[str, list[float]] = {"policy": [], "raw": []}
    for obs in sent:
        truth = obs.truth[:, :2]
        expected["policy"] += (channel.predictions[obs.tick] - truth).norm(dim=1)[obs.valid].tolist()
        expected["raw"] += (obs.gnss_m - truth).norm(dim=1)[obs.valid].tolist()
    report = part(tmp_path)
    assert report["ppo_mean_error_m"] == pytest.approx(np.mean(expected["policy"]), rel=1e-5)
    assert report["raw_gnss_mean_error_m"] == pytest.approx(np.mean(expected["raw"]), rel=1e-5)
    assert (report["env_steps"], report["updates"]) == (0, 0)
    assert report["evaluations"][0]["samples"] == len(expected["raw"])


def test_how_ticks_arrive_together_changes_nothing(tmp_path: Path) -> None:
    for group in (1, 3, 8):
        loop_over(
            tmp_path / str(group), with_evaluation(60, 9, 16, 5.0, 2), group, run_file(str(tmp_path / str(group)))
        )
    one, three, eight = (final_parameters(tmp_path / str(group)) for group in (1, 3, 8))
    for name, tensor in one.items():
        assert torch.equal(tensor, three[name])
        assert torch.equal(tensor, eight[name])
    errors = [part(tmp_path / str(group))["ppo_mean_error_m"] for group in (1, 3, 8)]
    assert errors == [errors[0]] * 3


def test_the_checkpoint_with_the_best_evaluation_is_kept(tmp_path: Path) -> None:
    """The first evaluation of a policy that has learnt is its best: the truth of the second one is 500 m away."""

    def ticks() -> Iterator[SyntheticObservation]:
        for obs in street_ticks(160, 16, 5.0, seed=3):
            phase = obs.tick // 40
            if phase == 3:
                obs.truth[:, :2] += 500.0
            yield replace(obs, episode=phase, evaluation=phase % 2 == 1, last=obs.tick == 159)

    loop_over(tmp_path, ticks(), run=run_file(str(tmp_path), checkpoint_interval=1, checkpoints_kept=1))
    first, second = part(tmp_path)["evaluations"]
    assert first["ppo_mean_error_m"] < second["ppo_mean_error_m"]
    best = best_checkpoint(tmp_path / "checkpoints")
    assert best == tmp_path / "checkpoints" / f"update-{first['policy_version']:06d}"
    assert read_manifest(best).counters.updates == first["policy_version"] == 2
    assert latest_checkpoint(tmp_path / "checkpoints").name == "update-000005"
    assert len(list((tmp_path / "checkpoints").glob("update-*"))) == 2


def test_tensorboard_has_every_tag_with_finite_values(tmp_path: Path) -> None:
    loop_over(tmp_path, with_evaluation(100, 20, 16, 5.0, seed=1))
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    tags = set(events.Tags()["scalars"])
    wanted = {f"update/{field.name}" for field in fields(UpdateStats)}
    assert {"update/policy_loss", "update/value_loss", "update/return_mean", "update/advantage_std"} < wanted
    assert {"update/ratio_max", "update/approximate_kl", "update/entropy", "update/sigma"} < wanted
    assert {"update/action_mean_x", "update/action_std_y", "update/action_outside"} < wanted
    wanted |= {"error/training_m", "error/training_raw_gnss_m", "error/evaluation_m", "error/evaluation_raw_gnss_m"}
    assert tags >= wanted | {"speed/env_steps_per_s", "speed/lag_ticks"}
    for tag in tags:
        points = events.Scalars(tag)
        assert len(points) == (2 if "evaluation" in tag else 6)
        assert all(math.isfinite(point.value) for point in points), tag


def test_the_course_of_training_has_every_update_and_evaluation(tmp_path: Path) -> None:
    loop_over(tmp_path, with_evaluation(100, 20, 16, 5.0, seed=1))
    lines = [json.loads(line) for line in (tmp_path / "learning.jsonl").read_text().splitlines()]
    updates = [line for line in lines if "training" in line]
    assert [line["update"] for line in updates] == [1, 2, 3, 4, 5, 6]
    for name in ("env_steps", "tick"):
        numbers = [line[name] for line in updates]
        assert numbers == sorted(set(numbers)), name
    assert {"sigma", "reward", "error_m", "raw_gnss_error_m"} <= updates[0]["training"].keys()
    evaluations = [line["evaluation"] for line in lines if "evaluation" in line]
    assert len(evaluations) == 2
    assert {"ppo", "raw_gnss"} <= evaluations[0].keys()


def test_a_prediction_comes_from_the_newest_policy(tmp_path: Path) -> None:
    channel = loop_over(tmp_path, with_evaluation(64, 1, 16, 5.0, 2), group=64)
    assert [channel.versions[tick] for tick in (0, 16, 17, 32, 33, 65)] == [0, 0, 1, 1, 2, 4]


def test_evaluation_ticks_never_reach_the_rollout(tmp_path: Path) -> None:
    loop_over(tmp_path / "a", with_evaluation(32, 5, 16, 5.0, 2), run=run_file(str(tmp_path / "a")))
    ticks = (replace(obs, evaluation=False) for obs in with_evaluation(32, 5, 16, 5.0, 2) if not obs.evaluation)
    channel = SyntheticChannel(run_file(str(tmp_path / "b")), ticks)
    loop = TrainingLoop(channel, RunConfig.from_run(channel.run), lambda: channel.consumed_up_to >= 36)
    loop.run()
    one, two = final_parameters(tmp_path / "a"), final_parameters(tmp_path / "b")
    assert all(torch.equal(tensor, two[name]) for name, tensor in one.items())


def test_lost_and_repeated_ticks_are_counted_and_repeats_not_learnt_from(tmp_path: Path) -> None:
    def ticks() -> Iterator[SyntheticObservation]:
        for obs in street_ticks(30, 16, 5.0, seed=1):
            if obs.tick not in (7, 8):
                yield replace(obs, last=obs.tick == 29)
            if obs.tick == 11:
                yield obs

    loop_over(tmp_path, ticks())
    report = part(tmp_path)
    assert (report["received_ticks"], report["lost_ticks"], report["duplicated_ticks"]) == (28, 2, 1)
    assert report["env_steps"] == 28 * 16


def test_a_resumed_run_counts_from_its_committed_tick() -> None:
    ledger = TickLedger(10)
    assert [ledger.first_sight(tick) for tick in (9, 10, 11, 13)] == [False, False, True, True]
    assert (ledger.received, ledger.lost, ledger.duplicated) == (2, 1, 2)


def test_stopping_and_resuming_ends_where_the_uninterrupted_run_does(tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    loop_over(whole, with_evaluation(64, 4, 16, 5.0, 3), run=run_file(str(whole)))
    channel = SyntheticChannel(run_file(str(cut)), with_evaluation(64, 4, 16, 5.0, 3), group=4)
    TrainingLoop(channel, RunConfig.from_run(channel.run), lambda: channel.consumed_up_to >= 40).run()
    first = part(cut)
    assert (first["updates"], first["untrained_env_steps"]) == (2, 8 * 16)
    resumed = run_file(str(cut)) | {"beginning": {"checkpoint": str(latest_checkpoint(cut / "checkpoints"))}}
    after = (obs for obs in with_evaluation(64, 4, 16, 5.0, 3) if obs.tick > 35)
    loop_over(cut, after, run=resumed)
    one, two = final_parameters(whole), final_parameters(cut)
    assert all(torch.equal(tensor, two[name]) for name, tensor in one.items())
    assert part(cut)["env_steps"] == part(whole)["env_steps"]


def test_stopping_before_the_first_tick_leaves_an_empty_report(tmp_path: Path) -> None:
    channel = SyntheticChannel(run_file(str(tmp_path)), iter(()))
    TrainingLoop(channel, RunConfig.from_run(channel.run), lambda: True).run()
    report = part(tmp_path)
    assert (report["env_steps"], report["updates"], report["ppo_mean_error_m"]) == (0, 0, None)
    assert not (tmp_path / "checkpoints").exists()


def test_a_loss_that_is_no_number_saves_its_batch(tmp_path: Path) -> None:
    def ticks() -> Iterator[SyntheticObservation]:
        for obs in street_ticks(100, 16, 5.0, seed=1):
            if obs.tick == 20:
                obs.truth[3, 0] = torch.nan
            yield obs

    with pytest.raises(NonFiniteLoss) as caught:
        loop_over(tmp_path, ticks())
    assert caught.value.batch_file == tmp_path / "logs" / "nonfinite-update-000002.safetensors"
    batch = load_file(caught.value.batch_file)
    (row,) = torch.isnan(batch["reward"]).nonzero().flatten().tolist()
    assert (batch["tick"][row].item(), batch["vehicle"][row].item()) == (20, 3)


class ProcessChannel(SyntheticChannel):
    """What `caraware.ipc.channel.Channel` would be in the process under test."""

    def __init__(self, run_file_path: str, first_tick: int = 0, *, place: object = None) -> None:
        run = json.loads(Path(run_file_path).read_text())
        super().__init__(run, with_evaluation(32, 4, 16, 5.0, 1))


class TerminatedChannel(SyntheticChannel):
    """... whose supervisor asks the process to stop at tick 25."""

    def __init__(self, run_file_path: str, first_tick: int = 0, *, place: object = None) -> None:
        super().__init__(json.loads(Path(run_file_path).read_text()), self._ticks())

    @staticmethod
    def _ticks() -> Iterator[SyntheticObservation]:
        for obs in street_ticks(1_000_000, 16, 5.0, seed=1):
            if obs.tick == 25:
                os.kill(os.getpid(), signal.SIGTERM)
            yield obs


def install(monkeypatch: pytest.MonkeyPatch, channel: type[SyntheticChannel]) -> None:
    module = types.ModuleType("caraware.ipc.channel")
    module.Channel = channel  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "caraware.ipc.channel", module)


@pytest.fixture(autouse=True)
def signal_handlers() -> Iterator[None]:
    """The process under test is this one: give it its handlers back."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def channel_module(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, ProcessChannel)


def write_run(tmp_path: Path, run: dict[str, Any]) -> str:
    file = tmp_path / "run.json"
    file.write_text(json.dumps(run))
    return str(file)


def failure(tmp_path: Path) -> dict[str, Any]:
    written: dict[str, Any] = json.loads((tmp_path / "logs" / "trainer.error.json").read_text())
    return written


@pytest.mark.usefixtures("channel_module")
def test_the_process_ends_with_0(tmp_path: Path) -> None:
    assert train.main([write_run(tmp_path, run_file(str(tmp_path)))]) == 0
    assert part(tmp_path)["updates"] == 2
    assert not (tmp_path / "logs").exists()


def test_sigterm_commits_a_checkpoint_and_ends_with_0(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, TerminatedChannel)
    assert train.main([write_run(tmp_path, run_file(str(tmp_path), checkpoint_interval=1000))]) == 0
    report = part(tmp_path)
    assert (report["updates"], report["env_steps"], report["untrained_env_steps"]) == (2, 32 * 16, 0)
    assert latest_checkpoint(tmp_path / "checkpoints").name == "update-000002"


@pytest.mark.usefixtures("channel_module")
def test_a_bad_configuration_ends_with_2_and_the_cure(tmp_path: Path) -> None:
    assert train.main([write_run(tmp_path, run_file(str(tmp_path), learning_rate="fast"))]) == 2
    failed = failure(tmp_path)
    assert failed["kind"] == "config"
    assert "trainer.learning_rate" in failed["message"]
    assert "float" in failed["help"]


@pytest.mark.usefixtures("channel_module")
def test_a_damaged_checkpoint_ends_with_1(tmp_path: Path) -> None:
    run = run_file(str(tmp_path)) | {"beginning": {"checkpoint": str(tmp_path / "nothing")}}
    assert train.main([write_run(tmp_path, run)]) == 1
    assert "manifest.json" in failure(tmp_path)["message"]


def test_a_missing_package_ends_with_3(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "caraware.ipc.channel", None)
    assert train.main([write_run(tmp_path, run_file(str(tmp_path)))]) == 3
    assert failure(tmp_path)["kind"] == "missing"


def test_no_run_file_ends_with_2(tmp_path: Path) -> None:
    assert train.main([]) == 2
    (tmp_path / "run.json").write_text("{")
    assert train.main([str(tmp_path / "run.json")]) == 2


class KilledError(Exception):
    """The trainer dies in the middle of a tick."""


def stream(first: int, death: int | None = None) -> Iterator[SyntheticObservation]:
    """Evaluations at the ticks 0 to 19, 60 to 79 and 120 to 139; training in between."""
    for obs in street_ticks(140, 16, 5.0, seed=4):
        if obs.tick == death:
            raise KilledError
        if obs.tick >= first:
            episode, evaluation = obs.tick // 20, obs.tick // 20 in (0, 3, 6)
            truncated = np.full(16, obs.tick % 20 == 0)
            yield replace(obs, episode=episode, evaluation=evaluation, truncated=truncated, last=obs.tick == 139)


def stream_settings(folder: Path, discount: float) -> dict[str, Any]:
    """An update every 16 training ticks, a checkpoint with every second."""
    return run_file(str(folder), discount=discount, checkpoint_interval=2)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[float, Path]:
    """Directories of undisturbed runs, by their discount."""
    folders = {discount: tmp_path_factory.mktemp("whole") for discount in (0.0, 0.9)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrainingLoop, "_draw", lambda loop: None)
        for discount, folder in folders.items():
            loop_over(folder, stream(0), group=1, run=stream_settings(folder, discount))
    return folders


@pytest.mark.parametrize("discount", [0.0, 0.9])
@pytest.mark.parametrize("tick", [2, 11, 30, 36, 60, 99, 110, 125])
@pytest.mark.parametrize("end", ["left", "killed"])
def test_a_successor_ends_where_the_undisturbed_run_does(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    undisturbed: dict[float, Path],
    end: str,
    tick: int,
    discount: float,
) -> None:
    monkeypatch.setattr(TrainingLoop, "_draw", lambda loop: None)
    whole, settings = undisturbed[discount], stream_settings(tmp_path, discount)
    config = RunConfig.from_run(settings)
    first = SyntheticChannel(settings, stream(0, tick if end == "killed" else None), 1)
    loop = TrainingLoop(
        first, config, lambda: False, leave_requested=lambda: end == "left" and first.consumed_up_to >= tick
    )
    with contextlib.suppress(KilledError):
        assert not loop.run()
    newest = newest_sound_checkpoint(tmp_path / "checkpoints")
    learner = Learner.begin(replace(config, resume_from=newest), 4)
    second = SyntheticChannel(settings, stream(learner.first_tick()), 1)
    assert TrainingLoop(second, config, lambda: False, learner=learner).run()
    one, two = final_parameters(whole), final_parameters(tmp_path)
    assert all(torch.equal(tensor, two[name]) for name, tensor in one.items())
    assert part(tmp_path) == part(whole)
