"""The course of training, from documents that overlap."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import recordings
import rerun as rr

from caraware_viewer.canvas import Canvas
from caraware_viewer.course import (
    COLORS,
    MAX_POINTS,
    REWARD,
    SIGMA,
    Course,
    end_path,
    evaluation_path,
    series_name,
    training_path,
)
from caraware_viewer.wire import FrameError

ERROR = training_path("error_m")


def update(number: int) -> dict[str, Any]:
    figures = {"sigma": 1 / number, "reward": number / 10, "error_m": 40.0 / number}
    return {"env_steps": 100 * number, "tick": 10 * number, "update": number, "training": figures}


def evaluation(number: int) -> dict[str, Any]:
    means = {"ppo": 4.5, "raw_gnss": 7.0}
    return {"env_steps": 100 * number, "tick": 10 * number, "metric": "error_m", "evaluation": means}


def document(updates: list[int], evaluations: list[int] = []) -> bytes:  # noqa: B006
    lines = {"updates": [update(n) for n in updates], "evaluations": [evaluation(n) for n in evaluations]}
    return json.dumps({"schema_version": 1, "run_id": "0x1"} | lines).encode()


def steps(course: Course, path: str = ERROR) -> list[int]:
    return [env_steps // 100 for env_steps in course.curves[path]]


def drawn(path: Path, *courses: tuple[Course, list[bytes]]) -> dict[str, recordings.Entity]:
    recording = rr.RecordingStream("test", recording_id="test")
    recording.save(path)
    canvas = Canvas(recording, 0.1)
    for course, payloads in courses:
        for payload in payloads:
            course.merge(payload)
            course.draw(canvas)
    recording.flush()
    recording.disconnect()
    return recordings.read(path)


def test_a_late_viewer_has_the_curve_from_the_start(tmp_path: Path) -> None:
    # The newest points arrive first, then the answer to the query, then more.
    payloads = [document([98, 99]), document([*range(1, 99, 2), 98], [50]), document([98, 99, 100])]
    found = drawn(tmp_path / "run.rrd", (Course(), payloads))
    for path, last in ((ERROR, 0.4), (REWARD, 10.0), (SIGMA, 0.01)):
        rows = [(at, row["Scalars:scalars"][0]) for at, row in found[path].rows if row.get("Scalars:scalars")]
        assert len(rows) == len({at for at, _ in rows}) == 52, path
        assert rows[0][0] == pytest.approx(1.1)
        assert rows[-1][0] == pytest.approx(100.1)
        assert rows[-1][1] == pytest.approx(last)
    assert len([row for _, row in found[evaluation_path("ppo", "m")].rows if row.get("Scalars:scalars")]) == 1


def test_a_learner_that_continues_makes_later_points_void() -> None:
    course = Course()
    course.merge(document([1, 2, 3, 4, 5], [4]))
    course.merge(document([1, 2, 3]))
    assert steps(course) == [1, 2, 3]


def test_a_long_run_stays_within_a_bound_and_keeps_its_ends() -> None:
    course = Course()
    for first in range(1, 3 * MAX_POINTS, 500):
        course.merge(document(list(range(first, first + 500))))
        assert len(course.curves[ERROR]) <= MAX_POINTS
    assert (steps(course)[0], steps(course)[-1]) == (1, 3 * MAX_POINTS)


def test_trips_are_shown_as_shares_of_those_that_ended() -> None:
    # As the trainer names them (caraware.tasks.ends).
    ends: tuple[dict[str, int], ...] = ({"collision": 3, "arrival": 1}, {}, {"arrival": 4}, {"off-road": 1})
    lines = [update(number) | ({"ends": each} if each else {}) for number, each in enumerate(ends, 1)]
    course = Course()
    course.merge(json.dumps({"updates": lines, "evaluations": []}).encode())
    shares = {
        series_name(path): [(point.env_steps, point.value) for point in course.curves[path].values()]
        for path in map(end_path, ("arrival", "collision", "off-road"))
    }
    assert shares == {
        "arrival": [(100, 25.0), (300, 100.0), (400, 0.0)],
        "collision": [(100, 75.0), (300, 0.0), (400, 0.0)],
        "off road": [(400, 100.0)],
    }
    names = ("collision", "off-road", "red light", "against traffic", "arrival", "blocked", "time limit")
    assert all(end_path(name).rsplit("/", 1)[1] in COLORS for name in names)
    assert series_name(end_path("end of the run's episode")) == "end of the episode"


def test_an_evaluation_is_drawn_in_the_unit_of_its_metric() -> None:
    course = Course()
    for number, metric in enumerate(("error_m", "progress_mps", "awareness_percent"), 1):
        line = evaluation(number) | {"metric": metric}
        course.merge(json.dumps({"updates": [], "evaluations": [line]}).encode())
        unit = metric.rsplit("_", 1)[1]
        assert list(course.curves[evaluation_path("ppo", unit)]) == [100 * number]
        assert training_path(metric).rsplit("/", 1)[0] == evaluation_path("ppo", unit).rsplit("/", 2)[0]


def test_curves_of_one_unit_share_a_view() -> None:
    assert training_path("error_m").rsplit("/", 1)[0] == training_path("raw_gnss_error_m").rsplit("/", 1)[0]
    assert training_path("progress_mps").split("/")[1] == "mps"


@pytest.mark.parametrize("payload", [b"", b"[]", b"null", b'{"updates": 3}', b'{"updates": [{}], "evaluations": []}'])
def test_an_unreadable_document_is_refused(payload: bytes) -> None:
    with pytest.raises(FrameError):
        Course().merge(payload)
