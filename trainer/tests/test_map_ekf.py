"""The Kalman filter with a map: what it gains by lanes, that it sees no truth, and that a wrong map is noticed."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from caraware.baselines import Ekf, MapEkf, SensorNoise
from caraware.baselines.lanes import Pieces
from caraware.baselines.map_ekf import LaneKeeping, lane_map, lanes_of_net
from caraware.baselines.motion import YAW, X, Y
from caraware.baselines.samples import read_samples
from synthetic_vehicle import Track, VehicleObservation, observations, sensor_tables, steady_track

TICKS, VEHICLES, HEADING_RAD, APART_M = 120, 5, 0.6, 40.0
NOSE_M = LaneKeeping().nose_m


def straight() -> Track:
    """Vehicles that drive straight on, side by side, each on a road of its own."""
    track = steady_track(TICKS, VEHICLES, 1)
    held = np.full_like(track.x_m, HEADING_RAD)
    way_m = np.cumsum(np.vstack((np.zeros(VEHICLES), track.speed_mps[1:] * 0.01)), 0)
    still = np.zeros_like(held)
    return replace(
        track,
        x_m=way_m * np.cos(held) - APART_M * np.arange(VEHICLES) * np.sin(held),
        y_m=way_m * np.sin(held) + APART_M * np.arange(VEHICLES) * np.cos(held),
        yaw_rad=held,
        yaw_rate_radps=still,
        accel_mps2=still,
        felt_mps2=still,
    )


def lanes_of(track: Track, *, aside_m: float = 0.0) -> Pieces:
    """A straight lane for each vehicle, along its way, or beside it to the left."""
    yaw = torch.tensor(track.yaw_rad[0], dtype=torch.float32)
    x, y = (torch.tensor(column[0], dtype=torch.float32) for column in (track.x_m, track.y_m))
    ones = torch.ones_like(x)
    return Pieces(
        x - 30 * yaw.cos() - aside_m * yaw.sin(),
        y - 30 * yaw.sin() + aside_m * yaw.cos(),
        yaw,
        200 * ones,
        200 * ones,
        13.9 * ones,
        *torch.zeros(7, len(ones)),
    )


def noise_of_tables() -> SensorNoise:
    noise = SensorNoise.from_run({"config": sensor_tables()})
    assert noise is not None
    return noise


def mean_error_m(ekf: Ekf, ticks: Iterator[VehicleObservation]) -> float:
    errors: list[float] = []
    for obs in ticks:
        ekf.step(read_samples(obs, ekf.noise.convention))
        errors += np.hypot(*(ekf.position_m - np.asarray(obs.truth)[:, :2]).T).tolist()
    return float(np.mean(errors))


@pytest.fixture(scope="module")
def run() -> Callable[[Ekf], float]:
    track = straight()
    ticks = list(observations(track, seed=2))
    return lambda ekf: mean_error_m(ekf, iter(ticks))


def test_it_is_better_than_the_filter_without_a_map(run: Callable[[Ekf], float]) -> None:
    noise = noise_of_tables()
    assert run(MapEkf(noise, lane_map(lanes_of(straight())))) < 0.8 * run(Ekf(noise))


@pytest.mark.parametrize("aside_m", [3.0, -3.0])
def test_a_map_that_lies_beside_the_roads_is_noticed(run: Callable[[Ekf], float], aside_m: float) -> None:
    noise = noise_of_tables()
    right, wrong = (MapEkf(noise, lane_map(lanes_of(straight(), aside_m=m))) for m in (0.0, aside_m))
    assert run(right) < 0.5 * run(wrong)


def test_far_from_every_lane_it_is_the_filter_without_a_map(run: Callable[[Ekf], float]) -> None:
    noise, lanes = noise_of_tables(), lanes_of(straight())
    away = replace(lanes, x_m=lanes.x_m + 5000.0)
    assert run(MapEkf(noise, lane_map(away))) == run(Ekf(noise))


def test_a_lane_that_leads_another_way_is_not_taken(run: Callable[[Ekf], float]) -> None:
    noise, lanes = noise_of_tables(), lanes_of(straight())
    other = replace(lanes, heading_rad=lanes.heading_rad + math.pi)
    assert run(MapEkf(noise, lane_map(other))) == run(Ekf(noise))


def test_it_sees_no_truth() -> None:
    noise, lanes = noise_of_tables(), lane_map(lanes_of(straight()))
    honest, lied = MapEkf(noise, lanes), MapEkf(noise, lanes)
    for obs in observations(straight(), seed=2):
        honest.step(read_samples(obs, noise.convention))
        lied.step(read_samples(replace(obs, truth=obs.truth + 100.0), noise.convention))
    np.testing.assert_array_equal(honest.position_m, lied.position_m)


def test_its_jacobian_is_that_of_the_way_from_the_nose_to_the_lane() -> None:
    """One correction without noise puts the nose onto the lane, by the least change that the covariance allows."""
    noise, track = noise_of_tables(), straight()
    ekf = MapEkf(noise, lane_map(lanes_of(track)), LaneKeeping(std_m=1e-4, gate=1e9))
    first = next(observations(track, seed=2))
    ekf.step(read_samples(first, noise.convention))
    before = ekf.belief.mean.copy()
    ekf._correct_by_map(np.ones(VEHICLES, bool))
    lane_rad = track.yaw_rad[0]
    nose = ekf.belief.mean[[X, Y]] + NOSE_M * np.stack((np.cos(ekf.belief.mean[YAW]), np.sin(ekf.belief.mean[YAW])))
    offset = nose - np.stack((track.x_m[0], track.y_m[0]))
    across_m = offset[1] * np.cos(lane_rad) - offset[0] * np.sin(lane_rad)
    corrected = np.abs(ekf.belief.mean - before).max(0) > 0
    assert corrected.any()
    assert np.abs(across_m[corrected]).max() < 0.02


def test_a_net_that_cannot_be_read_gives_no_map(tmp_path: Path) -> None:
    broken = tmp_path / "broken.net.xml"
    broken.write_text("<net><edge><lane shape='0,0 1,1'")
    assert lanes_of_net(broken) is None
    assert lanes_of_net(tmp_path / "none.net.xml") is None
