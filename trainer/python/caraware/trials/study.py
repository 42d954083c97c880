"""`caraware study NAME`: searches for the values of keys with which runs do best (Optuna; docs/trials.md).

Every trial is a run of `caraware train`. What it has reached is read from its report, and while it learns from its live
metric: one that is behind the median of the trials before it, at the same place, is stopped. The trials lie in a
storage that machines may share; the same command on another machine adds to them.
"""

import argparse
import json
import math
import os
import signal
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import optuna
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState

from caraware import _native
from caraware.run.program import ProgramError, caraware_program
from caraware.trials.run import TrialFailed, TrialRun
from caraware.trials.space import Space, SpaceError, known_keys, parse_space

ARRIVALS = "arrivals"
"""Share of the heroes' trips of the evaluations that arrive: no live metric, so `progress_mps` is pruned by."""
STARTUP_TRIALS, WARMUP_PLACES = 4, 4
"""Trials before any is stopped, and places of a run at which none is."""
MOST_FAILURES = 3
"""Trials that fail one after the other before the study gives up."""
BEAT_S, SILENT_S = 60.0, 900.0
"""A search says so often that its trial goes on; one of another machine that is silent for so long is dead."""
MACHINE, PROCESS, SEEN = "machine", "process", "seen"
"""What a trial says of its search: see `machine` and `began`; when it was last alive, in seconds since 1970."""
OVER = (TrialState.COMPLETE, TrialState.PRUNED)


@dataclass(frozen=True)
class Goal:
    """What a study makes better."""

    name: str
    live: str
    """The metric of `learning.jsonl` by which trials are stopped."""
    is_higher_better: bool

    @classmethod
    def named(cls, name: str) -> "Goal":
        """The goal of `--metric`. Raises `SpaceError`."""
        if name == ARRIVALS:
            return cls(name, "progress_mps", True)
        for metric in _native.METRICS:
            if metric.name == name and metric.reference_for is None:
                return cls(name, name, metric.higher_is_better)
        known = [metric.name for metric in _native.METRICS if metric.reference_for is None]
        raise SpaceError(f"--metric {name}: known are {', '.join([*known, ARRIVALS])}")

    def of_report(self, report: dict[str, Any]) -> float | None:
        """The mean over the final evaluations."""
        if self.name != ARRIVALS:
            return _number(report.get(f"ppo_mean_{self.name}"))
        ends = ((report.get("trainer") or {}).get("trips") or {}).get("evaluation") or {}
        counted = sum(count for end, count in ends.items() if end != "end of the run's episode")
        return ends.get("arrival", 0) / counted if counted else None


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


@dataclass(frozen=True)
class StudyPlace:
    """Where the runs and the trials are."""

    name: str
    runs: Path
    storage: str

    @property
    def directory(self) -> Path:
        """Of the study itself."""
        return self.runs / self.name

    def run(self, number: int) -> str:
        """Name of the run of a trial."""
        return f"{self.name}-{number:04}"

    def open_storage(self) -> BaseStorage:
        """The journal file, or the data base of an address with `://`."""
        if "://" in self.storage:
            return RDBStorage(self.storage)
        file = Path(self.storage)
        file.parent.mkdir(parents=True, exist_ok=True)
        return JournalStorage(JournalFileBackend(str(file)))


