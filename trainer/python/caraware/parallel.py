"""`torchrun --nproc-per-node N -m caraware.parallel [CONFIG] …`: N runs whose trainers learn together.

Every process that `torchrun` starts becomes a `caraware train` with environments, shared memory and a supervisor of its
own; the arguments are those of `caraware train`. The same command with a rendezvous address, on several machines,
learns on all of them. With `--resume RUN` they continue from the newest checkpoint of all. Processes that `torchrun
--max-restarts` starts again continue their launch. docs/parallel.md
"""

import argparse
import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import timedelta
from pathlib import Path

from caraware.run.manifest import BEGINNING, NEWEST, sound_checkpoints
from caraware.run.program import ProgramError, caraware_program, end_with_parent

WAIT_AT_MOST = timedelta(minutes=5)
"""For what the other ranks have of their runs."""
END_WITHIN_S = 30.0
"""Longest time in which the processes of a dead supervisor end by themselves."""
SHOWN = ("--quiet", "--viewer")
CREDENTIALS = ("--user", "--password-file", "--ca", "--certificate", "--key")
"""Options of `caraware train`, the latter with a value, that a run file does not hold."""


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


@dataclass(frozen=True)
class Launch:
    """The `torchrun` that started this process."""

    pid: int
    began_s: float
    """When it was started, seconds of the wall clock."""
    restarts: int = 0
    """How often it has started its processes again."""
    machines: int = 1

    @classmethod
    def from_environment(cls) -> "Launch":
        """That of this process, whose parent `torchrun` is."""
        pid = os.getppid()
        started_ticks = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19])
        age_s = time.clock_gettime(time.CLOCK_BOOTTIME) - started_ticks / os.sysconf("SC_CLK_TCK")
        restarts = int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))
        return cls(pid, time.time() - age_s, restarts, int(os.environ.get("GROUP_WORLD_SIZE", "1")))

    def has_made(self, run: Path) -> bool:
        """Whether a supervisor of this launch has written the run file in the directory `run`."""
        try:
            return (run / "run.json").stat().st_mtime >= self.began_s
        except OSError:
            return False


@dataclass(frozen=True)
class RankRun:
    """What a rank has of its run."""

    is_made: bool
    """It has a run file; after a restart, one of this launch."""
    is_completed: bool
    """This launch has completed it."""
    checkpoints: tuple[str, ...]
    """Names of those that are sound."""

    @classmethod
    def of(cls, run: Path, is_made: bool, launch: Launch) -> "RankRun":
        """That in the directory `run`."""
        is_completed = launch.has_made(run) and _is_completed(run)
        checkpoints = sound_checkpoints(run / "checkpoints") if is_made else ()
        return cls(is_made, is_completed, tuple(checkpoint.name for checkpoint in checkpoints))


Agree = Callable[[RankPlace, str, RankRun], list[RankRun]]
"""Sends what this rank has of the run of that name to the others; returns what all have."""


class Completed(Exception):
    """All ranks have completed their runs: nothing is left to do."""


def command(arguments: Sequence[str], place: RankPlace, launch: Launch, agree: Agree) -> list[str]:
    """Arguments of `caraware` for one rank. Raises `ResumeError` and `Completed`."""
    parser = argparse.ArgumentParser(prog="torchrun … -m caraware.parallel", description=__doc__, add_help=False)
    for name, kind in (("--name", str), ("--resume", Path), ("--runs", Path), ("--envs", int)):
        parser.add_argument(name, type=kind)
    known, others = parser.parse_known_args(arguments)
    if launch.restarts > 0 and launch.machines > 1:
        raise ResumeError("ranks on several machines do not continue by themselves: start them again with --resume")
    if "--restart" in others:
        raise ResumeError("--restart is for a trainer alone: `torchrun --max-restarts K …` continues ranks by itself")
    runs, config = known.runs or Path("runs"), others[0] if others and not others[0].startswith("-") else "town"
    others = [*others, "--runs", str(runs)]
    if place.rank > 0 and "--quiet" not in others:
        # One run can be watched; the others show nothing and say only what went wrong.
        others = [*others, "--quiet"]
    if known.resume:
        if known.envs is not None:
            raise ResumeError("--envs cannot change in a run that continues")
        return _resume(known.resume, runs, known.name, others, place, launch, agree)
    name = place.named(known.name or f"{Path(config).stem}-p{launch.pid}")
    if again := _continue(runs / name, others, place, launch, agree):
        return again
    envs = known.envs or 1
    settings = {"run.envs": envs, "run.first_env": place.rank * envs, "trainer.ranks": place.ranks}
    if place.rank > 0:
        settings["fanout.enabled"] = "false"
    return ["train", *others, "--name", name, *(f"--set={key}={value}" for key, value in settings.items())]


def _resume(
    named: Path, runs: Path, name: str | None, others: list[str], place: RankPlace, launch: Launch, agree: Agree
) -> list[str]:
    """Continues from the checkpoint `named`, or from the newest that all ranks have of the run `named`."""
    is_checkpoint = named.parent.name == "checkpoints"
    run = named.parents[1] if is_checkpoint else next((at for at in (runs / named, named) if at.is_dir()), runs / named)
    own = run.with_name(place.named(run.name))
    if is_checkpoint or name is not None:
        newest = named.name if is_checkpoint else _newest_of_all(own, place, launch, agree)
        if newest == BEGINNING:
            raise ResumeError(f"{own}: no checkpoint that all ranks have, with which another run could begin")
        new = place.named(name or f"{run.name}-p{launch.pid}")
        if again := _continue(runs / new, others, place, launch, agree):
            return again
        return ["train", *others, "--resume", str(own / "checkpoints" / newest), "--name", new]
    end_former_processes(own, launch)
    os.environ[NEWEST] = _newest_of_all(own, place, launch, agree)
    if launch.has_made(own):
        # The run file holds the settings of this command, and of handovers after it.
        others = _shown(others)
    return ["train", *others, "--resume", str(own)]


