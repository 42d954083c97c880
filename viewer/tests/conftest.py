"""Settings of all tests here."""

from __future__ import annotations

import os
import sys
from pathlib import Path

BYTECODE = Path(__file__).parents[2] / "target" / "tmp" / "bytecode"
"""Where the tests in Rust keep it, too."""


def pytest_configure() -> None:
    """Without bytecode every learner compiles 1 700 modules when it starts: seconds of a core."""
    if os.environ.pop("PYTHONDONTWRITEBYTECODE", None) is not None:
        os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix = str(BYTECODE)
        sys.dont_write_bytecode = False
