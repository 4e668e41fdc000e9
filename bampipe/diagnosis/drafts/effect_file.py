"""A drafted term as an effect file, for a person to rename, edit and keep."""

from typing import Any

import numpy as np

from bampipe.diagnosis.drafts.forms import round_constant
from bampipe.diagnosis.drafts.search import Term
from bampipe.results.intervals import NORMAL_95
from bampipe.results.rounding import round_with_sd

_PLACE_IN_WIDTHS = 2.0
_PLACE_IN_SPANS = 0.1
_LENGTH_RATIO = 3.0
_WAVES = 0.5
_LEAST_REACH = 0.1
"""Range of a later fit around the estimate: of a place in widths of the shape, or spans without
one, of a length as a ratio, of a wavenumber in waves on the span, of a number at least."""


def declare(term: Term, source: str) -> dict[str, Any]:
    """Return the declaration of a term with its estimates.

    Strengths keep the prior 0, at which the effect is absent, and have the estimate as typical
    value. The estimates of the other constants become their priors.
    """
    entries = {}
    for name, entry in term.form.entries().items():
        entries[name] = dict(entry)
        if name in term.values:
            interval = (
                f"{round_with_sd(term.values[name], NORMAL_95 * term.sd[name])} {entry['unit']}"
            )
            entries[name]["description"] += f"; drafted as {interval}".rstrip()
            entries[name] |= _numbers(term, name)
    return term.form.declaration(source, entries)


def _numbers(term: Term, name: str) -> dict[str, float]:
    """Return prior, standard deviation, bounds and typical value of one constant."""
    value, span = term.values[name], term.form.span
    kind = term.form.shape.searched.get(name)
    if kind is None:
        size = max(2.0 * abs(value), 1e-6)
        return {"sd": round_constant(size), "typical": round_constant(value)}
    if kind in ("length", "time"):
        low, high = value / _LENGTH_RATIO, value * _LENGTH_RATIO
    else:
        width = term.values.get("width")
        reach = {
            "place": _PLACE_IN_SPANS * span.width if width is None else _PLACE_IN_WIDTHS * width,
            "number": max(abs(value), _LEAST_REACH),
            "wavenumber": 2.0 * np.pi * _WAVES / span.width,
        }[kind]
        low, high = value - reach, value + reach
        if kind == "wavenumber":
            low = max(low, 0.5 * value)
    return {
        "prior": round_constant(value),
        "sd": round_constant(0.25 * (high - low)),
        "lower": round_constant(low),
        "upper": round_constant(high),
        "typical": round_constant(value),
    }
