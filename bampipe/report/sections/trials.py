"""Data: the trials, what was repaired, what was set aside, how motions were differentiated."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from bampipe.lists import join_names
from bampipe.report import verdicts, wording
from bampipe.report.document import Block, Paragraph, Section, Table
from bampipe.report.results import Results
from bampipe.results.filter import FilterResult

_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
_BLANK = "\0"
"""Where a number was taken out."""
_LONG = 60
"""Letters from which a remark that several trials share stands below the table, once."""
_SAME_RATE = 0.02
"""Of the rate of the grid: a mean that differs by less is said to be the same."""


def section(results: Results) -> Section:
    """Return the section."""
    session = results.session
    blocks: list[Block] = [Paragraph(_sampling(results))]
    if session.notes:
        blocks.append(Paragraph(f"Notes: {session.notes.rstrip('.')}."))
    blocks.append(_trials(results))
    filtered = results.read(FilterResult)
    if filtered is None:
        blocks.append(
            Paragraph(
                "Velocities and accelerations have not been computed: "
                f"`bampipe filter {results.root.name}` does it."
            )
        )
    else:
        blocks += _filter(results, filtered)
    return Section("Data", tuple(blocks))


def _sampling(results: Results) -> str:
    session = results.session
    text = f"{_rates(results)}."
    if session.force.noise_sd:
        each = join_names(
            f"{name} {wording.significant(sd, 2)}" for name, sd in session.force.noise_sd.items()
        )
        text += f" Noise of a sample: {each} {wording.unit(session.force.unit)}."
    remarks = (*session.sensor_warnings, *(hum.sentence for hum in session.mains_hum))
    return " ".join([text, *(f"{line[:1].upper()}{line[1:]}." for line in remarks)])


def _rates(results: Results) -> str:
    """Return how fast was sampled on average, and the grid where that is another."""
    grid = results.session.sample_rate_hz
    read = results.trials[results.trials["n_samples"] > 1]
    rate = float(((read["n_samples"] - 1) / read["duration_s"]).median())
    if not math.isfinite(rate) or abs(rate - grid) <= _SAME_RATE * grid:
        return f"Sampled at {wording.plain(grid, 0)} Hz"
    return (
        f"Sampled at {wording.significant(rate)} Hz on average, put on a grid of "
        f"{wording.plain(grid, 0)} Hz when filtered"
    )


def _trials(results: Results) -> Table:
    records = results.trials.to_dict("records")
    remarks = {str(row["trial_id"]): _remarks(row) for row in records}
    shared = _shared(remarks)
    rows = []
    for row in records:
        own = remarks[str(row["trial_id"])]
        left = [text for text in own if _pattern(text) not in shared]
        rows.append(
            (
                str(row["trial_id"]),
                _kind(row),
                _duration(row["duration_s"]),
                str(int(row["n_samples"])) if row["n_samples"] else "–",
                _emphasised(str(row["status"])),
                "; ".join(left) or ("below" if own else "none"),
            )
        )
    return Table(
        "Trials",
        ("Trial", "Kind", "Duration (s)", "Samples", "State", "Repairs, reason"),
        tuple(rows),
        "llrrll",
        (0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        " ".join(_once(remarks, pattern) for pattern in shared),
    )


def _pattern(remark: str) -> str:
    """Return a remark without its numbers."""
    return _NUMBER.sub(_BLANK, remark)


def _shared(remarks: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the patterns of long remarks that hold for several trials."""
    found = Counter(_pattern(text) for own in remarks.values() for text in own if len(text) > _LONG)
    return [pattern for pattern, count in found.items() if count > 1]


def _once(remarks: Mapping[str, Sequence[str]], pattern: str) -> str:
    """Return a remark of several trials as one sentence: which trials, each number's range."""
    held = {
        trial: _NUMBER.findall(text)
        for trial, own in remarks.items()
        for text in own
        if _pattern(text) == pattern
    }
    columns = [sorted(set(numbers), key=float) for numbers in zip(*held.values(), strict=True)]
    shown = iter("–".join(dict.fromkeys((each[0], each[-1]))) for each in columns)
    which = "All trials" if len(held) == len(remarks) else f"Trials {join_names(held)}"
    return f"{which}: {re.sub(_BLANK, lambda _: next(shown), pattern)}."


def _emphasised(status: str) -> str:
    state = wording.trial_state(status)
    return f"**{state}**" if status == "set_aside" else state


def _kind(row: dict[Any, Any]) -> str:
    kind = str(row["kind"])
    axis, damping = row.get("locked_axis"), row.get("viscous_n_s_per_m")
    if kind == "locked" and isinstance(axis, str) and axis:
        return f"locked, {axis}"
    if kind == "viscous" and damping is not None and math.isfinite(damping):
        return f"viscous, {wording.significant(float(damping), 2)} N·s/m"
    return kind


def _duration(seconds: object) -> str:
    """Return seconds; a dash for a trial that was set aside before it was read."""
    if isinstance(seconds, float) and math.isfinite(seconds):
        return wording.plain(seconds, 1)
    return "–"


def _remarks(row: dict[Any, Any]) -> list[str]:
    """Return why a trial is in its state, and what was repaired, each remark by itself."""
    texts = (row.get("reason"), row.get("repairs"))
    return [part for text in texts if isinstance(text, str) and text for part in text.split("; ")]


def _filter(results: Results, filtered: FilterResult) -> list[Block]:
    rows = []
    for axis in verdicts.ordered(results, filtered.axes):
        entry = filtered.axes[axis]
        rows.append(
            (
                axis,
                wording.scaled(entry.resolution, entry.unit),
                wording.significant(entry.bandwidth_hz),
                wording.scaled(entry.position_sd, entry.unit),
                wording.scaled(entry.velocity_sd, f"{entry.unit}/s"),
                wording.scaled(entry.acceleration_sd, f"{entry.unit}/s2"),
            )
        )
    method = filtered.method
    names = {
        "kalman": "a Kalman smoother",
        "butterworth": "a zero-phase Butterworth filter",
        "savitzky_golay": "a Savitzky-Golay filter",
        "savitzky-golay": "a Savitzky-Golay filter",
    }
    text = f"Velocity and acceleration come from {names.get(method, method)}"
    blocks: list[Block] = [Paragraph(f"{text} ({filtered.method_reason}).")]
    if filtered.skipped:
        skipped = "; ".join(f"{name}: {reason}" for name, reason in filtered.skipped.items())
        blocks.append(Paragraph(f"Not differentiated: {skipped}."))
    if filtered.disturbances:
        blocks.append(
            Table(
                "Stretches that no estimate and no error counts",
                ("Trial", "Time (s)", "Why"),
                tuple(
                    (name, f"{one.start_s:.1f} to {one.end_s:.1f}", one.reason)
                    for name, stretches in filtered.disturbances.items()
                    for one in stretches
                ),
                "lll",
                (1.0, 1.0, 6.0),
            )
        )
    if rows:
        blocks.append(
            Table(
                "Encoders and the motion derived from them: typical standard deviations of error",
                (
                    "Axis",
                    "Resolution",
                    "Bandwidth (Hz)",
                    "Position",
                    "Velocity",
                    "Acceleration",
                ),
                tuple(rows),
                "lrrrrr",
                (0.0, 1.0, 1.0, 1.0, 1.0, 1.0),
            )
        )
    return blocks
