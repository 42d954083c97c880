"""`python -m caraware.envs.outside RUN_FILE`: keeps the trainer's place in a run whose trainer is a process outside.

The supervisor starts it like any trainer. It sends the path of the run file to the process that asked for the
simulation. It ends in order when that process says so, and fails the run when that process is gone. So a
simulation never outlives its user, however that one ends. It imports nothing but the standard library.
"""

import json
import os
import select
import socket
import sys
from pathlib import Path

LINE = "CARAWARE_OUTSIDE"
"""Environment variable: name of the user's socket in Linux's abstract namespace, where nothing is left behind."""
USER = "CARAWARE_OUTSIDE_PID"
"""Environment variable: process id of the user, whose end is seen even if its children still hold the socket."""
DONE = b"done\n"
"""What the user says once the last tick has been consumed."""


class UserGoneError(Exception):
    """The process that uses the simulation has ended."""


def _hold(run_file: str) -> None:
    user, supervisor = os.pidfd_open(int(os.environ[USER])), os.pidfd_open(os.getppid())
    with socket.socket(socket.AF_UNIX) as line:
        line.connect("\0" + os.environ[LINE])
        line.sendall(run_file.encode() + b"\n")
        waited: list[socket.socket | int] = [line, user, supervisor]
        ready, _, _ = select.select(waited, [], [])
        if supervisor not in ready and (user in ready or line.recv(len(DONE)) != DONE):
            raise UserGoneError


def main(run_file: str) -> int:
    """Hold the run; the process's exit code."""
    try:
        _hold(run_file)
    except (UserGoneError, OSError, KeyError) as error:
        message = "the process that uses this simulation has ended"
        if isinstance(error, KeyError):
            message = "this module is for `caraware.envs.make`, which starts it"
        failure = {"kind": "run", "message": message, "help": "close an environment by its `close()`"}
        Path(run_file).parent.joinpath("logs", "trainer.error.json").write_text(json.dumps(failure) + "\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
