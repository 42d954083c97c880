"""What the panel's list says of runs that have ended."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from caraware_viewer.panel.runs import RunDirectories

REPORT = {"metric": "error_m", "ppo_mean_error_m": 4.256, "env_steps": 40_000, "evaluated_at_env_steps": 12_000}


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"result": "interrupted"}, "error_m 4.26 after 12000 of 40000 samples"),
        ({"result": "completed"}, "error_m 4.26"),
        ({"result": "interrupted", "evaluated_at_env_steps": 40_000}, "error_m 4.26"),
        ({"result": "interrupted", "evaluated_at_env_steps": None}, "error_m 4.26"),
        ({"result": "interrupted", "ppo_mean_error_m": None}, None),
    ],
)
def test_an_old_evaluation_is_shown_with_its_age(changes: dict[str, Any], error: str | None, tmp_path: Path) -> None:
    directory = tmp_path / "town-1"
    directory.mkdir()
    (directory / "run.json").write_text(json.dumps({"name": "town-1", "mode": "train"}))
    (directory / "report.json").write_text(json.dumps(REPORT | changes))
    (summary,) = RunDirectories(tmp_path).summaries([])
    assert (summary["name"], summary["result"], summary["error"]) == ("town-1", changes["result"], error)
