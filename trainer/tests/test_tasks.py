"""The contract of the tasks: what they declare, and that they treat a learner's rows like a face's slots."""

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from caraware import _native
from caraware.envs import Transition, rewards
from caraware.envs.settings import FaceSettings
from caraware.envs.transition import Rows
from caraware.ipc.arrays import BoolArray
from caraware.ipc.run_file import ConfigError, RunFile
from caraware.learn.encoders import CandidateNetwork
from caraware.run.trips import has_trips
from caraware.tasks.contract import (
    EndKind,
    OutcomeMissingError,
    Sampling,
    Task,
    TaskOutcome,
    TaskRows,
    TaskStep,
)
from caraware.tasks.driving import Driving
from caraware.tasks.lane import LanePosition
from caraware.tasks.localisation import Localisation
from caraware.tasks.messages import Messages, speech_width
from caraware.tasks.metrics import reference_names
from caraware.tasks.table import TASKS, task_of_run
from torch import Tensor

DOCS = Path(__file__).parents[2] / "docs"
ROWS = 6


def run_of(task: str) -> RunFile:
    """A run file with the keys that tasks and faces read."""
    observation = {"fields": ["route_left", "route_offset"], "history": 1, "scale": "minus_one_to_one"}
    config = {
        "run": {"tick_s": 0.1, "window_ticks": 16},
        "task": {"kind": task, "message_cost": 10.0},
        "v2x": {"candidates": 3},
        "curriculum": {"maps": []},
        "traffic": {"cavs": ROWS, "heroes": ROWS, "hero_ids": [], "pedestrians": 0},
        "episode": {"ticks": 100},
        "observation": observation,
        "gnss": {"pedestrians": False},
        "blackout": {"policy": "hold"},
        "trainer": {"reward": "exponential", "reward_scale_m": 5.0},
    }
    fields = [
        {"name": "route_left", "unit": "m", "range": [0.0, 1000.0]},
        {"name": "route_offset", "unit": "m", "range": [-5.0, 5.0]},
    ]
    return {
        "config": config,
        "map": {"bounds_m": [0.0, -50.0, 200.0, 50.0]},
        "scene_files": {"net_file": str(Path(__file__).parent / "two_lanes.net.xml")},
        "source": {"population": {}},
        "observation_fields": fields,
    }


@dataclass(frozen=True)
class MeasuredRows:
    """A tick as metrics take it."""

    truth: Tensor
    gnss_m: Tensor
    valid: BoolArray


def rows(seed: int) -> TaskRows:
    generator = torch.Generator().manual_seed(seed)
    observation = torch.rand(ROWS, 2, generator=generator) * 1.8 - 0.9
    return TaskRows(observation, torch.rand(ROWS, 4, generator=generator) * 10)


def step() -> TaskStep:
    """Six rows, of which two ended."""
    before, ended = rows(1), torch.arange(ROWS)
    return TaskStep(before.observation, before.truth, TaskOutcome(rows(2), ended == 4, ended == 5))


@pytest.fixture(params=list(TASKS))
def task(request: pytest.FixtureRequest) -> Task:
    return task_of_run(run_of(request.param))


def test_a_task_has_the_name_of_its_row_and_metrics_of_its_own(task: Task) -> None:
    classes = {"localisation": Localisation, "driving": Driving, "lane": LanePosition, "messages": Messages}
    assert isinstance(task, classes[task.name])
    assert task.metrics and {metric.task for metric in task.metrics} == {task.name}
    assert task.metrics[0].reference_for is None
    assert {metric.name for metric in _native.METRICS if metric.task == task.name} == {m.name for m in task.metrics}


def test_a_task_measures_the_metrics_of_the_policy_for_each_row(task: Task) -> None:
    action = torch.zeros(ROWS, task.actions.size)
    values = task.measure(step(), action)
    assert set(values) == {metric.name for metric in task.metrics if metric.reference_for is None}
    assert all(value.shape == (ROWS,) for value in values.values())
    assert task.reward(step(), action).shape == (ROWS,)


