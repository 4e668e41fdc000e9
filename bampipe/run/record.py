"""``run.json``: what was run on what, with what, and what came out; and the lock of a run."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bampipe.errors import InputError
from bampipe.files import (
    STORAGE_FAULTS,
    digest_file,
    is_inside,
    is_normal,
    json_text,
    read_json_table,
    refuse_links,
)
from bampipe.run.events import Event, Listener, unheard
from bampipe.run.lock import hold

if TYPE_CHECKING:
    from bampipe.results.run import RunResult, StepRecord

SCHEMA = "bampipe.run/1"
FILE = "run.json"
PRIVATE = ".bampipe"
SESSION = "session:"
"""What the names of a session's files begin with among the inputs of a step."""


def read(root: Path) -> RunResult:
    """Return what ``run.json`` in ``root`` says; of an empty run where there is none.

    What is damaged counts as not there: its stages run again, and the file is rebuilt.
    """
    from bampipe.results.run import RunResult, Timing

    found = _content(root) or {}
    by_name: dict[str, Callable[[object], object]] = {
        "stages": sound_step,
        "timings": lambda value: _sound(Timing, value),
        "failures": lambda value: _sound(str, value),
    }
    sound: dict[str, Any] = {"schema": SCHEMA, "stages": {}}
    for name, field in RunResult.model_fields.items():
        value = found.get(name)
        if name in by_name:
            entries = value.items() if isinstance(value, dict) else ()
            checked = {key: by_name[name](entry) for key, entry in entries}
            sound[name] = {key: entry for key, entry in checked.items() if entry is not None}
        elif value is not None and (checked := _sound(field.annotation, value)) is not None:
            sound[name] = checked
    return RunResult(**sound)


def is_damaged(root: Path) -> bool:
    """Whether there is a ``run.json`` in ``root`` that is damaged."""
    if not (root / FILE).exists():
        return False
    found = _content(root)
    return found is None or found.get("stages", {}).keys() != read(root).stages.keys()


def _content(root: Path) -> dict[str, Any] | None:
    try:
        content = read_json_table(root / FILE)
    except InputError:
        return None
    if content.get("schema") != SCHEMA:
        return None
    return content if isinstance(content.get("stages"), dict) else None


def _sound(kind: Any, value: object) -> Any:
    """Return ``value`` as a ``kind``; None where it is none."""
    from pydantic import TypeAdapter, ValidationError

    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError:
        return None


def is_timing(value: object) -> bool:
    """Whether ``value`` says when a step ran, and for how long."""
    from bampipe.results.run import Timing

    return _sound(Timing, value) is not None


def sound_step(value: object) -> StepRecord | None:
    """Return the record of a step; None where it is none, or names what leads out of the run."""
    from bampipe.results.run import StepRecord

    made: StepRecord | None = _sound(StepRecord, value)
    if made is None:
        return None
    inputs = [name for name in made.inputs if not name.startswith(SESSION)]
    normal = all(is_normal(name) for name in (*inputs, *made.declared_inputs))
    return made if normal and are_results(made.outputs) else None


def are_results(names: Iterable[object]) -> bool:
    """Whether all ``names`` can be those of results: normal, and none of the runner's own files."""
    return all(
        is_normal(name) and name != FILE and str(name).partition("/")[0].casefold() != PRIVATE
        for name in names
    )


def require_untouched(root: Path, names: Iterable[str]) -> None:
    """Hold results against the hashes that ``run.json`` keeps of them.

    Args:
        root: the run folder.
        names: paths relative to it; one that is not there, or that no step wrote, is passed over.

    Raises:
        InputError: a file was changed or damaged since it was written; says which.
    """
    written = {
        name: (step, known)
        for step, made in read(root).stages.items()
        for name, known in made.outputs.items()
    }
    for name in names:
        step, known = written.get(name, ("", ""))
        if step and (root / name).is_file() and digest_file(root / name) != known:
            raise touched(root, name, step)


def touched(root: Path, name: str, step: str) -> InputError:
    """Return the refusal of the result ``name`` that is not as ``step`` wrote it."""
    remedy = f"run `bampipe {step.partition(':')[0]}` again to rebuild it"
    return InputError(f"{name} was changed since {step} wrote it", where=str(root), remedy=remedy)


def replace_json(path: Path, content: dict[str, Any]) -> None:
    """Write ``content`` to ``path``, in one step: it appears complete or not at all."""
    replace_text(path, json_text(content))


def replace_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path``, in one step: it appears complete or not at all."""
    with _drafted(path) as draft:
        draft.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def _drafted(path: Path) -> Iterator[Path]:
    """A file that takes the place of ``path`` once the block has written it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = draft_of(path)
    try:
        yield draft
        draft.replace(path)
    except OSError:
        draft.unlink(missing_ok=True)
        raise


def draft_of(path: Path) -> Path:
    """Return where ``path`` is written before it counts."""
    return path.with_name(f".{path.name}.part")


def write(root: Path, content: RunResult) -> None:
    """Write ``run.json``, in one step: it appears complete or not at all."""
    replace_json(root / FILE, content.model_dump(mode="json"))


@contextlib.contextmanager
def lock(root: Path, wait: bool, listen: Listener = unheard) -> Iterator[None]:
    """Hold the run folder ``root`` alone; what the disk refuses meanwhile is a user's matter.

    Args:
        root: the run folder; made if it is not there.
        wait: wait while another process holds it; else refuse.
        listen: called before waiting, and where the last holder was killed.

    Raises:
        InputError: another process holds it and ``wait`` is false; it holds a link; or the disk
            is full, read-only or the like.
    """

    def tell(kind: str) -> Callable[[str], None]:
        return lambda holder: listen(Event(root.name, "", kind, message=holder))

    private = root / PRIVATE
    if private.exists() and not is_inside(root, f"{PRIVATE}/lock"):
        refuse_links(root)
    try:
        _make(private)
        with hold(private / "lock", wait, tell("waiting"), tell("taken over")):
            refuse_links(root)
            yield
    except OSError as error:
        if error.errno not in STORAGE_FAULTS:
            raise
        raise InputError(
            STORAGE_FAULTS[error.errno],
            where=os.fspath(error.filename or root),
            remedy="earlier results are untouched",
        ) from error


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileNotFoundError as error:
        raise InputError("no folder can be made here", where=str(folder.parent)) from error
