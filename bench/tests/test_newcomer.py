"""The commands of the README and of the tutorials, run as they are written: `scripts/newcomer.py`."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent.parent
PAGES = ["README.md", *sorted(f"docs/tutorials/{page.name}" for page in (ROOT / "docs" / "tutorials").glob("*.md"))]


def newcomer(page: Path) -> subprocess.CompletedProcess[str]:
    """Follow a page."""
    command = [sys.executable, str(ROOT / "scripts" / "newcomer.py"), str(page)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("page", PAGES)
def test_a_newcomer_can_follow_the_page(page: str) -> None:
    run = newcomer(ROOT / page)
    assert run.returncode == 0, f"{run.stdout}\n{run.stderr}"


def test_a_block_that_fails_is_reported(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("```sh\ncaraware --version\n```\n")
    run = newcomer(page)
    assert run.returncode == 1
    assert "command not found" in run.stdout
