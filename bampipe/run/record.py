"""``run.json``, the record of inputs, settings and results of every step; and the run's lock."""

from collections.abc import Iterable
from contextlib import AbstractContextManager
from pathlib import Path

from bampipe.errors import InputError
from bampipe.files import digest_file
from bampipe.results.run import PRIVATE, RunResult
from bampipe.run.events import Event, Listener, ignore_event
from bampipe.run.lock import hold

FILE = RunResult.FILE


def find_folder(name: str | Path, runs: Path) -> Path | None:
    """Return the run folder: a bare name is first of all one in ``runs``, anything else a path."""
    path = Path(name)
    places = (runs / path, path) if path.name == str(name) else (path, runs / path)
    return next((place for place in places if (place / FILE).is_file()), None)


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


def lock(root: Path, wait: bool, listen: Listener = ignore_event) -> AbstractContextManager[None]:
    """Hold the run folder ``root``, as `hold` does; ``listen`` hears of other holders."""

    def tell(kind: str, holder: str) -> None:
        listen(Event(root.name, "", kind, message=holder))

    return hold(root, f"{PRIVATE}/lock", wait, tell)
