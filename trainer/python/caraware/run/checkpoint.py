"""Checkpoints of any learner: directories of safetensors and a manifest, complete or absent, verified when read."""

import hashlib
import json
import logging
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.numpy import save as save_arrays
from safetensors.torch import load_file, save
from torch import Tensor

from caraware import _native
from caraware.ipc.storage import sync_directory, when_there_is_space, write_synced, write_whole
from caraware.learn.config import TrainerConfig
from caraware.learn.stored import MEMORY, RANDOM, SUPERVISED, LearnerShape, StoredLearner, StoredTensors
from caraware.report.evaluation import EvaluationResult
from caraware.report.metrics import TrainingPoint, TrainingPoints
from caraware.run.manifest import (
    BEST,
    COURSE,
    LATEST,
    MANIFEST,
    OWN_HASH,
    SCHEMA_VERSION,
    CheckpointError,
    Counters,
    Manifest,
    best_checkpoint,
    checkpoint_name,
    own_hash,
    read_manifest,
    verified,
)
from caraware.run.stream_position import StreamPosition

log = logging.getLogger(__name__)

POINTS = "points.safetensors"
ONLY_HERE = (COURSE, POINTS)
"""Files of a checkpoint that are not the learner's."""


@dataclass(frozen=True)
class TrainingHistory:
    """What a successor cannot compute again: how training went up to the checkpoint."""

    received_ticks: int = 0
    lost_ticks: int = 0
    duplicated_ticks: int = 0
    vehicles: int = 0
    """Most at a time."""
    evaluated_tick: int = -1
    """Newest tick of `evaluations`; -1 before the first."""
    evaluations: list[EvaluationResult] = field(default_factory=list)
    training: Sequence[TrainingPoint] = ()
    others: list[StreamPosition] = field(default_factory=list)
    """The environments after the first, which `Counters` and the fields above describe."""
    curriculum: dict[str, Any] = field(default_factory=dict)
    """`caraware.run.curriculum.Standing`; empty without a curriculum."""

    @classmethod
    def of(cls, first: StreamPosition, **others: Any) -> "TrainingHistory":
        """With the position of the first environment; what `Counters` holds of it is left out."""
        return cls(
            received_ticks=first.received_ticks,
            lost_ticks=first.lost_ticks,
            duplicated_ticks=first.duplicated_ticks,
            evaluated_tick=first.evaluated_tick,
            **others,
        )

    def first_position(self, counters: Counters) -> StreamPosition:
        """The position of the first environment."""
        return StreamPosition(
            committed_tick=counters.committed_tick,
            received_ticks=self.received_ticks,
            lost_ticks=self.lost_ticks,
            duplicated_ticks=self.duplicated_ticks,
            evaluated_tick=self.evaluated_tick,
            next_episode=counters.next_episode,
            next_episode_tick=counters.next_episode_tick,
        )


@dataclass(frozen=True)
class Keeping:
    """Which checkpoints outlive the next one; the one that `best` names always does."""

    newest: int
    every: int = 0
    """Updates between two that stay for good; 0: none but those above."""

    @classmethod
    def of(cls, config: TrainerConfig) -> "Keeping":
        """As configured. Ranks keep two at least: killed amid a checkpoint they continue from the one before."""
        least = 2 if config.ranks > 1 else 1
        return cls(max(config.checkpoints_kept, least), config.checkpoint_keep_every)


