"""Checkpoints: directories of safetensors and a manifest, complete or absent, verified when read."""

import hashlib
import json
import os
import shutil
from dataclasses import asdict, astuple, dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from caraware.learn.config import TrainerConfig
from caraware.learn.ppo import Ppo, ScheduledValues
from caraware.learn.supervised import Supervised
from caraware.report.evaluation import EvaluationResult
from caraware.report.metrics import TrainingPoint
from caraware.run.environment import Place
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
    Schedules,
    best_checkpoint,
    own_hash,
    read_manifest,
    verified,
)

PARAMETERS = "parameters.safetensors"
OPTIMISER = "optimiser.safetensors"
RANDOM = "random.safetensors"
POINTS = "points.safetensors"
MEMORY = "memory.safetensors"
"""What networks remember of trajectories at the committed tick; those that see one moment have none."""
SUPERVISED = "supervised.safetensors"
"""Of the baseline beside PPO; a checkpoint of a run without it has none, and the baseline then begins anew."""


@dataclass(frozen=True)
class Course:
    """What a successor cannot compute again: how training went up to the checkpoint."""

    received_ticks: int = 0
    lost_ticks: int = 0
    duplicated_ticks: int = 0
    vehicles: int = 0
    """Most at a time."""
    evaluated_tick: int = -1
    """Newest tick of `evaluations`; -1 before the first."""
    evaluations: list[EvaluationResult] = field(default_factory=list)
    training: list[TrainingPoint] = field(default_factory=list)
    others: list[Place] = field(default_factory=list)
    """The environments after the first, of which `Counters` and the fields above tell."""
    curriculum: dict[str, Any] = field(default_factory=dict)
    """`caraware.run.curriculum.Standing`; empty without a curriculum."""


@dataclass(frozen=True)
class Keeping:
    """Which checkpoints outlive the next one; the one that `best` names always does."""

    newest: int
    every: int = 0
    """Updates between two that stay for good; 0: none but those above."""

    @classmethod
    def of(cls, config: TrainerConfig) -> "Keeping":
        """As configured. Ranks keep two at least: killed amid a checkpoint they go on from the one before."""
        least = 2 if config.ranks > 1 else 1
        return cls(max(config.checkpoints_kept, least), config.checkpoint_keep_every)


def save_checkpoint(
    folder: Path,
    ppo: Ppo,
    counters: Counters,
    config_sha256: str,
    keep: Keeping,
    course: Course | None = None,
    random: dict[str, Tensor] | None = None,
    memory: dict[str, Tensor] | None = None,
    supervised: Supervised | None = None,
) -> Path:
    """Write `folder/update-NNNNNN`, then point `folder/latest` at it; older ones that `keep` does not name are removed.

    Everything is on disk under a temporary name before the rename, so a checkpoint is complete or not there. `random`
    and `memory` add the generators of other ranks and what they remember of their environments.
    """
    target = folder / checkpoint_name(counters.updates)
    temporary = folder / f".{target.name}.partial"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    tensors_of = _tensors(ppo, supervised)
    tensors_of[RANDOM] |= random or {}
    files = {name: _write(temporary / name, save(tensors)) for name, tensors in tensors_of.items()}
    if memory := (memory or {}) | ppo.memory_tensors():
        files[MEMORY] = _write(temporary / MEMORY, save(memory))
    if course is not None:
        rows = torch.tensor([astuple(point) for point in course.training], dtype=torch.float64)
        files[POINTS] = _write(temporary / POINTS, save({"training": rows}))
        rest = asdict(course) | {"training": None}
        files[COURSE] = _write(temporary / COURSE, json.dumps(rest).encode())
    manifest = Manifest(
        schema_version=SCHEMA_VERSION,
        torch_version=torch.__version__,
        config_sha256=config_sha256,
        observation_size=ppo.observation_size,
        hidden=ppo.config.hidden,
        network=ppo.config.network,
        activation=ppo.config.activation,
        counters=counters,
        schedules=_schedules(ppo),
        files=files,
    )
    entries = asdict(manifest)
    _write(temporary / MANIFEST, json.dumps(entries | {OWN_HASH: own_hash(entries)}, indent=2).encode())
    _sync_directory(temporary)
    if target.exists():
        shutil.rmtree(target)
    temporary.rename(target)
    _point(folder, LATEST, target)
    _remove_old(folder, keep)
    return target


def checkpoint_name(updates: int) -> str:
    """Of the directory of the checkpoint after so many updates."""
    return f"update-{updates:06d}"


def mark_best(checkpoint: Path) -> None:
    """Let `best` name this checkpoint; it stays until another is better."""
    _point(checkpoint.parent, BEST, checkpoint)


