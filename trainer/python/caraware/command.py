"""The command `caraware` of an installed wheel: becomes the program that the wheel carries."""

import os
import sys
from pathlib import Path


def main() -> None:
    """Replace this process by the program, which then starts the processes of Python with this interpreter."""
    program = Path(__file__).parent / "programs" / "caraware"
    os.environ.setdefault("CARAWARE_PYTHON", sys.executable)
    try:
        os.execv(program, ["caraware", *sys.argv[1:]])
    except OSError as error:
        sys.exit(f"caraware: cannot start {program}: {error}; install the wheel again")
