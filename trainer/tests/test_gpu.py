"""An environment without CUDA's libraries: what stands for them, and what the trainer does on a GPU without them."""

import importlib.util
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from types import ModuleType

import pytest
import torch
from caraware.learn import gpu

ROOT = Path(__file__).resolve().parents[2]
CALLS = """
import ctypes, sys
library = ctypes.CDLL(sys.argv[1])
library.ncclGetErrorString.restype = ctypes.c_char_p
print(library.ncclCommInitAll(), library.ncclGetErrorString(1).decode(), end="")
"""


def without_cuda() -> ModuleType:
    """The script as a module."""
    specification = importlib.util.spec_from_file_location("without_cuda", ROOT / "scripts" / "without_cuda.py")
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules["without_cuda"] = module
    specification.loader.exec_module(module)
    return module


def test_a_replaced_library_has_what_torch_imports_and_returns_an_error(tmp_path: Path) -> None:
    libraries = {library.soname: library for library in without_cuda().libraries_of(Path(torch.__file__).parent)}
    blas, nccl = libraries["libcublas.so.13"], libraries["libnccl.so.2"]
    # By the version of a symbol, and by the beginning of its name where it has no version.
    assert {"cublasCreate_v2", "cublasSgemm_v2"} <= set(blas.symbols)
    assert not any(name.startswith("cublasLt") for name in blas.symbols)
    assert nccl.symbols["ncclGetErrorString"] == "text"
    assert not any(name.startswith("cusparseLt") for name in libraries["libcusparse.so.12"].symbols)
    nccl.compile(tmp_path)
    command = [sys.executable, "-c", CALLS, str(tmp_path / nccl.soname)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("1 libnccl.so.2 is not installed")
    assert done.stderr.count("make build GPU=1") == 1


def test_a_gpu_without_libraries_is_reported_once_and_not_used(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(metadata, "requires", lambda _: ["numpy", "nvidia-none-cu0==1; platform_system == 'Linux'"])
    gpu.has_usable_gpu.cache_clear()
    try:
        assert not gpu.has_usable_gpu()
        assert not gpu.has_usable_gpu()
        assert capsys.readouterr().err.count("nvidia-none-cu0 are not installed") == 1
        monkeypatch.setattr(metadata, "requires", lambda _: ["numpy"])
        gpu.has_usable_gpu.cache_clear()
        assert gpu.has_usable_gpu()
    finally:
        gpu.has_usable_gpu.cache_clear()