def test_rows_of_a_learner_earn_what_slots_of_a_face_earn(task: Task) -> None:
    settings, given = FaceSettings.from_run(run_of(task.name)), step()
    assert given.outcome is not None
    following = given.outcome.next
    after = Rows(settings, following.observation.numpy(), following.truth.numpy(), np.zeros((ROWS, 2), np.float32))
    ids = np.zeros(ROWS, np.uint32), np.zeros(ROWS, np.uint64)
    flags = given.outcome.terminated.numpy(), given.outcome.truncated.numpy()
    transition = Transition(
        settings, given.observation.numpy(), given.truth.numpy(), after.gnss_m, np.ones(ROWS, bool), *ids, *flags, after
    )
    action = torch.linspace(-1.2, 1.2, ROWS * task.actions.size).view(ROWS, task.actions.size)
    earned = rewards.of_task(task)(transition, action.numpy())
    # A learner's rows are f32: e^(−d/5) of d ≈ 100 m loses a factor of 20 of its precision.
    assert earned.tolist() == pytest.approx(task.reward(given, action).tolist(), rel=1e-5)
    for name, value in task.measure(given, action).items():
        assert rewards.measured(transition, action.numpy())[name].tolist() == pytest.approx(value.tolist(), rel=1e-6)


FACE_ROWS = [
    # action, truth x and y (m), distance (m)
    ((0.30022913217544556, 0.9533131122589111), (74.42816162109375, 73.87957763671875), "0x1.ebb851712b7c8p+5"),
    ((0.2932301461696625, 1.17350435256958), (53.58665084838867, 41.33418273925781), "0x1.36c8f77cba65ap+6"),
    ((-0.9804105758666992, 0.09874517470598221), (63.25627517700195, 68.53797149658203), "0x1.6153390c50b40p+6"),
    ((1.122787356376648, -0.6839902997016907), (62.30442810058594, 70.26278686523438), "0x1.6d89f30bfeeddp+7"),
    ((1.1211557388305664, 0.378625750541687), (92.62158203125, 52.178001403808594), "0x1.f021ae33b8fabp+6"),
    ((-0.17227141559123993, 0.056976258754730225), (39.17930221557617, 52.67401885986328), "0x1.08d0bd221c3f6p+6"),
]
"""Rows on which torch's vector norm differs from hypot in the last bit of float64."""
FACE_REWARDS = ["0x1.3421d18e7247cp-4", "0x1.ef4e7c00d55f5p-5", "0x1.b6dde8d6cfca7p-5"]
FACE_REWARDS += ["0x1.b4479d5597c4ep-6", "0x1.3d703dc73fcc3p-5", "0x1.1f9ffa28d8770p-4"]


def test_a_face_earns_the_same_bits_as_ever() -> None:
    run = run_of("localisation")
    run["config"]["trainer"]["reward"] = "bounded_inverse"
    settings, count = FaceSettings.from_run(run), len(FACE_ROWS)
    action = np.array([row[0] for row in FACE_ROWS], np.float32)
    truth = np.zeros((count, 4), np.float32)
    truth[:, :2] = [row[1] for row in FACE_ROWS]
    none, ids = np.zeros(count, bool), (np.zeros(count, np.uint32), np.zeros(count, np.uint64))
    now = Rows(settings, np.zeros((count, 2), np.float32), truth, np.zeros((count, 2), np.float32))
    transition = Transition(settings, now.observation, truth, now.gnss_m, ~none, *ids, none, none, now)
    error_m = rewards.measured(transition, action)["error_m"]
    assert [float(value).hex() for value in error_m] == [row[2] for row in FACE_ROWS]
    assert [float(value).hex() for value in rewards.of_task(settings.task)(transition, action)] == FACE_REWARDS
    # A learner's float32 rows keep torch's vector norm.
    task = settings.task
    learnt = task.measure(
        TaskStep(torch.from_numpy(now.observation), torch.from_numpy(truth)), torch.from_numpy(action)
    )
    away = task.answer(torch.from_numpy(action)) - torch.from_numpy(truth)[:, :2]
    assert torch.equal(learnt["error_m"], torch.linalg.vector_norm(away, dim=-1))


def test_what_was_published_is_measured_as_the_action_is() -> None:
    """Without the rows that are not valid; for a metric of driving the outcome is missing."""
    run, given, valid = run_of("localisation"), step(), np.arange(ROWS) % 2 == 0
    action = torch.linspace(-1.2, 1.2, ROWS * 2).view(ROWS, 2)
    tick = MeasuredRows(given.truth, given.truth[:, :2] + 3.0, valid)
    task = task_of_run(run)
    measured = task.measure_answers(tick, task.answer(action))
    expected = task.measure(given, action)
    assert measured["error_m"].tolist() == pytest.approx(expected["error_m"][valid].tolist(), rel=1e-6)
    (raw_m,) = task.measure_references([tick])["raw_gnss_error_m"]
    assert raw_m.tolist() == pytest.approx([math.sqrt(18.0)] * 3, rel=1e-6)
    assert reference_names(task.metrics[0]) == {"raw_gnss": "raw_gnss_error_m"}
    driving = task_of_run(run_of("driving"))
    assert (driving.measure_answers(tick, action), reference_names(driving.metrics[0])) == ({}, {})


