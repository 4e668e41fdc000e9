"""The trials of a session: each read from its log and cleaned, copies of one another refused."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bampipe.data.quality import CleaningLimits, CleanTrial, clean
from bampipe.data.recording import read_recording
from bampipe.data.session import SECONDS, Session, TrialEntry, inside
from bampipe.errors import InputError
from bampipe.files import digest_file


def find_copies(session: Session) -> list[str]:
    """Why each trial is refused as the same file or content as another, or ''."""
    same: dict[str, list[int]] = defaultdict(list)
    for number, entry in enumerate(session.trials):
        try:
            path = inside(session.root, entry.file, where="")
        except InputError:
            continue  # said when the trial's turn comes
        if path.stat().st_size > 0:
            same[digest_file(path)].append(number)
    reasons = [""] * len(session.trials)
    for alike_files in same.values():
        numbers = [
            n
            for n in alike_files
            if any(session.trials[n].overlaps(session.trials[m]) for m in alike_files if m != n)
        ]
        entries = [session.trials[number] for number in numbers]
        alike = len({(entry.kind, entry.locked_axis, entry.viscous) for entry in entries}) == 1
        for number in numbers[1:] if alike else numbers if len(numbers) > 1 else []:
            entry = session.trials[number]
            other = next(e for e in entries if e is not entry)
            what = "file" if other.file == entry.file else "content"
            reasons[number] = f"the same {what} as trial {other.trial_id}" + (
                ": used once" if alike else f", which is declared {other.kind}"
            )
    return reasons


def describe_spans(spans: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Sentences on trials in which an axis goes as much farther as another unit would make it.

    Args:
        spans: what each axis covers, by name of the trial and of the axis.
    """
    said = []
    for name, own in spans.items():
        for axis, span in own.items():
            others = [other[axis] for trial, other in spans.items() if trial != name]
            ratio = span / max(float(np.median(others)), 1e-300) if len(others) > 1 else 1.0
            size = max(ratio, 1.0 / max(ratio, 1e-300))
            if any(low < size < 2.0 * low for low in (40.0, 700.0)):
                much = (
                    f"{ratio:.3g} times as far as" if ratio > 1.0 else f"{size:.3g} times less than"
                )
                said.append(
                    f"{name}: {axis} goes {much} in the others: is it logged in another unit?"
                )
    return said


def read_sound_trial(
    session: Session, entry: TrialEntry, limits: CleaningLimits, largest_bytes: int
) -> CleanTrial:
    """One sound trial in SI units.

    Args:
        session: what its columns mean; entry: what kind of trial it is.
        limits: what counts as sound; largest_bytes: what it may take in memory.

    Raises:
        InputError: the trial is to be set aside, with the reason.
    """
    clock = session.clock
    raw = read_recording(
        session.root, entry, session.columns, clock, session.dialect, largest_bytes
    )
    if clock.nanoseconds:
        columns = dict(raw.columns)
        seconds, nanoseconds = columns[clock.column], columns.pop(clock.nanoseconds)
        # Seconds since 1970 leave no room for nanoseconds in a double: the first goes first.
        columns[clock.column] = seconds - np.fmin.reduce(seconds) + SECONDS["ns"] * nanoseconds
        raw = replace(raw, columns=columns)
    if not clock.column:
        count = len(raw.columns[session.columns[0]])
        note = f"no time stamps: samples counted at {session.sample_rate:g} Hz"
        raw = replace(
            raw,
            columns={clock.column: np.arange(count, dtype=float), **raw.columns},
            remarks=(*raw.remarks, note),
        )
    return clean(raw, session, entry, limits)
