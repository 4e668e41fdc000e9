"""Set-ups that a person may have meant: what each says of the signals, cheapest mistakes first."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import combinations, permutations

import numpy as np

from bampipe.results.setup import Kind
from bampipe.trials.signals import Change, Signals

DEGREE = math.pi / 180.0
FACTORS: dict[str, tuple[tuple[str, float], ...]] = {
    "rad": (("deg", DEGREE), ("rev", 2.0 * math.pi), ("mrad", 1e-3)),
    "m": (("mm", 1e-3), ("cm", 1e-2), ("um", 1e-6), ("in", 0.0254)),
    "N": (("mN", 1e-3), ("kN", 1e3), ("kgf", 9.80665), ("gf", 9.80665e-3), ("lbf", 4.44822)),
    "N.m": (("mN.m", 1e-3), ("kN.m", 1e3), ("N.mm", 1e-3), ("N.cm", 1e-2)),
    "A": (("mA", 1e-3),),
    "V": (("mV", 1e-3),),
}
"""Units that are taken for the SI unit, and that for them, by SI unit."""
PLAIN = (10.0, 100.0, 1000.0, 2.0, 4.0)
"""Gains of an amplifier and edges of an encoder that are forgotten, or counted twice."""
MOST_TRAVEL = 4.0 * math.pi
"""Beyond two turns, rad, an angle is rather that of a motor before its gear."""
JOINT_SPANS = np.geomspace(0.5, MOST_TRAVEL, 20)
"""What a joint may travel then, rad: weight goes with the sine of the angle, so that only a factor
near the right one explains more."""
_ALIKE = 0.2
"""Logarithm within which a factor that a drawing suggests is that of a unit or a gain."""
CLOCKS = (1e-3, 1e3, 1e-6, 1e6, 1e-9, 1e9)
USUAL = ("deg", "mm", "mN", "kN", "mA", "mV", "mN.m", "kN.m", "kgf")


@dataclass(frozen=True)
class Correction:
    """One mistake, as the change of the signals that sets it right.

    Attributes:
        kind: what kind of mistake; signals: which it concerns, none for a clock.
        change: what it makes of the readings.
        cost: how unlikely a person is to make it, in the unit of the score.
        factor, offset: of a scale or clock; of a zero, rad or m.
        meant, stated: unit of the readings, and the one written; "" where no unit explains it.
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
    """What all corrections make of the signals, the first one first."""
    none = Change.none(len(signals.names))
    return reduce(lambda first, one: one.change.after(first), corrections, none)


def scaled(
    signals: Signals,
    names: Sequence[str],
    factor: float,
    cost: float,
    units: tuple[str, str] = ("", ""),
) -> Correction:
    """Signals ``names`` read 1/``factor`` times what they should."""
    gain = np.eye(len(signals.names))
    for place in signals.places(names):
        gain[place, place] = factor
    none = np.zeros(len(signals.names))
    return Correction("scale", tuple(names), Change(gain, none), cost, factor, 0.0, *units)


def shifted(signals: Signals, axis: str, offset: float, cost: float) -> Correction:
    """The zero of ``axis`` is off: ``offset`` must be added, rad or m."""
    change = Change.none(len(signals.names))
    change.offset[signals.places([axis])] = offset
    return Correction("zero", (axis,), change, cost, offset=offset)


def turned(signals: Signals, names: Sequence[str], cost: float = 0.0) -> Correction:
    """Signals ``names`` have the wrong sign."""
    change = scaled(signals, names, -1.0, 0.0).change
    return Correction("sign", tuple(names), change, cost, -1.0)


def under_gravity(signals: Signals, gravity: Iterable[float], cost: float) -> Correction:
    """Gravity is another in the frame of the base, m/s2, (3,)."""
    none = Change.none(len(signals.names))
    x, y, z = (float(v) for v in gravity)
    change = Change(none.gain, none.offset, gravity=(x, y, z))
    return Correction("gravity", (), change, cost)


def resized(signals: Signals, names: Sequence[str], factor: float) -> Correction:
    """Signals ``names`` read about 1/``factor`` times what they should: by a unit, if one is near.

    Or by a gain of those that are usual.
    """
    place = signals.places(names)[0]
    known = [*_units_taken(signals.units[place], signals.stated[place])]
    known += [(gain, 2.0, ("", "")) for plain in PLAIN for gain in (plain, 1.0 / plain)]
    nearest = min(known, key=lambda one: abs(math.log(one[0] / factor)))
    if abs(math.log(nearest[0] / factor)) > _ALIKE:
        return scaled(signals, names, float(factor), 2.0)
    return scaled(signals, names, *nearest)


def _units_taken(si: str, stated: str) -> Iterator[tuple[float, float, tuple[str, str]]]:
    """Factor, cost, and units meant and stated, where a unit is taken for another."""
    for unit, factor in FACTORS.get(si, ()):
        cost = 0.5 if unit in USUAL else 2.0
        if stated == si:
            yield factor, cost, (unit, si)
        elif stated == unit:
            yield 1.0 / factor, cost, (si, unit)


def groups_of_like(signals: Signals) -> tuple[tuple[str, ...], ...]:
    """Signals that share a mistake: each alone, then all axes of one unit, then all forces."""
    alone = [(name,) for name in (*signals.axes, *signals.forces, *signals.channels)]
    together = [
        tuple(a for a, u in zip(signals.axes, signals.units, strict=False) if u == unit)
        for unit in ("rad", "m")
    ]
    return tuple(dict.fromkeys([*alone, *(g for g in (*together, signals.forces) if len(g) > 1)]))


def sign_corrections(signals: Signals) -> Iterator[Correction]:
    """Reversed encoders, forces, channels and brake commands."""
    groups: list[tuple[str, ...]] = [
        (name,) for name in (*signals.axes, *signals.forces, *signals.channels)
    ]
    for many in (signals.forces, signals.brakes):
        groups += [many] if len(many) > 1 else []
    groups += [(name,) for name in signals.brakes]
    for names in groups:
        yield turned(signals, names, 0.0 if len(names) == 1 else 1.0)


def exchange_corrections(signals: Signals) -> Iterator[Correction]:
    """Columns that stand for each other: as raw readings, or with all that belongs to them."""
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
    """Time stamps in another unit than stated, the stated rate as well."""
    for factor in CLOCKS:
        none = Change.none(len(signals.names))
        yield Correction("clock", (), Change(none.gain, none.offset, factor), 2.0, factor)


def unit_corrections(signals: Signals) -> Iterator[Correction]:
    """Units taken for others, and factors of gains and counters."""
    for names in groups_of_like(signals):
        place = signals.places(names)[0]
        for taken in _units_taken(signals.units[place], signals.stated[place]):
            yield scaled(signals, names, *taken)
        for factor in PLAIN:
            yield scaled(signals, names, factor, 2.0)
            yield scaled(signals, names, 1.0 / factor, 2.0)


def quarter_turns(signals: Signals) -> Iterator[Correction]:
    """A rotary axis counted from another of its four main directions."""
    for axis, unit in zip(signals.axes, signals.units, strict=False):
        if unit == "rad":
            for turn in (-0.5, 0.5, 1.0):
                yield shifted(signals, axis, turn * math.pi, 1.0)
