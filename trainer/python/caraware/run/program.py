"""Where the `caraware` command is, for what starts it from Python. It imports nothing but the standard library."""

import ctypes
import os
import shutil
import signal
import sys
from pathlib import Path

_PR_SET_PDEATHSIG = 1


def end_with_parent(number: signal.Signals) -> None:
    """Make Linux send this process a signal once its parent has ended, however it ends. It outlives `exec`."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)


class ProgramError(Exception):
    """The command `caraware` was not found."""


def caraware_program() -> Path:
    """`CARAWARE`, the one of this wheel, the build beside this package or this Python, or the one in `PATH`.

    Raises `ProgramError`.
    """
    if named := os.environ.get("CARAWARE"):
        return Path(named)
    installed = Path(__file__).parents[1] / "programs" / "caraware"
    if installed.is_file():
        return installed
    roots = [*Path(__file__).parents, *Path(sys.executable).parents]
    for root in roots:
        program = root / "target" / "release" / "caraware"
        if program.is_file():
            return program
    if found := shutil.which("caraware"):
        return Path(found)
    raise ProgramError("the program caraware was not found: run `make build`, or set CARAWARE to its path")
