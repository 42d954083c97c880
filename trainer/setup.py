"""The wheel of the trainer: its Python package with the extension and the programs, as `cargo build` makes them.

    pip wheel --no-deps ./trainer      # compiles the whole workspace first, if need be

One wheel has all that a run needs but the viewer: the programs and the extension share the layout of the messages, and
belong to one revision. The whole workspace is compiled and not a crate alone, because another selection would compile
third-party crates again. `CARAWARE_BUILT=1` takes what is compiled already (`make wheels`).
"""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from setuptools import Distribution, setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent.parent
NOT_IN_THE_WHEEL = ("caraware-bench", "fanout-watch", "ipc-bench", "lidar-bench", "sights-bench", "v2x-bench")
"""Measurements of a checkout, where their Python side and their peers are."""
SUMO_BESIDE = b"$ORIGIN/../../sumo/lib64"
"""Where a program finds SUMO's library from its place in the wheel; `traffic-bridge/build.rs` links it so."""


def cargo(*arguments: str) -> str:
    """Run Cargo in the workspace; what it prints. Its errors and its progress go to standard error."""
    environment = dict(os.environ)
    has_own_sumo = list(ROOT.glob(".venv/lib/python3*/site-packages/sumo"))
    if not has_own_sumo and not environment.get("CARAWARE_SUMO_HOME") and (found := importlib.util.find_spec("sumo")):
        environment["CARAWARE_SUMO_HOME"] = str(Path(found.origin or "").parent)
    command = ["cargo", *arguments]
    return subprocess.run(command, cwd=ROOT, env=environment, check=True, stdout=subprocess.PIPE, text=True).stdout


def programs(metadata: dict[str, Any]) -> list[str]:
    """Names of the programs that a run needs."""
    targets = [target for package in metadata["packages"] for target in package["targets"]]
    names = {target["name"] for target in targets if target["kind"] == ["bin"]}
    return sorted(names.difference(NOT_IN_THE_WHEEL))


def copy_stripped(source: Path, target: Path) -> None:
    """Copy a program or a library without its debugging information and without paths of this machine to SUMO."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy2(source, target)
    subprocess.run(["strip", target], check=True)
    content = bytearray(target.read_bytes())
    # The search path is shortened within its place in the file.
    ending = b":" + SUMO_BESIDE + b"\0"
    while (position := content.find(ending)) >= 0:
        begin, end = content.rfind(b"\0", 0, position) + 1, position + len(ending)
        content[begin:end] = ending[1:].ljust(end - begin, b"\0")
    target.write_bytes(content)


class BuildWithPrograms(build_py):
    """The package, then what Cargo has made."""

    def run(self) -> None:
        """Compile and copy."""
        super().run()
        if not (ROOT / "Cargo.lock").is_file():
            sys.exit("the wheel of caraware is made from a checkout: the whole workspace is compiled")
        if not os.environ.get("CARAWARE_BUILT"):
            cargo("build", "--release", "--locked")
        metadata = json.loads(cargo("metadata", "--format-version=1", "--no-deps", "--offline", "--locked"))
        built, package = Path(metadata["target_directory"]) / "release", Path(self.build_lib) / "caraware"
        copy_stripped(built / "lib_native.so", package / "_native.abi3.so")
        for name in programs(metadata):
            copy_stripped(built / name, package / "programs" / name)


class PlatformDistribution(Distribution):
    """A package for one kind of machine."""

    def has_ext_modules(self) -> bool:
        """It has an extension, for any Python from 3.11 on."""
        return True


setup(
    distclass=PlatformDistribution,
    cmdclass={"build_py": BuildWithPrograms},
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
