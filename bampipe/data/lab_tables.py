"""The data set of a lab: its tables, their columns, and their Parquet files.

``<lab>/<table>/device=<device>/data.parquet``: a folder is one table, partitioned by device the
way Hive does it, so that pandas, DuckDB, Polars and Spark read a whole table in one line. A file
is written whole or not at all; the same rows give the same bytes.
"""

import shutil
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import quote

import pyarrow as pa

from bampipe.data import store
from bampipe.files import packaged_table

Row = Mapping[str, object]

_KINDS = {
    "text": pa.string(), "number": pa.float64(), "count": pa.int64(), "flag": pa.bool_(),
    "texts": pa.list_(pa.string()), "numbers": pa.list_(pa.float64()),
    "moment": pa.timestamp("us", tz="UTC"),
}  # fmt: skip


def _table(*columns: str) -> dict[str, pa.DataType]:
    """Columns given as ``name:kind``, behind those that every table has; numbers where no kind."""
    pairs = [c.partition(":") for c in ("session_id:text", "recorded_at:moment", *columns)]
    return {name: _KINDS[kind or "number"] for name, _, kind in pairs}


TABLES = {name: _table(*own) for name, own in packaged_table(__file__).items()}
"""Columns of each table; ``device`` stands in the path."""


def write(folder: Path, rows: Mapping[str, Sequence[Row]]) -> dict[str, int]:
    """Write every table, in place of what was there; return the number of rows of each.

    A row holds ``device``, and any of the table's columns; what it lacks is null.

    Raises:
        InputError: a file cannot be written.
    """
    devices = sorted({str(row["device"]) for row in rows["sessions"]})
    parts = {device: f"device={quote(device, safe='')}" for device in devices}
    for name, columns in TABLES.items():
        for device, part in parts.items():
            here = [row for row in rows.get(name, ()) if row["device"] == device]
            arrays = {c: pa.array([row.get(c) for row in here], k) for c, k in columns.items()}
            store.write_parquet(folder / name / part / "data.parquet", arrays)
        for old in sorted((folder / name).glob("device=*")):
            if old.name not in parts.values():
                shutil.rmtree(old)
    return {name: len(rows.get(name, ())) for name in TABLES}


def moment(text: str | None) -> datetime | None:
    """Return an ISO 8601 date and time in UTC; one without a zone is taken for UTC."""
    if not text:
        return None
    when = datetime.fromisoformat(text)
    return when.replace(tzinfo=UTC) if when.tzinfo is None else when.astimezone(UTC)
