"""Actions that correct the newest fix: what they mean, what the networks see, and that no map is too large for them."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from caraware.ipc.run_file import ConfigError, RunFile
from caraware.learn.build import build_ppo
from caraware.learn.config import TrainerConfig
from caraware.learn.ppo import Ppo
from caraware.learn.rollout import Rollout
from caraware.tasks.contract import TaskStep
from caraware.tasks.correction import FURTHEST_UNITS
from caraware.tasks.localisation import Localisation
from caraware.tasks.table import task_of_run
from synthetic import SyntheticObservation, run_file

HISTORY, TICK_S, NOISE_M, SPEED_MPS = 4, 0.1, 6.0, 9.0
NAMES = ("gnss_x", "gnss_y", "compass", "speed")
WIDE_M = 50_000.0


def run_of(width_m: float = WIDE_M, **tables: dict[str, Any]) -> RunFile:
    """A run file of a square map with fixes of `NOISE_M`."""
    half = width_m / 2
    run: RunFile = run_file("unused", actions_per_observation=1)
    run["map"] = {"bounds_m": [-half, -half, half, half]}
    ranges = {"gnss_x": [-half, half], "gnss_y": [-half, half], "compass": [0.0, math.tau], "speed": [0.0, 30.0]}
    run["observation_fields"] = [{"name": name, "unit": "", "range": ranges[name]} for name in NAMES]
    run["config"]["observation"] = {"fields": list(NAMES), "history": HISTORY, "scale": "minus_one_to_one"}
    run["config"]["task"] = {"kind": "localisation", "action": "correction"}
    run["config"]["run"] |= {"tick_s": TICK_S}
    run["config"]["gnss"] = {"noise_std_deg": [0.0, 0.0], "noise_std_m": [NOISE_M, NOISE_M, 0.0]}
    run["config"]["blackout"] = {"enabled": False, "policy": "hold"}
    for name, table in tables.items():
        run["config"][name] = run["config"].get(name, {}) | table
    return run


def task_of(run: RunFile) -> Localisation:
    task = task_of_run(run)
    assert isinstance(task, Localisation)
    return task


def rows(
    count: int, seed: int, width_m: float = WIDE_M, noise_m: float = NOISE_M
) -> tuple[torch.Tensor, np.ndarray, np.ndarray]:
    """Observations `[n, HISTORY * 4]` of vehicles that drive straight on, the newest fixes and the truth `[n, 2]`."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(-0.4, 0.4, (count, 2)) * width_m
    compass = rng.uniform(0.0, math.tau, count)
    way = SPEED_MPS * TICK_S * np.stack((np.sin(compass), np.cos(compass)), 1)
    ticks = []
    for back in reversed(range(HISTORY)):
        fix = place - back * way + rng.normal(0.0, noise_m, (count, 2))
        columns = (fix / (width_m / 2), (compass / math.pi - 1)[:, None], np.full((count, 1), SPEED_MPS / 15 - 1))
        ticks.append(np.concatenate(columns, 1))
    return torch.tensor(np.concatenate(ticks, 1), dtype=torch.float32), fix, place


def test_no_action_is_the_fix_itself_on_a_map_of_50_km() -> None:
    task = task_of(run_of())
    observation, fix_m, _ = rows(50, 1)
    assert np.abs(task.answer(torch.zeros(50, 2), observation).numpy() - fix_m).max() < 0.005
    moved = task.answer(torch.tensor([[1.0, -0.5]]).expand(50, 2), observation).numpy() - fix_m
    assert moved == pytest.approx(np.tile([NOISE_M, -NOISE_M / 2], (50, 1)), abs=0.01)
    assert task.metres_per_action() == [NOISE_M, NOISE_M]


def test_several_actions_of_a_row_correct_one_fix() -> None:
    task = task_of(run_of())
    observation, fix_m, place_m = rows(5, 2)
    truth = torch.tensor(np.concatenate((place_m, np.zeros((5, 2))), 1), dtype=torch.float32)
    actions, step = torch.randn(5, 3, 2), TaskStep(observation, truth)
    alone = torch.stack([task.error_m(actions[:, i], step) for i in range(3)], 1)
    torch.testing.assert_close(task.error_m(actions, step), alone)
    assert task.error_m(torch.zeros(5, 2), step).numpy() == pytest.approx(np.hypot(*(fix_m - place_m).T), abs=0.01)


