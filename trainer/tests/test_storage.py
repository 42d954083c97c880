"""Files on a disk that is full: what the run needs waits, what it does not need is dropped and reported once."""

import errno
import json
import logging
import math
import tracemalloc
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from caraware.ipc.storage import is_full, when_there_is_space, write_whole
from caraware.report.metrics import Metrics, TrainingPoint, TrainingPoints


def test_a_write_waits_for_space_and_goes_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = tmp_path / "file"
    file.symlink_to("/dev/full")
    attempts = 0

    def stop_requested() -> bool:
        """Asked after every attempt that failed: the third one finds space."""
        nonlocal attempts
        attempts += 1
        if attempts == 2:
            file.unlink()
        return False

    with caplog.at_level(logging.WARNING):
        when_there_is_space(file, lambda: file.write_text("content"), stop_requested)
    assert (file.read_text(), attempts) == ("content", 2)
    assert [record.getMessage().split(":")[0] for record in caplog.records] == [
        "the disk is full",
        "there is space again",
    ]


def test_a_stop_ends_the_wait(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.symlink_to("/dev/full")
    with pytest.raises(OSError) as caught:
        when_there_is_space(file, lambda: file.write_text("content"), lambda: True)
    assert is_full(caught.value)
    with pytest.raises(OSError) as caught:
        when_there_is_space(file, lambda: (tmp_path / "no" / "file").write_text(""))
    assert caught.value.errno == errno.ENOENT


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    for content in (b"old", b"new"):
        write_whole(tmp_path / "latest", content)
        assert (tmp_path / "latest").read_bytes() == content
    assert [file.name for file in tmp_path.iterdir()] == ["latest"]


@dataclass(frozen=True)
class _Stats:
    loss: float


def lines_of(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text().splitlines()]


def test_the_course_of_training_is_a_line_for_each_update_and_goes_on_after_a_resume(tmp_path: Path) -> None:
    def update(metrics: Metrics, env_steps: int) -> None:
        point = TrainingPoint(env_steps, 0.5, math.nan, {"error_m": env_steps / 100}, 1000.0)
        metrics.updated(point, _Stats(1.0), tick=env_steps // 10)

    first = Metrics(tmp_path / "tensorboard", ())
    for env_steps in (100, 200, 300):
        update(first, env_steps)
    first.close()
    file = tmp_path / "learning.jsonl"
    assert lines_of(file)[1] == {
        "env_steps": 200,
        "tick": 20,
        "update": 2,
        "training": {"sigma": 0.5, "error_m": 2.0},
    }
    # A successor continues after the checkpoint at 200 steps; the process was killed in the middle of a line.
    with file.open("a") as output:
        output.write('{"env_steps":4')
    second = Metrics(tmp_path / "tensorboard", ())
    second.resume(first.training[:2], [], 200)
    update(second, 250)
    second.close()
    assert [line["env_steps"] for line in lines_of(file)] == [100, 200, 250]
    # A learner that begins anew has no predecessor's lines.
    third = Metrics(tmp_path / "tensorboard", ())
    update(third, 50)
    third.close()
    assert [line["env_steps"] for line in lines_of(file)] == [50]


def test_a_long_training_is_kept_in_little_memory() -> None:
    def point(step: int) -> TrainingPoint:
        metrics = {"error_m": step + 0.25, "raw_gnss_m": 0.1 * step, "ekf_m": math.inf}
        return TrainingPoint(4096 * step, 0.5 / step, -1.0 * step, metrics, 1000.0 + step)

    points = TrainingPoints()
    assert (len(points), list(points), points.names) == (0, [], ())
    points.append(point(1))
    tracemalloc.start()
    for step in range(2, 20_001):
        points.append(point(step))
    kept_bytes = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    # Seven numbers of eight bytes, and what an array reserves ahead.
    assert kept_bytes < 20_000 * 64 * 1.2
    assert len(points) == 20_000
    assert (points[0], points[-1], points[1:3]) == (point(1), point(20_000), [point(2), point(3)])
    assert [one.env_steps for one in points[:3]] == [4096, 8192, 12288]
    with pytest.raises(IndexError):
        points[20_000]
    again = TrainingPoints(TrainingPoint.of_row(row, points.names) for row in points.rows().tolist())
    assert list(again) == list(points)


def test_events_that_cannot_be_written_are_dropped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = tmp_path / "tensorboard"
    folder.write_text("a file in the directory's place")
    metrics = Metrics(folder, ())
    with caplog.at_level(logging.WARNING):
        for env_steps in (100, 200):
            metrics.updated(TrainingPoint(env_steps, 0.5, 0.1, {}, 1000.0), _Stats(1.0))
    assert list(metrics.dropped.report()) == ["tensorboard"]
    assert len(caplog.records) == 1
    # Later events are written again, and the history has all of them.
    folder.unlink()
    metrics.updated(TrainingPoint(300, 0.5, 0.1, {}, 1000.0), _Stats(1.0))
    metrics.close()
    assert [file for file in folder.iterdir() if file.stat().st_size > 0]
    assert [point.env_steps for point in metrics.training] == [100, 200, 300]
