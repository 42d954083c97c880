"""Several environments in one loop: learning depends on their ticks, not on how the ticks arrive together."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from caraware.report.evaluation import Estimate, EvaluationResult, pooled
from caraware.run.checkpoint import load_history
from caraware.run.config import RunConfig
from caraware.run.environment import share
from caraware.run.learner import Learner
from caraware.run.loop import TrainingLoop
from caraware.run.manifest import read_manifest
from safetensors.torch import load_file
from synthetic import FIELDS, SyntheticChannel, SyntheticObservation, latest_checkpoint, run_file, with_evaluation

VEHICLES = 16
TICKS = 76
"""Of each environment: 64 for training, six for evaluation before and after."""


def ticks(environment: int) -> Iterator[SyntheticObservation]:
    return with_evaluation(64, 6, VEHICLES, 5.0, 1 + environment)


def settings(folder: Path, envs: int = 2, **trainer: object) -> dict[str, Any]:
    run = run_file(str(folder), **trainer)
    run["config"]["run"] |= {"envs": envs, "first_env": 0}
    return run


def loop(
    run: dict[str, Any], channels: list[SyntheticChannel], learner: Learner | None = None, until: int = TICKS
) -> TrainingLoop:
    first, *others = channels
    return TrainingLoop(
        first, RunConfig.from_run(run), lambda: first.consumed_up_to >= until, others=others, learner=learner
    )


def parameters(folder: Path) -> dict[str, torch.Tensor]:
    return load_file(latest_checkpoint(folder / "checkpoints") / "parameters.safetensors")


def part(folder: Path) -> dict[str, Any]:
    written: dict[str, Any] = json.loads((folder / "parts" / "trainer.json").read_text())
    return written


def test_how_the_ticks_of_environments_arrive_together_changes_nothing(tmp_path: Path) -> None:
    for name, groups in (("even", (8, 8)), ("uneven", (1, 13)), ("the other way", (20, 2))):
        run = settings(tmp_path / name)
        channels = [SyntheticChannel(run, ticks(env), group) for env, group in enumerate(groups)]
        assert loop(run, channels).run()
        assert [channel.is_done for channel in channels] == [True, True]
        assert [channel.consumed_up_to for channel in channels] == [TICKS - 1] * 2
        # 8 updates of 256 samples, 8 ticks of 16 vehicles from each environment, after 6 ticks of evaluation.
        assert [channel.committed_up_to for channel in channels] == [69, 69]
    one, two, three = (parameters(tmp_path / name) for name in ("even", "uneven", "the other way"))
    assert part(tmp_path / "even")["updates"] == 8
    for name, tensor in one.items():
        assert torch.equal(tensor, two[name])
        assert torch.equal(tensor, three[name])


def test_evaluations_of_all_environments_are_reported_as_one(tmp_path: Path) -> None:
    run = settings(tmp_path)
    loop(run, [SyntheticChannel(run, ticks(env)) for env in range(2)]).run()
    report = part(tmp_path)
    assert [evaluation["samples"] for evaluation in report["evaluations"]] == [2 * 6 * VEHICLES] * 2
    assert [evaluation["policy_version"] for evaluation in report["evaluations"]] == [0, 8]
    assert (report["received_ticks"], report["lost_ticks"], report["duplicated_ticks"]) == (2 * TICKS, 0, 0)
    assert report["env_steps"] == 2 * 64 * VEHICLES


def test_the_other_environments_continue_when_one_ends_early(tmp_path: Path) -> None:
    run = settings(tmp_path)
    short = (replace(obs, last=obs.tick == 30) for obs in ticks(0) if obs.tick <= 30)
    channels = [SyntheticChannel(run, short), SyntheticChannel(run, ticks(1))]
    loop(run, channels).run()
    report = part(tmp_path)
    # 25 training ticks in the first environment fill three shares of eight; the rest of the second is only evaluated.
    assert report["updates"] == 3
    assert report["env_steps"] == (25 + 64) * VEHICLES
    assert report["untrained_env_steps"] == (25 + 64 - 2 * 24) * VEHICLES
    assert channels[1].consumed_up_to == TICKS - 1
    assert channels[1].is_done


def test_a_successor_continues_each_environment_at_its_own_tick(tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    run = settings(whole)
    loop(run, [SyntheticChannel(run, ticks(env)) for env in range(2)]).run()
    run = settings(cut)
    loop(run, [SyntheticChannel(run, ticks(env), 4) for env in range(2)], until=40).run()
    checkpoint = latest_checkpoint(cut / "checkpoints")
    assert [place.committed_tick for place in load_history(checkpoint).others] == [37]
    assert read_manifest(checkpoint).counters.committed_tick == 37
    learner = Learner.begin(replace(RunConfig.from_run(run), resume_from=checkpoint), FIELDS)
    first_ticks = [learner.first_tick(env) for env in range(3)]
    assert first_ticks == [38, 38, 0]
    rest = [(obs for obs in ticks(env) if obs.tick >= first_ticks[env]) for env in range(2)]
    loop(run, [SyntheticChannel(run, each) for each in rest], learner=learner).run()
    one, two = parameters(whole), parameters(cut)
    assert all(torch.equal(tensor, two[name]) for name, tensor in one.items())
    assert part(cut)["received_ticks"] == 2 * TICKS
    assert part(cut)["lost_ticks"] == 0


def test_shares_of_a_horizon_add_up() -> None:
    assert [share(10, 3, index) for index in range(3)] == [4, 3, 3]
    assert share(256, 1, 0) == 256


def result(environment: int, samples: int, mean_m: float, standard_error_m: float) -> EvaluationResult:
    estimates = {"ppo": Estimate(mean_m, standard_error_m), "raw_gnss": Estimate(7.0, 0.1)}
    return EvaluationResult(100, 1, 1, samples, estimates, environment, metric="error_m")


def test_pooling_weighs_by_samples_and_waits_for_every_environment() -> None:
    phases = pooled([result(0, 300, 4.0, 0.2), result(0, 300, 3.0, 0.2), result(1, 100, 8.0, 0.6)])
    assert len(phases) == 1
    assert phases[0].samples == 400
    assert phases[0].estimates["ppo"].mean == pytest.approx(0.75 * 4 + 0.25 * 8)
    assert phases[0].estimates["ppo"].standard_error == pytest.approx((0.15**2 + 0.15**2) ** 0.5)
    assert phases[0].mean("ekf") is None
