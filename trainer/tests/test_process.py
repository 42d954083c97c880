"""A process in the trainer's place starts fast, and says what it lacks."""

import json
import subprocess
import sys
from pathlib import Path

BEGIN = """
import gc, sys
from pathlib import Path
collections = []
gc.callbacks.append(lambda phase, _: collections.append("torch" in sys.modules))
from caraware.run.process import run_process
"""


def begin(code: str) -> int:
    return subprocess.run([sys.executable, "-c", BEGIN + code]).returncode


def test_no_garbage_is_collected_while_torch_is_imported_and_it_is_afterwards(tmp_path: Path) -> None:
    code = """
def work(*_):
    assert "torch" in sys.modules and not any(collections)
    assert gc.isenabled() and gc.get_freeze_count() > 100_000
    assert gc.collect() >= 0 and any(collections)
"""
    assert begin(code + f"sys.exit(run_process([{str(tmp_path / 'run.json')!r}], work))") == 0


def test_without_torch_it_says_so_and_collects_garbage(tmp_path: Path) -> None:
    code = """
sys.modules["torch"] = None
code = run_process([RUN_FILE], lambda *_: None)
assert gc.isenabled()
sys.exit(code)
""".replace("RUN_FILE", repr(str(tmp_path / "run.json")))
    assert begin(code) == 3
    failure = json.loads((tmp_path / "logs" / "trainer.error.json").read_text())
    assert failure["kind"] == "missing" and "torch" in failure["message"]
