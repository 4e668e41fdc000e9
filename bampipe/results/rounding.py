"""Numbers and their uncertainty: intervals, and rounding for sentences in results."""

import math

NORMAL_95 = 1.959964
"""Standard deviations on either side that hold 95 % of a normal distribution."""
_MOST_DECIMALS = 9
_SMALLEST_PLAIN, _LARGEST_PLAIN = 1e-4, 1e7
"""Range in which a number is written without a power of ten."""


def find_digits(value: float, sd: float | None) -> tuple[int, int]:
    """Return the decimals of ``value``, two digits of ``sd``, and the power of ten before them.

    That power is to be factored out first; it is 0 if none is needed.
    """
    largest = max((abs(x) for x in (value, sd or 0.0) if math.isfinite(x)), default=0.0)
    is_plain = largest == 0.0 or _SMALLEST_PLAIN <= largest < _LARGEST_PLAIN
    power = 0 if is_plain else math.floor(math.log10(float(f"{largest:.1e}")))
    value, size = value / 10.0**power, abs(sd or 0.0) / 10.0**power
    if size > 0.0 and math.isfinite(size):
        digits = 1 - math.floor(math.log10(float(f"{size:.1e}")))
        return min(_MOST_DECIMALS, max(0, digits)), power
    if value == 0.0 or not math.isfinite(value):
        return 0, power
    return max(0, 3 - math.floor(math.log10(abs(value)))), power


def significant(value: float, digits: int = 3) -> str:
    """Return ``value`` with ``digits`` significant digits, trailing zeros included."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    size = math.floor(math.log10(abs(float(f"{value:.{digits - 1}e}"))))
    if not _SMALLEST_PLAIN <= 10.0**size < _LARGEST_PLAIN:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(0, digits - 1 - size)}f}"


def rounded(value: float, digits: int = 2) -> str:
    """Return ``value`` rounded to ``digits`` significant digits, without trailing zeros."""
    return f"{float(f'{value:.{digits}g}'):g}"


def round_with_sd(value: float, sd: float) -> str:
    """Return ``value ± sd``, both to two digits of ``sd``, with powers of ten if needed."""
    if sd == 0.0:
        return f"{value:.4g} ± 0"
    decimals, power = find_digits(value, sd)
    size = f"e{power:+03d}" if power else ""
    value, sd = value / 10.0**power, sd / 10.0**power
    return f"{round(value, decimals) + 0.0:.{decimals}f}{size} ± {sd:.{decimals}f}{size}"