def test_several_actions_on_a_row_earn_what_each_alone_earns() -> None:
    task = task_of_run(run_of("localisation"))
    actions = torch.rand(ROWS, 3, 2, generator=torch.Generator().manual_seed(3))
    together = task.reward(step(), actions)
    assert together.equal(torch.stack([task.reward(step(), actions[:, i]) for i in range(3)], 1))


def test_an_action_is_a_position_on_the_map_or_a_demand_within_its_range() -> None:
    action = torch.tensor([[0.0, 0.0], [1.0, -1.5]])
    assert task_of_run(run_of("localisation")).answer(action).tolist() == [[100.0, 0.0], [200.0, -75.0]]
    assert task_of_run(run_of("driving")).answer(action).tolist() == [[0.0, 0.0], [1.0, -1.0]]


def test_a_face_waits_where_the_simulation_waits() -> None:
    localisation, driving = (FaceSettings.from_run(run_of(name)) for name in ("localisation", "driving"))
    assert localisation.task.sampling is Sampling.WHEN_FULL and localisation.credit_ticks == 8
    assert driving.task.sampling is Sampling.EACH_TICK and driving.credit_ticks == 1


def test_driving_rewards_what_an_action_did() -> None:
    task, before = task_of_run(run_of("driving")), rows(1)
    with pytest.raises(OutcomeMissingError):
        task.reward(TaskStep(before.observation, before.truth), torch.zeros(ROWS, 2))


def test_the_ends_of_driving_are_as_documented() -> None:
    page = (DOCS / "driving.md").read_text()
    table = re.search(r"## Ends\n(.*?)\n\n[^|]", page, re.S)
    assert table is not None
    cells = [[cell.strip(" *") for cell in line.split("|")] for line in table[1].splitlines() if line.startswith("| ")]
    written = {(line[1], EndKind(line[3])) for line in cells if line[3] in {"terminated", "truncated"}}
    assert written == {(end.name, end.kind) for end in task_of_run(run_of("driving")).ends}


def test_an_unknown_task_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="no task is called 'parking'") as refused:
        task_of_run(run_of("parking"))
    assert refused.value.help == "`task.kind` is one of: localisation, driving, lane, messages"


def test_messages_are_rewarded_by_what_others_newly_know_less_the_price_of_bytes() -> None:
    task = task_of_run(run_of("messages"))
    achieved = torch.tensor([[1.5, 150.0, 3.0, 4.0], [0.0, 0.0, 0.0, 0.0], [9.0, 90.0, 2.0, 2.0]])
    before = TaskRows(torch.zeros(3, 53), torch.zeros(3, 4))
    none = torch.zeros(3, dtype=torch.bool)
    left = torch.tensor([False, False, True])
    given = TaskStep(before.observation, before.truth, TaskOutcome(TaskRows(before.observation, achieved), none, left))
    action = torch.zeros(3, 3)
    # 150 bytes at 10 s a kilobyte cost 1.5 s. What a vehicle that left told is not its last action's.
    assert task.reward(given, action).tolist() == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
    measured = task.measure(given, action)
    assert measured["awareness_percent"].tolist() == [75.0, 100.0, 100.0]
    assert measured["message_kbitps"].tolist() == pytest.approx([12.0, 0.0, 7.2])
    with pytest.raises(OutcomeMissingError):
        task.reward(TaskStep(before.observation, before.truth), action)


def test_each_candidate_is_judged_alike_wherever_it_stands() -> None:
    width = speech_width(3)
    network = CandidateNetwork(width, 3, (8,))
    value = CandidateNetwork(width, 1, (8,))
    rows = torch.rand(5, width, generator=torch.Generator().manual_seed(4))
    station, columns = _native.SPEAKER_COLUMNS, _native.CANDIDATE_COLUMNS
    members = rows[:, station:].view(5, 3, columns)
    turned = torch.cat([rows[:, :station], members[:, [2, 0, 1]].reshape(5, -1)], 1)
    assert torch.allclose(network(turned), network(rows)[:, [2, 0, 1]], atol=1e-6)
    assert torch.allclose(value(turned), value(rows), atol=1e-6) and value(rows).shape == (5, 1)
    with pytest.raises(ValueError, match="messages"):
        CandidateNetwork(width + 1, 3, (8,))


def test_trips_are_those_of_drivers() -> None:
    assert [name for name in TASKS if has_trips(task_of_run(run_of(name)))] == ["driving"]
