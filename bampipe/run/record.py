"""``run.json``, the record of inputs, settings and results of every step; and the run's lock."""

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from bampipe.errors import InputError
from bampipe.files import STORAGE_FAULTS, digest_file
from bampipe.results.run import PRIVATE, RunResult
from bampipe.run.events import Event, Listener, ignore_event
from bampipe.run.lock import hold

FILE = RunResult.FILE


def read(root: Path) -> RunResult:
    """Return ``run.json`` in ``root``, or an empty record.

    A damaged file counts as missing: all stages run again, and the file is rebuilt.
    """
    return _sound(root) or RunResult(schema="bampipe.run/1", stages={})


def is_damaged(root: Path) -> bool:
    """Return whether ``root`` has a damaged ``run.json``."""
    return (root / FILE).exists() and _sound(root) is None


def _sound(root: Path) -> RunResult | None:
    try:
        return RunResult.read(root / FILE)
    except InputError:
        return None


def require_untouched(root: Path, names: Iterable[str]) -> None:
    """Compare results, paths in the run folder ``root``, with their hashes in ``run.json``.

    Missing and unrecorded files are ignored; the first one that was changed or damaged since it was
    written raises `InputError`.
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
    """Return the error for the result ``name``, which is not as ``step`` wrote it."""
    remedy = f"run `bampipe {step.partition(':')[0]}` again to rebuild it"
    return InputError(f"{name} was changed since {step} wrote it", where=str(root), remedy=remedy)


@contextlib.contextmanager
def lock(root: Path, wait: bool, listen: Listener = ignore_event) -> Iterator[None]:
    """Hold the run folder ``root``, creating it if needed; faults of the disk are `InputError`.

    Args:
        wait: whether to wait while another process holds it; otherwise refuse.
        listen: called before waiting, and if the last holder was killed.

    Raises:
        InputError: another process holds it and ``wait`` is false; or the disk is full, read-only
            or otherwise faulty.
    """

    def tell(kind: str) -> Callable[[str], None]:
        return lambda holder: listen(Event(root.name, "", kind, message=holder))

    private = root / PRIVATE
    try:
        private.mkdir(parents=True, exist_ok=True)
        with hold(private / "lock", wait, tell("waiting"), tell("taken over")):
            yield
    except FileNotFoundError as error:
        if private.exists():
            raise
        raise InputError("no folder can be made here", where=str(root)) from error
    except OSError as error:
        if error.errno not in STORAGE_FAULTS:
            raise
        raise InputError(
            STORAGE_FAULTS[error.errno],
            where=os.fspath(error.filename or root),
            remedy="earlier results are untouched",
        ) from error
