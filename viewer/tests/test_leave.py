"""A viewer that is asked to end does so, whatever does not come back."""

import os
import signal
import subprocess
import sys
import threading
import time

import rerun as rr

from caraware_viewer.display import Display
from caraware_viewer.watch import _finish

STUCK = """
import os, signal, time
from caraware_viewer import __main__ as viewer
viewer.LEAVE_WITHIN_S = 0.3
signal.signal(signal.SIGINT, viewer.leave)
try:
    os.kill(os.getpid(), signal.SIGINT)
finally:
    time.sleep(60)
"""


def test_a_viewer_that_hangs_at_its_end_says_where_and_ends() -> None:
    began = time.monotonic()
    ended = subprocess.run([sys.executable, "-c", STUCK], capture_output=True, text=True, timeout=50)
    assert ended.returncode == 130, ended.stderr
    assert time.monotonic() - began < 30
    assert "Timeout" in ended.stderr and "<string>" in ended.stderr, ended.stderr


def test_a_display_that_stands_still_is_left() -> None:
    recording = rr.RecordingStream("test")
    with Display.web() as display:
        recording.set_sinks(rr.GrpcSink(display.url))
        recording.log("point", rr.Points2D([[0.0, 0.0]]))
        recording.flush(timeout_sec=20)
        server = display._process
        os.kill(server.pid, signal.SIGSTOP)
        recording.log("point", rr.Points2D([[1.0, 1.0]]))
        drawing = threading.Thread(target=lambda: None)
        drawing.start()
        began = time.monotonic()
        _finish(recording, drawing, display)
        assert time.monotonic() - began < 14
        assert server.poll() is not None