def _newest_of_all(own: Path, place: RankPlace, launch: Launch, agree: Agree) -> str:
    """The newest checkpoint of all ranks, or `BEGINNING`. Raises `ResumeError` and `Completed`."""
    of_all = agree(place, own.name, RankRun.of(own, (own / "run.json").is_file(), launch))
    missing = [str(rank) for rank, run in enumerate(of_all) if not run.is_made]
    if missing:
        raise ResumeError(f"{own}: each rank needs its run, on its machine; rank {', '.join(missing)} has none")
    return _newest(own, of_all)


def _newest(own: Path, of_all: Sequence[RankRun]) -> str:
    if all(run.is_completed for run in of_all):
        raise Completed
    if common := set.intersection(*(set(run.checkpoints) for run in of_all)):
        return max(common)
    # Ranks write every checkpoint together: one that dies before its first leaves the others with one at most.
    if any(len(run.checkpoints) > 1 for run in of_all):
        raise ResumeError(f"{own}: no checkpoint here that all {len(of_all)} ranks have, each on its machine")
    return BEGINNING


def _continue(own: Path, others: Sequence[str], place: RankPlace, launch: Launch, agree: Agree) -> list[str] | None:
    """Continues the run `own` of a launch that `torchrun` has started again; None where the run has to be made.

    Raises `ResumeError` and `Completed`.
    """
    if launch.restarts == 0:
        return None
    end_former_processes(own, launch)
    of_all = agree(place, own.name, RankRun.of(own, launch.has_made(own), launch))
    newest = _newest(own, of_all)
    if not launch.has_made(own):
        _remove_prepared(own)
        return None
    # Before all runs were made no trainer had learnt: each begins where it began.
    if all(run.is_made for run in of_all):
        os.environ[NEWEST] = newest
    return ["train", *_shown(others), "--resume", str(own)]


def _shown(words: Sequence[str]) -> list[str]:
    """Those of the arguments of `caraware train` that a run which continues does not know from its run file."""
    kept = []
    for word, after in zip(words, [*words[1:], ""], strict=True):
        option, has_value, _ = word.partition("=")
        if option in SHOWN or (option in CREDENTIALS and has_value):
            kept.append(word)
        elif option in CREDENTIALS:
            kept += [word, after]
    return kept


def end_former_processes(run: Path, launch: Launch) -> None:
    """Wait for the processes that a dead supervisor of this launch has left: a trainer may still write a checkpoint.

    Those that do not end in time are killed.
    """
    if not launch.has_made(run) or Path("/proc", str(_supervisor_pid(run))).exists():
        return
    deadline = time.monotonic() + END_WITHIN_S
    while left := [pid for pid in map(int, filter(str.isdecimal, os.listdir("/proc"))) if _belongs_to(pid, run)]:
        if time.monotonic() > deadline:
            for pid in left:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        time.sleep(0.05)


def _supervisor_pid(run: Path) -> int:
    try:
        return int(json.loads((run / "run.json").read_text())["supervisor_pid"])
    except (OSError, ValueError, KeyError):
        return os.getpid()


def _belongs_to(pid: int, run: Path) -> bool:
    """Whether a supervisor has started the process for this run: one of its run files is in the command line."""
    process, directory = Path("/proc", str(pid)), run.absolute()
    try:
        if b"CARAWARE_INCARNATION=" not in (process / "environ").read_bytes():
            return False
        words = [Path(os.fsdecode(word)) for word in (process / "cmdline").read_bytes().split(b"\0")]
    except OSError:
        return False
    files = [word for word in words if word.name in ("run.json", "run.next.json")]
    return any(directory in (file.parent, file.parent.parent) for file in files)


def _is_completed(run: Path) -> bool:
    try:
        return bool(json.loads((run / "report.json").read_text())["result"] == "completed")
    except (OSError, ValueError, KeyError):
        return False


def _remove_prepared(own: Path) -> None:
    """Remove the directory of a run whose supervisor died before it had written the run file, and nothing else."""
    if not own.is_dir() or (own / "run.json").exists():
        return
    marks = [mark.name.removeprefix(".preparing-") for mark in own.glob(".preparing-*")]
    is_empty = not any(own.iterdir())
    if is_empty or (marks and not any(Path("/proc", pid).exists() for pid in marks)):
        shutil.rmtree(own)


def exchange_runs(place: RankPlace, name: str, own: RankRun) -> list[RankRun]:
    """What every rank has of its run, exchanged by the store that `torchrun` keeps for its processes."""
    from torch.distributed import TCPStore  # type: ignore[attr-defined]  # torch lists it without exporting it

    address, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
    attempt = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
    store = TCPStore(address, port, is_master=False, timeout=WAIT_AT_MOST)
    launch = name.removesuffix(place.named(""))
    keys = [f"caraware/{attempt}/runs/{launch}/{rank}" for rank in range(place.ranks)]
    store.set(keys[place.rank], json.dumps(asdict(own)))
    return [RankRun(**json.loads(store.get(key))) for key in keys]


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
        words = command(arguments, place, Launch.from_environment(), exchange_runs)
    except Completed:
        return 0
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
