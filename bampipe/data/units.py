"""Units that logs are written in, and what makes coherent SI units of them."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class RecordedUnit:
    """How a unit becomes SI: value in ``si`` = scale * value + offset."""

    si: str
    scale: float = 1.0
    offset: float = 0.0


_TURN = 2 * math.pi
_POUND = 4.4482216152605
_BASE: dict[str, RecordedUnit] = {
    "s": RecordedUnit("s"),
    "min": RecordedUnit("s", 60.0),
    "m": RecordedUnit("m"),
    "rad": RecordedUnit("rad"),
    "deg": RecordedUnit("rad", math.pi / 180),
    "rev": RecordedUnit("rad", _TURN),
    "rad/s": RecordedUnit("rad/s"),
    "deg/s": RecordedUnit("rad/s", math.pi / 180),
    "rev/s": RecordedUnit("rad/s", _TURN),
    "rev/min": RecordedUnit("rad/s", _TURN / 60),
    "m/s": RecordedUnit("m/s"),
    "m/min": RecordedUnit("m/s", 1 / 60),
    "m/s2": RecordedUnit("m/s2"),
    "rad/s2": RecordedUnit("rad/s2"),
    "deg/s2": RecordedUnit("rad/s2", math.pi / 180),
    "N": RecordedUnit("N"),
    "N.m": RecordedUnit("N.m"),
    "N.cm": RecordedUnit("N.m", 1e-2),
    "N.mm": RecordedUnit("N.m", 1e-3),
    "kgf": RecordedUnit("N", 9.80665),
    "lbf": RecordedUnit("N", _POUND),
    "lbf.ft": RecordedUnit("N.m", _POUND * 0.3048),
    "lbf.in": RecordedUnit("N.m", _POUND * 0.0254),
    "in": RecordedUnit("m", 0.0254),
    "ft": RecordedUnit("m", 0.3048),
    "in/s": RecordedUnit("m/s", 0.0254),
    "A": RecordedUnit("A"),
    "V": RecordedUnit("V"),
    "W": RecordedUnit("W"),
    "Hz": RecordedUnit("Hz"),
    "Pa": RecordedUnit("Pa"),
    "bar": RecordedUnit("Pa", 1e5),
    "T": RecordedUnit("T"),
    "K": RecordedUnit("K"),
    "degC": RecordedUnit("K", 1.0, 273.15),
    "kg": RecordedUnit("kg"),
    "g": RecordedUnit("kg", 1e-3),
    "%": RecordedUnit("", 1e-2),
    "": RecordedUnit(""),
}
_PREFIXES = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3, "M": 1e6}
_PREFIXED = ("s", "m", "rad", "N", "N.m", "A", "V", "W", "Hz", "Pa", "m/s", "T", "m/s2")
_SPELLINGS = {
    "sec": "s", "second": "s", "seconds": "s", "msec": "ms", "usec": "us", "hz": "Hz",
    "degree": "deg", "degrees": "deg", "°": "deg", "°/s": "deg/s", "deg/sec": "deg/s",
    "rads": "rad", "radian": "rad", "radians": "rad", "rad/sec": "rad/s", "rpm": "rev/min",
    "r/min": "rev/min", "1/min": "rev/min", "rps": "rev/s", "turn": "rev", "turns": "rev",
    "nm": "nm", "n": "N", "volt": "V", "volts": "V", "v": "V", "amp": "A", "amps": "A",
    "ampere": "A", "a": "A", "newton": "N", "meter": "m", "meters": "m", "metre": "m",
    "lb": "lbf", "lbs": "lbf", "°c": "degC", "c": "degC", "degc": "degC", "percent": "%",
    "pct": "%", "-": "", "1": "", "none": "", "inch": "in", "kgf": "kgf",
}  # fmt: skip
_STEPS = re.compile(r"(?P<number>\d+\.?\d*|\.\d+)\.?(?P<unit>[^\W\d_].*|%|°.*)")
_SQUEEZED = {"Nm": "N.m", "Ncm": "N.cm", "Nmm": "N.mm", "mNm": "mN.m", "kNm": "kN.m"}


def spelled(text: str, among: Sequence[str]) -> str:
    """The one of ``among`` that means the same unit as ``text``, "" where there is none."""
    known = unit(text)
    if text in among or known is None:
        return text if text in among else ""
    return next((other for other in among if unit(other) == known), "")


def unit(text: str) -> RecordedUnit | None:
    """What ``text`` stands for, None where that is not known.

    ``Nm``, ``N*m``, ``N·m`` and ``N.m`` are the same, ``mA``, ``kN`` and the like are put together
    from their prefix; ``13.5mA`` is a reading in steps of 13.5 mA. ``nm`` is a nanometre, not a
    torque.
    """
    plain = text.strip().strip("[]()").strip()
    plain = re.sub(r"\s*[*·⋅ ]\s*", ".", plain)
    plain = plain.replace("µ", "u").replace("μ", "u").replace("²", "2").replace("^", "")
    plain = plain.replace("s**2", "s2")
    for spelling in (plain, _SQUEEZED.get(plain, ""), _SPELLINGS.get(plain.lower(), "")):
        if spelling in _BASE and (spelling or plain in ("", "-", "1", "none")):
            return _BASE[spelling]
        prefix, rest = spelling[:1], spelling[1:]
        if prefix in _PREFIXES and rest in _PREFIXED:
            base = _BASE[rest]
            return RecordedUnit(base.si, base.scale * _PREFIXES[prefix])
    if steps := _STEPS.fullmatch(plain):
        one, count = unit(steps["unit"]), float(steps["number"])
        if one is not None and one.offset == 0.0 and count > 0.0:
            return RecordedUnit(one.si, count * one.scale)
    return None
