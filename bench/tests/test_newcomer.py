"""The commands of README, docs and configs/README.md, run as they are written or parsed: `scripts/newcomer.py`."""

import importlib.util
import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent.parent
SCRIPT = ROOT / "scripts" / "newcomer.py"
_SPEC = importlib.util.spec_from_file_location("newcomer", SCRIPT)
assert _SPEC is not None and _SPEC.loader is not None
newcomer = importlib.util.module_from_spec(_SPEC)
sys.modules["newcomer"] = newcomer
_SPEC.loader.exec_module(newcomer)

STATES = {
    page: Counter(block.state(with_long=False) for block in newcomer.blocks_of(page) if block.is_code)
    for page in newcomer.pages()
}
NEVER_RUN = {
    "docs/cluster.md": 2,
    "docs/tutorials/many-machines.md": 1,
    "docs/tutorials/watch-from-a-laptop.md": 2,
    "docs/extending.md": 1,
    "docs/import.md": 1,
    "docs/install.md": 3,
    "docs/parallel.md": 1,
    "docs/remote.md": 4,
    "docs/sensor-models.md": 1,
    "docs/vehicle-model.md": 1,
    "docs/viewer.md": 1,
}
"""Blocks that no mode runs: they need another machine, a container engine, a run of their own kind or a place outside,
or write the checkout."""


BYTECODE = ROOT / "target" / "tmp" / "bytecode"
"""Where the tests in Rust keep it, too."""


def environment() -> dict[str, str]:
    """Without bytecode every learner compiles 1 700 modules when it starts: seconds of a core."""
    kept = dict(os.environ)
    if kept.pop("PYTHONDONTWRITEBYTECODE", None) is not None:
        kept["PYTHONPYCACHEPREFIX"] = str(BYTECODE)
    return kept


def follow(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the script."""
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, env=environment(), capture_output=True, text=True, check=False)


@pytest.mark.parametrize("page", [str(page.relative_to(ROOT)) for page, states in STATES.items() if states["run"]])
def test_a_newcomer_can_follow_the_page(page: str) -> None:
    run = follow(ROOT / page)
    assert run.returncode == 0, f"{run.stdout}\n{run.stderr}"


def test_what_does_not_run_is_parsed_and_has_a_reason() -> None:
    run = follow("--list")
    assert run.returncode == 0, f"{run.stdout}\n{run.stderr}"
    skipped = Counter(re.findall(r"^skip\s+(\S+):\d+: \w", run.stdout, re.MULTILINE))
    assert dict(skipped) == NEVER_RUN
    total = sum((states for states in STATES.values()), Counter[str]())
    assert total["run"] > 35 and sum(total.values()) > 90
    assert f"{total['run']} run" in run.stdout and f"{total['long']} long" in run.stdout


def test_a_block_that_fails_is_reported(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("The page activates nothing: `bin/activate`.\n\n```sh\n# bin/activate\ncaraware --version\n```\n")
    run = follow(page)
    assert run.returncode == 1
    assert "command not found" in run.stdout


@pytest.mark.parametrize(
    ("block", "said"),
    [
        ("<!-- newcomer: skip it is far -->\n```sh\ncaraware-viewer --sav F.rrd --color red\n```", "--color red"),
        ("<!-- newcomer: skip it is far -->\n```sh\ncaraware reproduce soup\n```", "invalid choice: 'soup'"),
        ("<!-- newcomer: skip it is far -->\n```sh\ncaraware bench lidar --soup\n```", "unexpected argument"),
        ("<!-- newcomer: skip it is far -->\n```sh\npython -m no_such_module\n```", "no module no_such_module"),
        ("<!-- newcomer: skip it is far -->\n```sh\ncargo run --example soup\n```", "no example soup"),
        ("<!-- newcomer: skip it is far -->\n```sh\nmake soup\n```", "no target soup"),
        ("<!-- newcomer: skip it is far -->\n```sh\nif true\n```", "syntax error"),
        ("<!-- newcomer: long it takes long -->\n```python\nfor x in\n```", "invalid syntax"),
        ("<!-- newcomer: long trainer/tests/soup.py does -->\n```python\n```", "trainer/tests/soup.py does not exist"),
        ("<!-- newcomer: elsewhere bench/tests/test_peers.py -->\n```python\n```", "does not read page.md"),
        ("<!-- newcomer: skip -->\n```sh\n```", "`skip` needs a text"),
        ("<!-- newcomer: without caraware -->\n```sh\n```", "`without` needs a reason"),
        ("<!-- newcomer: hide it -->\n```sh\n```", "no marker is called so"),
        ("```console\n$ ls\n```", "a block begins with"),
    ],
)
def test_a_block_that_cannot_be_right_is_reported(block: str, said: str, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"{block}\n")
    run = follow(page)
    assert run.returncode == 1
    assert said in run.stdout + run.stderr
