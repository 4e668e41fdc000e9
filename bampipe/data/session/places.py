"""Paths in a session file: inside the session folder, or refused."""

from __future__ import annotations

from pathlib import Path, PurePosixPath, PureWindowsPath

from bampipe.errors import InputError
from bampipe.files import is_inside


def is_device_path(device: str) -> bool:
    """Whether ``device`` is the path of a device file rather than a built-in name."""
    return device.endswith(".toml") or "/" in device or "\\" in device


def lexically_inside(path: str, where: str) -> None:
    """Refuse a path that by its text alone leaves the session folder.

    Raises:
        InputError: the path is absolute, has "..", a drive, a backslash or a NUL character.
    """
    remedy = "give a path relative to the session folder, with / between folders"
    if PurePosixPath(path).is_absolute() or PureWindowsPath(path).drive:
        raise InputError(f"absolute path '{path}'", where=where, remedy=remedy)
    if ".." in PurePosixPath(path).parts or ".." in PureWindowsPath(path).parts:
        raise InputError(f"path '{path}' leaves the session folder", where=where, remedy=remedy)
    if "\\" in path or not path.isprintable():
        shown = path.encode("unicode_escape").decode()
        raise InputError(f"path '{shown}' is not portable", where=where, remedy=remedy)


def inside(root: Path, path: str, where: str) -> Path:
    """The existing file ``path`` of the session folder ``root``.

    Raises:
        InputError: it is no regular file, or it leaves the folder, also by a symbolic link.
    """
    lexically_inside(path, where)
    full = Path(root) / path
    try:
        exists, regular = full.exists(), full.is_file()
    except (OSError, ValueError) as error:
        raise InputError(f"path '{path}' cannot be used", where=where) from error
    if exists and not is_inside(Path(root), PurePosixPath(path).as_posix()):
        raise InputError(
            f"'{path}' is a link to a place outside the session folder",
            where=where,
            remedy="copy the file into the session folder",
        )
    if not exists:
        stem = full.stem.lower()
        near = [other for other in full.parent.glob("*") if other.stem.lower() == stem != ""]
        names = [other.relative_to(root).as_posix() for other in near if other != full]
        remedy = f"there is '{min(names)}'" if names else ""
        raise InputError(f"no such file '{path}'", where=where, remedy=remedy)
    if not regular:
        raise InputError(f"'{path}' is not a file", where=where)
    return full
