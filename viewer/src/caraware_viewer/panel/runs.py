"""The runs that the panel shows: those below its directory, and live ones from elsewhere, by the files they write."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypedDict

LOG_LINES = 300
"""Newest lines of a log that are shown."""
LOG_BYTES = 1 << 18
"""Newest bytes of a log that are read."""

_RUN_FILE = "run.json"
_REPORT = "report.json"
_CURRICULUM = "curriculum.jsonl"


class RunSummary(TypedDict):
    """A run in the list of the page."""

    id: str
    """Name of a run in the panel's directory; the directory of a live run elsewhere. Commands take both."""
    name: str
    mode: str
    alive: bool
    result: str | None
    """`completed`, `interrupted` or `failed`; `None` without a report."""
    error: str | None
    """The mean of the headline metric on unseen seeds, with its name."""
    checkpoint: bool
    recording: bool


class Stage(TypedDict):
    """A stage of a run's curriculum."""

    settings: dict[str, Any]
    """As configured, without what is unset."""
    since: list[dict[str, int]]
    """`lesson` and `tick` at which the run entered it; empty if it has not."""


class UnknownRunError(LookupError):
    """There is no such run, or no such file of it."""


class RunDirectories:
    """Finds runs by their ids, and reads what they write."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._live: dict[str, Path] = {}
        self._documents: dict[Path, tuple[int, dict[str, Any]]] = {}

    def summaries(self, live: Iterable[Path]) -> list[RunSummary]:
        """All runs, those in the panel's directory by age, newest first; `live` are the directories of live runs."""
        alive = {path.resolve() for path in live}
        here = [path for path in _subdirectories(self.root) if (path / _RUN_FILE).is_file()]
        known = {path.resolve(): path.name for path in here}
        elsewhere = sorted(path for path in alive if path not in known)
        self._live = {str(path): path for path in elsewhere}
        here.sort(key=lambda path: (path / _RUN_FILE).stat().st_mtime, reverse=True)
        return [
            *(self._summary(str(path), path, True) for path in elsewhere),
            *(self._summary(path.name, path, path.resolve() in alive) for path in here),
        ]

    def directory(self, run: str) -> Path:
        """The directory of a run that the list has, by its id. Raises `UnknownRunError`."""
        if run in self._live:
            return self._live[run]
        if run and run == Path(run).name and (self.root / run / _RUN_FILE).is_file():
            return self.root / run
        raise UnknownRunError(f"there is no run {run!r}")

    def files(self, run: str, folder: str) -> list[str]:
        """Names of the files in `folder` of a run's directory. Raises `UnknownRunError`."""
        directory = self.directory(run) / folder
        return sorted(path.name for path in directory.iterdir() if path.is_file()) if directory.is_dir() else []

    def file(self, run: str, folder: str, name: str) -> Path:
        """Path of a file that `files` lists. Raises `UnknownRunError`."""
        if name not in self.files(run, folder):
            raise UnknownRunError(f"the run {run!r} has no file {folder}/{name}")
        return self.directory(run) / folder / name

    def log(self, run: str, name: str) -> list[str]:
        """The newest lines of a log. Raises `UnknownRunError`."""
        with self.file(run, "logs", name).open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(0, size - LOG_BYTES))
            text = file.read().decode(errors="replace")
        return list(deque(text.splitlines(), maxlen=LOG_LINES))

    def checkpoints(self, run: str) -> list[str]:
        """Directories of a run's checkpoints, newest first. Raises `UnknownRunError`."""
        folder = self.directory(run) / "checkpoints"
        return sorted((str(path) for path in _subdirectories(folder)), reverse=True)

    def curriculum(self, run: str) -> list[Stage]:
        """The stages of a run's curriculum; empty if it has none. Raises `UnknownRunError`."""
        directory = self.directory(run)
        configured = self._document(directory / _RUN_FILE).get("config", {}).get("curriculum", {}).get("stages", [])
        entered = _json_lines(directory / _CURRICULUM)
        return [
            Stage(
                settings={key: value for key, value in settings.items() if value not in (None, [])},
                since=[
                    {"lesson": int(entry["lesson"]), "tick": int(entry["tick"])}
                    for entry in entered
                    if entry.get("stage") == index
                ],
            )
            for index, settings in enumerate(configured)
        ]

    def _summary(self, identity: str, directory: Path, alive: bool) -> RunSummary:
        run = self._document(directory / _RUN_FILE)
        report = {} if alive else self._document(directory / _REPORT)
        metric = report.get("metric")
        mean = report.get(f"ppo_mean_{metric}")
        return RunSummary(
            id=identity,
            name=str(run.get("name", directory.name)),
            mode=str(run.get("mode", "")),
            alive=alive,
            result=report.get("result"),
            error=f"{metric} {mean:.2f}{_evaluated_before(report)}" if isinstance(mean, float) else None,
            checkpoint=(directory / "checkpoints" / "latest").is_file(),
            recording=(directory / "recording.mcap").is_file(),
        )

    def _document(self, path: Path) -> dict[str, Any]:
        """A JSON document, read again when it has changed; empty while it is absent or half written."""
        try:
            changed = path.stat().st_mtime_ns
            known = self._documents.get(path)
            if known is not None and known[0] == changed:
                return known[1]
            document = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        if not isinstance(document, dict):
            return {}
        self._documents[path] = (changed, document)
        return document


def _subdirectories(directory: Path) -> list[Path]:
    return [path for path in directory.iterdir() if path.is_dir()] if directory.is_dir() else []


def _json_lines(path: Path) -> list[dict[str, Any]]:
    """The whole lines of a log of JSON objects."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    found = []
    for line in lines:
        try:
            found.append(json.loads(line))
        except ValueError:
            break
    return found


def _evaluated_before(report: Mapping[str, Any]) -> str:
    """When the last evaluation was, if the run ended before another one."""
    last, all_steps = report.get("evaluated_at_env_steps"), report.get("env_steps")
    is_old = isinstance(last, int) and isinstance(all_steps, int) and last < all_steps
    return f" after {last} of {all_steps} samples" if is_old and report.get("result") != "completed" else ""
