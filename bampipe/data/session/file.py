"""Reading and checking ``session.toml``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bampipe.data.session.records import FILE_NAME, Session
from bampipe.errors import InputError
from bampipe.files import read_toml
from bampipe.schema import read


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
    session = read(Session, table, where)
    session._root = Path(root)
    return session
