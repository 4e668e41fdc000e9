"""Numbers, units and names as they are printed."""

import math
import re
from collections.abc import Callable, Iterable
from typing import Any

from bampipe.results.rounding import find_digits, significant

_POWERS = {"2": "²", "3": "³"}
_PREFIXES = ((1e-6, 1e-7, "µ"), (1e-3, 1e-4, "m"), (1.0, 0.1, ""), (1e3, 1e3, "k"), (1e6, 1e6, "M"))
"""Factor of each prefix, and the largest value from which it is used."""
_PREFIXED = ("rad", "m", "N", "Pa")
"""Units that take a prefix when they lead; kg already has one."""
_UNIT_PATTERN = re.compile(r"\b(?:(?:k?N|kg)(?:\.(?:m2?|s2?))+(?:/[A-Za-z]+2?)?|(?:rad|m)/s2)\b")
_MINUS = re.compile(r"(?<![\w.)\]-])-(?=[\d.])")
_POWER = re.compile(r"(?<![\w.])(\d+(?:\.\d+)?)e([+-]\d+)\b")
_BASE_PARAMETERS = {"viscous": "viscous damping", "coulomb": "Coulomb friction"}
NONE = "–"
"""Placeholder of an unknown number."""


def format_unit(text: str) -> str:
    """Return a unit as printed: ``N.m.s/rad`` gives ``N·m·s/rad``, ``m/s2`` gives ``m/s²``."""
    shown = text.replace(".", "·").replace("*", "·").replace("^", "")
    return re.sub(r"(?<=[A-Za-z])[23]", lambda found: _POWERS[found[0]], shown)


def format_prose(text: str) -> str:
    """Return text with minus signs, powers of ten and units as printed; names are not changed."""
    text = _MINUS.sub("−", _POWER.sub(lambda found: f"{found[1]}{_format_power(found[2])}", text))
    return _UNIT_PATTERN.sub(lambda found: format_unit(found[0]), text)


def _format_power(exponent: int | str) -> str:
    raised = ("⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".index(mark)] for mark in str(int(exponent)))
    return f"·10{''.join(raised)}" if int(exponent) else ""


def choose_scale(values: Iterable[float], base: str) -> tuple[float, str]:
    """Return the factor and the unit that bring the largest of ``values`` to 0.1 … 1000.

    Args:
        values: finite numbers in the unit ``base``; base: a unit such as ``N.m/rad``.
    """
    largest = max((abs(value) for value in values), default=0.0)
    if base.replace("/", ".").split(".")[0] not in _PREFIXED or largest == 0.0:
        return 1.0, format_unit(base)
    fitting = [one for one in _PREFIXES if largest >= one[1]] or [_PREFIXES[0]]
    size, _, letter = fitting[-1]
    return 1.0 / size, letter + format_unit(base)


def format_scaled(value: float | None, base: str, digits: int = 2, sd: float | None = None) -> str:
    """Return a value with the unit that suits it, rounded by ``sd`` where that is given."""
    if value is None:
        return NONE
    factor, shown = choose_scale([value], base) if base != "J" else (1e3, "mJ")
    if sd is None:
        return f"{format_digits(factor * value, digits)} {shown}"
    return f"{format_with_sd(factor * value, factor * sd)} {shown}"


def format_decimals(value: float, decimals: int, power: int = 0) -> str:
    """Return ``value`` with so many decimals, without that power of ten."""
    text = f"{value / 10.0**power:.{decimals}f}"
    if float(text) == 0.0:
        text = text.removeprefix("-")
    return text.replace("-", "−") + _format_power(power)


def format_digits(value: float | None, digits: int = 3) -> str:
    """Return ``value`` with so many significant digits."""
    if value is None or not math.isfinite(value):
        return NONE
    return format_prose(significant(value, digits))


def format_stated(value: float) -> str:
    """Return a stated number with at most four digits and no zeros added."""
    return format_prose(f"{value:.4g}")


def format_with_sd(value: float | None, sd: float | None) -> str:
    """Return ``value ± sd``, both rounded to two digits of ``sd``."""
    if value is None or not math.isfinite(value):
        return NONE
    decimals, power = find_digits(value, sd)
    if sd is None or not math.isfinite(sd) or sd == 0.0:
        return format_decimals(value, decimals, power)
    return _join_numbers(" ± ", value, sd, decimals, power)


def format_quantity(value: float, sd: float, unit: str) -> str:
    """Return ``value ± sd`` with its unit."""
    return f"{format_with_sd(value, sd)} {format_unit(unit)}".rstrip()


def format_interval(low: float, high: float, sd: float | None) -> str:
    """Return ``low to high``, rounded as :func:`format_with_sd` rounds."""
    decimals, power = find_digits(0.5 * (low + high), sd if sd else (high - low) / 4.0)
    return _join_numbers(" to ", low, high, decimals, power)


def _join_numbers(word: str, first: float, second: float, decimals: int, power: int) -> str:
    shown = word.join(format_decimals(x / 10.0**power, decimals) for x in (first, second))
    return f"({shown}){_format_power(power)}" if power else shown


def format_percent(share: float | None) -> str:
    """Return a share (1 is all) in per cent."""
    if share is None or not math.isfinite(share):
        return NONE
    return f"{format_decimals(100.0 * share, 0 if abs(share) >= 0.1 else 1)} %"


def format_p_value(value: float | None) -> str:
    """Return a p-value, three decimals at most."""
    if value is None or not math.isfinite(value):
        return NONE
    return "< 0.001" if value < 0.001 else format_digits(value, 2)


_FORMS: dict[str, Callable[[Any], str]] = {
    "": format_digits,
    "2": lambda value: format_digits(value, 2),
    "%": format_percent,
    "p": format_p_value,
    "code": "`{}`".format,
    "name": lambda name: name_parameter(name),
    "unit": format_unit,
}
"""How the cells of a table are printed, by the form of their column."""


def format_entry(value: Any, form: str = "") -> str:
    """Return the cell of a table: a number, a value with its sd, whether something is so, or text.

    None is `NONE`, whatever the ``form``; text in a column of numbers is printed as it is.
    """
    if value is None or isinstance(value, tuple):
        return NONE if value is None else format_with_sd(*value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    is_text = isinstance(value, str) and form not in ("code", "name", "unit")
    return value if is_text else _FORMS[form](value)


def break_lines(text: str, most: int, behind: str = " _") -> str:
    """Return ``text`` in lines of ``most`` letters, broken behind these marks."""
    found = [""]
    for part in re.split(f"(?<=[{behind}])", text):
        if found[-1] and len((found[-1] + part).rstrip()) > most:
            found.append("")
        found[-1] += part
    return "\n".join(line.rstrip() for line in found)


def split_name(name: str) -> str:
    """Return a name from a file as words: ``brake_residual_torque`` with spaces."""
    return name.replace("_", " ")


def name_trial_state(status: str) -> str:
    """Return the state of a trial, as ingest stores it, in words."""
    return "sound" if status == "ok" else split_name(status)


def name_parameter(name: str) -> str:
    """Return the name of a parameter in words: ``viscous.yaw`` is "Viscous damping, yaw"."""
    first, *others = name.split(".")
    shown = ", ".join([_BASE_PARAMETERS.get(first, split_name(first)), *map(split_name, others)])
    return shown[:1].upper() + shown[1:]
