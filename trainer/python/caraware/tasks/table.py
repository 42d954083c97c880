"""The tasks by name: a new task is a row here and a file beside it (docs/extending.md)."""

from collections.abc import Callable, Mapping

from caraware.ipc.run_file import ConfigError, RunFile, setting
from caraware.tasks.contract import Task
from caraware.tasks.driving import Driving
from caraware.tasks.lane import LanePosition
from caraware.tasks.localisation import Localisation
from caraware.tasks.messages import Messages

TASKS: Mapping[str, Callable[[RunFile], Task]] = {
    "localisation": Localisation.from_run,
    "driving": Driving.from_run,
    "lane": LanePosition.from_run,
    "messages": Messages.from_run,
}
"""By `task.kind`: reads the task of a run out of its run file."""


def task_of_run(run: RunFile) -> Task:
    """The task that the run file names. Raises `ConfigError` where there is none of that name."""
    kind = setting(run, "task.kind", str)
    if kind not in TASKS:
        raise ConfigError(f"no task is called {kind!r}", f"`task.kind` is one of: {', '.join(TASKS)}")
    return TASKS[kind](run)
