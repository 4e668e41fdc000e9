"""Resolution of arguments to sessions and runs."""

import glob
from collections.abc import Sequence
from pathlib import Path

from bampipe.errors import InputError, choose_from
from bampipe.run.session_name import session_folder, session_id

_FIRST = "start with `bampipe run SESSION`"


def find_run(argument: str | None, runs: Path) -> Path:
    """Return the run folder that ``argument`` means.

    Args:
        argument: the name of a run in ``runs``, which goes before a folder of that name in the
            current directory; the path of a run folder; or a session that was run. None for the
            most recent run.
        runs: the folder of runs.

    Raises:
        InputError: there is no such run.
    """
    from bampipe.run import record

    files = sorted(runs.glob(f"*/{record.FILE}"), key=lambda file: -file.stat().st_mtime_ns)
    known = [file.parent for file in files]
    if argument is None:
        if not known:
            raise InputError(f"no run yet in {runs}", remedy=_FIRST)
        return known[0]
    if root := record.find_folder(argument, runs):
        return root
    folder = session_folder(argument)
    if not (folder / "session.toml").is_file():
        remedy = choose_from(argument, [root.name for root in known]) or _FIRST
        raise InputError(f"no run {argument!r}", where=str(runs), remedy=remedy)
    root = runs / session_id(folder)
    if not (root / record.FILE).is_file():
        raise InputError(
            "this session has not been run", where=str(folder), remedy=f"`bampipe run {folder}`"
        )
    return root


def find_sessions(arguments: Sequence[str]) -> list[Path]:
    """Return the session folders that ``arguments`` mean, patterns expanded, each once.

    A folder that a pattern finds counts only if it holds a session; a pattern without is refused.
    """
    found: list[Path] = []
    for argument in (str(session_folder(name)) for name in arguments):
        if Path(argument).exists() or not glob.has_magic(argument):
            found.append(Path(argument))
            continue
        matches = [Path(name) for name in sorted(glob.glob(argument))]
        sessions = [path for path in matches if (path / "session.toml").is_file()]
        if not sessions:
            raise InputError("no session matches", where=argument)
        found += sessions
    unique = {path.resolve(): path for path in reversed(found)}
    return list(reversed(unique.values()))


def next_to(path: Path, runs: Path) -> str:
    """Return how to name the run ``path`` in the next command."""
    return path.name if path.parent == runs and runs == Path("runs") else str(path)
