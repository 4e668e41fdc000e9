"""Files of text: read with mistakes named, written whole or not at all, and hashed.

Nothing heavy is imported. A file that cannot be read or written raises
:class:`bampipe.errors.InputError` naming it.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import date, datetime, time
from pathlib import Path
from typing import Any, BinaryIO

from bampipe.errors import InputError

LARGEST_TOML_BYTES = 4_000_000
"""A settings file larger than this is taken for something else, and not parsed."""

DEEPEST_TOML = 40
"""Settings nested more deeply than this are refused (code that walks them may recurse)."""

STORAGE_FAULTS = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EROFS: "the file system is read-only",
    errno.EACCES: "permission denied",
    errno.EPERM: "permission denied",
    errno.EFBIG: "a file would be larger than this system allows",
    errno.ENOTDIR: "a file is in the way of a folder",
    errno.EEXIST: "a file is in the way of a folder",
    errno.ENAMETOOLONG: "a name is too long",
}
"""What the disk may refuse, in words."""

_REMEDIES = {
    errno.ENOSPC: "free some space and run again",
    errno.EACCES: "check the permissions of the folder",
    errno.EROFS: "choose a folder that can be written",
}


def read_json(path: Path) -> Any:
    """The value in a JSON file.

    Raises:
        InputError: no such file, or not JSON (file and line are named).
    """
    try:
        return json.loads(_read_bytes(path))
    except json.JSONDecodeError as error:
        raise InputError(f"not JSON: {error.msg}", where=f"{path}, line {error.lineno}") from error
    except UnicodeDecodeError as error:
        raise InputError("not JSON: not UTF-8 text", where=str(path)) from error
    except (ValueError, RecursionError) as error:
        raise InputError("not JSON of a sensible size", where=str(path)) from error


def read_toml(path: Path) -> dict[str, Any]:
    """The table in a TOML file.

    Raises:
        InputError: no such file, not UTF-8, or not TOML (file and line are named).
    """
    data = _read_bytes(path, limit=LARGEST_TOML_BYTES)
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(
            "UTF-16 text, where TOML is UTF-8", where=str(path), remedy="save it as UTF-8"
        )
    try:
        table = tomllib.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise InputError(
            "not UTF-8 text", where=f"{path}, line {line}", remedy="save it as UTF-8"
        ) from error
    except ValueError as error:  # TOMLDecodeError, or a number of thousands of digits
        what, _, place = str(error).rpartition(" (at ")
        found = re.match(r"line (\d+)", place)
        line = int(found[1]) if found else data.rstrip().count(b"\n") + 1
        raise InputError(f"not TOML: {what}", where=f"{path}, line {line}") from error
    except RecursionError as error:
        raise InputError("nested too deeply", where=str(path)) from error
    if _deeper(table, DEEPEST_TOML):
        raise InputError("nested too deeply", where=str(path))
    return table


@contextmanager
def atomic_writer(path: Path) -> Iterator[BinaryIO]:
    """A binary file that takes the place of ``path`` only when the block ends without error.

    Raises:
        InputError: the folder is read-only, the disk is full, or the like.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(path)
    except OSError as error:
        _discard(partial)
        raise cannot("write", path, error) from error
    except BaseException:
        _discard(partial)
        raise


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8 with ``\\n`` line ends, whole or not at all."""
    with atomic_writer(path) as stream:
        stream.write(text.encode())


def json_text(value: object) -> str:
    """Return ``value`` as JSON with sorted keys: the same content gives the same text.

    Raises:
        ValueError: a number is NaN or infinite: store None and say why.
    """
    text = json.dumps(
        value, sort_keys=True, indent=1, allow_nan=False, ensure_ascii=False, default=_listed
    )
    return text + "\n"


def write_json(path: Path, value: object) -> None:
    """Write ``value`` as :func:`json_text` gives it, whole or not at all."""
    write_text(path, json_text(value))


def digest_bytes(content: bytes) -> str:
    """Return the SHA-256 of ``content`` in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def digest_file(path: Path) -> str:
    """Return the SHA-256 of the bytes of ``path`` in hexadecimal, read in pieces.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise cannot("read", path, error) from error


def digest_content(content: object) -> str:
    """Return the SHA-256 of ``content`` (what JSON or TOML can hold), whatever its key order."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), default=_plain)
    return digest_bytes(text.encode())


def digest_input(path: Path) -> str:
    """Return the hash of an input: a TOML file counts by what it says, others by their bytes.

    White space and comments in a TOML file therefore change nothing. A file that is not valid
    TOML counts by its bytes: the stage that reads it says what is wrong with it.
    """
    if path.suffix == ".toml":
        try:
            return digest_content(read_toml(path))
        except InputError:
            return digest_file(path)
    return digest_file(path)


def cannot(verb: str, path: Path, error: OSError) -> InputError:
    """Return what to tell the user of a file that cannot be read or written.

    Args:
        verb: "read" or "write".
        path: the file.
        error: what the operating system said.
    """
    reason = STORAGE_FAULTS.get(error.errno or 0) or (error.strerror or str(error)).lower()
    return InputError(
        f"cannot {verb}: {reason}", where=str(path), remedy=_REMEDIES.get(error.errno or 0, "")
    )


def _read_bytes(path: Path, limit: int | None = None) -> bytes:
    path = Path(path)
    try:
        if path.is_dir():
            raise InputError("a folder, where a file is expected", where=str(path))
        if limit is not None and path.stat().st_size > limit:
            raise InputError(f"larger than {limit // 1_000_000} MB", where=str(path))
        return path.read_bytes()
    except FileNotFoundError as error:
        raise InputError("no such file", where=str(path)) from error
    except OSError as error:
        raise cannot("read", path, error) from error


def _deeper(value: object, limit: int) -> bool:
    """Whether containers are nested more than ``limit`` deep (no recursion beyond that)."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if not isinstance(value, list):
        return False
    return limit == 0 or any(_deeper(item, limit - 1) for item in value)


def _discard(partial: Path) -> None:
    if partial.exists():
        partial.unlink()


def _listed(value: Any) -> object:
    """An array or a number of numpy as JSON can hold it."""
    return value.tolist()


def _plain(value: object) -> object:
    if isinstance(value, datetime | date | time):
        return value.isoformat()
    raise TypeError(f"cannot hash a {type(value).__name__}")
