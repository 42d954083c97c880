"""Each baseline beats a deliberately broken copy of itself: an opponent that was handicapped would be noticed."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from caraware.baselines import Ekf, MapEkf, SensorNoise, Smoother
from caraware.baselines.map_ekf import lane_map
from caraware.baselines.samples import read_samples
from caraware.learn.rewards import distance_m
from synthetic import street_ticks
from synthetic_vehicle import VehicleObservation, observations, town_track
from test_map_ekf import lanes_of, mean_error_m, noise_of_tables, straight
from test_ppo import NOISE_M, TOY, fresh
from test_supervised import beside, train_both

TICKS, VEHICLES = 120, 10
WRONG_NOISE: dict[str, dict[str, Any]] = {
    "fixes taken for exact": {"fix_std_m": (0.05, 0.05)},
    "a compass taken for worthless": {"compass_std_rad": 10.0, "gyro_std_radps": 1.0},
    "a wheel taken for worthless": {"wheel_std_mps": 100.0, "accel_std_mps2": 50.0},
}


def ticks() -> Iterator[VehicleObservation]:
    return observations(town_track(TICKS, VEHICLES, 3), seed=4)


def smoothed_m(noise: SensorNoise) -> float:
    ekf, errors = Ekf(noise), []
    smoother = Smoother(ekf)
    for obs in ticks():
        ekf.step(read_samples(obs, noise.convention))
        smoother.push(np.asarray(obs.truth)[:, :2])
    for tick in smoother.finish():
        errors.append(np.hypot(*(tick.mean[:2].T - tick.label).T).mean())
    return float(np.mean(errors))


@pytest.mark.parametrize("handicap", WRONG_NOISE)
def test_the_filter_beats_itself_with_wrong_noise(handicap: str) -> None:
    noise = noise_of_tables()
    right, wrong = (mean_error_m(Ekf(n), ticks()) for n in (noise, replace(noise, **WRONG_NOISE[handicap])))
    assert right < 0.9 * wrong


def test_the_filter_beats_itself_with_biased_fixes() -> None:
    def biased() -> Iterator[VehicleObservation]:
        for obs in ticks():
            yield replace(obs, gnss_m=obs.gnss_m + 2.0)

    assert mean_error_m(Ekf(noise_of_tables()), ticks()) < 0.5 * mean_error_m(Ekf(noise_of_tables()), biased())


def test_the_filter_with_a_map_beats_itself_with_wrong_noise_and_with_a_shifted_map() -> None:
    noise, track = noise_of_tables(), straight()
    right, exact, shifted = (
        mean_error_m(MapEkf(n, lane_map(lanes_of(track, aside_m=aside_m))), observations(track, seed=2))
        for n, aside_m in ((noise, 0.0), (replace(noise, fix_std_m=(0.05, 0.05)), 0.0), (noise, 2.0))
    )
    assert right < 0.9 * exact and right < 0.9 * shifted


def test_the_smoother_beats_itself_with_wrong_noise_and_the_filter() -> None:
    noise = noise_of_tables()
    right = smoothed_m(noise)
    assert right < 0.9 * smoothed_m(replace(noise, fix_std_m=(0.05, 0.05)))
    assert right < mean_error_m(Ekf(noise), ticks())


def test_the_regression_beats_itself_with_an_eighth_of_its_steps() -> None:
    """The handicap that this baseline had: half of the samples, once each."""
    ticks = list(street_ticks(100, 64, NOISE_M, seed=99))
    observation, truth = (torch.cat([getattr(obs, name) for obs in ticks]) for name in ("observation", "truth"))
    means_m: list[float] = []
    for epochs, updates in ((4, 40), (1, 20)):
        ppo = fresh(**TOY | {"epochs": epochs})
        baseline = beside(ppo)
        train_both(ppo, baseline, updates)
        means_m.append(distance_m(baseline.predict_m(observation), truth).mean().item())
    assert means_m[0] < 0.9 * means_m[1]
