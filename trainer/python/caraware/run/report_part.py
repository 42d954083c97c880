"""The trainer's part of the report of a run that evaluates, `parts/trainer.json`."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from caraware.ipc.report_part import write_entries
from caraware.report.evaluation import EvaluationResult, no_headline

RTS_NOTE = "the smoother sees the future: a bound, not an estimator"


def write_part(
    run_dir: Path,
    entries: Mapping[str, object],
    phases: Sequence[EvaluationResult],
    metric: str,
    stop_requested: Callable[[], bool] = lambda: False,
) -> None:
    """Write the part with these entries. The headline is the last evaluation's, by the task's `metric`.

    Blocks while the disk is full, and raises `OSError`, as `write_entries`.
    """
    part = {
        **entries,
        **(phases[-1].headline() if phases else no_headline(metric)),
        "rts_note": RTS_NOTE,
        "evaluations": [result.report() for result in phases],
    }
    write_entries(run_dir, part, stop_requested)
