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
from caraware.tasks.contract import EndKind, Sampling, Task, TaskOutcome, TaskRows, TaskStep
from caraware.tasks.driving import Driving, OutcomeMissingError
from caraware.tasks.localisation import Localisation
from caraware.tasks.metrics import reference_names
from caraware.tasks.table import TASKS, task_of_run
from torch import Tensor

DOCS = Path(__file__).parents[2] / "docs"
ROWS = 6


def run_of(task: str) -> RunFile:
    """A run file with the keys that tasks and faces read."""
    observation = {"fields": ["route_left", "route_offset"]}
    config = {
        "run": {"tick_s": 0.1, "window_ticks": 16},
        "task": {"kind": task},
        "traffic": {"cavs": ROWS, "heroes": ROWS, "pedestrians": 0},
        "episode": {"ticks": 100},
        "observation": observation,
        "gnss": {},
        "trainer": {"reward": "exponential", "reward_scale_m": 5.0},
    }
    fields = [
        {"name": "route_left", "unit": "m", "range": [0.0, 1000.0]},
        {"name": "route_offset", "unit": "m", "range": [-5.0, 5.0]},
    ]
    return {"config": config, "map": {"bounds_m": [0.0, -50.0, 200.0, 50.0]}, "observation_fields": fields}


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
    assert isinstance(task, {"localisation": Localisation, "driving": Driving}[task.name])
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
    assert refused.value.help == "`task.kind` is one of: localisation, driving"
