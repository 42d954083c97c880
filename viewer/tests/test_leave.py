"""A viewer that is asked to end does so, whatever does not come back."""

import subprocess
import sys
import time

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
