"""Files of text: read with mistakes named, written whole or not at all, and hashed.

Nothing heavy is imported. A file that is not there, cannot be read or written, is no regular file,
too large, or not what is asked for (JSON, TOML) raises :class:`bampipe.errors.InputError`, which
names it, and the line.
"""

import errno
import hashlib
import json
import os
import re
import stat
import tempfile
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import date, datetime, time
from pathlib import Path
from typing import Any, BinaryIO

from bampipe.errors import InputError

LARGEST_TOML_BYTES = 4_000_000
LARGEST_JSON_BYTES = 100_000_000
"""A larger file is not parsed."""

DEEPEST = 40
"""Tables nested more deeply than this are refused (code that walks them may recurse)."""

STORAGE_FAULTS = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EROFS: "the file system is read-only",
    errno.EACCES: "permission denied",
    errno.EPERM: "permission denied",
    errno.EFBIG: "a file would be larger than this system allows",
    errno.ENOTDIR: "a file is in the way of a folder",
    errno.EEXIST: "a file is in the way of a folder",
    errno.EISDIR: "a folder is in the way of a file",
    errno.ENAMETOOLONG: "a name is too long",
}
"""Refusals of the disk, in words."""

_REMEDIES = {
    errno.ENOSPC: "free some space and run again",
    errno.EACCES: "check the permissions of the folder",
    errno.EROFS: "choose a folder that can be written",
}


def read_json(path: Path) -> Any:
    """The value in a JSON file."""
    return parse_json(read_bytes(path, LARGEST_JSON_BYTES), str(path))


def read_json_table(path: Path) -> dict[str, Any]:
    """The table in a JSON file that bampipe wrote."""
    try:
        content = read_json(path)
        if isinstance(content, dict):
            return content
        raise InputError("not a table", where=str(path))
    except InputError as error:
        error.remedy = "make it again (--force)"
        raise


def pick_values(content: object, dotted: str, key: str = "") -> dict[str, Any]:
    """The values at a ``dotted`` place in tables; keys may hold dots themselves.

    They are by the key that the last ``*`` of the place matches, or by ``key`` without one.
    """
    if not dotted:
        return {key: content}
    if not isinstance(content, Mapping):
        return {}
    if dotted.partition(".")[0] == "*":
        parts = (pick_values(content[name], dotted[2:], name) for name in sorted(content))
        return {name: value for part in parts for name, value in part.items()}
    names = [name for name in content if f"{dotted}.".startswith(f"{name}.")]
    longest = max(names, key=len, default="")
    return pick_values(content[longest], dotted[len(longest) + 1 :], key) if names else {}


def parse_json(data: bytes, where: str) -> Any:
    """The value that the bytes ``data`` of the JSON file ``where`` stand for."""
    try:
        value = json.loads(data)
    except json.JSONDecodeError as error:
        raise InputError(f"not JSON: {error.msg}", where=f"{where}, line {error.lineno}") from error
    except UnicodeDecodeError as error:
        raise InputError("not JSON: not UTF-8 text", where=where) from error
    except RecursionError as error:
        raise InputError("nested too deeply", where=where) from error
    except ValueError as error:
        raise InputError(f"not JSON that bampipe can hold: {error}", where=where) from error
    _refuse_deep(value, where)
    return value


def read_toml(path: Path) -> dict[str, Any]:
    """The table in a TOML file."""
    data = read_bytes(path, LARGEST_TOML_BYTES)
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
    _refuse_deep(table, str(path))
    return table


def packaged_table(module: str) -> dict[str, Any]:
    """The table in the TOML file that stands beside a module, given its ``__file__``."""
    return tomllib.loads(Path(module).with_suffix(".toml").read_text(encoding="utf-8"))


def is_normal(name: object) -> bool:
    """Whether ``name`` is the normal form of a path below a folder: ``a``, ``a/b``, ``a/b/c``.

    Not normal are absolute paths, empty parts, ``.`` and ``..``, backslashes, and characters that
    are not printable (some file systems leave them out when they compare names).
    """
    return (
        isinstance(name, str)
        and name.isprintable()
        and "\\" not in name
        and not any(part in ("", ".", "..") for part in name.split("/"))
    )


def is_inside(folder: Path, name: object) -> bool:
    """Whether ``name`` is a normal path that stays in ``folder``, links followed."""
    if not is_normal(name):
        return False
    try:
        return (folder / str(name)).resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # a link to itself, a name that is too long
        return False


def require_regular(path: Path) -> os.stat_result:
    """Return the status of ``path``, which is to be read.

    A pipe could be waited for without end, and a device has none.
    """
    try:
        status = os.stat(path)
    except FileNotFoundError as error:
        raise InputError("no such file", where=str(path)) from error
    except OSError as error:
        raise cannot("read", path, error) from error
    except ValueError as error:
        raise InputError("no path of a file", where=str(path)) from error
    if stat.S_ISDIR(status.st_mode):
        raise InputError("a folder, where a file is expected", where=str(path))
    if not stat.S_ISREG(status.st_mode):
        raise InputError("not a regular file", where=str(path), remedy="give a file on a disk")
    return status