class Interrupts:
    """Ctrl-C and SIGTERM, which wait until the storage is not in use: half of a transaction locks a data base.

    A second one does not wait.
    """

    def __init__(self) -> None:
        self._has_come = False

    def catch(self) -> None:
        """Catch them from now on. Clusters end jobs by SIGTERM, which a container's first process would ignore."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self._has_come:
            raise KeyboardInterrupt
        self._has_come = True

    def raise_if_any(self) -> None:
        """Raises `KeyboardInterrupt` once one has come."""
        if self._has_come:
            raise KeyboardInterrupt


class Search:
    """A study that runs its trials one after the other."""

    def __init__(
        self,
        place: StudyPlace,
        space: Space,
        goal: Goal,
        command: list[str],
        seed: int,
        interrupts: Interrupts | None = None,
    ) -> None:
        """`command` is that of a run, without its name and the varied keys."""
        self._place, self._space, self._goal, self._command, self._seed = place, space, goal, command, seed
        self._interrupts = interrupts or Interrupts()
        self._study = optuna.create_study(
            study_name=place.name,
            storage=place.open_storage(),
            load_if_exists=True,
            direction="maximize" if goal.is_higher_better else "minimize",
            pruner=optuna.pruners.MedianPruner(STARTUP_TRIALS, WARMUP_PLACES),
        )
        self._refuse_another_study(" ".join([*command[1:], goal.name, *sorted(map(str, space.items()))]))

    @property
    def study(self) -> optuna.Study:
        """Optuna's."""
        return self._study

    def trials(self) -> list[FrozenTrial]:
        """Of all machines."""
        return self._study.get_trials(deepcopy=False)

    def search(self, most: int) -> None:
        """Run trials until there are `most` that have not failed, on all machines.

        Raises `TrialFailed`, and `KeyboardInterrupt` once one has come and the trial's run has ended.
        """
        failures = 0
        while self._made() < most:
            self._interrupts.raise_if_any()
            try:
                self._try()
                failures = 0
            except TrialFailed as error:
                failures += 1
                print(f"error: {error}", file=sys.stderr)
                if failures == MOST_FAILURES:
                    raise

    def _made(self) -> int:
        """Trials that count: those that are over or alive."""
        self._end_dead_trials()
        return sum(trial.state in (*OVER, TrialState.RUNNING) for trial in self.trials())

    def _try(self) -> None:
        trial = self._study.ask()
        try:
            value = self._run(trial)
        except BaseException:
            self._study.tell(trial, state=TrialState.FAIL)
            raise
        if value is None:
            self._study.tell(trial, state=TrialState.PRUNED)
            return
        self._study.tell(trial, value)
        best = self._study.best_trial
        print(
            f"trial {trial.number}: {self._goal.name} {value:.4g}; best {best.value:.4g} of trial {best.number}",
            flush=True,
        )

    def _run(self, trial: optuna.Trial) -> float | None:
        """What the run of a trial has reached, or None where it was stopped. Raises `TrialFailed`."""
        trial.set_user_attr(MACHINE, machine())
        trial.set_user_attr(PROCESS, [os.getpid(), began(os.getpid())])
        # What a trial draws depends on the seed, its number and those before it: machines do not repeat each other.
        self._study.sampler = optuna.samplers.TPESampler(seed=(self._seed * 1_000_003 + trial.number) % 2**32)
        values = {key: varied.suggest(trial, key) for key, varied in self._space.items()}
        name = self._place.run(trial.number)
        command = [*self._command, "--name", name, "--runs", str(self._place.runs)]
        for key, text in values.items():
            command += ["--set", f"{key}={text}"]
        print(f"trial {trial.number}: {' '.join(f'{key}={text}' for key, text in values.items())}", flush=True)
        beaten = time.monotonic()

        def beat() -> None:
            nonlocal beaten
            self._interrupts.raise_if_any()
            if time.monotonic() - beaten > BEAT_S:
                trial.set_user_attr(SEEN, time.time())
                beaten = time.monotonic()

        with TrialRun(command, self._place.runs / name, self._goal.live) as run:
            for place, value in run.points(beat):
                trial.report(value, place)
                if trial.should_prune():
                    print(f"trial {trial.number}: stopped at {self._goal.live} {value:.4g}", flush=True)
                    return None
            # Ctrl-C in a terminal has ended the run, too.
            self._interrupts.raise_if_any()
            return run.final(self._goal.of_report)

    def _refuse_another_study(self, what: str) -> None:
        """Trials of different commands would be compared with each other. Raises `SpaceError`."""
        there = self._study.user_attrs.get("command")
        if there is None:
            self._study.set_user_attr("command", what)
        elif there != what:
            raise SpaceError(
                f"the study {self._place.name} is there already, of another command:\n  {there}\nand not\n  {what}\n"
                "give another NAME, or the same command"
            )

    def _end_dead_trials(self) -> None:
        """Trials that a killed search left, of this machine or another."""
        for trial in self.trials():
            if trial.state == TrialState.RUNNING and not _goes_on(trial):
                self._study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)


