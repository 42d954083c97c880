"""The part of a run's report that its trainer writes, whichever program is the trainer. Imports nothing heavy."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path

from caraware.ipc.storage import when_there_is_space, write_whole

PART = Path("parts", "trainer.json")
"""In the run directory."""


def write_entries(
    run_dir: Path, entries: Mapping[str, object], stop_requested: Callable[[], bool] = lambda: False
) -> None:
    """Write the part with these entries, from one moment to the next. Raises `OSError`.

    On a full disk it waits until there is space, or until a stop is requested; then it raises `OSError`.
    """
    file = run_dir / PART
    content = (json.dumps(entries, indent=2) + "\n").encode()

    def write() -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(file, content)

    when_there_is_space(file, write, stop_requested)
