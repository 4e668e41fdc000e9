"""Collect the runs of a lab: tables, trends and a report, from all stages that have run."""

import os
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import quote

from bampipe.data import lab_tables
from bampipe.errors import InputError
from bampipe.lab import rows
from bampipe.lab.folders import LOCK, is_foreign, run_folders
from bampipe.lab.trends import build_trends
from bampipe.progress import Progress, silent
from bampipe.results.lab import LabResult, TrendsResult
from bampipe.run.lock import hold

_EARLIEST = datetime.min.replace(tzinfo=UTC)


def collect(
    runs: Path, folder: Path, progress: Progress = silent
) -> tuple[TrendsResult, LabResult]:
    """Read every run in ``runs`` and write the lab's folder anew.

    A run that cannot be read is left out and named. Every file is replaced whole; ``lab.json``
    comes last. Returns the content of ``trends.json`` and of ``lab.json``.

    Raises:
        InputError: there is no run in ``runs``, or a file cannot be written.
    """
    roots = run_folders(runs)
    if not roots:
        raise InputError(f"no run in {runs}", remedy="start with `bampipe run 'sessions/*'`")
    found = []
    skipped: list[str] = []
    for number, root in enumerate(roots):
        progress(0.6 * number / len(roots), root.name)
        try:
            found.append(rows.read_run(root))
        except InputError as error:
            skipped.append(f"{root.name}: {error}")
    if not found:
        raise InputError(f"no run in {runs} has completed ingest", remedy=skipped[0])
    # Sessions of the same moment stay in the order of their names.
    found.sort(key=lambda one: one["sessions"][0]["recorded_at"] or _EARLIEST)
    tables = {name: [row for one in found for row in one[name]] for name in lab_tables.TABLES}
    content = build_trends(tables)
    if is_foreign(folder):
        raise InputError(
            "holds other files", where=str(folder), remedy="choose another folder with --out"
        )
    with hold(folder, LOCK):  # simultaneous collections take turns
        counts = lab_tables.write(folder, tables)
        content.write(folder)
        progress(0.7, "report")
        # matplotlib is slow to import: only here
        from bampipe.report.lab_report import build_lab_report

        # The folders of the sessions' reports, relative to the lab's.
        reports = {root.name: root.resolve() / "report" for root in roots}
        pages = {
            name: quote(os.path.relpath(report, folder.resolve()).replace(os.sep, "/"))
            for name, report in reports.items()
            if (report / "explore.html").is_file()
        }
        made = build_lab_report(folder, pages)
        made.write(folder)
        for old in (folder / "figures").glob("*.svg"):
            if old.stem not in made.figures:
                old.unlink()
        sessions = tuple(row["session_id"] for row in tables["sessions"])
        lab = LabResult(
            schema="bampipe.lab/1", sessions=sessions, skipped=tuple(skipped), tables=counts
        )
        lab.write(folder)
    return content, lab
