"""Policy, raw fixes, filter and smoother over the same rows, from the evaluation to the report."""

import json
import logging
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from caraware.baselines import BaselineErrors, Baselines, SensorNoise
from caraware.baselines.noise import ImuConvention
from caraware.baselines.samples import read_samples
from caraware.ipc.channel import read_only_tensor
from caraware.ipc.stream import Observation
from caraware.report import evaluation
from caraware.report.evaluation import ESTIMATORS, Evaluation
from caraware.run.config import RunConfig
from caraware.run.loop import TrainingLoop
from synthetic import SyntheticChannel, run_file, street_ticks
from synthetic_vehicle import VehicleObservation, observations, sensor_tables, town_track, vehicle_run
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

TICKS, VEHICLES = 60, 6


def episodes(*evaluations: bool, ticks: int = TICKS) -> Iterator[VehicleObservation]:
    """One episode for each argument, each with its own seed; True for evaluation. A third of the rows is not valid."""
    rng = np.random.default_rng(9)
    for episode, is_evaluation in enumerate(evaluations):
        for obs in observations(town_track(ticks, VEHICLES, episode), seed=episode):
            yield replace(
                obs,
                tick=episode * ticks + obs.tick,
                episode=episode,
                evaluation=is_evaluation,
                valid=rng.random(VEHICLES) < 0.67,
                truncated=np.full(VEHICLES, obs.tick == 0 and episode > 0),
                last=episode == len(evaluations) - 1 and obs.tick == ticks - 1,
            )


def run_over(tmp_path: Path, ticks: Iterator[VehicleObservation], run: dict[str, Any]) -> SyntheticChannel:
    channel = SyntheticChannel(run, ticks)
    TrainingLoop(channel, RunConfig.from_run(run), lambda: False).run()
    return channel


def part(tmp_path: Path) -> dict[str, Any]:
    written: dict[str, Any] = json.loads((tmp_path / "parts" / "trainer.json").read_text())
    return written


def test_all_are_measured_on_the_same_valid_rows(tmp_path: Path) -> None:
    """Compares with sums taken by hand: the filter alone, and the smoother over each whole episode."""
    run_over(tmp_path, episodes(True, True), vehicle_run(str(tmp_path)))
    expected: dict[str, list[float]] = {"raw_gnss": [], "ekf": [], "rts": []}
    noise = SensorNoise.from_run({"config": sensor_tables()})
    assert noise is not None
    by_hand = Baselines(noise)
    for obs in episodes(True, True):
        if obs.tick % TICKS == 0:
            expected["rts"] += [e for tick in by_hand.finish_episode() for e in tick.error_m]
            by_hand = Baselines(noise)
        of_filters, early = by_hand.add(obs)
        assert early == [] and list(of_filters) == ["ekf"]
        filtered = of_filters["ekf"]
        np.testing.assert_array_equal(filtered.vehicle, np.flatnonzero(obs.valid))
        expected["ekf"] += list(filtered.error_m)
        expected["raw_gnss"] += (obs.gnss_m[:, :2] - obs.truth[:, :2]).norm(dim=1)[obs.valid].tolist()
    expected["rts"] += [e for tick in by_hand.finish_episode() for e in tick.error_m]
    (result,) = part(tmp_path)["evaluations"]
    for name, errors_m in expected.items():
        assert len(errors_m) == result["samples"]
        assert result[f"{name}_mean_error_m"] == pytest.approx(np.mean(errors_m), rel=1e-5)
    assert result["rts_mean_error_m"] < result["ekf_mean_error_m"] < result["raw_gnss_mean_error_m"] / 3


