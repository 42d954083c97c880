"""`caraware study`: what may be varied, what is stopped, and that machines share one study."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import optuna
import pytest
from caraware.trials.space import KeyChoices, KeyRange, SpaceError, known_keys, parse_space
from caraware.trials.study import (
    ARRIVALS,
    MACHINE,
    MOST_FAILURES,
    PROCESS,
    SEEN,
    SILENT_S,
    Goal,
    Interrupts,
    Search,
    StudyPlace,
    began,
    machine,
    main,
)
from optuna.trial import TrialState
from recorded_run import CARAWARE

SMALL = {
    "traffic.cavs": 4,
    "traffic.others": 1,
    "traffic.pedestrians": 1,
    "episode.ticks": 200,
    "episode.training_episodes": 2,
    "episode.evaluation_interval": 0,
    "episode.evaluation_ticks": 30,
    "episode.final_evaluations": 1,
    "trainer.horizon": 64,
    "trainer.plots": "false",
    "trainer.batch_size": 32,
    "trainer.hidden": "[16]",
    "fanout.enabled": "false",
}
VARIED = "trainer.learning_rate=1e-4..1e-2:log"


def small(**changes: object) -> list[str]:
    settings = SMALL | {name.replace("__", "."): value for name, value in changes.items()}
    return [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]


def start(runs: Path, trials: int, storage: str = "", **changes: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "caraware.trials", "s", "town", "--vary", VARIED, "--runs", str(runs)]
    command += ["--trials", str(trials), *small(**changes), *(["--storage", storage] if storage else [])]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def trials(runs: Path) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = json.loads((runs / "s" / "trials.json").read_text())
    return rows


@pytest.fixture(scope="module")
def keys() -> dict[str, dict[str, Any]]:
    return known_keys(CARAWARE)


def test_a_space_has_ranges_and_choices_of_the_keys_kind(keys: dict[str, dict[str, Any]]) -> None:
    varied = ["trainer.learning_rate=1e-5..1e-2:log", "trainer.epochs=1..8", "trainer.activation=relu,tanh"]
    varied += ["trainer.hidden=[64, 64],[128]", "trainer.target_kl=0.01,0.05", "task.begin_from=../a,../b"]
    assert parse_space(varied, keys) == {
        "trainer.learning_rate": KeyRange(1e-5, 1e-2, False, True),
        "trainer.epochs": KeyRange(1, 8, True, False),
        "trainer.activation": KeyChoices(("relu", "tanh")),
        "trainer.hidden": KeyChoices(("[64, 64]", "[128]")),
        "trainer.target_kl": KeyChoices(("0.01", "0.05")),
        "task.begin_from": KeyChoices(("../a", "../b")),
    }


@pytest.mark.parametrize(
    ("varied", "why"),
    [
        ([], "nothing is varied"),
        (["trainer.epochs"], "write KEY=LOW..HIGH"),
        (["trainer.epoch=1..2"], "no key `trainer.epoch`"),
        (["trainer.epochs=1..2", "trainer.epochs=3,4"], "varied twice"),
        (["trainer.epochs=1.5..2"], "an end is not an integer"),
        (["trainer.epochs=0..2"], "allowed is"),
        (["trainer.epochs=4..2"], "the first end must be below"),
        (["trainer.gae_lambda=0..1:log"], "begins above 0"),
        (["trainer.activation=relu..tanh"], "one value is no choice"),
        (["trainer.activation=relu"], "one value is no choice"),
        (["trainer.activation=relu,gelu"], "'gelu' is not allowed"),
        (["trainer.epochs=4,4"], "there twice"),
    ],
)
def test_what_cannot_be_searched_is_refused_with_the_way_to_write_it(
    varied: list[str], why: str, keys: dict[str, dict[str, Any]]
) -> None:
    with pytest.raises(SpaceError, match=why):
        parse_space(varied, keys)


def test_a_goal_reads_its_number_in_a_report_and_knows_which_way_is_better() -> None:
    error, progress, arrivals = Goal.named("error_m"), Goal.named("progress_mps"), Goal.named(ARRIVALS)
    assert (error.is_higher_better, progress.is_higher_better, arrivals.is_higher_better) == (False, True, True)
    report: dict[str, Any] = {
        "ppo_mean_error_m": 4.5,
        "ppo_mean_progress_mps": None,
        "trainer": {"trips": {"evaluation": {}}},
    }
    assert (error.of_report(report), progress.of_report(report), arrivals.of_report(report)) == (4.5, None, None)
    report["trainer"] = {"trips": {"evaluation": {"arrival": 3, "collision": 1, "end of the run's episode": 9}}}
    assert arrivals.of_report(report) == 0.75
    with pytest.raises(SpaceError, match="known are error_m"):
        Goal.named("happiness")


def test_a_wrong_command_is_refused_before_any_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["s", "--vary", "trainer.epochs=0..2", "--runs", str(tmp_path)]) == 2
    assert "error: --vary trainer.epochs=0..2: allowed is" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_runs_that_fail_one_after_the_other_end_the_study_with_their_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["s", "nowhere", "--vary", VARIED, "--runs", str(tmp_path), "--trials", "9"]
    assert main(arguments) == 1
    error = capsys.readouterr().err
    assert "nowhere" in error and error.count("error:") == MOST_FAILURES


def test_a_run_behind_the_median_is_stopped_and_one_ahead_of_it_is_not(tmp_path: Path) -> None:
    """The trials before it are written by hand: no run reaches one micrometre, and any is better than a light year."""
    for others, state in ((1e-6, TrialState.PRUNED), (1e16, TrialState.COMPLETE)):
        place = StudyPlace("s", tmp_path / str(others), str(tmp_path / f"{others}.log"))
        space = parse_space([VARIED], known_keys(CARAWARE))
        settings = small(run__real_time_factor=8)
        command = [str(CARAWARE), "train", "town", "--quiet", *settings]
        search = Search(place, space, Goal.named("error_m"), command, 1)
        for _ in range(4):
            search.study.add_trial(
                optuna.create_trial(
                    params={"trainer.learning_rate": 1e-3},
                    distributions={
                        "trainer.learning_rate": optuna.distributions.FloatDistribution(1e-4, 1e-2, log=True)
                    },
                    value=others,
                    intermediate_values=dict.fromkeys(range(1, 21), others),
                )
            )
        search.search(5)
        trial = search.trials()[-1]
        assert trial.state == state
        report = json.loads((place.runs / "s-0004" / "report.json").read_text())
        assert report["result"] == ("interrupted" if state == TrialState.PRUNED else "completed")
        assert len(trial.intermediate_values) >= 4, "it was watched"


def test_two_searches_share_a_study_and_make_its_trials_once(tmp_path: Path) -> None:
    both = [start(tmp_path, 3), start(tmp_path, 3)]
    for search in both:
        out, error = search.communicate(timeout=300)
        assert search.returncode == 0, error + out
    rows = trials(tmp_path)
    assert 3 <= len(rows) <= 4, "each may begin one while the other begins the last"
    assert {row["state"] for row in rows} == {"complete"}
    assert len({row["trainer.learning_rate"] for row in rows}) == len(rows), "they draw different values"
    for row in rows:
        report = json.loads((tmp_path / row["run"] / "report.json").read_text())
        assert row["error_m"] == report["ppo_mean_error_m"]
    assert {"history.png", "slices.png", "live.png"} <= {file.name for file in (tmp_path / "s").iterdir()}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_waits_until_the_storage_is_not_in_use_and_a_second_does_not(number: signal.Signals) -> None:
    before = {known: signal.getsignal(known) for known in (signal.SIGINT, signal.SIGTERM)}
    interrupts = Interrupts()
    try:
        interrupts.catch()
        interrupts.raise_if_any()
        # As in the middle of a transaction.
        os.kill(os.getpid(), number)
        with pytest.raises(KeyboardInterrupt):
            interrupts.raise_if_any()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    finally:
        for known, handler in before.items():
            signal.signal(known, handler)


def test_an_interrupted_or_killed_search_goes_on_and_leaves_no_run_behind(tmp_path: Path) -> None:
    storage = f"sqlite:///{tmp_path / 'trials.db'}"
    search = start(tmp_path, 1, storage, run__real_time_factor=4)
    learning = tmp_path / "s-0000" / "learning.jsonl"
    while not learning.exists() and search.poll() is None:
        time.sleep(0.1)
    search.send_signal(signal.SIGTERM)
    out, error = search.communicate(timeout=120)
    assert search.returncode == 130, error + out
    assert json.loads((tmp_path / "s-0000" / "report.json").read_text())["result"] == "interrupted"
    assert [row["state"] for row in trials(tmp_path)] == ["fail"]

    # As a killed search of this machine leaves it: a trial that nobody runs.
    gone = subprocess.Popen(["true"])
    gone.wait()
    study = optuna.load_study(study_name="s", storage=StudyPlace("s", tmp_path, storage).open_storage())
    now, mine = time.time(), began(os.getpid())
    assert mine is not None
    for where, process, seen in (
        (machine(), [gone.pid, mine], now),
        (machine(), [os.getpid(), mine], now - 2 * SILENT_S),
        # A search whose process id another process has now, as that of a container that is made again.
        (machine(), [os.getpid(), mine - 1], now),
        ("another", [gone.pid, mine], now - 2 * SILENT_S),
        ("another", [gone.pid, mine], now),
    ):
        trial = study.ask()
        for name, value in ((MACHINE, where), (PROCESS, process), (SEEN, seen)):
            trial.set_user_attr(name, value)

    refused = start(tmp_path, 3, storage)
    _, error = refused.communicate(timeout=120)
    assert refused.returncode == 2 and "is there already, of another command" in error

    # The trials that are alive count: one more makes three.
    search = start(tmp_path, 3, storage, run__real_time_factor=4)
    out, error = search.communicate(timeout=300)
    assert search.returncode == 0, error + out
    assert [row["state"] for row in trials(tmp_path)] == [
        "fail",
        "fail",
        "running",
        "fail",
        "fail",
        "running",
        "complete",
    ]


def test_a_run_ends_with_its_search(tmp_path: Path) -> None:
    search = start(tmp_path, 1, run__real_time_factor=1)
    while not (tmp_path / "s-0000" / "learning.jsonl").exists() and search.poll() is None:
        time.sleep(0.1)
    search.kill()
    search.communicate(timeout=60)
    report, begun = tmp_path / "s-0000" / "report.json", time.monotonic()
    while not report.exists():
        assert time.monotonic() - begun < 60
        time.sleep(0.1)
    assert json.loads(report.read_text())["result"] == "interrupted"
