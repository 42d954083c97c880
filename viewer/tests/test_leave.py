"""A viewer ends after Ctrl-C, even if a call hangs or the display stops."""

import os
import signal
import subprocess
import sys
import threading

import rerun as rr

from caraware_viewer.display import Display
from caraware_viewer.watch import _finish

STUCK = """
import os, signal, time
from caraware_viewer import __main__ as viewer
viewer.EXIT_LIMIT_S = 0.3
signal.signal(signal.SIGINT, viewer.interrupt)
try:
    os.kill(os.getpid(), signal.SIGINT)
finally:
    time.sleep(6000)
"""


def test_a_viewer_that_hangs_prints_where_and_ends() -> None:
    ended = subprocess.run([sys.executable, "-c", STUCK], capture_output=True, text=True, timeout=600)
    assert ended.returncode == 130, ended.stderr
    assert "Timeout" in ended.stderr and "<string>" in ended.stderr, ended.stderr


def test_a_display_that_has_stopped_is_abandoned() -> None:
    recording = rr.RecordingStream("test")
    with Display.web() as display:
        recording.set_sinks(rr.GrpcSink(display.url))
        recording.log("point", rr.Points2D([[0.0, 0.0]]))
        recording.flush(timeout_sec=120)
        server = display._process
        os.kill(server.pid, signal.SIGSTOP)
        # Until the signal has reached every thread, the others may still accept data.
        os.waitid(os.P_PID, server.pid, os.WSTOPPED | os.WNOWAIT)
        recording.log("point", rr.Points2D([[1.0, 1.0]]))
        drawing = threading.Thread(target=lambda: None)
        drawing.start()
        _finish([recording], drawing, display)
        assert server.poll() is not None
