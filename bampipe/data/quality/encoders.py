"""Encoder readings: whole counts, no wraps, no jumps; and motion as the kind of trial has it."""

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import median_filter

from bampipe.arrays import Array, Indices
from bampipe.data.quality.channels import fill_missing, take_out
from bampipe.data.quality.table import TrialTable, in_times
from bampipe.data.session.channels import Encoder
from bampipe.lists import count_noun

FASTEST = {"rad": 20.0, "m": 4.0}
"""Speed below which a step is never taken for a wild reading, rad/s and m/s."""

VELOCITY_RATIO = 1.5
"""A recorded velocity further than this factor from the change of position is in another unit."""
_WINDOW_S = 0.1
"""Length of the stretches over which the two are compared, s: neither noise nor lag counts much."""


def refuse_fractions(table: TrialTable, encoder: Encoder) -> None:
    """Counts are whole numbers."""
    if not encoder.counts:
        return
    values = table.columns[encoder.column]
    fractions = np.isfinite(values) & (values != np.rint(values))
    table.refuse("fractions", encoder.column, values, fractions)


def integrate(table: TrialTable, encoder: Encoder) -> None:
    """Take the integral of a velocity, by trapezia from 0, for the position that was not recorded.

    What a constant error of the velocity adds grows with time, which only terms in the position
    itself, such as a spring, can feel.
    """
    if not encoder.integrate:
        return
    rate = table.columns[encoder.column]
    table.columns[encoder.column] = cumulative_trapezoid(rate, table.t, initial=0.0)
    table.notes.append(f"position is the integral of the velocity '{encoder.column}', from 0")


def unwrap(table: TrialTable, encoder: Encoder) -> None:
    """Undo the wrap-around of a counter, or of an angle at a full turn."""
    values = table.columns[encoder.column]
    # A counter in steps of its unit, such as 0.01 mm, has bits, too.
    counts = encoder.counts or np.array_equal(values, np.rint(values), equal_nan=True)
    if encoder.integrate or (encoder.unit == "m" and not counts):
        return
    turn = 2 * np.pi / abs(encoder.raw_scale) if encoder.unit == "rad" else 0.0
    found, rows, words = unwrapped(values, turn, counts, encoder.zero)
    if len(rows):
        table.columns[encoder.column] = found
        spans = [float(np.nanmax(x) - np.nanmin(x)) for x in (found, values)]
        far = encoder.counts and spans[0] > spans[1]
        table.repairs.append(
            f"column '{encoder.column}' wraps {words} {in_times(len(rows))},"
            f" first at row {table.rows[rows[0]]}: unwrapped"
            + ("; a trial begun in another turn of it has another zero" if far else "")
        )


def unwrapped(
    values: Array, turn: float, counts: bool, zero: float = 0.0
) -> tuple[Array, Indices, str]:
    """Readings that go on where they start anew: after full turns, or at the bits of a counter.

    A motion within one turn of a counter is placed in the turn around ``zero``, like the value of a
    signed register. Motors whose protocol covers +-12.5 rad (the Mini Cheetah's) wrap as well.

    Args:
        values: (T,) raw readings, NaN where missing.
        turn: raw units of a full turn, 0 where none is known.
        counts: whether they may wrap at the 10 to 32 bits of a counter.

    Returns:
        Readings (T,), the samples before which one wraps, and where it does in words.
    """
    known = np.flatnonzero(np.isfinite(values))
    steps = np.diff(values[known])
    periods = [(2.0**bits, f"at {bits} bits") for bits in range(10, 33)] if counts else []
    ranges = {"a full turn": 1.0, "two turns": 2.0, "25 rad": 12.5 / np.pi, "four turns": 4.0}
    periods += [(turn * number, f"at {words}") for words, number in ranges.items() if turn]
    for period, words in periods:
        wraps = np.abs(steps) > period / 2
        near = np.abs(np.abs(steps) - period) < period / 16
        if wraps.any() and near[wraps].all() and np.ptp(values[known]) <= period:
            found = values.copy()
            found[known[1:]] -= period * np.cumsum(np.where(wraps, np.sign(steps), 0.0))
            low, high = np.nanmin(found), np.nanmax(found)
            if high - low <= period:
                found -= period * np.rint((0.5 * (low + high) - zero) / period)
            return found, (known[np.flatnonzero(wraps) + 1]).astype(np.int64), words
    return values, np.empty(0, dtype=np.int64), ""


