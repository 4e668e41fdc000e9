"""Set-up mistakes in words: what is wrong, what to write instead, and what speaks for it."""

from __future__ import annotations

import math

from bampipe.lists import join_names
from bampipe.physics import System
from bampipe.results.ingest import IngestResult
from bampipe.setup.hypotheses import Correction
from bampipe.setup.plausibility import Plausibility, distance_from_prior


def describe_correction(correction: Correction, session: IngestResult) -> str:
    """One sentence without a full stop: the mistake, a colon, what to write in session.toml."""
    if correction.kind == "clock":
        return _clock(correction, session)
    if correction.change.gravity is not None:
        shown = ", ".join(f"{v:.4g}" for v in correction.change.gravity)
        return (
            "gravity points elsewhere in the frame of the base: if the robot is mounted so, write"
            f" gravity = [{shown}] into [robot] of the device file"
        )
    if correction.kind == "zero":
        return _zero(correction, session)
    if correction.kind == "exchange":
        return f"{join_names(correction.signals)} are exchanged: exchange their columns"
    return _sign(correction, session) if correction.kind == "sign" else _scale(correction, session)


def describe_evidence(
    system: System, axes: list[int], before: Plausibility, after: Plausibility, drawn: bool
) -> str:
    """What setting it right changes: errors, and parameters that were not believable.

    Args:
        system: the device; axes: whose errors; before, after: what is explained.
        drawn: whether that is with bodies as they are drawn.
    """
    parts = [
        f"error of {system.coordinates[i]} falls from {_fall(i, before, after)}"
        for i in axes
        if after.error[i] < before.error[i] / 1.5
    ]
    back = [
        f"{item.name} goes from {old:.3g} to {new:.3g} {item.unit}, where {item.prior:g} ±"
        f" {item.sd:g} is expected"
        for item, old, new in zip(system.parameters, before.p, after.p, strict=True)
        if abs(distance_from_prior(item, old)) > abs(distance_from_prior(item, new)) + 1.0
    ]
    said = "; ".join(parts or back[:3])
    if not drawn:
        return said
    return f"with bodies as drawn, {said or 'all drives are off by one factor'}"


def describe_lack(system: System, before: Plausibility, after: Plausibility) -> list[str]:
    """A sentence without a full stop for each axis on which a torque over position is missing."""
    return [
        f"a torque that follows the position of {axis}, as of gravity or a spring, takes its error"
        f" from {_fall(i, before, after)}, and the device has none there: put it into [energy]"
        " potential of the device file, or let diagnose name it"
        for i, axis in enumerate(system.coordinates)
        if after.error[i] < before.error[i] / 1.5
    ]


def _fall(axis: int, before: Plausibility, after: Plausibility) -> str:
    fallen = percent(before.error[axis]), percent(after.error[axis])
    return f"{fallen[0]} to {fallen[1]} of the applied force"


def percent(share: float) -> str:
    """A share in per cent, two digits, no more than a reader wants of a very large one."""
    if share >= 10.0:
        return "over 1000 %"
    return f"{100.0 * share:.0f} %" if share >= 0.1 else f"{100.0 * share:.2g} %"


def number(value: float) -> str:
    """A factor, three digits, without powers of ten as long as that is short."""
    return f"{value:.0f}" if 1000.0 <= abs(value) < 1e6 else f"{value:.3g}"


def _sign(correction: Correction, session: IngestResult) -> str:
    names = correction.signals
    if len(names) > 1:
        if names[0] in session.force.columns:
            return (
                f"{join_names(names)} all have the wrong sign, as forces on the hand taken for"
                f" those of the hand have: negate {_force_entry(session)}"
            )
        return f"{join_names(names)} have the wrong sign: negate their columns"
    name = names[0]
    if name in session.axes:
        counts = session.axes[name].counts_per_unit
        fix = "negate counts_per_unit" if counts else "negate gear_ratio, 1 where left out"
        return f"the encoder of {name} counts the other way: {fix}"
    entry = f"scale of channels.{name}" if name in session.channels else "its column"
    if name in session.force.columns:
        entry = _force_entry(session) + " in its row" * (len(session.force.columns) > 1)
    return f"{name} has the wrong sign: negate {entry}"


def describe_size(correction: Correction) -> str:
    """By how much signals read too much or too little."""
    factor = correction.factor
    off = f"{number(1.0 / factor)} times too much"
    if factor > 1.0:
        off = f"{number(factor)} times too little"
    verb = "read" if len(correction.signals) > 1 else "reads"
    return f"{join_names(correction.signals)} {verb} about {off}"


def _scale(correction: Correction, session: IngestResult) -> str:
    fixes = dict.fromkeys(_scale_fix(name, correction, session) for name in correction.signals)
    channels = [f"channels.{name}" for name in correction.signals if name in session.channels]
    if len(channels) == len(correction.signals) > 1:
        fixes = {f"multiply scale of {join_names(channels)} by {number(correction.factor)}": None}
    like = f", as {correction.meant} read as {correction.stated}" if correction.meant else ""
    return f"{describe_size(correction)}{like}: {'; '.join(fixes)}"


def _scale_fix(name: str, correction: Correction, session: IngestResult) -> str:
    factor = correction.factor
    if name in session.axes:
        encoder = session.axes[name]
        if encoder.counts_per_unit:
            stated = encoder.counts_per_unit
            right = number(stated / factor)
            return f"counts_per_unit of {name} should be about {right}, not {number(stated)}"
        if correction.meant and encoder.raw_unit == correction.stated:
            return f'unit = "{correction.meant}"'
        return f"gear_ratio = {number(1.0 / factor)}"
    if name in session.force.columns:
        if correction.meant and session.force.raw_unit == correction.stated:
            return f'unit = "{correction.meant}" of [force]'
        row = " of its row" if len(correction.signals) < len(session.force.columns) else ""
        return f"multiply {_force_entry(session)}{row} by {number(factor)}"
    return f"multiply scale of channels.{name} by {number(factor)}"


def _force_entry(session: IngestResult) -> str:
    return "calibration_n_per_v" if session.force.raw_unit == "V" else "the columns of [force]"


def _zero(correction: Correction, session: IngestResult) -> str:
    axis = correction.signals[0]
    encoder = session.axes[axis]
    off = correction.offset
    size = f"{math.degrees(off):.3g}°" if encoder.unit == "rad" else f"{off:.3g} m"
    zero = encoder.zero - off / encoder.scale
    return f"the zero of {axis} is off by {size}: zero_counts should be about {zero:.6g}"


def _clock(correction: Correction, session: IngestResult) -> str:
    factor = correction.factor
    how = f"{1.0 / factor:.4g} times too slowly" if factor < 1.0 else f"{factor:.4g} times too fast"
    return (
        f"the clock runs {how}: correct the unit of the time column, and sample_rate_hz, which"
        f" would be {session.sample_rate_hz / factor:.4g}"
    )
