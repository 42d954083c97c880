"""The rooms of the package: which may import which. An arrow that is not in the table fails here."""

import ast
from pathlib import Path

import caraware

PACKAGE = Path(caraware.__file__).parent
MAY_IMPORT = {
    "ipc": set(),
    "baselines": {"ipc"},
    "tasks": {"ipc"},
    "data": {"ipc", "tasks"},
    "learn": {"ipc", "tasks"},
    "report": {"ipc", "baselines", "tasks"},
    "run": {"ipc", "baselines", "tasks", "learn", "report"},
    "envs": {"ipc", "tasks", "run"},
    "fusion": {"ipc", "baselines", "tasks", "learn", "report", "run"},
    "cooperation": {"ipc"},
    "study": {"ipc", "baselines", "tasks", "learn", "report", "run", "cooperation"},
    "trials": {"run"},
    "examples": {"ipc", "tasks", "envs", "run"},
    "driving": {"ipc", "tasks", "learn", "run", "examples"},
}
"""Rooms from the bottom up: a room imports only earlier ones, so there is no circle."""
ENTRY_POINTS = {"__init__", "command", "consumer", "parallel", "play", "train"}
"""Modules at the top: they may import every room, and no room imports them."""
BENCHMARKS = "benchmarks"


def imported_rooms(file: Path) -> set[str]:
    """The rooms, or modules at the top, that a file imports anywhere, functions and type checking included."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: a relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return {name.split(".")[1] for name in names if name.startswith("caraware.")} - {"_native", "__version__"}


def test_every_module_lies_in_a_room() -> None:
    assert {file.stem for file in PACKAGE.glob("*.py")} == ENTRY_POINTS
    assert {file.parent.name for file in PACKAGE.glob("*/__init__.py")} - {BENCHMARKS} == set(MAY_IMPORT)


def test_a_room_imports_only_the_rooms_of_its_row() -> None:
    wrong = [
        f"{file.relative_to(PACKAGE)} imports {name}"
        for room, allowed in MAY_IMPORT.items()
        for file in sorted((PACKAGE / room).rglob("*.py"))
        for name in sorted(imported_rooms(file) - allowed - {room})
    ]
    assert wrong == []


def test_the_table_has_no_circle_and_no_arrow_that_nothing_uses() -> None:
    lower: set[str] = set()
    for room, allowed in MAY_IMPORT.items():
        assert allowed <= lower, room
        used = set().union(*(imported_rooms(file) for file in (PACKAGE / room).rglob("*.py"))) - {room}
        assert used == allowed, room
        lower.add(room)


def test_every_room_has_its_purpose_in_one_sentence() -> None:
    for room in MAY_IMPORT:
        docstring = ast.get_docstring(ast.parse((PACKAGE / room / "__init__.py").read_text()))
        assert docstring and docstring.splitlines()[0].endswith("."), room
