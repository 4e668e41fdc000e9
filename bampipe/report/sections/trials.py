"""Data: the trials, their repairs, those set aside, and how the motion was differentiated."""

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

from bampipe.lists import join_names
from bampipe.phrases import results as phrases
from bampipe.report.document import Block, Table
from bampipe.report.run_results import Results
from bampipe.report.wording import (
    format_decimals,
    format_digits,
    format_scaled,
    format_unit,
    name_trial_state,
)
from bampipe.results.filter import FilterResult

TITLE = "Data"
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
_BLANK = "\0"
"""Placeholder of a number in a remark."""
_blank_numbers = partial(_NUMBER.sub, _BLANK)
_LONG = 60
"""Length from which a remark shared by several trials is printed once, below the table."""
_SAME_RATE = 0.02
"""Largest relative difference between a mean rate and the grid's for which they are the same."""


def list_blocks(results: Results) -> Iterator[Block]:
    """Yield sampling, trials, and the differentiated motion."""
    notes = results.session.notes.rstrip(".")
    yield _describe_sampling(results)
    yield f"Notes: {notes}." if notes else ""
    yield _tabulate_trials(results)
    filtered = results.read(FilterResult)
    if filtered is None:
        yield results.state_undone("Velocities and accelerations have not been computed", "filter")
        return
    method = phrases.FILTERS.get(filtered.method, filtered.method)
    yield f"Velocity and acceleration come from {method} ({filtered.method_reason})."
    skipped = "; ".join(f"{name}: {reason}" for name, reason in filtered.skipped.items())
    yield f"Not differentiated: {skipped}." if skipped else ""
    stretches = [
        (name, f"{one.start_s:.1f} to {one.end_s:.1f}", one.reason)
        for name, found in filtered.disturbances.items()
        for one in found
    ]
    title = "Stretches that no estimate and no error uses"
    yield Table(title, "Trial ~1 | Time (s) ~1 | Why ~6", stretches)
    rows = []
    for axis, one in results.order_axes(filtered.axes).items():
        sds = ((one.position_sd, ""), (one.velocity_sd, "/s"), (one.acceleration_sd, "/s2"))
        shown = (format_scaled(sd, one.unit + per) for sd, per in sds)
        rows.append((axis, format_scaled(one.resolution, one.unit), one.bandwidth_hz, *shown))
    yield Table(
        "Encoders and the motion derived from them: typical standard deviations of error",
        "Axis | >Resolution ~1 | >Bandwidth (Hz) ~1 | >Position ~1 | >Velocity ~1"
        " | >Acceleration ~1",
        rows,
    )


def _describe_sampling(results: Results) -> str:
    session = results.session
    grid = session.sample_rate_hz
    read = results.trials[results.trials["n_samples"] > 1]
    rate = float(((read["n_samples"] - 1) / read["duration_s"]).median())
    text = f"{format_decimals(grid, 0)} Hz"
    if math.isfinite(rate) and abs(rate - grid) > _SAME_RATE * grid:
        text = f"{format_digits(rate)} Hz on average, put on a grid of {text} when filtered"
    thinned = f", thinned from {format_digits(session.announced_rate_hz)} Hz"
    text = f"Sampled at {text}{thinned * (session.kept_every > 1)}."
    if noise := session.force.noise_sd:
        each = join_names(f"{name} {format_digits(sd, 2)}" for name, sd in noise.items())
        text += f" Noise of a sample: {each} {format_unit(session.force.unit)}."
    remarks = (*session.sensor_warnings, *map(phrases.describe_hum, session.mains_hum))
    return " ".join([text, *(f"{line[:1].upper()}{line[1:]}." for line in remarks)])


def _tabulate_trials(results: Results) -> Table:
    records = results.trials.to_dict("records")
    # The reason of a trial's state and its repairs, each remark by itself.
    remarks = {
        str(row["trial_id"]): [
            part
            for text in (row.get("reason"), row.get("repairs"))
            if isinstance(text, str) and text
            for part in text.split("; ")
        ]
        for row in records
    }
    counts = Counter(
        _blank_numbers(text) for own in remarks.values() for text in own if len(text) > _LONG
    )
    shared = [pattern for pattern, count in counts.items() if count > 1]
    rows = []
    for row in records:
        own = remarks[str(row["trial_id"])]
        left = [text for text in own if _blank_numbers(text) not in shared]
        state, seconds = name_trial_state(str(row["status"])), row["duration_s"]
        # A trial that was set aside before it was read has no duration.
        is_known = isinstance(seconds, float) and math.isfinite(seconds)
        duration = format_decimals(seconds, 1) if is_known else None
        count = str(int(row["n_samples"])) if row["n_samples"] else None
        state = f"**{state}**" if row["status"] == "set_aside" else state
        said = "; ".join(left) or ("below" if own else "none")
        rows.append((str(row["trial_id"]), _describe_kind(row), duration, count, state, said))
    columns = "Trial | Kind | >Duration (s) | >Samples | State | Repairs, reason ~1"
    note = " ".join(_merge_remarks(remarks, pattern) for pattern in shared)
    return Table("Trials", columns, rows, note)


def _merge_remarks(remarks: Mapping[str, Sequence[str]], pattern: str) -> str:
    """Return a remark of several trials as one sentence: which trials, each number's range."""
    found = {
        trial: _NUMBER.findall(text)
        for trial, own in remarks.items()
        for text in own
        if _blank_numbers(text) == pattern
    }
    columns = [sorted(set(numbers), key=float) for numbers in zip(*found.values(), strict=True)]
    shown = iter("–".join(dict.fromkeys((each[0], each[-1]))) for each in columns)
    which = "All trials" if len(found) == len(remarks) else f"Trials {join_names(found)}"
    return f"{which}: {re.sub(_BLANK, lambda _: next(shown), pattern)}."


def _describe_kind(row: dict[Any, Any]) -> str:
    kind = str(row["kind"])
    axis, damping = row.get("locked_axis"), row.get("viscous_n_s_per_m")
    if kind == "locked" and isinstance(axis, str) and axis:
        return f"locked, {axis}"
    if kind == "viscous" and damping is not None and math.isfinite(damping):
        return f"viscous, {format_digits(float(damping), 2)} N·s/m"
    return kind
