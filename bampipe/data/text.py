"""JSON and TOML files as they are read: nothing heavy is imported, and mistakes are named."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bampipe.errors import InputError

LARGEST_TOML_BYTES = 4_000_000
"""A settings file larger than this is taken for something else, and not parsed."""

DEEPEST_TOML = 40
"""Settings nested more deeply than this are refused (code that walks them may recurse)."""


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
        line = found[1] if found else data.rstrip().count(b"\n") + 1
        raise InputError(f"not TOML: {what}", where=f"{path}, line {line}") from error
    except RecursionError as error:
        raise InputError("nested too deeply", where=str(path)) from error
    if _deeper(table, DEEPEST_TOML):
        raise InputError("nested too deeply", where=str(path))
    return table


def cannot(verb: str, path: Path, error: OSError) -> InputError:
    """Return what to tell the user of a file that cannot be read or written.

    Args:
        verb: "read" or "write".
        path: the file.
        error: what the operating system said.
    """
    reason = (error.strerror or str(error)).lower()
    remedy = {
        "no space left on device": "free some space and run again",
        "permission denied": "check the permissions of the folder",
        "read-only file system": "choose a folder that can be written",
    }.get(reason, "")
    return InputError(f"cannot {verb}: {reason}", where=str(path), remedy=remedy)


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
