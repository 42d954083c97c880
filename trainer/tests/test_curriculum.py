"""The curriculum: its gates, decisions that are made once, and the decisions of a successor."""

import math
from dataclasses import dataclass, field

from caraware.run.curriculum import Curriculum, Stage

STAGES = (Stage(until_std=0.5), Stage(until_metric="error_m", until_value=7.0, until_lessons=3), Stage())


@dataclass
class Simulation:
    """Records the decisions sent to it."""

    decisions: list[tuple[int, int, int]] = field(default_factory=list)

    def decided(self, lessons: int, since: int, stage: int) -> None:
        """Record the decision."""
        self.decisions.append((lessons, since, stage))


@dataclass
class End:
    """The last tick of a lesson."""

    tick: int
    stage: int


def test_gates_open_in_order_and_once() -> None:
    simulation = Simulation()
    curriculum = Curriculum(STAGES, simulation)
    curriculum.begin()
    assert simulation.decisions == [(1, 0, 0)], "the first lesson needs no learner"
    curriculum.lesson_ended(End(9, 1), 10, policy_std=0.51, metrics={"error_m": 5.0})
    assert simulation.decisions[-1] == (2, 0, 0), "an error that is small opens no gate of σ"
    curriculum.lesson_ended(End(19, 1), 20, policy_std=0.5, metrics={"error_m": 9.0})
    assert simulation.decisions[-1] == (3, 2, 1)
    curriculum.lesson_ended(End(29, 2), 30, policy_std=0.2, metrics={"error_m": 7.5})
    assert simulation.decisions[-1] == (4, 2, 1), "one gate after the other"
    curriculum.lesson_ended(End(39, 2), 40, policy_std=0.2, metrics={"error_m": 7.0})
    assert simulation.decisions[-1] == (5, 4, 2)
    curriculum.lesson_ended(End(49, 3), 50, policy_std=0.0, metrics={"error_m": 0.0})
    assert simulation.decisions[-1] == (6, 4, 2), "a stage without a gate lasts"
    report = curriculum.report()
    assert report is not None
    passed = report["passed"]
    assert [(gate["stage"], gate["tick"], gate["lessons"], gate["env_steps"]) for gate in passed] == [
        (1, 19, 2, 20),
        (2, 39, 4, 40),
    ]
    assert [gate["metrics"] for gate in passed] == [{"error_m": 9.0}, {"error_m": 7.0}]


def test_a_metric_of_which_more_is_better_opens_the_gate_from_below() -> None:
    stage = Stage(until_metric="progress_mps", until_value=5.0)
    values = (4.9, math.nan, 5.0, 5.1)
    assert [stage.passed(1.0, {"progress_mps": value}, 9) for value in values] == [False, False, True, True]
    assert not stage.passed(1.0, {"error_m": 9.0}, 9), "a metric that is not measured opens nothing"


def test_a_learner_without_measures_counts_lessons() -> None:
    simulation = Simulation()
    curriculum = Curriculum((Stage(until_std=0.5, until_lessons=2),), simulation)
    curriculum.begin()
    for tick in (9, 19):
        curriculum.lesson_ended(End(tick, 1), tick)
    assert simulation.decisions == [(1, 0, 0), (2, 0, 0), (3, 2, 1)]


def test_a_successor_decides_nothing_twice() -> None:
    simulation = Simulation()
    predecessor = Curriculum(STAGES, Simulation())
    predecessor.begin()
    predecessor.lesson_ended(End(9, 1), 10, 0.4, {"error_m": 9.0})
    successor = Curriculum(STAGES, simulation)
    successor.begin(predecessor.saved())
    assert simulation.decisions == [(2, 1, 1)]
    successor.lesson_ended(End(9, 1), 10, 0.4, {"error_m": 9.0})
    assert len(simulation.decisions) == 1, "the tick is delivered again, the lesson is not counted again"
    successor.lesson_ended(End(19, 2), 20, 0.4, {"error_m": 9.0})
    assert simulation.decisions[-1] == (3, 1, 1)
    report = successor.report()
    assert report is not None and report["lessons"] == 2


def test_a_successor_that_would_have_decided_otherwise_follows_the_ticks() -> None:
    simulation = Simulation()
    curriculum = Curriculum(STAGES, simulation)
    curriculum.begin()
    curriculum.lesson_ended(End(9, 2), 10, 0.9, {"error_m": 9.0})
    assert simulation.decisions[-1] == (2, 0, 1)


def test_without_stages_nothing_is_published() -> None:
    simulation = Simulation()
    curriculum = Curriculum((), simulation)
    curriculum.begin({})
    assert simulation.decisions == [] and not curriculum and curriculum.report() is None