def test_the_report_has_every_mean_with_its_interval(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    net = tmp_path / "far.net.xml"
    net.write_text('<net><edge id="far"><lane id="far_0" speed="13.9" shape="9000,9000 9050,9000"/></edge></net>')
    run = vehicle_run(str(tmp_path)) | {"scene_files": {"net_file": str(net)}}
    run_over(tmp_path, episodes(True, False, True, True, True), run)
    report = part(tmp_path)
    assert report["map_ekf_mean_error_m"] == report["ekf_mean_error_m"]  # no lane is near
    first, final = report["evaluations"]
    assert (report["evaluation_seeds"], first["episodes"]) == (3, 1)
    for name in ESTIMATORS:
        assert report[f"{name}_mean_error_m"] == final[f"{name}_mean_error_m"] > 0
        assert 0 < report[f"{name}_ci95_m"] < 4 * report[f"{name}_mean_error_m"]
        # A single seed has no spread.
        assert first[f"{name}_ci95_m"] is None
        assert first[f"{name}_standard_error_m"] > 0
    assert "sees the future" in report["rts_note"]
    (line, _) = (r.message for r in caplog.records if r.message.startswith("evaluation at"))
    expected_words = [
        f"{label} {report['evaluations'][0][f'{name}_mean_error_m']:.3f} ± " for name, label in ESTIMATORS.items()
    ]
    assert all(words in line for words in expected_words)
    assert "sees the future" in line


def test_intervals_are_over_seeds() -> None:
    """Three episodes whose mean errors are known by hand: t(0.95, 2) s/√3."""
    phase = Evaluation("error_m")
    for obs in street_ticks(6, 4, 1.0, seed=1):
        error_m = np.full(4, [2.0, 3.0, 7.0][obs.tick // 2])
        phase.add(replace(obs, episode=obs.tick // 2), {"ppo": error_m, "raw_gnss": 2 * error_m})
    result = phase.result(0, 1)
    assert result is not None
    policy = result.estimates["ppo"]
    assert (policy.mean, result.episodes) == (4.0, 3)
    assert policy.ci95 is not None and policy.ci95 == pytest.approx(4.302653 * math.sqrt(7 / 3), rel=1e-6)
    assert result.estimates["raw_gnss"].ci95 == pytest.approx(2 * policy.ci95)
    assert policy.half_width() == policy.ci95
    assert "95 % over 3 seeds" in str(result)


def test_tensorboard_has_a_curve_for_each(tmp_path: Path) -> None:
    run_over(tmp_path, episodes(True), vehicle_run(str(tmp_path)))
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    report = part(tmp_path)
    for tag, name in (("_m", "ppo"), ("_raw_gnss_m", "raw_gnss"), ("_ekf_m", "ekf"), ("_rts_sees_the_future_m", "rts")):
        (point,) = events.Scalars(f"error/evaluation{tag}")
        assert point.value == pytest.approx(report[f"{name}_mean_error_m"], rel=1e-5)


def test_training_never_runs_a_filter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[bool] = []

    class Watched(Baselines):
        def add(self, obs: Observation) -> tuple[dict[str, BaselineErrors], list[BaselineErrors]]:
            seen.append(obs.evaluation)
            return super().add(obs)

    monkeypatch.setattr(evaluation, "Baselines", Watched)
    run_over(tmp_path, episodes(True, False, False, True, ticks=20), vehicle_run(str(tmp_path)))
    assert seen == [True] * 40


def test_the_policy_s_results_do_not_depend_on_the_baselines(tmp_path: Path) -> None:
    with_, without = tmp_path / "with", tmp_path / "without"
    run_over(with_, episodes(True, False, True), vehicle_run(str(with_)))
    run_over(without, episodes(True, False, True), run_file(str(without)))
    one, two = part(with_), part(without)
    assert one["ppo_mean_error_m"] == two["ppo_mean_error_m"]
    assert one["raw_gnss_mean_error_m"] == two["raw_gnss_mean_error_m"]
    assert set(one) == set(two)
    assert [two[key] for key in ("ekf_mean_error_m", "ekf_ci95_m", "rts_mean_error_m", "rts_ci95_m")] == [None] * 4


def test_the_interval_covers_the_true_mean() -> None:
    """Errors whose mean is 2 m in clusters of their own, 400 phases: 95 % of the intervals hold it, within 4 σ."""
    rng, covered = np.random.default_rng(1), 0
    (obs,) = street_ticks(1, 40, 5.0, seed=1)
    for _ in range(400):
        phase = Evaluation("error_m")
        level = rng.normal(2.0, 0.5, 40)
        for _ in range(5):
            errors_m = level + rng.normal(0, 0.3, 40)
            phase.add(obs, {"ppo": errors_m, "raw_gnss": errors_m})
        result = phase.result(0, 0)
        assert result is not None
        covered += abs(result.estimates["ppo"].mean - 2.0) < result.estimates["ppo"].half_width()
    assert abs(covered / 400 - 0.95) < 4 * math.sqrt(0.95 * 0.05 / 400)


def test_samples_are_read_from_read_only_memory_and_copied() -> None:
    obs = next(observations(town_track(2, 3, 1)))
    locked = replace(
        obs,
        gnss_m=read_only_tensor(obs.gnss_m.numpy()),
        imu=read_only_tensor(obs.imu.numpy()),
        speed_steering=read_only_tensor(obs.speed_steering.numpy()),
    )
    one, two = read_samples(obs, ImuConvention.KINEMATIC), read_samples(locked, ImuConvention.KINEMATIC)
    for name, array in vars(one).items():
        np.testing.assert_array_equal(array, getattr(two, name))
    before = {name: np.array(array) for name, array in vars(one).items()}
    for array in (obs.gnss_m, obs.imu, obs.speed_steering, obs.vehicle, obs.valid, obs.age_s):
        array[:] = 1 if isinstance(array, torch.Tensor) else array.dtype.type(1)
    for name, array in vars(one).items():
        np.testing.assert_array_equal(array, before[name])
