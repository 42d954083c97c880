"""Reads a recording back: the values of each entity, and their times."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader

from caraware_viewer.canvas import TIMELINE

ALWAYS = float("-inf")
"""Time of a static row."""


@dataclass
class Entity:
    """Everything that was logged on one path."""

    rows: list[tuple[float, dict[str, Any]]] = field(default_factory=list)
    """Simulated time in seconds, values by component ("Points2D:positions")."""

    def newest(self, component: str) -> Any:
        """The last value of a component."""
        return [row[component] for _, row in self.rows if row.get(component) is not None][-1]


def read(path: Path) -> dict[str, Entity]:
    """All entities of a recording, rows in the order of simulated time."""
    entities: dict[str, Entity] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        entity = entities.setdefault(chunk.entity_path.removeprefix("/"), Entity())
        columns = {name: batch.column(name) for name in batch.schema.names if ":" in name}
        times = batch.column(TIMELINE).cast("int64").to_pylist() if TIMELINE in batch.schema.names else None
        for index in range(batch.num_rows):
            at_s = ALWAYS if times is None else times[index] * 1e-9
            entity.rows.append((at_s, {name: column[index].as_py() for name, column in columns.items()}))
    for entity in entities.values():
        entity.rows.sort(key=lambda row: row[0])
    return entities


def layouts(path: Path) -> dict[str, list[Any]]:
    """Every value in the layouts that a recording brings along, in no order, by component ("Background:color")."""
    reader = RrdReader(path)
    values: dict[str, list[Any]] = {}
    for store in reader.blueprints():
        for chunk in reader.stream(store=store):
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                if ":" in name:
                    known = values.setdefault(name, [])
                    known += [value for value in batch.column(name).to_pylist() if value is not None]
    return values