def _schedules(ppo: Ppo) -> Schedules:
    """Of the newest update; before the first, of that one."""
    now = ScheduledValues.at(ppo.config, max(ppo.updates - 1, 0), ppo.progress)
    return Schedules(ppo.progress, now.learning_rate, now.clip_epsilon, now.entropy_scale)


def load_checkpoint(checkpoint: Path, ppo: Ppo, supervised: Supervised | None = None) -> Counters:
    """Verify a checkpoint and continue from it, bit for bit on a CPU. Raises `CheckpointError`."""
    manifest = read_manifest(checkpoint)
    _check_network(checkpoint / MANIFEST, manifest, ppo)
    own = _tensors(ppo, supervised)
    current = {name: tensors for name, tensors in own.items() if name != SUPERVISED or name in manifest.files}
    stored = {
        name: _read_tensors(checkpoint / name, digest) for name, digest in manifest.files.items() if name in current
    }
    memory = _read_tensors(checkpoint / MEMORY, manifest.files[MEMORY]) if MEMORY in manifest.files else {}
    for name, tensors in current.items():
        found = set(stored.get(name, {}))
        # A checkpoint of several ranks holds the generators of all.
        if not found.issuperset(tensors) or (name != RANDOM and found != set(tensors)):
            raise CheckpointError(checkpoint / name, "does not hold the tensors of this trainer")
        if name != OPTIMISER:
            for key, tensor in tensors.items():
                tensor.copy_(stored[name][key])
    ppo.updater.restore_moments(stored[OPTIMISER])
    for name, generator in ppo.sampling_generators().items():
        generator.set_state(stored[RANDOM][name])
    ppo.shuffling.set_state(stored[RANDOM]["shuffling"])
    ppo.restore_memory(memory)
    ppo.updates = manifest.counters.updates
    return manifest.counters


def _check_network(file: Path, manifest: Manifest, ppo: Ppo) -> None:
    """Raises `CheckpointError` where the networks are others."""
    expected = {"observation_size": ppo.observation_size}
    expected |= {name: getattr(ppo.config, name) for name in ("network", "hidden", "activation")}
    for name, own in expected.items():
        if (found := getattr(manifest, name)) != own:
            raise CheckpointError(file, f"its {name} is {found}, this run's is {own}")


def load_course(checkpoint: Path) -> Course:
    """How training went up to a checkpoint; nothing if it was saved without. Raises `CheckpointError`."""
    files = read_manifest(checkpoint).files
    if COURSE not in files:
        return Course()
    rest = json.loads(verified(checkpoint / COURSE, files[COURSE]))
    rows = _read_tensors(checkpoint / POINTS, files[POINTS])["training"].tolist()
    evaluations = [EvaluationResult.restored(result) for result in rest.pop("evaluations")]
    others = [Place(**place) for place in rest.pop("others", [])]
    training = [TrainingPoint(int(steps), *values) for steps, *values in rows]
    return Course(**rest | {"evaluations": evaluations, "training": training, "others": others})


def remove_partial(folder: Path) -> None:
    """Remove what a killed trainer left half-written. Nobody may be writing."""
    for partial in folder.glob(".*.partial"):
        if partial.is_dir():
            shutil.rmtree(partial)
        else:
            partial.unlink()


def _tensors(ppo: Ppo, supervised: Supervised | None) -> dict[str, dict[str, Tensor]]:
    """Every tensor of the trainer by file and name. Filling them loads them, but for the optimisers' moments."""
    random = {name: generator.get_state() for name, generator in ppo.sampling_generators().items()}
    random["shuffling"] = ppo.shuffling.get_state()
    tensors = {PARAMETERS: ppo.updater.parameters(), OPTIMISER: ppo.updater.moments(), RANDOM: random}
    return tensors | ({SUPERVISED: supervised.tensors()} if supervised is not None else {})


def _read_tensors(file: Path, sha256: str) -> dict[str, Tensor]:
    verified(file, sha256)
    try:
        return load_file(file)
    except SafetensorError as error:
        raise CheckpointError(file, f"is not a safetensors file ({error})") from error


def _point(folder: Path, name: str, checkpoint: Path) -> None:
    """Let the file `name` name a checkpoint, from one moment to the next."""
    _write(folder / f".{name}.partial", checkpoint.name.encode())
    (folder / f".{name}.partial").rename(folder / name)
    _sync_directory(folder)


def _write(file: Path, content: bytes) -> str:
    """Write and flush to disk; the SHA-256 of the content."""
    with file.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    return hashlib.sha256(content).hexdigest()


def _sync_directory(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove_old(folder: Path, keep: Keeping) -> None:
    best = best_checkpoint(folder)
    for old in sorted(folder.glob("update-*"))[: -keep.newest]:
        stays = keep.every > 0 and int(old.name.removeprefix("update-")) % keep.every == 0
        if old != best and not stays:
            shutil.rmtree(old)
