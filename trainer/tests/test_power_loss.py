"""In which order a checkpoint and the record of commits reach the disk: a loss of power leaves the old or the new."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from caraware import _native
from caraware.ipc.commits import COMMITS, CommitLog, CommittedPosition
from caraware.learn.config import MapBounds, TrainerConfig
from caraware.run.checkpoint import Keeping, TrainingHistory, save_checkpoint
from caraware.run.manifest import Counters, sound_checkpoints
from synthetic import FIELDS, SIZE_M, locating_ppo, run_file


@dataclass
class Disk:
    """What this process asks the system for, in order, and what of it would survive a loss of power."""

    folder: Path
    """The directory in which names change."""
    target: Path
    """The name that must always be there; absent before the first step of a test that creates it."""
    steps: list[str] = field(default_factory=list)
    """`flush FILE`, `rename FROM TO`, `exchange FROM TO`, `flush folder`, `remove FILE`."""
    must_be_there: bool = True
    flushed: dict[int, bytes | tuple[str, ...]] = field(default_factory=dict)
    """By inode: the bytes of a file, or the names in a directory, when they were flushed."""
    renamed: bool = False
    """A name has changed, and the directory has not been flushed since."""

    def watch(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """From now on every step is noted and checked, then done."""
        flush = os.fsync

        def fsync(descriptor: int) -> None:
            path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
            flush(descriptor)
            self.flushed[path.stat().st_ino] = _content(path)
            if path == self.folder:
                self.renamed = False
            self._step("flush folder" if path == self.folder else f"flush {path.name}")

        monkeypatch.setattr(os, "fsync", fsync)
        for module, name in ((os, "rename"), (os, "replace"), (_native, "exchange")):
            monkeypatch.setattr(module, name, self._renaming(name, getattr(module, name)))
        for module, name in ((os, "unlink"), (os, "remove"), (shutil, "rmtree")):
            monkeypatch.setattr(module, name, self._removing(getattr(module, name)))

    def _renaming(self, name: str, do: Callable[..., Any]) -> Callable[..., Any]:
        def rename(source: os.PathLike[str], target: os.PathLike[str]) -> None:
            self._assert_flushed(Path(source))
            do(source, target)
            self.renamed = True
            self._step(f"{name} {Path(source).name} {Path(target).name}")

        return rename

    def _removing(self, do: Callable[..., Any]) -> Callable[..., Any]:
        def remove(path: Any, *arguments: Any, **options: Any) -> None:
            if isinstance(path, os.PathLike) and Path(path).exists():
                assert not self.renamed, f"{path} is removed before the new name is on the disk"
                self._step(f"remove {Path(path).name}")
            do(path, *arguments, **options)
            assert self.target.exists() or not self.must_be_there, self.steps

        return remove

    def _assert_flushed(self, path: Path) -> None:
        """Everything under a name is on the disk before the name changes."""
        for each in [path, *path.rglob("*")]:
            assert self.flushed.get(each.stat().st_ino) == _content(each), f"{each.name} is not flushed: {self.steps}"

    def _step(self, step: str) -> None:
        self.steps.append(step)
        self.must_be_there |= self.target.exists()
        assert self.target.exists() or not self.must_be_there, self.steps


def _content(path: Path) -> bytes | tuple[str, ...]:
    return tuple(sorted(os.listdir(path))) if path.is_dir() else path.read_bytes()


def save(folder: Path, learned_ticks: int) -> Path:
    """The checkpoint after two updates, which has learnt so many ticks."""
    ppo = locating_ppo(TrainerConfig.from_run(run_file("x")), FIELDS, MapBounds(0.0, 0.0, SIZE_M, SIZE_M))
    ppo.updates = 2
    counters = Counters(2, learned_ticks, 0, learned_ticks - 1)
    return save_checkpoint(folder, ppo, counters, "abc", Keeping(5), TrainingHistory())


@pytest.mark.parametrize("exists", [True, False], ids=["over an existing one", "new"])
def test_a_checkpoint_is_on_the_disk_before_it_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exists: bool
) -> None:
    folder = tmp_path / "checkpoints"
    target, partial = folder / "update-000002", ".update-000002.partial"
    if exists:
        save(folder, learned_ticks=100)
    disk = Disk(folder, target, must_be_there=exists)
    disk.watch(monkeypatch)
    assert save(folder, learned_ticks=200) == target
    monkeypatch.undo()
    named = f"{'exchange' if exists else 'rename'} {partial} {target.name}"
    files = [f"flush {file.name}" for file in target.iterdir()]
    begin = [] if exists else [f"flush {tmp_path.name}"]
    at = disk.steps.index(named)
    assert sorted(disk.steps[:at]) == sorted([*begin, *files, f"flush {partial}"])
    assert disk.steps[at - 2 : at] == ["flush manifest.json", f"flush {partial}"]
    # The directory follows at once, then what has lost its name; last comes the pointer, in the same way.
    pointer = ["flush .latest.partial", "rename .latest.partial latest", "flush folder"]
    assert disk.steps[at + 1 :] == ["flush folder", *[f"remove {partial}"] * exists, *pointer]
    assert not disk.renamed
    assert list(sound_checkpoints(folder)) == [target]


@pytest.mark.parametrize("exists", [True, False], ids=["over an existing one", "new"])
def test_the_record_of_commits_is_on_the_disk_before_it_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exists: bool
) -> None:
    record = CommitLog(run_file(str(tmp_path)))
    if exists:
        record.record("ppo", {0: CommittedPosition(100)})
    disk = Disk(tmp_path, tmp_path / COMMITS, must_be_there=exists)
    disk.watch(monkeypatch)
    record.record("ppo", {0: CommittedPosition(200)})
    monkeypatch.undo()
    partial = f".{COMMITS}.partial"
    assert disk.steps == [f"flush {partial}", f"rename {partial} {COMMITS}", "flush folder"]
    assert not disk.renamed
    assert record.positions()[0].ticks == 200
