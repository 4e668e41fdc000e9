"""The data set of a lab: its tables, their columns, and their Parquet files.

``<lab>/<table>/device=<device>/data.parquet``: a folder is one table, partitioned by device the
way Hive does it, so that pandas, DuckDB, Polars and Spark read a whole table in one line. A file
is written whole or not at all; the same rows give the same bytes.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import quote

import pandas as pd
import pyarrow as pa

from bampipe.data import store
from bampipe.errors import InputError

Row = Mapping[str, object]

_SESSION = {"session_id": pa.string(), "recorded_at": pa.timestamp("us", tz="UTC")}
_TEXT, _NUMBER, _COUNT, _FLAG = pa.string(), pa.float64(), pa.int64(), pa.bool_()
_LIST = pa.list_(pa.string())

TABLES: dict[str, dict[str, pa.DataType]] = {
    "sessions": {
        **_SESSION,
        "sample_rate_hz": _NUMBER,
        "trials": _COUNT,
        "trials_repaired": _COUNT,
        "trials_set_aside": _COUNT,
        "models": _LIST,
        "counting_model": _TEXT,
        "effects": _LIST,
        "gates_failed": _COUNT,
        "gates_warned": _COUNT,
        "failures": _LIST,
        "bampipe": _TEXT,
    },
    "parameters": {
        **_SESSION,
        "model": _TEXT,
        "parameter": _TEXT,
        "axis": _TEXT,
        "estimate": _NUMBER,
        "sd": _NUMBER,
        "lower": _NUMBER,
        "upper": _NUMBER,
        "unit": _TEXT,
        "at_bound": _FLAG,
        "method": _TEXT,
    },
    "stiffness": {
        **_SESSION,
        "axis": _TEXT,
        "stiffness": _NUMBER,
        "sd": _NUMBER,
        "lower": _NUMBER,
        "upper": _NUMBER,
        "unit": _TEXT,
        "bandwidth_hz": _NUMBER,
        "n_cycles": _COUNT,
    },
    "errors": {
        **_SESSION,
        "model": _TEXT,
        "axis": _TEXT,
        "rmse": _NUMBER,
        "rmse_without_friction": _NUMBER,
        "held_out_rmse": _NUMBER,
        "noise_floor": _NUMBER,
        "error_over_floor": _NUMBER,
        "standing": _TEXT,
        "fit_percent": _NUMBER,
        "unit": _TEXT,
    },
    "verdicts": {
        **_SESSION,
        "model": _TEXT,
        "axis": _TEXT,
        "verdict": _TEXT,
        "effects": _LIST,
        "named": _TEXT,
        "likely": _LIST,
        "probabilities": pa.list_(_NUMBER),
        "unknown": _NUMBER,
        "explained": _NUMBER,
        "explainable_share": _NUMBER,
        "rmse_before": _NUMBER,
        "rmse_after": _NUMBER,
        "noise_floor": _NUMBER,
        "unit": _TEXT,
        "sentence": _TEXT,
    },
    "quality": {
        **_SESSION,
        "trial_id": _TEXT,
        "kind": _TEXT,
        "status": _TEXT,
        "reason": _TEXT,
        "repairs": _TEXT,
        "n_samples": _COUNT,
        "duration_s": _NUMBER,
        "sample_rate_hz": _NUMBER,
        "nis": _NUMBER,
    },
}
"""Columns of each table; ``device`` stands in the path."""


def write(folder: Path, rows: Mapping[str, Sequence[Row]]) -> dict[str, int]:
    """Write every table, in place of what was there.

    Args:
        folder: the lab's folder.
        rows: of each table, in the order in which they are stored. A row holds ``device``, and
            any of the table's columns; what it lacks is null.

    Returns:
        The number of rows of each table.

    Raises:
        InputError: a file cannot be written.
    """
    devices = sorted({str(row["device"]) for row in rows["sessions"]})
    for name, columns in TABLES.items():
        kept = set()
        for device in devices:
            part = f"device={quote(device, safe='')}"
            kept.add(part)
            here = [row for row in rows.get(name, ()) if row["device"] == device]
            with store.ParquetAppender(folder / name / part / "data.parquet") as file:
                file.append(_columns(here, columns))
        for old in sorted((folder / name).glob("device=*")):
            if old.name not in kept:
                shutil.rmtree(old)
    return {name: len(rows.get(name, ())) for name in TABLES}


def read(folder: Path, table: str) -> pd.DataFrame:
    """Return a whole table, ``device`` as its last column.

    Raises:
        InputError: there is no such table in ``folder``, or it is damaged.
    """
    if not (folder / table).is_dir():
        raise InputError(f"no table {table!r}", where=str(folder), remedy="run `bampipe lab`")
    try:
        return pd.read_parquet(folder / table)
    except (OSError, ValueError) as error:
        raise InputError(
            "not a sound data set", where=str(folder / table), remedy="run `bampipe lab` again"
        ) from error


def moment(text: str | None) -> datetime | None:
    """Return an ISO 8601 date and time in UTC; one without a zone is taken for UTC."""
    if not text:
        return None
    when = datetime.fromisoformat(text)
    return when.replace(tzinfo=UTC) if when.tzinfo is None else when.astimezone(UTC)


def _columns(rows: Iterable[Row], columns: Mapping[str, pa.DataType]) -> dict[str, pa.Array]:
    found = list(rows)
    return {
        name: pa.array([row.get(name) for row in found], type=kind)
        for name, kind in columns.items()
    }
