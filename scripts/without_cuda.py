#!/usr/bin/env python3
"""Lets torch's CUDA build run on a machine without a GPU, without the 4 GB of libraries and compilers that it asks for.

    .venv/bin/python scripts/without_cuda.py       # after torch was installed without them

The linker loads every library that torch names, whatever torch calls. For each that is not installed this script
compiles a small one of the same name into `torch/lib`, with what torch imports from it. Without a GPU torch calls none
of it. A function that is called all the same says so on standard error, and returns an error code.

torch looks into `torch/lib` last, so the real libraries win as soon as they are installed.
"""

import ctypes
import importlib.util
import os
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

NEVER_REPLACED = ("libcuda.so", "libcudart.so", "libcupti.so", "libcusolver.so")
"""The driver's library says that there is a GPU. CUDA's runtime and CUPTI are called without one, and are installed.
torch opens cuSOLVER where a GPU computes, and never before."""

SOURCE = r"""#include <unistd.h>

static const char text[] = "SONAME is not installed: this environment was made for a machine without a GPU; "
                           "`make build GPU=1` installs torch's CUDA libraries\n";

static const char *report(void) {
    static int is_reported;
    if (!is_reported) {
        is_reported = 1;
        if (write(2, text, sizeof text - 1) < 0) return text;
    }
    return text;
}
"""
BODIES = {
    "code": "long NAME(void) { report(); return 1; }",
    "text": "const char *NAME(void) { return report(); }",
    "data": "char NAME[4096];",
}


@dataclass
class Library:
    """A library that torch is linked against and that is not installed."""

    soname: str
    version: str = ""
    """Name of the version of its symbols, empty if they have none."""
    symbols: dict[str, str] = field(default_factory=dict)
    """What torch imports from it, and which of `BODIES` stands for it."""

    @property
    def prefix(self) -> str:
        """How the names of its functions begin, in lower case: "nccl" for "libnccl.so.2"."""
        return self.soname.removeprefix("lib").split(".")[0].split("_")[0].lower()

    def compile(self, directory: Path) -> None:
        """Write the replacement to `directory`. Raises `CalledProcessError` if the compiler fails."""
        bodies = (BODIES[kind].replace("NAME", name) for name, kind in sorted(self.symbols.items()))
        with tempfile.TemporaryDirectory() as place:
            source, script = Path(place, "library.c"), Path(place, "versions")
            source.write_text("\n".join([SOURCE.replace("SONAME", self.soname), *bodies, ""]))
            script.write_text(f"{self.version} {{ global: *; }};\n")
            flags = ["-shared", "-fPIC", "-O1", f"-Wl,-soname,{self.soname}"]
            if self.version:
                flags.append(f"-Wl,--version-script,{script}")
            compiler = os.environ.get("CXX", "c++")
            subprocess.run([compiler, *flags, "-o", directory / self.soname, "-x", "c", source], check=True)


def readelf(*arguments: str | Path) -> str:
    """What readelf prints, untranslated."""
    command = ["readelf", "--wide", *map(str, arguments)]
    environment = {**os.environ, "LC_ALL": "C"}
    return subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout


def is_installed(soname: str, torch: Path) -> bool:
    """True if torch finds the library in its own folder, in those of its packages, or where the system looks."""
    if (torch / "lib" / soname).exists() or list(torch.parent.glob(f"nvidia/*/lib/{soname}")):
        return True
    try:
        ctypes.CDLL(soname)
    except OSError:
        return False
    return True


def libraries_of(torch: Path) -> list[Library]:
    """The libraries that torch names, with what it imports from each."""
    files = [*sorted((torch / "lib").glob("*.so*")), *sorted(torch.glob("_C*.so"))]
    named = {name for file in files for name in re.findall(r"\(NEEDED\).*\[(.+)\]", readelf("--dynamic", file))}
    # The longest prefix first: cuSPARSELt's functions begin with cuSPARSE's name as well.
    libraries = sorted(map(Library, named), key=lambda library: len(library.prefix), reverse=True)
    for file in files:
        for line in readelf("--dyn-syms", file).splitlines():
            # Number, value, size, type, binding, visibility, section, name@version.
            words = line.split()
            if len(words) < 8 or words[4] != "GLOBAL" or words[6] != "UND":
                continue
            name, _, version = words[7].partition("@")
            by_version = (library for library in libraries if version == library.soname)
            by_name = (library for library in libraries if name.lower().startswith(library.prefix))
            if library := next(by_version, None) or next(by_name, None):
                is_text = name.endswith(("String", "ErrorName"))
                library.version = version
                library.symbols[name] = "data" if words[3] == "OBJECT" else "text" if is_text else "code"
    return libraries


def main() -> int:
    """Replace what is missing, and make sure that torch starts."""
    found = importlib.util.find_spec("torch")
    if found is None or found.origin is None:
        print(f"torch is not installed in the environment of {sys.executable}", file=sys.stderr)
        return 3
    torch = Path(found.origin).parent
    missing = [
        library
        for library in libraries_of(torch)
        if not library.soname.startswith(NEVER_REPLACED) and not is_installed(library.soname, torch)
    ]
    for library in missing:
        library.compile(torch / "lib")
    subprocess.run([sys.executable, "-c", "import torch; torch.ones(2, 2) @ torch.ones(2, 2)"], check=True)
    names = ", ".join(sorted(library.soname for library in missing))
    print(f"torch runs without CUDA; replaced: {names or 'nothing'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
