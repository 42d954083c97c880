"""The rollout: every sample is one vehicle at one tick, whatever the slots do."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from caraware.ipc.stream import EMPTY_SLOT
from caraware.learn.config import MapBounds, TrainerConfig
from caraware.learn.rewards import bounded_inverse, distance_m
from caraware.learn.rollout import Horizon, Rollout
from synthetic import SIZE_M, SyntheticObservation, locating_ppo, run_file, street_ticks


def marked(tick: int, vehicles: list[int], **changes: Any) -> SyntheticObservation:
    """A tick in which every number encodes its vehicle and its tick."""
    n = len(vehicles)
    index = torch.tensor([v if v >= 0 else 0 for v in vehicles], dtype=torch.float32)
    columns = torch.stack((index, torch.full((n,), float(tick)), index + tick / 1000, torch.ones(n)), 1)
    present = np.array([v >= 0 for v in vehicles])
    obs = SyntheticObservation(
        tick=tick,
        observation=columns.clone(),
        truth=columns.clone(),
        gnss_m=columns[:, :2].clone(),
        vehicle=np.array([v if v >= 0 else EMPTY_SLOT for v in vehicles], np.uint32),
        valid=present,
        terminated=np.zeros(n, bool),
        truncated=np.zeros(n, bool),
    )
    return replace(obs, **changes)


def collect(horizon: int, *ticks: SyntheticObservation, bootstrap: bool = False) -> Rollout:
    rollout = Rollout(horizon, 4, bootstrap=bootstrap)
    for obs in ticks:
        rollout.add(obs)
    return rollout


def belongs_together(horizon: Horizon) -> None:
    """Observation, truth, vehicle and tick of every sample agree."""
    for t, i in horizon.valid.nonzero().tolist():
        expected = [float(horizon.vehicle[t, i]), float(horizon.tick[t])]
        assert horizon.observation[t, i, :2].tolist() == expected
        assert horizon.truth[t, i, :2].tolist() == expected


def test_rows_stay_together_while_slots_become_empty_get_new_vehicles_and_grow() -> None:
    turns = [[0], [0, 1], [-1, 1, 2], [3, 1, -1, 4, 5], [3, 1, -1, 4, 5], [6], [6, 7, 8, 9, 10, 11]]
    horizon = collect(1, *(marked(t, turn) for t, turn in enumerate(turns))).take()
    belongs_together(horizon)
    assert horizon.samples() == sum(v >= 0 for turn in turns for v in turn)
    assert horizon.observation.shape == (7, 6, 4)
    assert horizon.tick.tolist() == list(range(7))


def test_memory_of_an_observation_may_change_once_it_is_added() -> None:
    obs = marked(0, [1, 2])
    rollout = collect(2, obs)
    obs.observation.fill_(9)
    obs.truth.fill_(9)
    obs.vehicle[:] = 9
    belongs_together(rollout.take())


def test_action_reward_and_truth_of_a_sample_are_of_one_vehicle_and_tick() -> None:
    run = run_file("x", reward="bounded_inverse", reward_scale_m=5.0)
    ppo = locating_ppo(TrainerConfig.from_run(run), 4, MapBounds(0.0, 0.0, SIZE_M, SIZE_M))
    rng = np.random.default_rng(0)
    rollout = Rollout(200, 4, bootstrap=False)
    sent: dict[tuple[int, int], tuple[list[float], list[float]]] = {}
    for obs in street_ticks(100, 6, 5.0, seed=3):
        obs.vehicle[:] = obs.vehicle + 10 * (obs.tick // 7)
        obs.valid[:] = rng.random(6) < 0.7
        for i in np.flatnonzero(obs.valid):
            sent[obs.tick, int(obs.vehicle[i])] = (obs.observation[i].tolist(), obs.truth[i].tolist())
        rollout.add(obs)
    batch = ppo.score(rollout.take())
    assert len(batch.reward) == len(sent)
    for row, key in enumerate(zip(batch.tick.tolist(), batch.vehicle.tolist(), strict=True)):
        assert sent[key] == (batch.observation[row].tolist(), batch.truth[row].tolist())
    expected = bounded_inverse(distance_m(ppo.task.answer(batch.action), batch.truth), 5.0)
    torch.testing.assert_close(batch.reward, expected)
    mean = ppo.updater.mean(batch.observation)
    deviation = (batch.action - mean) / ppo.updater.log_std.exp()
    assert abs(deviation.mean().item()) < 4 / len(sent) ** 0.5
    assert deviation.abs().max() < 6


def test_the_end_of_a_trajectory_is_marked_on_its_last_row() -> None:
    flags = np.array([True, False, False])
    ticks = [
        marked(0, [0, 1, 2]),
        marked(1, [3, 1, 2], terminated=flags),
        marked(2, [3, 1, 2], truncated=np.roll(flags, 1)),
        marked(3, [3, 1, 9]),
    ]
    horizon = collect(1, *ticks).take()
    assert horizon.terminated.tolist() == [[True, False, False], [False] * 3, [False] * 3, [False] * 3]
    assert horizon.truncated.tolist() == [[False] * 3, [False, True, False], [False, False, True], [False] * 3]


def test_a_gap_in_the_ticks_cuts_every_trajectory() -> None:
    horizon = collect(1, marked(0, [0, 1]), marked(5, [0, 1])).take()
    assert horizon.truncated[0].tolist() == [True, True]
    assert not horizon.terminated.any()


def test_an_evaluation_tick_has_the_end_of_the_last_training_row() -> None:
    rollout = collect(1, marked(0, [0, 1]))
    rollout.ended(marked(1, [7, 8], truncated=np.array([True, True])))
    rollout.add(marked(9, [0, 1]))
    horizon = rollout.take()
    assert horizon.truncated[0].tolist() == [True, True]
    assert horizon.tick.tolist() == [0, 9]


def test_a_bootstrap_tick_opens_the_next_horizon() -> None:
    rollout = collect(4, marked(0, [0, 1]), marked(1, [0, 1]), bootstrap=True)
    assert not rollout.full()
    rollout.add(marked(2, [0, 5], terminated=np.array([False, True])))
    assert rollout.full()
    first = rollout.take()
    assert first.tick.tolist() == [0, 1]
    assert first.terminated[1].tolist() == [False, True]
    assert first.bootstrap is not None
    assert first.bootstrap[:, 0].tolist() == [0, 5]
    assert rollout.pending_samples() == 2
    rollout.add(marked(3, [0, 5]))
    rollout.add(marked(4, [0, 5, 6]))
    second = rollout.take()
    belongs_together(second)
    assert second.tick.tolist() == [2, 3]


def test_every_sample_is_taken_once_though_horizons_do_not_divide() -> None:
    rollout, taken = Rollout(10, 4, bootstrap=False), []
    for tick in range(50):
        rollout.add(marked(tick, [0, 1, 2] if tick % 3 else [0, -1, 2]))
        if rollout.full():
            horizon = rollout.take()
            taken += [(int(horizon.tick[t]), i) for t, i in horizon.valid.nonzero().tolist()]
    assert len(taken) == len(set(taken)) == sum(3 if t % 3 else 2 for t in range(50)) - rollout.pending_samples()


def test_ticks_without_a_valid_row_take_no_room() -> None:
    rollout = collect(1, marked(0, [0]), *(marked(t, [-1]) for t in range(1, 500)))
    horizon = rollout.take()
    assert horizon.tick.tolist() == [0]
    assert horizon.truncated[0, 0] or not horizon.terminated[0, 0]
