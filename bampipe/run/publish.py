"""Publication of finished runs on any file system that fsspec knows.

Examples are object stores, HDFS, SFTP and plain folders. Object stores lack the renames and locks
that a run needs while it is made, so it is made in a local or shared folder and published whole:

    <url>/<session>/<version>/...     every file of the run; a version is named by its content
    <url>/<session>/current.json      the current version, and the hash of each of its files

``current.json`` is written last, in one piece. A reader therefore sees the old version or the new
one, never a mixture; an interrupted upload is invisible, and the next one completes it. Older
versions are kept, because somebody may be reading them. Any refusal by fsspec, by the driver of a
file system or by the place itself is an `InputError`.
"""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bampipe.data.run_folder import RunFolder
from bampipe.errors import InputError, choose_from
from bampipe.files import digest_content, digest_file, json_text, parse_json
from bampipe.results.run import PRIVATE, Published
from bampipe.run.session_name import is_name
from bampipe.schema import read

SCHEMA = "bampipe.published/1"
CURRENT = "current.json"


def publish(root: Path, url: str) -> str:
    """Publish the run folder ``root`` below ``url``; return the version.

    No other process may use it. A complete version that exists already is not sent again.

    Args:
        url: a folder as fsspec names it, such as ``s3://bucket/runs`` or ``file:///mnt/runs``.
    """
    names = RunFolder(root).glob("**/*")
    files = {name: root / name for name in names if name.partition("/")[0] != PRIVATE}
    hashes = {name: digest_file(path) for name, path in files.items()}
    version = digest_content(hashes)[:16]
    system, base = open_place(url)
    here = f"{base}/{root.name}"
    with _driver("cannot be published", url):
        current = _current(system, here)
        if current is not None and current.version == version:
            return version
        for name, path in files.items():
            target = f"{here}/{version}/{name}"
            if not system.exists(target) or system.size(target) != path.stat().st_size:
                system.makedirs(target.rpartition("/")[0], exist_ok=True)
                system.put_file(str(path), target)
        content = {"schema": SCHEMA, "session": root.name, "version": version, "files": hashes}
        # The transaction renames or completes the upload: no half-written file is ever seen.
        with system.transaction, system.open(f"{here}/{CURRENT}", "wb") as stream:
            stream.write(json_text(content).encode())
    return version


def published(url: str) -> list[str]:
    """Return the names of the sessions published below ``url``, sorted."""
    system, base = open_place(url)
    with _driver("cannot be read", url):
        if not system.exists(base):
            return []
        system.invalidate_cache()
        names = [str(path).rstrip("/").rpartition("/")[2] for path in system.ls(base, detail=False)]
        # Other names are not sessions of bampipe, and ".." would lead out of the folder.
        sessions = [name for name in names if is_name(name)]
        return sorted(name for name in sessions if system.exists(f"{base}/{name}/{CURRENT}"))


def fetch(url: str, session: str, runs: Path, force: bool = False) -> Path:
    """Fetch the published run of ``session`` into the folder ``runs``; return its run folder.

    Every file is checked by its hash. ``force`` replaces a run folder with other content.

    Raises:
        InputError: nothing is published, a file does not match its hash, or there is another run.
    """
    system, base = open_place(url)
    here, root = f"{base}/{session}", runs / session
    with _driver("cannot be fetched", url):
        current = _current(system, here)
        if current is None:
            remedy = choose_from(session, published(url))
            raise InputError(f"no session {session!r} is published", where=url, remedy=remedy)
        stored = ((root / name, known) for name, known in current.files.items())
        if root.exists() and all(p.is_file() and digest_file(p) == known for p, known in stored):
            return root
        if root.exists() and not force:
            raise InputError(
                "there is another run of this session",
                where=str(root),
                remedy="fetch into another folder with --runs, or replace it with --force",
            )
        runs.mkdir(parents=True, exist_ok=True)
        draft, old = (runs / f".{session}.{os.getpid()}.{word}" for word in ("new", "old"))
        draft.mkdir()
        try:
            for name, known in current.files.items():
                source, target = f"{here}/{current.version}/{name}", draft / name
                target.parent.mkdir(parents=True, exist_ok=True)
                system.get_file(source, str(target))
                if digest_file(target) != known:
                    raise InputError(f"{name} is not as it was published", where=f"{url}/{session}")
            if root.exists():
                root.replace(old)
                draft.replace(root)
                shutil.rmtree(old)
            else:
                draft.replace(root)
        finally:
            shutil.rmtree(draft, ignore_errors=True)
    return root


def open_place(url: str) -> tuple[Any, str]:
    """Return the file system and the path on it; an impossible place raises `InputError`."""
    from bampipe.data.readers.trial import need

    fsspec = need("fsspec.core", "remote")
    with _driver("no such file system", url):
        system, path = fsspec.url_to_fs(url)
    return system, str(path).rstrip("/")


@contextlib.contextmanager
def _driver(what: str, url: str) -> Iterator[None]:
    """Turn any exception of an fsspec driver into one line, since each driver has its own."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        first_line = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{what}: {first_line}", where=url) from error


def _current(system: Any, here: str) -> Published | None:
    place = f"{here}/{CURRENT}"
    try:
        system.invalidate_cache(here)
        return read(Published, parse_json(system.cat_file(place), place), place)
    except FileNotFoundError:
        return None
