"""``run.json``: what was run on what, with what, and what came out; and the lock of a run."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from bampipe.errors import InputError
from bampipe.stages.base import write_json

SCHEMA = "bampipe.run/1"
FILE = "run.json"
PRIVATE = ".bampipe"


def read(root: Path) -> dict[str, Any]:
    """Return the contents of ``run.json`` in ``root``; of an empty run where there is none.

    A damaged file counts as none: every stage then runs again, and the file is rebuilt.
    """
    empty: dict[str, Any] = {"schema": SCHEMA, "stages": {}}
    try:
        content = json.loads((root / FILE).read_text(encoding="utf-8"))
    except (FileNotFoundError, json.JSONDecodeError, UnicodeDecodeError):
        return empty
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        return empty
    return content


def replace_json(path: Path, content: dict[str, Any]) -> None:
    """Write ``content`` to ``path``, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.part")
    write_json(draft, content)
    draft.replace(path)


def write(root: Path, content: dict[str, Any]) -> None:
    """Write ``run.json``, whole or not at all."""
    replace_json(root / FILE, content)


@contextlib.contextmanager
def lock(root: Path, wait: bool, waiting: Callable[[], None]) -> Iterator[None]:
    """Hold the run folder ``root`` alone.

    Args:
        root: the run folder; made if it is not there.
        wait: wait while another process holds it; else refuse.
        waiting: called once before waiting.

    Raises:
        InputError: another process holds it and ``wait`` is false.
    """
    (root / PRIVATE).mkdir(parents=True, exist_ok=True)
    with (root / PRIVATE / "lock").open("a") as handle:
        told = False
        while True:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                    raise
            else:
                break
            if not wait:
                raise InputError(
                    "another bampipe is at work in this run folder",
                    where=str(root),
                    remedy="wait until it is done, or leave out --no-wait",
                )
            if not told:
                waiting()
                told = True
            time.sleep(0.1)
        yield
