"""Files on a disk that is full: what the run needs waits, what it does not need is dropped and reported once."""

import errno
import logging
from dataclasses import dataclass
from pathlib import Path

import pytest
from caraware.report.metrics import Metrics, TrainingPoint
from caraware.run.storage import is_full, when_there_is_space, write_whole


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
