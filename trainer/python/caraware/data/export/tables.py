"""Tables of vehicle-ticks as Parquet and as CSV."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from caraware.data.export.card import source
from caraware.data.export.rows import table
from caraware.data.names import RoadUsers
from caraware.data.recording import Episode, Recording

MEANING = "One row for each vehicle-tick: truth, sensors, observation, prediction and reward."
"""What a row is, for the data card."""


def _described(recording: Recording, episode: Episode) -> pa.Table:
    """The table of an episode, with what it is of in its schema."""
    rows = table(recording, episode, RoadUsers(recording))
    return rows.replace_schema_metadata(source(recording, episode))


def write_parquet(recording: Recording, episode: Episode, path: Path) -> None:
    """Write one episode as Parquet, compressed by zstd."""
    pyarrow.parquet.write_table(_described(recording, episode), path, compression="zstd")


def write_csv(recording: Recording, episode: Episode, path: Path) -> None:
    """Write one episode as CSV, with a line of column names."""
    pyarrow.csv.write_csv(_described(recording, episode), path)
