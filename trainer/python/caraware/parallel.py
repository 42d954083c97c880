"""`torchrun --nproc-per-node N -m caraware.parallel [CONFIG] …`: N runs whose trainers learn together.

Every process that `torchrun` starts becomes a `caraware train` with environments, shared memory and a supervisor of its
own; the arguments are those of `caraware train`. The same command with a rendezvous address, on several machines,
learns on all of them. docs/parallel.md
"""

import argparse
import ctypes
import os
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from caraware.program import ProgramError, caraware_program

PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class Place:
    """Which of the processes that `torchrun` started this one is."""

    rank: int
    ranks: int
    local_rank: int
    local_ranks: int
    """Those on this machine."""

    @classmethod
    def from_environment(cls) -> "Place":
        """Raises `KeyError` where `torchrun` has not started it."""
        names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
        return cls(*(int(os.environ[name]) for name in names))

    def cores(self, available: Sequence[int]) -> list[int]:
        """An even share of the machine's cores, or all of them where there are fewer than ranks."""
        each = len(available) // self.local_ranks
        return list(available[self.local_rank * each :][:each] if each else available)


def command(arguments: Sequence[str], place: Place, launch: int) -> list[str]:
    """Arguments of `caraware` for one rank; `launch` tells launches on one machine apart."""
    parser = argparse.ArgumentParser(prog="torchrun … -m caraware.parallel", description=__doc__, add_help=False)
    parser.add_argument("--name")
    parser.add_argument("--envs", type=int, default=1)
    known, others = parser.parse_known_args(arguments)
    config = others[0] if others and not others[0].startswith("-") else "town"
    name = known.name or f"{Path(config).stem}-p{launch}"
    settings = {
        "run.envs": known.envs,
        "run.first_env": place.rank * known.envs,
        "trainer.ranks": place.ranks,
    }
    if place.rank > 0:
        # One run can be watched; the others show nothing and say only what went wrong.
        settings["fanout.enabled"] = "false"
        others = [*others, "--quiet"]
        name = f"{name}-rank{place.rank}"
    return ["train", *others, "--name", name, *(f"--set={key}={value}" for key, value in settings.items())]


def main(arguments: Sequence[str]) -> int:
    """Become the `caraware train` of this rank; returns only if that cannot be."""
    try:
        place, program = Place.from_environment(), caraware_program()
    except KeyError:
        print("start it by torchrun: torchrun --nproc-per-node 2 -m caraware.parallel town", file=sys.stderr)
        return 2
    except ProgramError as error:
        print(error, file=sys.stderr)
        return 3
    os.sched_setaffinity(0, place.cores(sorted(os.sched_getaffinity(0))))
    # Whatever ends torchrun ends its runs; what they started ends with them.
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    os.environ.setdefault("CARAWARE_PYTHON", sys.executable)
    os.execv(program, [str(program), *command(arguments, place, os.getppid())])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
