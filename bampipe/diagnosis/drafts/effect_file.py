"""A drafted term as the text of an effect file: what a person renames, edits and keeps."""

from collections.abc import Mapping
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
"""How far around what was found a later fit looks for a place (in widths of the shape, or in spans
where it has none), a length (as a ratio), a wavenumber (in waves on the range) and a number (at
least)."""


def declare(term: Term, source: str) -> dict[str, Any]:
    """The declaration of a term with what was found in it.

    Strengths keep the prior 0, where the effect is absent, and get the value found as the typical
    one; what shapes the effect starts from the value found.
    """
    entries = {}
    for name, entry in term.form.entries().items():
        entries[name] = dict(entry)
        if name in term.values:
            interval = (
                f"{round_with_sd(term.values[name], NORMAL_95 * term.sd[name])} {entry['unit']}"
            )
            entries[name]["description"] += f"; drafted as {interval}".rstrip()
            entries[name] |= _numbers(term, name, entry)
    return term.form.declaration(source, entries)


def _numbers(term: Term, name: str, entry: Mapping[str, Any]) -> dict[str, float]:
    """Prior, spread, bounds and typical value of one constant."""
    value, span = term.values[name], term.form.span
    kind = term.form.shape.searched.get(name)
    if kind is None:
        size = max(2.0 * abs(value), 1e-6)
        return {"sd": round_constant(size), "typical": round_constant(value)}
    low, high = entry["lower"], entry["upper"]
    if kind == "place":
        width = term.values.get("width")
        reach = _PLACE_IN_SPANS * span.width if width is None else _PLACE_IN_WIDTHS * width
        low, high = value - reach, value + reach
    elif kind in ("length", "time"):
        low, high = value / _LENGTH_RATIO, value * _LENGTH_RATIO
    elif kind == "number":
        reach = max(abs(value), _LEAST_REACH)
        low, high = value - reach, value + reach
    else:
        reach = 2.0 * np.pi * _WAVES / span.width
        low, high = max(value - reach, 0.5 * value), value + reach
    return {
        "prior": round_constant(value),
        "sd": round_constant(0.25 * (high - low)),
        "lower": round_constant(low),
        "upper": round_constant(high),
        "typical": round_constant(value),
    }
