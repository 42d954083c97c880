"""Which learner has learnt which ticks of a run: `commits.json`, the record from which any learner continues.

A commit is the rename of this file. Each of its entries begins where the one before it ends, so every tick below the
newest entry is in exactly one committed update, whatever learners took turns. Imports nothing heavy.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

from caraware.ipc.run_file import RunFile
from caraware.ipc.storage import when_there_is_space, write_whole

COMMITS = "commits.json"
"""In the run directory."""
SCHEMA_VERSION = 1


class CommitLogError(Exception):
    """The record of commits cannot be used."""

    def __init__(self, file: Path, reason: str) -> None:
        super().__init__(f"{file}: {reason}")
        self.help = "restore the file; without it only a learner with checkpoints of its own can continue"


@dataclass(frozen=True)
class CommittedPosition:
    """How far the commits of one environment reach."""

    ticks: int = 0
    """All ticks below this one are learnt."""
    episode: int = 0
    """The episode of the next tick: a resumed simulation begins there."""
    episode_tick: int = 0
    """The first tick of that episode."""

    def at_most(self, ticks: int) -> "CommittedPosition":
        """The position at `ticks` if that is earlier; its episode is then not later than the true one."""
        return self if ticks >= self.ticks else CommittedPosition(ticks, *_earlier(self, ticks))


@dataclass(frozen=True)
class Commit:
    """What one learner has learnt in a row: the ticks from the entry before to these positions."""

    learner: str
    """`ppo` and `fusion` are this project's; others are named by their module."""
    positions: tuple[CommittedPosition, ...]
    """One for each environment."""


class EpisodeTick(Protocol):
    """What tells where an episode begins."""

    @property
    def tick(self) -> int:
        """Number of the tick in the run."""

    @property
    def episode(self) -> int:
        """Number of its episode."""

    @property
    def episode_last(self) -> bool:
        """True for the last tick of its episode."""


class EpisodeStarts:
    """The first ticks of episodes: a simulation that resumes after a tick begins with the episode of the next one."""

    def __init__(self, episode: int = 0, tick: int = 0) -> None:
        self._starts = [(tick, episode)]
        self.newest = episode
        """The newest episode that is known."""

    def note(self, obs: EpisodeTick) -> None:
        """Note a tick of the run, in order. Only the first and the last tick of an episode matter."""
        if obs.episode != self.newest:
            self._add(obs.tick, obs.episode)
        if obs.episode_last:
            self._add(obs.tick + 1, obs.episode + 1)

    def _add(self, tick: int, episode: int) -> None:
        self._starts.append((tick, episode))
        self.newest = episode

    def after(self, committed_tick: int) -> tuple[int, int]:
        """Episode of the tick after `committed_tick`, and its first tick; earlier episodes are forgotten."""
        while len(self._starts) > 1 and self._starts[1][0] <= committed_tick + 1:
            del self._starts[0]
        tick, episode = self._starts[0]
        return episode, tick


