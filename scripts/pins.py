#!/usr/bin/env python3
"""Prints pins of `requirements.lock`, as `pip install --no-deps -r` takes them.

    scripts/pins.py --gpu 1                          # all
    scripts/pins.py --gpu 0                          # all but what a GPU needs: see scripts/without_cuda.py
    .venv/bin/python scripts/pins.py --gpu 0 trainer[envs,data] viewer      # what these packages ask for, and no tools

The last form follows what the installed packages ask for, and so runs in the environment that has them.
"""

import argparse
import re
import sys
import tomllib
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CALLED_ON_A_CPU = {"nvidia-cuda-runtime", "nvidia-cuda-cupti"}
"""What torch calls of CUDA without a GPU: the runtime finds that there is none, and the profiler opens CUPTI."""
GPU_ONLY = re.compile(r"nvidia-|cuda-|triton")
"""Beginnings of the names of other packages that torch asks for, for a GPU."""
REQUIREMENT = re.compile(r"([\w.-]+)\s*(?:\[([\w\s,.-]+)\])?[^;]*(?:;(.*))?")


def canonical(name: str) -> str:
    """The name as PyPI compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def pins() -> dict[str, str]:
    """The lines of requirements.lock by their packages."""
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    return {canonical(line.partition("==")[0]): line for line in lines if "==" in line}


def asked_by_project(directory: str, extras: set[str]) -> list[str]:
    """What a package of this repository asks for, with its extras."""
    project = tomllib.loads((ROOT / directory / "pyproject.toml").read_text())["project"]
    asked = list(project["dependencies"])
    for extra in sorted(extras):
        asked += project["optional-dependencies"][extra]
    return asked


def asked_by(package: str, extras: set[str]) -> list[str]:
    """What an installed package asks for, with its extras. A condition on the machine is taken as true."""
    try:
        lines = metadata.requires(package) or []
    except metadata.PackageNotFoundError:
        return []
    kept = []
    for line in lines:
        extra = re.search(r"extra\s*==\s*['\"]([\w.-]+)['\"]", line)
        if extra is None or canonical(extra[1]) in extras:
            kept.append(line)
    return kept


def closure(roots: list[str]) -> set[str]:
    """Names of all packages that these projects of the repository ask for, directly or not."""
    waiting: list[str] = []
    for root in roots:
        match = REQUIREMENT.match(root)
        if match is None:
            sys.exit(f"{root}: write DIRECTORY or DIRECTORY[EXTRA,…]")
        waiting += asked_by_project(match[1], {canonical(name.strip()) for name in (match[2] or "").split(",") if name})
    seen: set[tuple[str, frozenset[str]]] = set()
    while waiting:
        match = REQUIREMENT.match(waiting.pop())
        if match is None:
            continue
        extras = {canonical(name.strip()) for name in (match[2] or "").split(",") if name.strip()}
        package = (canonical(match[1]), frozenset(extras))
        if package not in seen:
            seen.add(package)
            waiting += asked_by(package[0], extras)
    return {name for name, _ in seen}


def main() -> None:
    """Print the pins."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gpu", type=int, choices=(0, 1), required=True, help="1: also CUDA's libraries and Triton")
    parser.add_argument("projects", nargs="*", help="directories of packages, with extras; without, all pins")
    options = parser.parse_args()
    # The package that asks for the two is for a GPU, and may be absent.
    needed = closure(options.projects) | CALLED_ON_A_CPU if options.projects else None
    for name, line in pins().items():
        is_left_out = not options.gpu and name not in CALLED_ON_A_CPU and GPU_ONLY.match(name)
        if (needed is None or name in needed) and not is_left_out:
            print(line)


if __name__ == "__main__":
    main()
