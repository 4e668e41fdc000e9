"""Numbers rounded as their uncertainty allows, for the sentences that results carry."""

from __future__ import annotations

import math

_MOST_DECIMALS = 9


def decimals_for(sd: float | None, value: float) -> int:
    """Return how many decimals of ``value`` mean something: those of two digits of ``sd``."""
    size = abs(sd) if sd is not None and math.isfinite(sd) else 0.0
    if size == 0.0:
        if value == 0.0 or not math.isfinite(value):
            return 0
        return max(0, 3 - math.floor(math.log10(abs(value))))
    return min(_MOST_DECIMALS, max(0, 1 - math.floor(math.log10(float(f"{size:.1e}")))))


def round_with_sd(value: float, sd: float) -> str:
    """Return ``value ± sd``, both to two digits of ``sd``, and by powers of ten where need be."""
    if not 1e-7 < sd < 1e4 or abs(value) >= 1e7:
        return f"{value:.4g} ± {sd:.2g}"
    decimals = decimals_for(sd, value)
    return f"{round(value, decimals) + 0.0:.{decimals}f} ± {sd:.{decimals}f}"
