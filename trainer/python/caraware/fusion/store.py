"""Checkpoints of the learned estimator: directories of safetensors and a manifest, complete or absent, verified."""

import hashlib
import json
import logging
import os
import shutil
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from safetensors.torch import load, save

from caraware.fusion.learner import FusionLearner
from caraware.report.evaluation import EvaluationResult
from caraware.report.metrics import TrainingPoint
from caraware.run.manifest import CheckpointError

log = logging.getLogger(__name__)

FORMAT = "caraware-fusion-1"
MANIFEST = "manifest.json"
LATEST = "latest"


@dataclass(frozen=True)
class Progress:
    """How far training has come, and how it went."""

    updates: int = 0
    env_steps: int = 0
    episode: int = 0
    committed_tick: int = -1
    """Newest tick that the parameters have learnt from; always the last of an episode."""
    vehicles: int = 0
    evaluated_tick: int = -1
    training: list[TrainingPoint] = field(default_factory=list)
    evaluations: list[EvaluationResult] = field(default_factory=list)


def save_fusion(folder: Path, learner: FusionLearner, progress: Progress, keep: int) -> Path:
    """Write `folder/update-NNNNNN` under a temporary name, rename it, then remove older ones beyond `keep`."""
    target = folder / f"update-{progress.updates:06d}"
    temporary = folder / f".{target.name}.partial"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    files = {name: _write(temporary / name, save(tensors)) for name, tensors in learner.tensors().items()}
    files["progress.json"] = _write(temporary / "progress.json", json.dumps(asdict(progress)).encode())
    manifest = {"format": FORMAT, "shape": learner.shape(), "files": files}
    _write(temporary / MANIFEST, json.dumps(manifest, indent=2).encode())
    _sync(temporary)
    shutil.rmtree(target, ignore_errors=True)
    temporary.rename(target)
    _write(folder / f".{LATEST}.partial", target.name.encode())
    (folder / f".{LATEST}.partial").rename(folder / LATEST)
    _sync(folder)
    for old in sorted(folder.glob("update-*"))[:-keep]:
        shutil.rmtree(old)
    return target


def load_fusion(checkpoint: Path, learner: FusionLearner) -> Progress:
    """Verify a checkpoint and go on from it, bit for bit. Raises `CheckpointError`."""
    manifest, contents = _verified(checkpoint)
    if manifest["shape"] != learner.shape():
        raise CheckpointError(checkpoint, f"is of {manifest['shape']}, the configuration asks for {learner.shape()}")
    for name, tensors in learner.tensors().items():
        stored = load(contents[name])
        if set(stored) != set(tensors):
            raise CheckpointError(checkpoint / name, "does not hold the tensors of this trainer")
        for key, tensor in tensors.items():
            tensor.copy_(stored[key])
        if name == "random.safetensors":
            learner.random.set_state(stored["shuffling"])
    raw = json.loads(contents["progress.json"])
    learner.updates = raw["updates"]
    training = [TrainingPoint(**point) for point in raw.pop("training")]
    evaluations = [EvaluationResult.restored(result) for result in raw.pop("evaluations")]
    return Progress(**raw, training=training, evaluations=evaluations)


def newest_sound(folder: Path) -> Path | None:
    """The newest checkpoint that verifies, None if there is none."""
    for checkpoint in sorted(folder.glob("update-*"), reverse=True):
        try:
            _verified(checkpoint)
            return checkpoint
        except CheckpointError as error:
            log.warning("checkpoint refused, the one before it is used: %s", error)
    return None


def _verified(checkpoint: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Manifest and the contents of all files. Raises `CheckpointError`."""
    try:
        manifest = json.loads((checkpoint / MANIFEST).read_bytes())
        if manifest["format"] != FORMAT:
            raise CheckpointError(checkpoint / MANIFEST, f"is of format {manifest['format']}, this is {FORMAT}")
        contents = {name: (checkpoint / name).read_bytes() for name in manifest["files"]}
    except OSError as error:
        raise CheckpointError(checkpoint, f"cannot be read ({error.strerror})") from error
    except (ValueError, KeyError, TypeError) as error:
        raise CheckpointError(checkpoint / MANIFEST, f"is not a manifest of this trainer ({error})") from error
    for name, stated in manifest["files"].items():
        found = hashlib.sha256(contents[name]).hexdigest()
        if found != stated:
            raise CheckpointError(checkpoint / name, f"is damaged: SHA-256 {found[:12]}…, not {stated[:12]}…")
    return manifest, contents


def _write(file: Path, content: bytes) -> str:
    with file.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    return hashlib.sha256(content).hexdigest()


def _sync(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
