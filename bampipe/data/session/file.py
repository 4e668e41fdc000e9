"""Reading and checking ``session.toml``."""

from __future__ import annotations

import datetime
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bampipe.data import schema
from bampipe.data.readers.trial import Dialect
from bampipe.data.session.channels import (
    brakes_from,
    channels_from,
    clock_from,
    encoder_from,
    force_from,
)
from bampipe.data.session.places import is_device_path, lexically_inside
from bampipe.data.session.records import FILE_NAME, Session
from bampipe.data.session.trials import trials_from
from bampipe.errors import InputError
from bampipe.files import read_toml


def read_session(path: Path) -> Session:
    """Read and check the session in the folder ``path`` (or the session file ``path`` itself).

    Raises:
        InputError: no such session, or any mistake in its session file.
    """
    path = Path(path)
    file = path if path.is_file() else path / FILE_NAME
    if not path.exists():
        raise InputError("no such session folder", where=str(path))
    if not file.is_file():
        raise InputError(
            f"no {FILE_NAME} in this folder", where=str(path), remedy="give a session folder"
        )
    return session_from(read_toml(file), file.parent, str(file))


def session_from(table: Mapping[str, Any], root: Path, where: str = FILE_NAME) -> Session:
    """Check the parsed session file ``table`` of the folder ``root``.

    Args:
        table: what TOML parsing gave.
        root: the session folder; only a device file is looked for in it.
        where: the file, for messages.

    Raises:
        InputError: any mistake, named by field.
    """
    table = {**table}
    if isinstance(table.get("recorded_at"), datetime.date):
        table["recorded_at"] = table["recorded_at"].isoformat()
    _refuse_non_finite(table, (), where)
    schema.validate(table, "session", where)
    recorded_at = table.get("recorded_at")
    if recorded_at is not None:
        try:
            datetime.datetime.fromisoformat(recorded_at)
        except ValueError as error:
            raise InputError(
                f'found "{recorded_at}", expected a date and time like 2026-10-03T10:12:00Z',
                where=f"{where}: recorded_at",
            ) from error
    rate = float(table["sample_rate_hz"])
    text = table.get("csv", {})
    encoders = tuple(
        encoder_from(axis, entry, f"{where}: encoders.{axis}")
        for axis, entry in table["encoders"].items()
    )
    force = force_from(table["force"], f"{where}: force") if "force" in table else None
    session = Session(
        root=Path(root),
        session_id=table["session_id"],
        device=table["device"],
        recorded_at=recorded_at,
        sample_rate=rate,
        clock=clock_from(table.get("time"), rate, f"{where}: time"),
        encoders=encoders,
        force=force,
        brakes=brakes_from(table.get("brakes"), encoders, f"{where}: brakes"),
        channels=channels_from(table.get("channels", {}), f"{where}: channels"),
        trials=trials_from(table["trials"], encoders, where),
        dialect=Dialect(**{**text, "names": tuple(text.get("names", ()))}),
    )
    _refuse_shared_columns(session, where)
    if is_device_path(session.device):
        lexically_inside(session.device, where=f"{where}: device")
    return session


def _refuse_non_finite(value: object, path: tuple[str | int, ...], where: str) -> None:
    if isinstance(value, Mapping):
        for key, item in value.items():
            _refuse_non_finite(item, (*path, key), where)
    elif isinstance(value, list):
        for number, item in enumerate(value):
            _refuse_non_finite(item, (*path, number), where)
    elif isinstance(value, float) and not math.isfinite(value):
        raise InputError(
            f"found {value}, expected a finite number", where=f"{where}: {schema.dotted(path)}"
        )
    elif isinstance(value, int) and abs(value) > 2**53:
        raise InputError(
            "found a whole number beyond 2^53", where=f"{where}: {schema.dotted(path)}"
        )
    elif isinstance(value, datetime.date | datetime.time):
        raise InputError(f"found the date or time {value}", where=f"{where}: {schema.dotted(path)}")


def _refuse_shared_columns(session: Session, where: str) -> None:
    for column, times in Counter(session.columns).items():
        if times > 1:
            raise InputError(
                f"column '{column}' is used for {times} channels",
                where=where,
                remedy="each channel has its own column",
            )