def save_checkpoint(
    folder: Path,
    learner: StoredLearner,
    counters: Counters,
    config_sha256: str,
    keep: Keeping,
    history: TrainingHistory | None = None,
    of_other_ranks: StoredTensors | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> Path:
    """Write `folder/update-NNNNNN`, then point `folder/latest` at it; older ones that `keep` does not name are removed.

    Everything is on disk under a temporary name before the rename, so a checkpoint is complete or not there. On a full
    disk it waits until there is space, or until a stop is requested; then it raises `OSError`.
    """
    target = folder / checkpoint_name(counters.updates)

    def save_all() -> None:
        _save_all(target, learner, counters, config_sha256, history, of_other_ranks)

    when_there_is_space(target, save_all, stop_requested)
    when_there_is_space(folder / LATEST, lambda: _point(folder, LATEST, target), stop_requested)
    _remove_old(folder, learner.shape().learner, keep)
    return target


def _save_all(
    target: Path,
    learner: StoredLearner,
    counters: Counters,
    config_sha256: str,
    history: TrainingHistory | None,
    of_other_ranks: StoredTensors | None,
) -> None:
    """Write every file of a checkpoint under a temporary name, and rename it. Raises `OSError`, and leaves nothing."""
    temporary = target.parent / f".{target.name}.partial"
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        if not target.parent.is_dir():
            target.parent.mkdir(parents=True)
            sync_directory(target.parent.parent)
        temporary.mkdir()
        _write_files(temporary, learner, counters, config_sha256, history, of_other_ranks)
    except OSError:
        # What was written of it takes space that is missing.
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    # From one moment to the next it is there under its name.
    sync_directory(temporary)
    if target.exists():
        # The name belongs to one of the two at any moment.
        _native.exchange(temporary, target)
        # Before the old one loses a file: after a loss of power the name could still be the old one's.
        sync_directory(target.parent)
        shutil.rmtree(temporary)
    else:
        temporary.rename(target)
        sync_directory(target.parent)


def _write_files(
    folder: Path,
    learner: StoredLearner,
    counters: Counters,
    config_sha256: str,
    history: TrainingHistory | None,
    of_other_ranks: StoredTensors | None,
) -> None:
    """Write every file of a checkpoint into `folder`, the manifest last. Raises `OSError`."""
    # The tensors of the learner, and of ranks that learn with it.
    tensors, beside = learner.tensors(), of_other_ranks or {}
    merged = {name: beside.get(name, {}) | tensors.get(name, {}) for name in tensors | beside}
    files = {name: _write(folder / name, save(_contiguous(named))) for name, named in merged.items()}
    if history is not None:
        points = TrainingPoints.of(history.training)
        # Not by safetensors.torch: for each size of a tensor that keeps two types of ctypes for ever, some 6 KB.
        files[POINTS] = _write(folder / POINTS, save_arrays({"training": points.rows()}))
        evaluations = [result.report() for result in history.evaluations]
        rest = asdict(replace(history, training=(), evaluations=[]))
        rest |= {"training": list(points.names), "evaluations": evaluations}
        files[COURSE] = _write(folder / COURSE, json.dumps(rest).encode())
    manifest = Manifest(
        schema_version=SCHEMA_VERSION,
        torch_version=torch.__version__,
        config_sha256=config_sha256,
        counters=counters,
        schedules=learner.schedules(),
        files=files,
        **asdict(learner.shape()),
    )
    entries = asdict(manifest)
    _write(folder / MANIFEST, json.dumps(entries | {OWN_HASH: own_hash(entries)}, indent=2).encode())


def mark_best(checkpoint: Path, stop_requested: Callable[[], bool] = lambda: False) -> None:
    """Let `best` name this checkpoint; it stays until another is better. It waits for space as `save_checkpoint`."""
    folder = checkpoint.parent
    when_there_is_space(folder / BEST, lambda: _point(folder, BEST, checkpoint), stop_requested)


def load_checkpoint(checkpoint: Path, learner: StoredLearner) -> Counters:
    """Verify a checkpoint and continue from it, bit for bit on a CPU. Raises `CheckpointError`."""
    manifest = read_manifest(checkpoint)
    _check_shape(checkpoint / MANIFEST, manifest, learner.shape())
    stored = {
        name: _read_tensors(checkpoint / name, digest)
        for name, digest in manifest.files.items()
        if name not in ONLY_HERE
    }
    # Nothing is changed before every file is read and fits.
    for name, tensors in learner.tensors().items():
        if name != MEMORY and (name != SUPERVISED or name in stored):
            _check_tensors(checkpoint / name, stored.get(name, {}), tensors)
    learner.restore(stored, manifest.counters.updates)
    return manifest.counters


def _check_shape(file: Path, manifest: Manifest, shape: LearnerShape) -> None:
    """Raises `CheckpointError` where the learner or its networks are others."""
    for name, own in asdict(shape).items():
        if (found := getattr(manifest, name)) != own:
            raise CheckpointError(file, f"its {name} is {found}, this run's is {own}")


def _check_tensors(file: Path, stored: dict[str, Tensor], own: dict[str, Tensor]) -> None:
    """Raises `CheckpointError` where names or shapes differ. Of several ranks, a checkpoint holds all generators."""
    names_fit = set(stored).issuperset(own) if file.name == RANDOM else set(stored) == set(own)
    if not names_fit or any(stored[name].shape != tensor.shape for name, tensor in own.items()):
        raise CheckpointError(file, "does not hold the tensors of this trainer")


def load_history(checkpoint: Path) -> TrainingHistory:
    """How training went up to a checkpoint; nothing if it was saved without. Raises `CheckpointError`."""
    files = read_manifest(checkpoint).files
    if COURSE not in files:
        return TrainingHistory()
    rest = json.loads(verified(checkpoint / COURSE, files[COURSE]))
    rows = _read_tensors(checkpoint / POINTS, files[POINTS])["training"].tolist()
    evaluations = [EvaluationResult.restored(result) for result in rest.pop("evaluations")]
    others = [StreamPosition(**position) for position in rest.pop("others", [])]
    names = rest.pop("training")
    training = TrainingPoints(TrainingPoint.of_row(row, names) for row in rows)
    return TrainingHistory(**rest | {"evaluations": evaluations, "training": training, "others": others})


def remove_newer(folder: Path, name: str | None, stop_requested: Callable[[], bool] = lambda: False) -> None:
    """Remove checkpoints newer than `name`, or all: only some of the trainers that learn together have written them.

    It waits for space as `save_checkpoint`.
    """
    newer = [checkpoint for checkpoint in folder.glob("update-*") if name is None or checkpoint.name > name]
    if not newer:
        return
    if name is None:
        (folder / LATEST).unlink(missing_ok=True)
    else:
        when_there_is_space(folder / LATEST, lambda: _point(folder, LATEST, folder / name), stop_requested)
    for checkpoint in newer:
        log.warning("%s was not written by all ranks, which continue from %s: removed", checkpoint.name, name)
        shutil.rmtree(checkpoint)


def remove_partial(folder: Path) -> None:
    """Remove what a killed trainer left half-written; no other process may be writing."""
    for partial in folder.glob(".*.partial"):
        if partial.is_dir():
            shutil.rmtree(partial)
        else:
            partial.unlink()


def _contiguous(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors as safetensors stores them."""
    return {name: tensor.contiguous() for name, tensor in tensors.items()}


def _read_tensors(file: Path, sha256: str) -> dict[str, Tensor]:
    verified(file, sha256)
    try:
        return load_file(file)
    except SafetensorError as error:
        raise CheckpointError(file, f"is not a safetensors file ({error})") from error


def _point(folder: Path, name: str, checkpoint: Path) -> None:
    """Let the file `name` name a checkpoint, from one moment to the next."""
    write_whole(folder / name, checkpoint.name.encode())


def _write(file: Path, content: bytes) -> str:
    """Write and flush to disk; the SHA-256 of the content."""
    write_synced(file, content)
    return hashlib.sha256(content).hexdigest()


def _remove_old(folder: Path, learner: str, keep: Keeping) -> None:
    """Only those of `learner`: another one continues from its own when it is handed the run again."""
    best = best_checkpoint(folder)
    own = [old for old in sorted(folder.glob("update-*")) if _is_of(old, learner)]
    for old in own[: -keep.newest]:
        stays = keep.every > 0 and int(old.name.removeprefix("update-")) % keep.every == 0
        if old != best and not stays:
            shutil.rmtree(old)


def _is_of(checkpoint: Path, learner: str) -> bool:
    """Whether a learner wrote it; a checkpoint that cannot be read is of any, and old when its turn comes."""
    if not checkpoint.name.removeprefix("update-").isdecimal():
        return False
    try:
        return read_manifest(checkpoint).learner == learner
    except CheckpointError:
        return True
