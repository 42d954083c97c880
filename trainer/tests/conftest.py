"""Runs that several test modules read."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from recorded_run import ASKEW, TRAINED, RecordedFrame, of_carriers, recorded_run

BYTECODE = Path(__file__).parents[2] / "target" / "tmp" / "bytecode"
"""Where the tests in Rust keep it, too."""


def pytest_configure() -> None:
    """Without bytecode every learner compiles 1 700 modules when it starts: seconds of a core."""
    if os.environ.pop("PYTHONDONTWRITEBYTECODE", None) is not None:
        os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix = str(BYTECODE)
        sys.dont_write_bytecode = False


@pytest.fixture(scope="session", autouse=True)
def logs_of_libraries(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Stable-Baselines3 and `torchrun` make a directory for logs at every start, and leave it: pytest removes these."""
    with pytest.MonkeyPatch.context() as patch:
        for variable in ("SB3_LOGDIR", "PET_LOG_DIR"):
            patch.setenv(variable, str(tmp_path_factory.mktemp("logs")))
        yield


@pytest.fixture(scope="session")
def askew_run() -> Iterator[Path]:
    """A recorded run of three carriers with sensors that are mounted off-centre and turned."""
    with recorded_run("simulate", ASKEW) as run_dir:
        yield run_dir


@pytest.fixture(scope="session")
def askew_frames(askew_run: Path) -> dict[tuple[int, int], RecordedFrame]:
    """Its frames by vehicle and tick."""
    return of_carriers(askew_run)


@pytest.fixture(scope="session")
def trained_run() -> Iterator[Path]:
    """A recorded run of a learner, `a.run_3`, with seed 3."""
    with recorded_run("train", TRAINED | {"run.seed": 3}, name="a.run_3") as run_dir:
        yield run_dir