class CommitLog:
    """The commits of one run. Only the trainer at work writes them, and waits while the disk is full."""

    def __init__(self, run: RunFile) -> None:
        self.file = Path(run["run_dir"], COMMITS)
        self._beginning = tuple(_beginning(run))

    def commits(self) -> list[Commit]:
        """All commits, the oldest first; those in a row of one learner are one. Raises `CommitLogError`."""
        try:
            text = self.file.read_bytes()
        except FileNotFoundError:
            return []
        except OSError as error:
            raise CommitLogError(self.file, f"cannot be read ({error.strerror})") from error
        try:
            raw = json.loads(text)
            if raw["schema_version"] != SCHEMA_VERSION:
                raise CommitLogError(self.file, f"schema version {raw['schema_version']}, not {SCHEMA_VERSION}")
            if raw["sha256"] != _digest(raw["commits"]):
                raise CommitLogError(self.file, "is damaged: its content is not what its SHA-256 says")
            return [
                Commit(entry["learner"], tuple(CommittedPosition(**place) for place in entry["positions"]))
                for entry in raw["commits"]
            ]
        except (ValueError, KeyError, TypeError) as error:
            raise CommitLogError(self.file, f"is not a record of commits ({error})") from error

    def positions(self) -> tuple[CommittedPosition, ...]:
        """Where a learner continues, in each environment. Raises `CommitLogError`."""
        commits = self.commits()
        return commits[-1].positions if commits else self._beginning

    def own(self, learner: str) -> Commit | None:
        """The newest commit of `learner`. Raises `CommitLogError`."""
        return next((commit for commit in reversed(self.commits()) if commit.learner == learner), None)

    def newest_of_others(self, learner: str) -> Commit | None:
        """The newest commit of any other learner. Raises `CommitLogError`."""
        return next((commit for commit in reversed(self.commits()) if commit.learner != learner), None)

    def counts(self, learner: str, ticks: int) -> bool:
        """Whether a state of `learner` after `ticks` ticks of environment 0 is one that it has committed.

        A state beyond the last commit counts if no other learner has learnt those ticks since. Raises `CommitLogError`.
        """
        commits, begin = self.commits(), 0
        for commit in commits:
            end = commit.positions[0].ticks
            if commit.learner == learner and begin <= ticks <= end:
                return True
            begin = end
        return not commits or (commits[-1].learner == learner and ticks >= begin)

    def record(
        self,
        learner: str,
        positions: Mapping[int, CommittedPosition],
        stop_requested: Callable[[], bool] = lambda: False,
    ) -> None:
        """Commit `positions` of some environments, from one moment to the next. Raises `OSError`, `CommitLogError`.

        On a full disk it waits until there is space, or until a stop is requested; then it raises `OSError`.
        """
        commits = self.commits()
        newest = commits[-1].positions if commits else self._beginning
        commit = Commit(learner, tuple(positions.get(i, position) for i, position in enumerate(newest)))
        if commits and commits[-1].learner == learner:
            commits.pop()
        self._write([*commits, commit], stop_requested)

    def begin(
        self,
        learner: str,
        first_ticks: Mapping[int, CommittedPosition],
        stop_requested: Callable[[], bool] = lambda: False,
    ) -> None:
        """`learner` continues from these positions: later ticks are not learnt, earlier ones are.

        It waits for space as `record` does. Raises `OSError` and `CommitLogError`.
        """
        ends = [first_ticks.get(i, position).ticks for i, position in enumerate(self.positions())]
        commits = self.commits()
        if any(end < position.ticks for end, position in zip(ends, self.positions(), strict=True)):
            cut = [Commit(commit.learner, _cut(commit.positions, ends)) for commit in commits]
            self._write(list(_progressing(cut)), stop_requested)
        if any(end > position.ticks for end, position in zip(ends, self.positions(), strict=True)):
            self.record(learner, first_ticks, stop_requested)

    def _write(self, commits: list[Commit], stop_requested: Callable[[], bool]) -> None:
        entries = [asdict(commit) for commit in commits]
        text = json.dumps({"schema_version": SCHEMA_VERSION, "sha256": _digest(entries), "commits": entries})
        content = (text + "\n").encode()

        def write() -> None:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            write_whole(self.file, content)

        when_there_is_space(self.file, write, stop_requested)


def _digest(entries: Any) -> str:
    return hashlib.sha256(json.dumps(entries, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _earlier(position: CommittedPosition, ticks: int) -> tuple[int, int]:
    """Episode and first tick that a position before `position` may begin with: its own, or the run's first."""
    return (position.episode, position.episode_tick) if position.episode_tick <= ticks else (0, 0)


def _cut(positions: tuple[CommittedPosition, ...], ends: list[int]) -> tuple[CommittedPosition, ...]:
    return tuple(position.at_most(end) for position, end in zip(positions, ends, strict=True))


def _progressing(commits: list[Commit]) -> Iterator[Commit]:
    """Those that have learnt a tick since the one before."""
    before = None
    for commit in commits:
        if before is None or any(a.ticks > b.ticks for a, b in zip(commit.positions, before, strict=True)):
            yield commit
            before = commit.positions


def _beginning(run: RunFile) -> Iterator[CommittedPosition]:
    """Where the run begins, in each environment: with a checkpoint, or at the first tick."""
    envs = int(run["config"]["run"].get("envs", 1))
    beginning = run.get("beginning") or {}
    known = [beginning, *beginning.get("others", [])]
    for index in range(envs):
        start = known[index] if index < len(known) else {}
        yield CommittedPosition(*(int(start.get(key, 0)) for key in ("committed_ticks", "episode", "episode_tick")))
