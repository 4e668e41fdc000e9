"""The place of a lab's folder, and whether it is up to date."""

from pathlib import Path

from bampipe.errors import InputError
from bampipe.results.lab import LabResult
from bampipe.run import record

LOCK = ".lock"


def lab_folder(runs: Path) -> Path:
    """Return the lab's folder for a folder of runs: ``lab`` next to it."""
    return runs.resolve().parent / "lab" if runs.name in ("", "..") else runs.parent / "lab"


def run_folders(runs: Path) -> list[Path]:
    """Return the run folders in ``runs``, by name."""
    return sorted(path.parent for path in runs.glob(f"*/{record.FILE}"))


def is_foreign(folder: Path) -> bool:
    """Return whether ``folder`` holds files other than a lab's, which must not be replaced."""
    return folder.is_dir() and not (folder / LOCK).exists() and any(folder.iterdir())


def is_current(runs: Path, folder: Path) -> bool:
    """Return whether ``folder`` holds all runs in ``runs``, none of them younger."""
    about = folder / LabResult.FILE
    if not about.is_file():
        return False
    written = about.stat().st_mtime_ns
    roots = run_folders(runs)
    if any((root / record.FILE).stat().st_mtime_ns > written for root in roots):
        return False
    try:
        lab = LabResult.read(about)
    except InputError:
        return False
    known = [*lab.sessions, *(line.split(":")[0] for line in lab.skipped)]
    return sorted(known) == sorted(root.name for root in roots)
