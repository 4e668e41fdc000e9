"""Hypotheses about mistakes in a set-up, each as a change of the signals with its cost."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import combinations, permutations

import numpy as np

from bampipe.data import units
from bampipe.data.vocabulary import VOCABULARY
from bampipe.results.setup import Kind
from bampipe.trials.signals import Change, Signals

_Units = tuple[str, str]
PLAIN = (10.0, 100.0, 1000.0, 2.0, 4.0)
"""Factors of amplifier gains and of encoder edges that are forgotten or applied twice."""
MOST_TRAVEL = 4.0 * math.pi
"""Travel beyond which an angle is probably that of a motor before its gear: two turns, rad."""
JOINT_SPANS = np.geomspace(0.5, MOST_TRAVEL, 20)
"""Candidates for the joint's travel in that case, rad: weight varies with the sine of the angle, so
that only a factor near the right one explains more."""
_ALIKE = 0.2
"""Largest difference of logarithms at which a factor is taken for that of a unit or a gain."""
CLOCKS = (1e-3, 1e3, 1e-6, 1e6, 1e-9, 1e9)
USUAL = ("deg", "mm", "mN", "kN", "mA", "mV", "mN.m", "kN.m", "kgf")


@dataclass(frozen=True, eq=False)
class Correction:
    """A mistake in a set-up, with the change of the signals that corrects it.

    Two are the same only if they are one object.

    Attributes:
        kind: of the mistake; signals: those it concerns, none for a clock.
        change: the change of the readings.
        cost: improbability of the mistake, in units of the score.
        factor, offset: of a scale or clock; of a zero, rad or m.
        meant, stated: the actual unit of the readings, and the stated one; "" if no unit
            explains the factor.
    """

    kind: Kind
    signals: tuple[str, ...]
    change: Change
    cost: float
    factor: float = 1.0
    offset: float = 0.0
    meant: str = ""
    stated: str = ""


def combine(signals: Signals, corrections: Sequence[Correction]) -> Change:
    """Return the change of the signals by all corrections, the first one applied first."""
    none = Change.none(len(signals.names))
    return reduce(lambda first, one: one.change.after(first), corrections, none)


def scale_correction(
    signals: Signals, names: Sequence[str], factor: float, cost: float, units: _Units = ("", "")
) -> Correction:
    """Signals ``names`` must be multiplied by ``factor``."""
    change, places = Change.none(len(signals.names)), signals.places(names)
    change.gain[places, places] = factor
    return Correction("scale", tuple(names), change, cost, factor, 0.0, *units)


def zero_correction(signals: Signals, axis: str, offset: float, cost: float) -> Correction:
    """The zero of ``axis`` is wrong: ``offset`` must be added, rad or m."""
    change = Change.none(len(signals.names))
    change.offset[signals.places([axis])] = offset
    return Correction("zero", (axis,), change, cost, offset=offset)


def sign_correction(signals: Signals, names: Sequence[str], cost: float = 0.0) -> Correction:
    """Signals ``names`` have the wrong sign."""
    change = scale_correction(signals, names, -1.0, 0.0).change
    return Correction("sign", tuple(names), change, cost, -1.0)


def gravity_correction(signals: Signals, gravity: Iterable[float], cost: float) -> Correction:
    """Gravity has another direction in the frame of the base, m/s2, (3,)."""
    x, y, z = (float(v) for v in gravity)
    change = replace(Change.none(len(signals.names)), gravity=(x, y, z))
    return Correction("gravity", (), change, cost)


def nearest_scale_correction(signals: Signals, names: Sequence[str], factor: float) -> Correction:
    """Signals ``names`` must be multiplied by about ``factor``.

    The factor of a unit or of a usual gain is taken if one is near.
    """
    nearest = min(_usual_scales(signals, names), key=lambda one: abs(math.log(one[0] / factor)))
    if abs(math.log(nearest[0] / factor)) > _ALIKE:
        return scale_correction(signals, names, float(factor), 2.0)
    return scale_correction(signals, names, *nearest)


def _usual_scales(signals: Signals, names: Sequence[str]) -> Iterator[tuple[float, float, _Units]]:
    """Yield factor, cost, and (meant, stated) of units that are mistaken for others, and gains."""
    place = signals.places(names)[0]
    si, stated = signals.units[place], signals.stated[place]
    for name in VOCABULARY["confused_units"].get(si, "").split():
        known = units.unit(name)
        cost = 0.5 if name in USUAL else 2.0
        if known is not None and stated == si:
            yield known.scale, cost, (name, si)
        elif known is not None and stated == name:
            yield 1.0 / known.scale, cost, (si, name)
    for gain in PLAIN:
        yield gain, 2.0, ("", "")
        yield 1.0 / gain, 2.0, ("", "")


def group_signals(signals: Signals) -> tuple[tuple[str, ...], ...]:
    """Groups of signals that share a mistake: each alone, all axes of one unit, all forces."""
    alone = [(name,) for name in (*signals.axes, *signals.forces, *signals.channels)]
    together = [
        tuple(a for a, u in zip(signals.axes, signals.units, strict=False) if u == unit)
        for unit in ("rad", "m")
    ]
    return tuple(dict.fromkeys([*alone, *(g for g in (*together, signals.forces) if len(g) > 1)]))


def sign_corrections(signals: Signals) -> Iterator[Correction]:
    """Signs of encoders, forces, channels and brake commands."""
    yield from (sign_correction(signals, [name]) for name in signals.names)
    for names in (signals.forces, signals.brakes):
        if len(names) > 1:
            yield sign_correction(signals, names, 1.0)


def exchange_corrections(signals: Signals) -> Iterator[Correction]:
    """Columns that are exchanged: only their raw readings, or with their calibration."""
    count = len(signals.names)
    inverse = np.linalg.inv(signals.gain)
    pools = [*combinations(signals.names[: count - len(signals.brakes)], 2)]
    cycles = [c for many in (signals.axes, signals.forces) for c in combinations(many, 3)]
    for names in (*pools, *cycles):
        places = signals.places(names)
        for order in permutations(places):
            if any(a == b for a, b in zip(places, order, strict=True)):
                continue
            swap = np.eye(count)
            swap[places] = np.eye(count)[list(order)]
            raw = signals.gain @ swap @ inverse
            changes = [Change(raw, signals.offset - raw @ signals.offset)]
            if not np.allclose(raw, swap) or changes[0].offset.any():
                changes.append(Change(swap, np.zeros(count)))
            for change in changes:
                yield Correction("exchange", tuple(names), change, 0.5 if len(names) == 2 else 2.0)


def clock_corrections(signals: Signals) -> Iterator[Correction]:
    """Time stamps in another unit than stated, with the stated rate wrong by the same factor."""
    for factor in CLOCKS:
        change = replace(Change.none(len(signals.names)), time=factor)
        yield Correction("clock", (), change, 2.0, factor)


def unit_corrections(signals: Signals) -> Iterator[Correction]:
    """Units that are mistaken for others, and factors of gains and counters."""
    for names in group_signals(signals):
        yield from (scale_correction(signals, names, *one) for one in _usual_scales(signals, names))


def quarter_turns(signals: Signals) -> Iterator[Correction]:
    """A rotary axis whose zero is wrong by quarter turns."""
    for axis, unit in zip(signals.axes, signals.units, strict=False):
        if unit == "rad":
            for turn in (-0.5, 0.5, 1.0):
                yield zero_correction(signals, axis, turn * math.pi, 1.0)
