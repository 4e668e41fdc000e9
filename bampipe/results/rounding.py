"""Numbers and their uncertainty: intervals, and rounding for sentences in results."""

import math

NORMAL_95 = 1.959964
"""Standard deviations on either side that hold 95 % of a normal distribution."""
_MOST_DECIMALS = 9
SMALLEST_PLAIN, _LARGEST_PLAIN = 1e-4, 1e7
"""Range in which a number is written without a power of ten."""


def decimals_for(sd: float | None, value: float) -> int:
    """Return the number of significant decimals of ``value``: two digits of ``sd``."""
    size = abs(sd) if sd is not None and math.isfinite(sd) else 0.0
    if size == 0.0:
        if value == 0.0 or not math.isfinite(value):
            return 0
        return max(0, 3 - math.floor(math.log10(abs(value))))
    return min(_MOST_DECIMALS, max(0, 1 - math.floor(math.log10(float(f"{size:.1e}")))))


def significant(value: float, digits: int = 3) -> str:
    """Return ``value`` with ``digits`` significant digits, trailing zeros included."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    size = math.floor(math.log10(abs(float(f"{value:.{digits - 1}e}"))))
    if not SMALLEST_PLAIN <= 10.0**size < _LARGEST_PLAIN:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(0, digits - 1 - size)}f}"


def rounded(value: float, digits: int = 2) -> str:
    """Return ``value`` rounded to ``digits`` significant digits, without trailing zeros."""
    return f"{float(f'{value:.{digits}g}'):g}"


def power_for(value: float, sd: float | None) -> int:
    """Return the power of ten to factor out of ``value`` and ``sd``; 0 if none is needed."""
    largest = max((abs(x) for x in (value, sd or 0.0) if math.isfinite(x)), default=0.0)
    if largest == 0.0 or SMALLEST_PLAIN <= largest < _LARGEST_PLAIN:
        return 0
    return math.floor(math.log10(float(f"{largest:.1e}")))


def round_with_sd(value: float, sd: float) -> str:
    """Return ``value ± sd``, both to two digits of ``sd``, with powers of ten if needed."""
    if sd == 0.0:
        return f"{value:.4g} ± 0"
    power = power_for(value, sd)
    size = f"e{power:+03d}" if power else ""
    value, sd = value / 10.0**power, sd / 10.0**power
    decimals = decimals_for(sd, value)
    return f"{round(value, decimals) + 0.0:.{decimals}f}{size} ± {sd:.{decimals}f}{size}"
