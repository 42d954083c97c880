"""Whether torch can use a GPU: a driver is there, and so are the libraries that torch computes with."""

import functools
import re
import sys
from importlib import metadata

import torch


def missing_libraries() -> list[str]:
    """Packages of CUDA's libraries that torch asks for and that are not installed, as after `make build GPU=0`."""
    names = {re.split(r"[^\w.-]", line)[0] for line in metadata.requires("torch") or [] if "extra ==" not in line}
    return sorted(name for name in names if name.startswith("nvidia-") and not _is_installed(name))


def _is_installed(package: str) -> bool:
    try:
        metadata.version(package)
    except metadata.PackageNotFoundError:
        return False
    return True


@functools.cache
def has_usable_gpu() -> bool:
    """True if torch computes on a GPU of this machine. A GPU that lacks only libraries is reported once."""
    if not torch.cuda.is_available():
        return False
    if missing := missing_libraries():
        print(
            f"the GPU of this machine is not used: {', '.join(missing)} are not installed; run `make build GPU=1`",
            file=sys.stderr,
            flush=True,
        )
    return not missing
