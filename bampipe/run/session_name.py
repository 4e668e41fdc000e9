"""Names of sessions and of their run folders."""

import re
from pathlib import Path

from bampipe.errors import InputError
from bampipe.files import read_toml


def is_name(text: str) -> bool:
    """Return whether ``text`` can name a run folder: no path, no hidden or control character."""
    return re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9._+-]{0,127}", text) is not None


def session_folder(path: str | Path) -> Path:
    """Return the folder of a session, given that folder or its ``session.toml``."""
    return Path(path).parent if Path(path).name == "session.toml" else Path(path)


def session_id(session: Path) -> str:
    """Return the name of the run folder for ``session``: the ``session_id`` in its file."""
    try:
        str(session.resolve()).encode()
    except UnicodeEncodeError as error:
        raise InputError(
            "the path is no UTF-8 text", where=str(session), remedy="rename the folder"
        ) from error
    path = session / "session.toml"
    if not path.is_file():
        what, remedy = "no session.toml here", "give the folder of a session"
        if not session.exists():
            what, remedy = "no such session folder", ""
        elif session.is_dir() and any(session.glob("*/session.toml")):
            what, remedy = "this is a folder of sessions", "give them one by one, or as "
            remedy += f"'{session}/*'"
        raise InputError(what, where=str(session), remedy=remedy)
    name = read_toml(path).get("session_id")
    if name is None:
        raise InputError(
            "'session_id' is missing", where=str(path), remedy="give the session a name of its own"
        )
    if not isinstance(name, str) or not is_name(name):
        raise InputError(
            f"session_id must be a name of letters, digits, '.', '_', '+' or '-', not {name!r}",
            where=str(path),
        )
    return name
