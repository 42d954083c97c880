"""The curriculum: its gates, decisions that are made once, and the decisions of a successor."""

from dataclasses import dataclass, field

from caraware.run.curriculum import Curriculum, Stage

STAGES = (Stage(until_std=0.5), Stage(until_error_m=7.0, until_lessons=3), Stage())


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


def test_gates_open_in_order_and_once():
    simulation = Simulation()
    curriculum = Curriculum(STAGES, simulation)
    curriculum.begin()
    assert simulation.decisions == [(1, 0, 0)], "the first lesson needs no learner"
    curriculum.lesson_ended(End(9, 1), 10, policy_std=0.51, error_m=5.0)
    assert simulation.decisions[-1] == (2, 0, 0), "an error that is small opens no gate of σ"
    curriculum.lesson_ended(End(19, 1), 20, policy_std=0.5, error_m=9.0)
    assert simulation.decisions[-1] == (3, 2, 1)
    curriculum.lesson_ended(End(29, 2), 30, policy_std=0.2, error_m=7.5)
    assert simulation.decisions[-1] == (4, 2, 1), "one gate after the other"
    curriculum.lesson_ended(End(39, 2), 40, policy_std=0.2, error_m=7.0)
    assert simulation.decisions[-1] == (5, 4, 2)
    curriculum.lesson_ended(End(49, 3), 50, policy_std=0.0, error_m=0.0)
    assert simulation.decisions[-1] == (6, 4, 2), "a stage without a gate lasts"
    passed = curriculum.report()["passed"]
    assert [(gate["stage"], gate["tick"], gate["lessons"], gate["env_steps"]) for gate in passed] == [
        (1, 19, 2, 20),
        (2, 39, 4, 40),
    ]


def test_a_learner_without_measures_counts_lessons():
    simulation = Simulation()
    curriculum = Curriculum((Stage(until_std=0.5, until_lessons=2),), simulation)
    curriculum.begin()
    for tick in (9, 19):
        curriculum.lesson_ended(End(tick, 1), tick)
    assert simulation.decisions == [(1, 0, 0), (2, 0, 0), (3, 2, 1)]


def test_a_successor_decides_nothing_twice():
    simulation = Simulation()
    predecessor = Curriculum(STAGES, Simulation())
    predecessor.begin()
    predecessor.lesson_ended(End(9, 1), 10, 0.4, 9.0)
    successor = Curriculum(STAGES, simulation)
    successor.begin(predecessor.saved())
    assert simulation.decisions == [(2, 1, 1)]
    successor.lesson_ended(End(9, 1), 10, 0.4, 9.0)
    assert len(simulation.decisions) == 1, "the tick is delivered again, the lesson is not counted again"
    successor.lesson_ended(End(19, 2), 20, 0.4, 9.0)
    assert simulation.decisions[-1] == (3, 1, 1)
    assert successor.report()["lessons"] == 2


def test_a_successor_that_would_have_decided_otherwise_follows_the_ticks():
    simulation = Simulation()
    curriculum = Curriculum(STAGES, simulation)
    curriculum.begin()
    curriculum.lesson_ended(End(9, 2), 10, 0.9, 9.0)
    assert simulation.decisions[-1] == (2, 0, 1)


def test_without_stages_nothing_is_published():
    simulation = Simulation()
    curriculum = Curriculum((), simulation)
    curriculum.begin({})
    assert simulation.decisions == [] and not curriculum and curriculum.report() is None