def machine() -> str:
    """Where a process id means the same process: this start of the kernel, and this container."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return f"{boot} {os.readlink('/proc/self/ns/pid')}"


def began(pid: int) -> int | None:
    """When a process began, in ticks of the kernel, or None without it: ids are given again, in containers soon."""
    try:
        # Field 22 of proc_pid_stat(5). The second is a name in brackets, which may hold anything.
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19])
    except (FileNotFoundError, ProcessLookupError):
        return None


def _goes_on(trial: FrozenTrial) -> bool:
    if trial.user_attrs.get(MACHINE) == machine() and PROCESS in trial.user_attrs:
        pid, since = trial.user_attrs[PROCESS]
        return bool(began(pid) == since)
    begun = trial.datetime_start.timestamp() if trial.datetime_start else 0.0
    return time.time() - float(trial.user_attrs.get(SEEN, begun)) < SILENT_S


def write_results(search: Search, place: StudyPlace, goal: Goal) -> None:
    """`trials.json` and pictures in the study's directory, and the five best on the screen."""
    made = [(trial.value, trial) for trial in search.trials() if trial.state == TrialState.COMPLETE]
    completed = [(value, trial) for value, trial in made if value is not None]
    completed.sort(key=lambda pair: pair[0], reverse=goal.is_higher_better)
    place.directory.mkdir(parents=True, exist_ok=True)
    rows = [
        {"run": place.run(trial.number), "state": trial.state.name.lower(), goal.name: trial.value} | trial.params
        for trial in search.trials()
    ]
    (place.directory / "trials.json").write_text(json.dumps(rows, indent=2) + "\n")
    for value, trial in completed[:5]:
        values = " ".join(f"{key}={text}" for key, text in trial.params.items())
        print(f"{place.run(trial.number)}  {goal.name} {value:.4g}  {values}")
    if len(completed) > 1:
        _draw(search.study, place.directory, goal)
    print(f"trials: {place.directory / 'trials.json'}")


def _draw(study: optuna.Study, directory: Path, goal: Goal) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from optuna.visualization import matplotlib as pictures

    def save(name: str) -> None:
        pyplot.savefig(directory / f"{name}.png", dpi=120, bbox_inches="tight")
        pyplot.close()

    pictures.plot_optimization_history(study, target_name=goal.name)
    save("history")
    pictures.plot_slice(study, target_name=goal.name)
    save("slices")
    pictures.plot_intermediate_values(study)
    save("live")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="caraware study",
        description="Searches for the values of keys with which runs do best.",
        epilog="""examples:
  caraware study rates town --vary trainer.learning_rate=1e-4..1e-2:log --vary trainer.epochs=4..20 --trials 30
  caraware study nets paper --vary 'trainer.hidden=[128, 128],[500, 300]' --vary trainer.activation=relu,tanh
  caraware study drive driving --metric arrivals --vary trainer.learning_rate=1e-5..1e-3:log

Every trial is a run of `caraware train CONFIG`, called NAME-0000, NAME-0001, … below --runs; `caraware compare` and
`caraware report` take them. One that is behind the median of the others while it learns is stopped. Ctrl-C ends the
search and its run; the same command goes on. With the same --storage, machines share a study (docs/trials.md).""",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", metavar="NAME", help="name of the study, and the beginning of its runs' names")
    parser.add_argument("config", metavar="CONFIG", nargs="?", default="town", help="as `caraware train` takes it")
    parser.add_argument(
        "--vary",
        metavar="KEY=VALUES",
        action="append",
        default=[],
        help="a key and its values: LOW..HIGH, LOW..HIGH:log, or A,B,C (repeatable)",
    )
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="for all runs (repeatable)")
    parser.add_argument("--trials", type=int, default=20, help="trials of all machines (default 20)")
    parser.add_argument("--metric", default="error_m", help="what to make better (default error_m), or arrivals")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="directory of the runs (default runs)")
    parser.add_argument("--storage", default="", help="file or data base of the trials (default RUNS/NAME/journal.log)")
    parser.add_argument("--seed", type=int, default=1, help="of what is drawn (default 1)")
    return parser


def main(arguments: Sequence[str]) -> int:
    """0 once the trials are made, 1 where they fail, 2 for a wrong command, 130 after Ctrl-C or SIGTERM."""
    options = parser().parse_args(arguments)
    if options.trials < 1:
        parser().error("--trials: give at least 1")
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    # Its pictures, storage and sampler say at each call that they may change.
    warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
    try:
        program = caraware_program()
        goal = Goal.named(options.metric)
        space = parse_space(options.vary, known_keys(program))
        place = StudyPlace(
            options.name, options.runs, options.storage or str(options.runs / options.name / "journal.log")
        )
        command = [str(program), "train", options.config, "--quiet"]
        for setting in options.set:
            command += ["--set", setting]
        interrupts = Interrupts()
        search = Search(place, space, goal, command, options.seed, interrupts)
    except (SpaceError, ProgramError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    status = 0
    interrupts.catch()
    try:
        search.search(options.trials)
    except TrialFailed:
        status = 1
    except KeyboardInterrupt:
        status = 130
    write_results(search, place, goal)
    return status
