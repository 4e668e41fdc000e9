"""Numbers, units and names as a reader wants them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

from bampipe.results import rounding
from bampipe.results.rounding import decimals_for, power_for

_POWERS = {"2": "²", "3": "³"}
_PREFIXES = ((1e-6, "µ"), (1e-3, "m"), (1.0, ""), (1e3, "k"), (1e6, "M"))
_PREFIXED = ("rad", "m", "N", "Pa")
"""Units that take a prefix when they lead; kg already has one."""
_UNIT = re.compile(r"\b(?:(?:k?N|kg)(?:\.(?:m2?|s2?))+(?:/[A-Za-z]+2?)?|(?:rad|m)/s2)\b")
_MINUS = re.compile(r"(?<![\w.)\]-])-(?=[\d.])")
_POWER = re.compile(r"(?<![\w.])(\d+(?:\.\d+)?)e([+-]\d+)\b")


def unit(text: str) -> str:
    """Return a unit as printed: ``N.m.s/rad`` gives ``N·m·s/rad``, ``m/s2`` gives ``m/s²``."""
    shown = text.replace(".", "·").replace("*", "·").replace("^", "")
    return "".join(
        _POWERS[mark] if mark in _POWERS and before.isalpha() else mark
        for before, mark in zip(" " + shown, shown, strict=False)
    )


def prose(text: str) -> str:
    """Return text with minus signs, powers of ten and units as printed; names stay as they are."""
    text = _MINUS.sub("−", _POWER.sub(lambda found: f"{found[1]}·10{_raised(found[2])}", text))
    return _UNIT.sub(lambda found: unit(found[0]), text)


def _raised(exponent: str) -> str:
    return "".join("⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".index(mark)] for mark in str(int(exponent)))


def scale(values: Iterable[float], base: str) -> tuple[float, str]:
    """Return the factor and the unit that bring the largest of ``values`` to 0.1 … 1000.

    Args:
        values: finite numbers in the unit ``base``.
        base: a unit such as ``rad/s`` or ``N.m/rad``.
    """
    largest = max((abs(value) for value in values), default=0.0)
    first = base.replace("/", ".").split(".")[0]
    if first not in _PREFIXED or largest == 0.0:
        return 1.0, unit(base)
    fitting = [item for item in _PREFIXES if largest >= 0.1 * item[0]]
    size, letter = fitting[-1] if fitting else _PREFIXES[0]
    if size == 1e3 and largest < 1e3:
        size, letter = 1.0, ""
    if size == 1e6 and largest < 1e6:
        size, letter = 1e3, "k"
    return 1.0 / size, letter + unit(base)


def scaled(value: float | None, base: str, digits: int = 2, sd: float | None = None) -> str:
    """Return a value with the unit that suits it; with ``sd`` rounded by that; a dash for none."""
    if value is None:
        return "–"
    factor, shown = scale([value], base) if base != "J" else (1e3, "mJ")
    number = (
        significant(factor * value, digits) if sd is None else with_sd(factor * value, factor * sd)
    )
    return f"{number} {shown}"


def plain(value: float, decimals: int, power: int = 0) -> str:
    """Return ``value`` with so many decimals, a true minus sign and that power of ten taken out."""
    text = f"{value / 10.0**power:.{decimals}f}"
    if float(text) == 0.0:
        text = text.removeprefix("-")
    return text.replace("-", "−") + _times(power)


def _times(power: int) -> str:
    return f"·10{_raised(str(power))}" if power else ""


def significant(value: float | None, digits: int = 3) -> str:
    """Return ``value`` with so many significant digits; a dash for none."""
    if value is None or not math.isfinite(value):
        return "–"
    return prose(rounding.significant(value, digits))


def as_written(value: float) -> str:
    """Return a number that somebody stated: four digits at most, and no zeros of our own."""
    return prose(f"{value:.4g}")


def with_sd(value: float | None, sd: float | None) -> str:
    """Return ``value ± sd``, both rounded to two digits of ``sd``."""
    if value is None or not math.isfinite(value):
        return "–"
    decimals, power = digits_of(value, sd)
    if sd is None or not math.isfinite(sd) or sd == 0.0:
        return plain(value, decimals, power)
    shown = f"{plain(value / 10.0**power, decimals)} ± {plain(sd / 10.0**power, decimals)}"
    return f"({shown}){_times(power)}" if power else shown


def digits_of(value: float, sd: float | None) -> tuple[int, int]:
    """Return the decimals that ``sd`` leaves ``value``, and the power of ten to take out first."""
    power = power_for(value, sd)
    return decimals_for(sd / 10.0**power if sd else sd, value / 10.0**power), power


def interval(low: float, high: float, sd: float | None) -> str:
    """Return ``low to high``, rounded as :func:`with_sd` rounds."""
    decimals, power = digits_of(0.5 * (low + high), sd if sd else (high - low) / 4.0)
    shown = f"{plain(low / 10.0**power, decimals)} to {plain(high / 10.0**power, decimals)}"
    return f"({shown}){_times(power)}" if power else shown


def percent(share: float | None) -> str:
    """Return a share (1 is all) in percent."""
    if share is None or not math.isfinite(share):
        return "–"
    size = 100.0 * share
    return f"{plain(size, 0 if abs(size) >= 10.0 else 1)} %"


def probability(value: float | None) -> str:
    """Return a p-value, three decimals at most."""
    if value is None or not math.isfinite(value):
        return "–"
    return "< 0.001" if value < 0.001 else significant(value, 2)


def words(name: str) -> str:
    """Return a name from a file as words: ``brake_residual_torque`` with spaces."""
    return name.replace("_", " ")


def trial_state(status: str) -> str:
    """Return the state of a trial, as ingest has it, in words."""
    return "sound" if status == "ok" else words(status)


def count(number: int, noun: str) -> str:
    """Return ``1 trial``, ``2 trials``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


_BASE_PARAMETERS = {"viscous": "viscous damping", "coulomb": "Coulomb friction"}


def parameter(name: str) -> str:
    """Return the name of a parameter in words: ``viscous.yaw`` is "Viscous damping, yaw"."""
    parts = name.split(".")
    first = _BASE_PARAMETERS.get(parts[0], words(parts[0]))
    shown = ", ".join([first, *(words(part) for part in parts[1:])])
    return shown[:1].upper() + shown[1:]
