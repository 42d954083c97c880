"""`torchrun --nproc-per-node N -m caraware.parallel [CONFIG] …`: N runs whose trainers learn together.

Every process that `torchrun` starts becomes a `caraware train` with environments, shared memory and a supervisor of its
own; the arguments are those of `caraware train`. The same command with a rendezvous address, on several machines,
learns on all of them. With `--resume RUN` they continue from the newest checkpoint of all. docs/parallel.md
"""

import argparse
import json
import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

from caraware.run.manifest import BEGINNING, NEWEST, sound_checkpoints
from caraware.run.program import ProgramError, caraware_program, end_with_parent

WAIT_AT_MOST = timedelta(minutes=5)
"""For the names of the other ranks' checkpoints."""


class ResumeError(Exception):
    """The ranks cannot continue."""


@dataclass(frozen=True)
class RankPlace:
    """Which of the processes that `torchrun` started this one is."""

    rank: int
    ranks: int
    local_rank: int
    local_ranks: int
    """Those on this machine."""

    @classmethod
    def from_environment(cls) -> "RankPlace":
        """Raises `KeyError` where `torchrun` has not started it."""
        names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
        return cls(*(int(os.environ[name]) for name in names))

    def cores(self, available: Sequence[int]) -> list[int]:
        """An even share of the machine's cores, or all of them where there are fewer than ranks."""
        each = len(available) // self.local_ranks
        return list(available[self.local_rank * each :][:each] if each else available)

    def named(self, name: str) -> str:
        """The name of this rank's run, where that of rank 0 is `name`."""
        return f"{name}-rank{self.rank}" if self.rank > 0 else name


RankCheckpoints = list[str] | None
"""Names of a rank's sound checkpoints; None where it has no run."""
Agree = Callable[[RankPlace, RankCheckpoints], list[RankCheckpoints]]
"""Sends the names of this rank's checkpoints to the others; returns those of all ranks."""


def command(arguments: Sequence[str], place: RankPlace, launch: int, agree: Agree) -> list[str]:
    """Arguments of `caraware` for one rank; `launch` distinguishes launches on one machine. Raises `ResumeError`."""
    parser = argparse.ArgumentParser(prog="torchrun … -m caraware.parallel", description=__doc__, add_help=False)
    for name, kind in (("--name", str), ("--resume", Path), ("--runs", Path), ("--envs", int)):
        parser.add_argument(name, type=kind)
    known, others = parser.parse_known_args(arguments)
    runs, config = known.runs or Path("runs"), others[0] if others and not others[0].startswith("-") else "town"
    others = [*others, "--runs", str(runs)]
    if place.rank > 0:
        # One run can be watched; the others show nothing and say only what went wrong.
        others = [*others, "--quiet"]
    if known.resume:
        if known.envs is not None:
            raise ResumeError("--envs cannot change in a run that continues")
        return ["train", *others, *_resume(known.resume, runs, known.name, place, launch, agree)]
    envs = known.envs or 1
    settings = {"run.envs": envs, "run.first_env": place.rank * envs, "trainer.ranks": place.ranks}
    if place.rank > 0:
        settings["fanout.enabled"] = "false"
    name = place.named(known.name or f"{Path(config).stem}-p{launch}")
    return ["train", *others, "--name", name, *(f"--set={key}={value}" for key, value in settings.items())]


def _resume(named: Path, runs: Path, name: str | None, place: RankPlace, launch: int, agree: Agree) -> list[str]:
    """Continues from the checkpoint `named`, or from the newest that all ranks have of the run `named`."""
    is_checkpoint = named.parent.name == "checkpoints"
    run = named.parents[1] if is_checkpoint else next((at for at in (runs / named, named) if at.is_dir()), runs / named)
    own = run.with_name(place.named(run.name))
    newest = named.name if is_checkpoint else _newest_of_all(own, place, agree)
    if is_checkpoint or name is not None:
        if newest == BEGINNING:
            raise ResumeError(f"{own}: no checkpoint that all ranks have, with which another run could begin")
        return ["--resume", str(own / "checkpoints" / newest), "--name", place.named(name or f"{run.name}-p{launch}")]
    os.environ[NEWEST] = newest
    return ["--resume", str(own)]


def _newest_of_all(own: Path, place: RankPlace, agree: Agree) -> str:
    """The newest checkpoint of all ranks, or `BEGINNING`. Raises `ResumeError`."""
    names = [checkpoint.name for checkpoint in sound_checkpoints(own / "checkpoints")]
    of_all = agree(place, names if (own / "run.json").is_file() else None)
    made = [names for names in of_all if names is not None]
    if len(made) < len(of_all):
        missing = ", ".join(str(rank) for rank, names in enumerate(of_all) if names is None)
        raise ResumeError(f"{own}: each rank needs its run, on its machine; rank {missing} has none")
    if common := set.intersection(*map(set, made)):
        return max(common)
    # Ranks write every checkpoint together: one that dies before its first leaves the others with one at most.
    if any(len(names) > 1 for names in made):
        raise ResumeError(f"{own}: no checkpoint here that all {place.ranks} ranks have, each on its machine")
    return BEGINNING


def exchange_checkpoints(place: RankPlace, own: RankCheckpoints) -> list[RankCheckpoints]:
    """The names of every rank's checkpoints, exchanged by the store that `torchrun` keeps for its processes."""
    from torch.distributed import TCPStore  # type: ignore[attr-defined]  # torch lists it without exporting it

    address, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
    attempt = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
    store = TCPStore(address, port, is_master=False, timeout=WAIT_AT_MOST)
    store.set(f"caraware/{attempt}/checkpoints/{place.rank}", json.dumps(own))
    return [json.loads(store.get(f"caraware/{attempt}/checkpoints/{rank}")) for rank in range(place.ranks)]


def main(arguments: Sequence[str]) -> int:
    """Become the `caraware train` of this rank; returns only if that cannot be."""
    try:
        place, program = RankPlace.from_environment(), caraware_program()
    except KeyError:
        print("start it by torchrun: torchrun --nproc-per-node 2 -m caraware.parallel town", file=sys.stderr)
        return 2
    except ProgramError as error:
        print(error, file=sys.stderr)
        return 3
    try:
        words = command(arguments, place, os.getppid(), exchange_checkpoints)
    except ResumeError as error:
        print(error, file=sys.stderr)
        return 2
    os.sched_setaffinity(0, place.cores(sorted(os.sched_getaffinity(0))))
    # Whatever ends torchrun ends its runs; what they started ends with them.
    end_with_parent(signal.SIGTERM)
    os.environ.setdefault("CARAWARE_PYTHON", sys.executable)
    os.execv(program, [str(program), *words])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