@contextmanager
def atomic_writer(path: Path, *, durable: bool = True) -> Iterator[BinaryIO]:
    """A binary file that takes the place of ``path`` only when the block ends without error.

    Args:
        durable: survive a loss of power; not needed for what can be made again.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("wb") as stream:
            yield stream
            if durable:
                stream.flush()
                os.fsync(stream.fileno())
        partial.replace(path)
    except OSError as error:
        raise cannot("write", path, error) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


@contextmanager
def temporary_space() -> Iterator[None]:
    """A block that writes temporary files, in which faults of their disk name that disk.

    Raises:
        InputError: there is no folder for temporary files, or its disk is full or the like.
    """
    try:
        folder = tempfile.gettempdir()
    except FileNotFoundError as error:
        raise InputError(
            "there is no folder for temporary files that can be written",
            remedy="free some space, or set TMPDIR to a folder with room",
        ) from error
    try:
        yield
    except OSError as error:
        if error.errno not in STORAGE_FAULTS:
            raise
        raise InputError(
            f"no temporary files can be written: {STORAGE_FAULTS[error.errno]}",
            where=folder,
            remedy="free some space there, or set TMPDIR to a folder with room",
        ) from error


def write_text(path: Path, text: str, *, durable: bool = True) -> None:
    """Write ``text`` as UTF-8 with ``\\n`` line ends, whole or not at all; see `atomic_writer`."""
    with atomic_writer(path, durable=durable) as stream:
        stream.write(text.encode())


def json_text(value: object) -> str:
    """Return ``value`` as JSON with sorted keys: the same content gives the same text.

    Raises:
        ValueError: a number is NaN or infinite: store None and say why.
    """
    text = json.dumps(value, sort_keys=True, indent=1, allow_nan=False, ensure_ascii=False)
    return text + "\n"


def write_json(path: Path, value: object) -> None:
    """Write ``value`` as :func:`json_text` gives it, whole or not at all."""
    write_text(path, json_text(value))


def toml_text(table: Mapping[str, Any]) -> str:
    """Return a table of text, numbers, booleans, times, lists and tables as TOML."""
    lines: list[str] = []

    def quoted(key: str) -> str:
        return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key)

    def write(path: tuple[str, ...], content: Mapping[str, Any], head: str = "[{}]") -> None:
        tables = {
            key: value
            for key, value in content.items()
            if isinstance(value[0] if isinstance(value, list) and value else value, Mapping)
        }
        if path and (len(tables) < len(content) or not content):
            lines.extend(["", head.format(".".join(map(quoted, path)))])
        for key, value in content.items():
            if key not in tables:
                moment = value.isoformat() if isinstance(value, datetime) else ""
                lines.append(f"{quoted(key)} = {moment or json.dumps(value, ensure_ascii=False)}")
        for key, value in tables.items():
            if isinstance(value, Mapping):
                write((*path, key), value)
                continue
            for one in value:
                write((*path, key), one, "[[{}]]")

    write((), table)
    return "\n".join(lines) + "\n"


def digest_bytes(content: bytes) -> str:
    """Return the SHA-256 of ``content`` in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def digest_file(path: Path) -> str:
    """Return the SHA-256 of the bytes of ``path`` in hexadecimal, read in pieces."""
    require_regular(path)
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
    """Return the hash of an input: a TOML file counts by its content, others by their bytes.

    White space and comments in a TOML file therefore change nothing. An invalid TOML file counts by
    its bytes: the stage that reads it reports its faults.
    """
    if path.suffix == ".toml":
        with suppress(InputError):
            return digest_content(read_toml(path))
    return digest_file(path)


def cannot(verb: str, path: Path, error: OSError) -> InputError:
    """Return the error for a file that cannot be read or written (``verb``)."""
    reason = STORAGE_FAULTS.get(error.errno or 0) or (error.strerror or str(error)).lower()
    return InputError(
        f"cannot {verb}: {reason}", where=str(path), remedy=_REMEDIES.get(error.errno or 0, "")
    )


def read_bytes(path: Path, limit: int) -> bytes:
    """The content of a regular file of at most ``limit`` bytes."""
    path = Path(path)
    if require_regular(path).st_size > limit:
        raise InputError(f"larger than {limit // 1_000_000} MB", where=str(path))
    try:
        return path.read_bytes()
    except OSError as error:
        raise cannot("read", path, error) from error


def _refuse_deep(value: object, where: str, depth: int = DEEPEST) -> None:
    if not isinstance(value, Mapping | list):
        return
    if depth == 0:
        raise InputError("nested too deeply", where=where)
    for item in value.values() if isinstance(value, Mapping) else value:
        _refuse_deep(item, where, depth - 1)


def _plain(value: object) -> object:
    if isinstance(value, datetime | date | time):
        return value.isoformat()
    raise TypeError(f"cannot hash a {type(value).__name__}")
