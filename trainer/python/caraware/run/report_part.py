"""The trainer's part of a run's report, `parts/trainer.json`."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from caraware.report.evaluation import EvaluationResult, no_headline
from caraware.run.storage import when_there_is_space, write_whole

RTS_NOTE = "the smoother sees the future: a bound, not an estimator"


def write_part(
    run_dir: Path,
    entries: Mapping[str, object],
    phases: Sequence[EvaluationResult],
    metric: str,
    stop_requested: Callable[[], bool] = lambda: False,
) -> None:
    """Write the part with these entries. The headline is the last evaluation's, by the task's `metric`."""
    part = {
        **entries,
        **(phases[-1].headline() if phases else no_headline(metric)),
        "rts_note": RTS_NOTE,
        "evaluations": [result.report() for result in phases],
    }
    file = run_dir / "parts" / "trainer.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    content = (json.dumps(part, indent=2) + "\n").encode()
    when_there_is_space(file, lambda: write_whole(file, content), stop_requested)