def test_networks_see_older_fixes_carried_to_the_newest() -> None:
    """Without noise every older fix, carried forward by wheel speed and compass, lies on the newest."""
    task = task_of(run_of())
    exact, _, _ = rows(40, 3, noise_m=0.0)
    seen = task.network_input(exact).unflatten(1, (HISTORY, len(NAMES)))
    assert seen[:, :-1, :2].abs().max() < 0.01
    assert torch.equal(seen[:, -1], exact.unflatten(1, (HISTORY, len(NAMES)))[:, -1])
    noisy, fix_m, _ = rows(4000, 4)
    seen = task.network_input(noisy).unflatten(1, (HISTORY, len(NAMES)))
    # The difference of two fixes has the variance of both.
    assert seen[:, 0, :2].std().item() == pytest.approx(math.sqrt(2.0), rel=0.05)
    assert np.abs(task.answer(torch.zeros(4000, 2), task.network_input(noisy)).numpy() - fix_m).max() < 0.005


def test_what_is_far_from_the_newest_fix_is_cut() -> None:
    observation, _, _ = rows(3, 5)
    observation[:, 0] = 0.9
    assert task_of(run_of()).network_input(observation)[:, 0].abs().max() <= FURTHEST_UNITS


@pytest.mark.parametrize(
    ("tables", "key"),
    [
        ({"observation": {"fields": ["compass"]}}, "observation.fields"),
        ({"blackout": {"enabled": True, "policy": "nan"}}, "blackout.policy"),
    ],
)
def test_where_no_fix_is_seen_it_is_refused(tables: dict[str, Any], key: str) -> None:
    with pytest.raises(ConfigError, match=key):
        task_of_run(run_of(**tables))


def test_a_run_file_without_the_key_names_places() -> None:
    run = run_of()
    del run["config"]["task"]["action"]
    task = task_of(run)
    assert not task.is_relative
    assert task.answer(torch.ones(1, 2)).tolist() == [[WIDE_M / 2, WIDE_M / 2]]


def ticks_of(count: int, vehicles: int, width_m: float) -> list[SyntheticObservation]:
    none, ticks = np.zeros(vehicles, bool), []
    for tick in range(count):
        observation, fix_m, place_m = rows(vehicles, 100 + tick, width_m)
        ticks.append(
            SyntheticObservation(
                tick=tick,
                observation=observation,
                truth=torch.tensor(np.concatenate((place_m, np.zeros((vehicles, 2))), 1), dtype=torch.float32),
                gnss_m=torch.tensor(fix_m, dtype=torch.float32),
                vehicle=np.arange(vehicles, dtype=np.uint32),
                valid=~none,
                terminated=none.copy(),
                truncated=none.copy(),
            )
        )
    return ticks


def learnt(run: RunFile, ticks: list[SyntheticObservation], **settings: object) -> Ppo:
    run["config"]["trainer"] |= {"horizon": 1024, "batch_size": 256, "hidden": [64, 64]} | settings
    ppo = build_ppo(TrainerConfig.from_run(run), HISTORY * len(NAMES), task_of(run))
    rollout = Rollout(1024, HISTORY * len(NAMES), bootstrap=False)
    for obs in ticks:
        rollout.add(obs)
        if rollout.full():
            ppo.learn(rollout.take())
    return ppo


@pytest.mark.parametrize("width_m", [200.0, WIDE_M])
def test_it_learns_to_be_better_than_the_fix_on_maps_of_any_size(width_m: float) -> None:
    ppo = learnt(run_of(width_m), ticks_of(240, 256, width_m))
    observation, fix_m, place_m = rows(4000, 7, width_m)
    raw_m = np.hypot(*(fix_m - place_m).T).mean()
    (predicted_m,) = ppo.predict_m([observation])
    assert np.hypot(*(predicted_m.numpy() - place_m).T).mean() < 0.85 * raw_m