def interpolate_jumps(table: TrialTable, encoder: Encoder) -> None:
    """Interpolate isolated wild readings; refuse a lasting jump (lost counts, a reset).

    A step is wild when it is 20 times what all but one step in twenty stay below, and faster
    than any of these axes can go; where samples are missing, it is that of each of them.
    """
    values = table.columns[encoder.column]
    if len(table) <= 2 * table.limits.nan_run:
        return
    usual = float(np.median(np.diff(table.t)))
    spanned = np.maximum(np.diff(table.t) / usual, 1.0)
    steps = np.abs(np.diff(values)) / spanned
    fastest = FASTEST[encoder.unit] * usual / encoder.scale
    limit = max(20 * float(np.quantile(steps, 0.95)), abs(fastest))
    jumps = np.flatnonzero(steps > limit)
    if len(jumps) == 0:
        return
    run, total = table.limits.nan_run, len(table)
    level = median_filter(values, 2 * run + 1, mode="nearest")
    level[:run], level[total - run :] = level[run], level[total - run - 1]
    wild = np.abs(values - level) > limit
    lasting = np.flatnonzero(np.abs(np.diff(level)) / spanned > limit)
    if len(lasting) or wild.sum() > table.limits.nan_share * total:
        at = int(lasting[0] if len(lasting) else jumps[0])
        size = abs(values[at + 1] - values[at]) * abs(encoder.scale)
        of = {"size": size, "unit": encoder.unit, "times": in_times(len(jumps))}
        raise table.fault("jumps", encoder.column, at + 1, **of, t=table.t[at + 1])
    take_out(table, encoder.column, wild)
    fill_missing(table)


def check_velocity(table: TrialTable, encoder: Encoder) -> None:
    """Refuse an axis whose recorded velocity is in another unit, or of another sign."""
    if encoder.velocity is None:
        return
    speed = table.columns.pop(encoder.velocity.column) * encoder.velocity.scale
    position = (table.columns[encoder.column] - encoder.zero) * encoder.scale
    # Distances over short stretches: as moved, and as expected by the velocity.
    every = max(1, round(_WINDOW_S / float(np.median(np.diff(table.t)))))
    reached = cumulative_trapezoid(speed, table.t, initial=0.0)
    moved, expected = (np.diff(x[::every]) for x in (position, reached))
    size = float(moved @ moved), float(expected @ expected)
    if len(moved) < 10 or not all(size):
        return
    product = float(moved @ expected)
    ratio, correlation = product / size[0], product / float(np.sqrt(size[0] * size[1]))
    column = encoder.velocity.column
    if abs(correlation) < 0.9:
        table.notes.append(
            f"column '{column}' is not the velocity of {encoder.name} by its position"
            f" (correlation {correlation:.2f}); it is not used"
        )
        return
    if not 1 / VELOCITY_RATIO < ratio < VELOCITY_RATIO:
        raise table.fault("other_velocity", column, ratio=ratio, position=encoder.column)
    if not 0.95 < ratio < 1.05:
        table.notes.append(f"'{column}' is {ratio:.3g} times the change of '{encoder.column}'")


def refuse_wrong_motion(table: TrialTable, columns: dict[str, np.ndarray]) -> None:
    """A free trial moves; a locked axis winds up, but stays."""
    session, limits, entry = table.session, table.limits, table.entry
    travel = {e.name: float(np.ptp(columns[f"q_{e.name}"])) for e in session.encoders}
    still = {"rad": limits.still_rad, "m": limits.still_m}
    if entry.kind != "locked":
        if all(travel[e.name] < still[e.unit] for e in session.encoders):
            shown = ", ".join(f"{e.name} {travel[e.name]:.2g} {e.unit}" for e in session.encoders)
            raise table.fault("never_moves", kind=entry.kind, shown=shown)
        for encoder in session.encoders:
            if travel[encoder.name] == 0.0:
                if not limits.held_axes:
                    raise table.fault("axis_frozen", encoder.column)
                said = "never changes while other axes move"
                table.notes.append(f"column '{encoder.column}' {said}: is {encoder.name} held?")
        return
    encoder = next(e for e in session.encoders if e.name == entry.locked_axis)
    most = {"rad": limits.locked_rad, "m": limits.locked_m}[encoder.unit]
    moved = travel[encoder.name]
    if moved > most:
        of = {"axis": encoder.name, "moved": moved, "unit": encoder.unit, "most": most}
        raise table.fault("locked_moves", encoder.column, **of)
    if encoder.resolution is not None and moved < (limits.locked_steps - 0.5) * encoder.resolution:
        steps = count_noun(round(moved / encoder.resolution), "encoder step")
        raise table.fault("locked_still", encoder.column, axis=encoder.name, steps=steps)


def refuse_wrong_brakes(table: TrialTable, columns: dict[str, np.ndarray]) -> None:
    """A free trial has its brakes off, a viscous one has them on, and recorded."""
    entry, brakes = table.entry, table.session.brakes
    highest = {b.axis: float(np.abs(columns[f"brake_{b.axis}"]).max()) for b in brakes}
    for brake in brakes:
        if entry.kind == "free" and highest[brake.axis] > table.limits.brake_on:
            of = {"highest": highest[brake.axis], "unit": brake.unit}
            raise table.fault("free_braked", brake.column, **of)
        if brake.axis == entry.locked_axis and highest[brake.axis] == 0.0:
            table.notes.append(f"brake of the locked axis {brake.axis} is never commanded")
    if entry.kind == "viscous" and not brakes:
        raise table.fault("no_commands")
    if entry.kind == "viscous" and not any(highest.values()):
        raise table.fault("never_commanded")
