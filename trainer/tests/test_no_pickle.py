"""No program here reads a pickle, which can run code when it is read: what comes from a network or a file is data.

Ruff's rules S301 and S302 refuse calls that read one. This test also refuses the imports, torch's exchanges of objects
between ranks, which pickle without being asked, and files that torch or NumPy may unpickle.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TREES = ("trainer/python", "viewer/src", "bench/python", "maps", "scripts")
MODULES = {"pickle", "_pickle", "cloudpickle", "dill", "joblib", "jsonpickle", "marshal", "shelve"}
"""Modules that write and read pickles, or Python's own compiled code."""
EXCHANGES = {
    "all_gather_object",
    "broadcast_object_list",
    "gather_object",
    "recv_object_list",
    "rpc_async",
    "rpc_sync",
    "scatter_object_list",
    "send_object_list",
}
"""Of `torch.distributed`: the receiver unpickles."""
EXCEPTIONS: dict[str, str] = {}
"""Files that may, by their path in the repository, each with the reason."""


def pickles(source: str) -> Iterator[str]:
    """What in a Python source may read a pickle: its line, and the name."""
    for node in ast.walk(ast.parse(source)):
        for name in _named(node):
            yield f"line {getattr(node, 'lineno', 0)}: {name}"


def _named(node: ast.AST) -> list[str]:
    """The banned names of one node."""
    match node:
        case ast.Import(names=names):
            return [alias.name for alias in names if _is_pickling(alias.name)]
        case ast.ImportFrom(module=str(module), names=names):
            from_torch = [f"torch.{alias.name}" for alias in names if module == "torch" and alias.name == "load"]
            exchanges = [alias.name for alias in names if alias.name in EXCHANGES]
            return [module] * _is_pickling(module) + from_torch + exchanges
        case ast.Attribute(attr=name) | ast.Name(id=name) if name in EXCHANGES:
            return [name]
        case ast.Call(func=ast.Attribute(value=ast.Name(id="torch"), attr="load"), keywords=keywords):
            return [] if _is_set(keywords, "weights_only", True) else ["torch.load without weights_only=True"]
        case ast.Call(keywords=keywords) if any(keyword.arg == "allow_pickle" for keyword in keywords):
            return [] if _is_set(keywords, "allow_pickle", False) else ["allow_pickle"]
        case ast.Attribute(value=ast.Name(id="pd" | "pandas"), attr="read_pickle"):
            return ["read_pickle"]
    return []


def _is_pickling(module: str) -> bool:
    return module.split(".")[0] in MODULES or module.startswith("torch.distributed.rpc")


def _is_set(keywords: list[ast.keyword], name: str, value: bool) -> bool:
    """Whether a call gives the keyword this value, in so many words."""
    values = [keyword.value for keyword in keywords if keyword.arg == name]
    return any(isinstance(given, ast.Constant) and given.value is value for given in values)


def test_no_program_reads_a_pickle() -> None:
    found, files = {}, 0
    for tree in TREES:
        for file in sorted((ROOT / tree).rglob("*.py")):
            files += 1
            if lines := list(pickles(file.read_text())):
                found[str(file.relative_to(ROOT))] = lines
    assert files > 200
    # An exception that is of no use any more goes, too.
    assert sorted(found) == sorted(EXCEPTIONS), found


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("import pickle", "pickle"),
        ("def late():\n    import os, pickle as p", "pickle"),
        ("from pickle import loads", "pickle"),
        ("import cloudpickle", "cloudpickle"),
        ("import torch.distributed.rpc as rpc", "torch.distributed.rpc"),
        ("dist.broadcast_object_list(values)", "broadcast_object_list"),
        ("self._dist.all_gather_object(values, own)", "all_gather_object"),
        ("from torch.distributed import gather_object", "gather_object"),
        ("exchange = dist.send_object_list", "send_object_list"),
        ("torch.load(file)", "torch.load"),
        ("torch.load(file, weights_only=False)", "torch.load"),
        ("torch.load(file, weights_only=trusted)", "torch.load"),
        ("from torch import load", "torch.load"),
        ("np.load(file, allow_pickle=True)", "allow_pickle"),
        ("pd.read_pickle(file)", "read_pickle"),
    ],
)
def test_what_reads_a_pickle_is_found(source: str, name: str) -> None:
    assert any(name in found for found in pickles(source))


@pytest.mark.parametrize(
    "source",
    [
        "torch.load(file, weights_only=True)",
        "np.load(file, allow_pickle=False)",
        "np.load(file)",
        "json.load(file)",
        "safetensors.load(data)",
        "dist.all_gather(sizes, own)",
        '"""Torch unpickles what comes."""',
    ],
)
def test_what_reads_data_is_not(source: str) -> None:
    assert not list(pickles(source))
