"""`python -m caraware.data.export RECORDING --to FORMAT --output DIRECTORY`, which `caraware export` starts."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from caraware.data.export.card import write_card
from caraware.data.export.parts import FORMATS, part_name, write_part
from caraware.data.export.sensors import omissions
from caraware.data.recording import RecordingError, open_recording


def _report(line: str) -> None:
    """Print a sentence about what an export lacks."""
    print(f"caraware export: {line}", file=sys.stderr)


def export(
    recording_path: Path,
    format_name: str,
    directory: Path,
    jobs: int,
    show: Callable[[int, int], None],
    report: Callable[[str], None] = _report,
) -> int:
    """Write every episode that the directory does not have yet; return the number of parts written.

    `report` gets a sentence for each sensor that the format leaves out in whole or in part. Raises `RecordingError`.
    """
    recording, chosen = open_recording(recording_path), FORMATS[format_name]
    # The memory maps are made once, before other processes need them.
    episodes = list(recording.episodes())
    if "world" in recording.channels and format_name == "fcd":
        recording.headers("world")
    if "traffic-meta" in recording.channels:
        recording.headers("traffic-meta")
    for channel in ("prediction", "lane-position"):
        if channel in recording.channels:
            recording.headers(channel)
    directory.mkdir(parents=True, exist_ok=True)
    names = {episode.number: part_name(episode.number, chosen.ending) for episode in episodes}
    due = [number for number, name in names.items() if not (directory / name).exists()]
    done = len(names) - len(due)
    show(done, len(names))
    if jobs == 1 or len(due) <= 1:
        for number in due:
            write_part(recording_path, format_name, number, directory)
            show(done := done + 1, len(names))
    else:
        with ProcessPoolExecutor(min(jobs, len(due)), mp_context=get_context("spawn")) as pool:
            parts = [pool.submit(write_part, recording_path, format_name, number, directory) for number in due]
            for part in as_completed(parts):
                part.result()
                show(done := done + 1, len(names))
    if chosen.join is not None:
        chosen.join(recording, directory, list(names.values()))
    lacking = omissions(recording, chosen.lacks, has_observations=chosen.has_observations)
    for line in lacking:
        report(f"left out: {line}")
    write_card(recording, directory, chosen.title, chosen.meaning, list(names.values()), lacking)
    return len(due)


def _show(done: int, total: int) -> None:
    """A progress bar on a terminal, nothing elsewhere."""
    if sys.stderr.isatty():
        filled = 40 * done // max(total, 1)
        end = "\n" if done == total else "\r"
        print(f"[{'=' * filled}{' ' * (40 - filled)}] {done} of {total} episodes", end=end, file=sys.stderr)


def main() -> int:
    """Run the command line; 2 for input that cannot be used."""
    parser = argparse.ArgumentParser(prog="caraware export")
    parser.add_argument("recording", type=Path)
    parser.add_argument("--to", choices=sorted(FORMATS), required=True)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    path: Path = arguments.recording
    parent = path if path.is_dir() else path.parent
    directory: Path = arguments.output or parent / f"export-{arguments.to}"
    try:
        written = export(path, arguments.to, directory, max(arguments.jobs, 1), _show)
        damage = open_recording(path).damage
    except RecordingError as error:
        print(f"caraware export: {error}", file=sys.stderr)
        return 2
    if damage is not None:
        print(f"caraware export: the recording is damaged at byte {damage[0]}: {damage[1]}", file=sys.stderr)
    print(f"{directory}: {written} episodes written as {FORMATS[arguments.to].title}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
