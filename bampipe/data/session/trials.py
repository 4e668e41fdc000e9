"""The list of trials in a session file."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any

from bampipe.data.session.places import lexically_inside
from bampipe.data.session.records import Encoder, TrialEntry
from bampipe.errors import InputError, did_you_mean


def trials_from(
    entries: list[Mapping[str, Any]], encoders: tuple[Encoder, ...], where: str
) -> tuple[TrialEntry, ...]:
    """The ``[[trials]]``, with a distinct name for each.

    Raises:
        InputError: a path outside the session, an axis that is none, stretches that overlap, or
            nothing left to identify from.
    """
    axes = [encoder.axis for encoder in encoders]
    for number, entry in enumerate(entries):
        place = f"{where}: trials[{number}]"
        lexically_inside(entry["file"], where=f"{place}.file")
        kind, axis = entry["kind"], entry.get("locked_axis")
        for key, only in (("locked_axis", "locked"), ("viscous_n_s_per_m", "viscous")):
            if key in entry and kind != only:
                raise InputError(
                    f'given for a "{kind}" trial',
                    where=f"{place}.{key}",
                    remedy=f'only for "{only}"',
                )
        if axis is not None and axis not in axes:
            raise InputError(
                f"no axis '{axis}'{did_you_mean(axis, axes)}",
                where=f"{place}.locked_axis",
                remedy=f"the axes are {', '.join(axes)}",
            )
    files = [PurePosixPath(entry["file"]).as_posix() for entry in entries]
    ids = _trial_ids(files)
    trials = tuple(
        TrialEntry(
            trial_id=trial_id,
            file=file,
            kind=entry["kind"],
            locked_axis=entry.get("locked_axis"),
            viscous=None if "viscous_n_s_per_m" not in entry else float(entry["viscous_n_s_per_m"]),
            start_s=float(entry.get("start_s", 0.0)),
            end_s=float(entry.get("end_s", math.inf)),
            hold_out=entry.get("hold_out", False),
        )
        for trial_id, file, entry in zip(ids, files, entries, strict=True)
    )
    _refuse_bad_stretches(trials, where)
    if all(trial.hold_out for trial in trials if trial.kind == "free") and any(
        trial.hold_out for trial in trials
    ):
        raise InputError(
            "every free trial is held out: nothing is left to identify from",
            where=f"{where}: trials",
            remedy="leave hold_out away from some",
        )
    return trials


def _refuse_bad_stretches(trials: tuple[TrialEntry, ...], where: str) -> None:
    """Raise InputError for an empty stretch, or for stretches of one file that overlap.

    The same file twice without stretches is left to ingest, which uses it once and says so.
    """
    for number, trial in enumerate(trials):
        place = f"{where}: trials[{number}]"
        if not trial.start_s < trial.end_s:
            raise InputError(
                f"found {trial.end_s:g}, expected more than start_s = {trial.start_s:g}",
                where=f"{place}.end_s",
            )
        for other in trials[:number]:
            whole = (trial.start_s, trial.end_s) == (other.start_s, other.end_s) == (0.0, math.inf)
            if other.file == trial.file and other.overlaps(trial) and not whole:
                raise InputError(
                    f"overlaps trial {other.trial_id} of the same file",
                    where=place,
                    remedy="give each stretch its own start_s and end_s: held-out samples must"
                    " not be in another trial",
                )


def _trial_ids(files: list[str]) -> list[str]:
    """Distinct short names: the stem, else the whole path, else the path and a number."""
    stems = Counter(PurePosixPath(file).stem for file in set(files))
    seen: Counter[str] = Counter()
    ids = []
    for file in files:
        stem = PurePosixPath(file).stem
        name = stem if stems[stem] == 1 else file.replace("/", "_").replace(".", "_")
        seen[name] += 1
        ids.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return ids
