"""Files that `--save` has written are shown in the same page as a live run; anything else is refused."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from browser import Browser
from ports import free_port


def saved(path: Path) -> Path:
    """A recording of a few ticks that fills the page with one colour at its last."""
    recording = rr.RecordingStream("caraware", recording_id="town-1/0")
    recording.save(path)
    for tick in range(10):
        recording.set_time("tick", sequence=tick)
        recording.log("image", rr.Image(np.full((40, 80, 3), (0, 25 * tick, 0), np.uint8)))
    recording.disconnect()
    return path


def test_a_saved_run_opens_in_the_page_of_live_runs(tmp_path: Path) -> None:
    path = saved(tmp_path / "a run.rrd")
    command = [sys.executable, "-m", "caraware_viewer", str(path), "--web", "--web-port", str(free_port())]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as viewer:
        try:
            assert viewer.stderr is not None
            lines = [viewer.stderr.readline(), viewer.stderr.readline()]
            assert lines[0] == f"showing {path}\n"
            opened = re.fullmatch(r"open (http://127\.0\.0\.1:\d+/) in a browser\n", lines[1])
            assert opened is not None, lines
            with Browser(800, 500) as browser:
                browser.open(f"{opened[1]}?renderer=webgl")
                browser.wait_for("window._handle !== undefined", 180)
                deadline = time.monotonic() + 300
                while not (browser.screenshot() == (0, 225, 0)).all(2).mean() > 0.2:
                    assert time.monotonic() < deadline, "the last tick is not in the picture"
                # The bars of rerun are dark, as live.
                assert browser.screenshot()[:30].mean() < 60
        finally:
            viewer.terminate()
        assert viewer.wait(30) == 130


@pytest.mark.parametrize(
    ("content", "more", "says"),
    [
        (None, (), "No such file or directory"),
        (b"RIFF", (), "is not a file of `caraware view --save`"),
        (b"RRF2", ("--vehicle", "cav.3"), "--vehicle is for a live run"),
        (b"RRF2", ("--lidar", "all"), "--lidar is for a live run"),
    ],
)
def test_what_cannot_be_shown_is_refused(
    content: bytes | None, more: tuple[str, ...], says: str, tmp_path: Path
) -> None:
    path = tmp_path / "run.rrd"
    if content is not None:
        path.write_bytes(content)
    command = [sys.executable, "-m", "caraware_viewer", str(path), *more]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 1 and says in ended.stderr and "Traceback" not in ended.stderr, ended.stderr
