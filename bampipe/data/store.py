"""Parquet files: written whole or not at all, and the same bytes for the same content.

They have fixed options and no metadata that varies. A file that cannot be read or written raises
:class:`bampipe.errors.InputError` naming it.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO, TypeAlias

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from bampipe.data.readers.trial import check_columns
from bampipe.data.refusals import refusal
from bampipe.errors import InputError
from bampipe.files import atomic_writer

Frame: TypeAlias = pd.DataFrame | Mapping[str, np.ndarray | pa.Array]


class ParquetAppender(ExitStack):
    """Parquet file written frame by frame; appears whole when closed.

    Use as a context manager; :meth:`append` frames with the same columns. A ``trial_id`` column
    gives one row group a stretch of equal ids, so that :func:`read_parquet` can fetch one trial
    without reading the others. An error inside the block leaves no file. Constant text columns may
    be dictionary arrays: they are stored, and read back, as text.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = Path(path)
        self._writer: pq.ParquetWriter | None = None
        self._stream = self.enter_context(atomic_writer(self._path))
        self.push(self._finish)

    def append(self, frame: Frame) -> None:
        """Write the rows of a frame.

        Args:
            frame: a DataFrame (its index is dropped) or named columns of equal length.

        Raises:
            ValueError: columns differ from those of the first frame.
        """
        table = _table(frame)
        if self._writer is None:
            self._writer = _writer(self._stream, table.schema)
        elif table.schema != self._writer.schema:
            table = table.cast(self._writer.schema)
        bounds = [0, table.num_rows]
        if "trial_id" in table.column_names:
            ids = table.column("trial_id").to_pandas().to_numpy()
            bounds[1:1] = (np.flatnonzero(ids[1:] != ids[:-1]) + 1).tolist()
        for start, stop in pairwise(bounds):
            part = table.slice(start, stop - start)
            self._writer.write_table(part, row_group_size=max(part.num_rows, 1))

    def _finish(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._writer is not None:
            self._writer.close()
        elif kind is None:
            raise ValueError(f"{self._path}: no frame was written")


def write_parquet(path: Path, frame: Frame) -> None:
    """Write one DataFrame, or named columns of equal length, as by `ParquetAppender`."""
    with ParquetAppender(path) as file:
        file.append(frame)


def read_parquet(
    path: Path, columns: Sequence[str] | None = None, trial: str | None = None
) -> pd.DataFrame:
    """Read a Parquet file, or the rows of one trial of it.

    Args:
        path: the file.
        columns: which columns, in this order (default all).
        trial: only rows whose ``trial_id`` is this; other row groups are not read.

    Raises:
        InputError: no such file, not a sound Parquet file, no such column, no such trial.
    """
    return _read_table(path, columns, trial).to_pandas()


def read_arrays(path: Path, columns: Sequence[str], trial: str) -> dict[str, np.ndarray]:
    """Read columns of numbers of one trial, each as a float64 array (T,); absent values are NaN.

    A tenth of the time of `read_parquet`. The arrays may be written to.

    Raises:
        InputError: as `read_parquet`.
    """
    table = _read_table(path, columns, trial)
    return {name: np.array(table.column(name).to_numpy(), dtype=float) for name in columns}


def _read_table(path: Path, columns: Sequence[str] | None, trial: str | None) -> pa.Table:
    path = Path(path)
    metadata, by_trial = _footer(path)
    with _damage_named(path), pq.ParquetFile(path, metadata=metadata, memory_map=False) as file:
        names = file.schema_arrow.names
        wanted = list(columns) if columns is not None else names
        check_columns(names, [*wanted, *["trial_id"] * (trial is not None)], str(path))
        if trial is None:
            return file.read(columns=wanted).select(wanted)
        if trial not in by_trial:
            raise InputError(f"no trial '{trial}'", where=str(path))
        groups = file.read_row_groups(by_trial[trial], columns=wanted, use_threads=False)
        return groups.select(wanted)


def column_names(path: Path) -> tuple[str, ...]:
    """The columns of a Parquet file.

    Raises:
        InputError: no such file, or not a sound Parquet file.
    """
    return tuple(_footer(Path(path))[0].schema.names)


def trial_ids(path: Path) -> frozenset[str]:
    """The trials that a Parquet file has rows of.

    Raises:
        InputError: no such file, or not a sound Parquet file with ``trial_id``.
    """
    metadata, by_trial = _footer(Path(path))
    if "trial_id" not in metadata.schema.names:
        raise InputError("no column 'trial_id'", where=str(path))
    return frozenset(by_trial)


def _table(frame: Frame) -> pa.Table:
    if isinstance(frame, pd.DataFrame):
        table = pa.Table.from_pandas(frame, preserve_index=False)
    else:
        table = pa.table(dict(frame))
    # A column of nothing but nulls has no type of its own: here only text may be absent.
    fields = [
        field.with_type(pa.string())
        if pa.types.is_null(field.type) or pa.types.is_large_string(field.type)
        else field
        for field in table.schema
    ]
    return table.cast(pa.schema(fields)).replace_schema_metadata(None)


def _writer(stream: BinaryIO, schema: pa.Schema) -> pq.ParquetWriter:
    text = (pa.types.is_string, pa.types.is_large_string, pa.types.is_dictionary)
    return pq.ParquetWriter(
        stream,
        schema,
        version="2.6",
        data_page_version="1.0",
        compression="zstd",
        compression_level=3,
        use_dictionary=[f.name for f in schema if any(check(f.type) for check in text)],
        # Those that find a trial: others would make most of a footer with thousands of row groups.
        write_statistics=["trial_id"] if "trial_id" in schema.names else False,
        store_schema=False,
    )


def _footer(path: Path) -> tuple[pq.FileMetaData, Mapping[str, Sequence[int]]]:
    """Metadata of a file and its row groups by their trial, read once while it is the same file.

    Reading it takes time in proportion to the number of trials: once a trial would be too often.
    InputError where there is no such file, or not a sound Parquet file.
    """
    if not path.is_file():
        raise InputError("no such file", where=str(path))
    status = path.stat()
    with _damage_named(path):
        return _read_footer(path, status.st_ino, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=8)
def _read_footer(
    path: Path, inode: int, size: int, changed_ns: int
) -> tuple[pq.FileMetaData, Mapping[str, Sequence[int]]]:
    metadata = pq.read_metadata(path, memory_map=False)
    groups: dict[str, list[int]] = {}
    if "trial_id" in metadata.schema.names:
        column = metadata.schema.names.index("trial_id")
        for group in range(metadata.num_row_groups):
            limits = metadata.row_group(group).column(column).statistics
            if limits is not None and limits.has_min_max:
                if limits.min != limits.max:
                    raise pa.ArrowInvalid(f"row group {group} has rows of several trials")
                groups.setdefault(str(limits.min), []).append(group)
    return metadata, groups


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    try:
        yield
    except (pa.ArrowException, OSError) as error:
        raise refusal("no_parquet", str(path)) from error
