"""Logs as binary files: text turned into Parquet, read in a tenth of the time; MCAP of JSON."""

from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

import pandas as pd
import pytest


def write_mcap(
    stream: BinaryIO, topic: str, messages: Iterable[tuple[int, bytes]], **options: int
) -> None:
    """Write messages in JSON, each with its time in ns, as MCAP; ``options`` of the writer."""
    writer_module = pytest.importorskip("mcap.writer")
    writer = writer_module.Writer(stream, **options)
    writer.start()
    schema = writer.register_schema("state", "jsonschema", b'{"type": "object"}')
    channel = writer.register_channel(topic, "json", schema)
    for moment, content in messages:
        writer.add_message(channel, moment, content, moment)
    writer.finish()


def to_parquet(folder: Path) -> Path:
    """Turn the CSV files below ``folder``, and what names them in session.toml; returns it."""
    for path in folder.rglob("*.csv"):
        frame = pd.read_csv(path, float_precision="round_trip")
        frame.to_parquet(path.with_suffix(".parquet"))
        path.unlink()
    session = folder / "session.toml"
    if session.is_file():
        session.write_text(session.read_text().replace('.csv"', '.parquet"'))
    return folder
