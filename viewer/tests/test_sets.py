"""Frames of different ticks are never drawn together."""

from __future__ import annotations

import pytest

from caraware_viewer.sets import TICK_TOPICS, TickSets

RUN = 7


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def sets(clock: Clock) -> TickSets[str]:
    return TickSets(clock)


def add(sets: TickSets[str], tick: int, *topics: str, run: int = RUN) -> None:
    for topic in topics:
        sets.add(topic, (run, tick), f"{topic} {tick}")


def test_a_tick_is_returned_once_all_its_topics_are_there(sets: TickSets[str]) -> None:
    add(sets, 1, "prediction", "world")
    assert (sets.ready(), sets.take()) == (False, {})
    add(sets, 1, "observation")
    assert list(sets.take().items()) == [(t, f"{t} 1") for t in ("world", "observation", "prediction")]
    assert sets.take() == {}


def test_the_newest_whole_tick_wins_and_no_other_is_mixed_in(sets: TickSets[str]) -> None:
    for tick in (1, 2):
        add(sets, tick, "world", "observation", "prediction")
    add(sets, 3, "world", "observation")
    assert set(sets.take().values()) == {"world 2", "observation 2", "prediction 2"}
    assert sets.skipped == 3
    add(sets, 3, "prediction")
    assert set(sets.take().values()) == {"world 3", "observation 3", "prediction 3"}
    # What comes for a tick that is over is dropped.
    add(sets, 2, "world")
    assert not sets.ready()


def test_a_topic_that_is_off_is_waited_for_only_at_first(sets: TickSets[str], clock: Clock) -> None:
    add(sets, 1, "world")
    assert not sets.ready()
    clock.now_s = 0.3
    assert sets.take() == {"world": "world 1"}
    add(sets, 2, "world")
    assert sets.take() == {"world": "world 2"}
    # Once it is there, it is waited for again.
    add(sets, 3, "world", "observation")
    sets.take()
    add(sets, 4, "world")
    assert not sets.ready()


def test_messages_are_waited_for_where_they_are_subscribed_to(clock: Clock) -> None:
    sets: TickSets[str] = TickSets(clock, TICK_TOPICS)
    add(sets, 1, "world", "observation", "prediction")
    assert not sets.ready()
    add(sets, 1, "neighbours")
    assert list(sets.take()) == ["world", "observation", "prediction", "neighbours"]


def test_a_lost_frame_delays_its_tick_and_no_later_one(sets: TickSets[str], clock: Clock) -> None:
    add(sets, 1, "world", "observation")
    clock.now_s = 1.0
    sets.take()
    add(sets, 2, "world")
    assert not sets.ready()
    add(sets, 3, "world", "observation")
    assert set(sets.take()) == {"world", "observation"}


def test_at_the_end_the_newest_tick_is_returned_as_it_is(sets: TickSets[str]) -> None:
    add(sets, 1, "world", "observation", "prediction")
    add(sets, 2, "world")
    assert sets.take(at_once=True) == {"world": "world 2"}


def test_a_new_run_may_begin_at_an_earlier_tick(sets: TickSets[str]) -> None:
    add(sets, 50, "world", "observation", "prediction")
    sets.take()
    add(sets, 0, "world", "observation", "prediction", run=RUN + 1)
    assert sets.take()["world"] == "world 0"


def test_ticks_that_never_complete_are_forgotten(sets: TickSets[str]) -> None:
    for tick in range(100):
        add(sets, tick, "world")
    assert sets.skipped == 92
