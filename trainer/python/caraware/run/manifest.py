"""What a checkpoint says of itself, and whether that is true: manifests, hashes, which one is the newest or the best.

Imports nothing heavy, so `python -m caraware.run.manifest RUN|CHECKPOINT newest|best` answers at once.
"""

import errno
import hashlib
import json
import logging
import os
import stat
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

log = logging.getLogger(__name__)

SCHEMA_VERSION = 2
EARLIER_FUSION = "caraware-fusion-1"
"""Format of the learned estimator's checkpoints before all learners had one."""
MANIFEST = "manifest.json"
NAMED = "update-"
"""How the names of checkpoint directories begin."""
COURSE = "course.json"
"""How training went, and where the environments after the first stand."""
LATEST, BEST = "latest", "best"
"""Files beside the checkpoints that name the newest, and the one whose evaluation had the least mean error."""
NEWEST = "CARAWARE_NEWEST_CHECKPOINT"
"""Environment variable: name of the newest checkpoint of a run that counts. Ranks continue from one that all have."""
BEGINNING = "beginning"
"""Its value where ranks have none in common: they begin again, and none of their checkpoints counts."""
OWN_HASH = "manifest_sha256"
"""Entry of the manifest: SHA-256 of all its other entries, as canonical JSON."""


class CheckpointError(Exception):
    """A checkpoint that cannot be used: which file, and why."""

    def __init__(self, file: Path, reason: str) -> None:
        super().__init__(f"{file}: {reason}")
        self.file, self.reason = file, reason


@dataclass(frozen=True)
class Counters:
    """How far training has come."""

    updates: int
    env_steps: int
    episode: int
    committed_tick: int
    """Newest tick that the parameters have learned from; -1 before the first."""
    next_episode: int = 0
    """The episode that the tick after it belongs to: a resumed simulation begins there."""
    next_episode_tick: int = 0
    """The first tick of that episode."""


@dataclass(frozen=True)
class Manifest:
    """What `manifest.json` says."""

    schema_version: int
    torch_version: str
    config_sha256: str
    observation_size: int
    hidden: tuple[int, ...]
    counters: Counters
    schedules: dict[str, float]
    """Where the values that change over training stood in the update that the checkpoint follows."""
    files: dict[str, str]
    """Name to SHA-256. `random.safetensors` holds the states of the random numbers."""
    network: str = "mlp"
    activation: str = "relu"
    """Of the hidden layers; a manifest without these two is of a time when there was no other."""
    learner: str = "ppo"
    """Or `fusion`; a manifest without it is of a time when the learned estimator had a format of its own."""


def best_checkpoint(folder: Path) -> Path | None:
    """The checkpoint that `best` names, if there is one."""
    try:
        return folder / (folder / BEST).read_text().strip()
    except OSError:
        return None


def newest_sound_checkpoint(folder: Path) -> Path | None:
    """The newest checkpoint that verifies, None if there is none."""
    return next(sound_checkpoints(folder), None)


def sound_checkpoints(folder: Path) -> Iterator[Path]:
    """Those that verify, the newest first."""
    for checkpoint in sorted(folder.glob("update-*"), reverse=True):
        try:
            verify_checkpoint(checkpoint)
            yield checkpoint
        except CheckpointError as error:
            log.warning("checkpoint refused, the one before it is used: %s", error)


def newest_update(folder: Path) -> int:
    """The largest number of updates that a checkpoint is named by; 0 without any."""
    numbers = (name.name.removeprefix("update-") for name in folder.glob("update-*"))
    return max((int(number) for number in numbers if number.isdecimal()), default=0)


def verify_checkpoint(checkpoint: Path) -> Manifest:
    """The manifest of a checkpoint of which every byte is as it was written. Raises `CheckpointError`."""
    manifest = read_manifest(checkpoint)
    for name, digest in manifest.files.items():
        verified(checkpoint / name, digest)
    return manifest


def read_manifest(checkpoint: Path) -> Manifest:
    """The manifest of a checkpoint directory. Raises `CheckpointError`."""
    file = checkpoint / MANIFEST
    try:
        raw = json.loads(_content(file))
        if "format" in raw and raw["format"] == EARLIER_FUSION:
            raise CheckpointError(file, "is of the learned estimator's earlier format, which is not read any more")
        if raw["schema_version"] != SCHEMA_VERSION:
            raise CheckpointError(file, f"schema version {raw['schema_version']}, this trainer reads {SCHEMA_VERSION}")
        stated, found = raw.pop(OWN_HASH), own_hash(raw)
        if stated != found:
            raise CheckpointError(file, f"is damaged: SHA-256 {found[:12]}…, it says {stated[:12]}…")
        parts = {"counters": Counters(**raw["counters"])}
        if checkpoint.name.startswith(NAMED) and checkpoint.name != checkpoint_name(parts["counters"].updates):
            raise CheckpointError(
                file, f"belongs to {checkpoint_name(parts['counters'].updates)}, not to this directory"
            )
        return Manifest(**raw | parts | {"hidden": tuple(raw["hidden"])})
    except OSError as error:
        raise CheckpointError(file, f"cannot be read ({error.strerror})") from error
    except (ValueError, KeyError, TypeError) as error:
        raise CheckpointError(file, f"is not a manifest ({error})") from error


def verified(file: Path, sha256: str) -> bytes:
    """The content of a file of a checkpoint."""
    try:
        content = _content(file)
    except OSError as error:
        raise CheckpointError(file, f"cannot be read ({error.strerror})") from error
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise CheckpointError(file, f"is damaged: SHA-256 {found[:12]}…, the manifest says {sha256[:12]}…")
    return content


def _content(file: Path) -> bytes:
    """The bytes of a regular file: a pipe in its place would be waited for, a device has no end. Raises `OSError`."""
    if not stat.S_ISREG(file.stat().st_mode):
        raise OSError(errno.EINVAL, "it is no regular file")
    return file.read_bytes()


def checkpoint_name(updates: int) -> str:
    """Of the directory of the checkpoint after so many updates."""
    return f"{NAMED}{updates:06d}"


def own_hash(entries: dict[str, Any]) -> str:
    """Of a manifest without this hash."""
    return hashlib.sha256(json.dumps(entries, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def main(arguments: list[str]) -> int:
    """Print the checkpoint that is asked for and its manifest, or why it is refused; one JSON object."""
    logging.basicConfig(stream=sys.stderr, level=logging.WARNING, format="%(message)s")
    place, which = Path(arguments[0]), arguments[1]
    try:
        checkpoint = _choose(place / "checkpoints", which) if (place / "checkpoints").is_dir() else place
        manifest = verify_checkpoint(checkpoint)
        course = json.loads((checkpoint / COURSE).read_bytes()) if COURSE in manifest.files else {}
    except CheckpointError as error:
        print(json.dumps({"refused": str(error)}))
        return 1
    print(json.dumps({"checkpoint": str(checkpoint), "manifest": asdict(manifest), "others": course.get("others", [])}))
    return 0


def _choose(folder: Path, which: str) -> Path:
    """The best or the newest of a run; the newest sound one where that is damaged. Raises `CheckpointError`."""
    best = best_checkpoint(folder) if which == "best" else None
    if best is not None:
        try:
            verify_checkpoint(best)
            return best
        except CheckpointError as error:
            log.warning("checkpoint refused, the newest is used: %s", error)
    limit = os.environ.get(NEWEST)
    counting = (each for each in sound_checkpoints(folder) if limit is None or each.name <= limit)
    newest = None if limit == BEGINNING else next(counting, None)
    if newest is None:
        raise CheckpointError(folder, "holds no checkpoint that can be used")
    return newest


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
