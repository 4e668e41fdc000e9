"""A drafted term: its values, its curve, and its effect file for a person to edit and keep."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bampipe.arrays import Array
from bampipe.diagnosis.drafts.forms import Form, round_constant
from bampipe.results.rounding import NORMAL_95, round_with_sd

_PLACE_IN_WIDTHS = 2.0
_PLACE_IN_SPANS = 0.1
_LENGTH_RATIO = 3.0
_WAVES = 0.5
_LEAST_REACH = 0.1
"""Range of a later fit around the estimate: of a place in widths of the shape, or spans without
one, of a length as a ratio, of a wavenumber in waves on the span, of a number at least."""


@dataclass(frozen=True)
class Term:
    """A form with the fitted values of its constants, by name, and their covariance."""

    form: Form
    values: dict[str, float]
    covariance: Array

    @property
    def sd(self) -> dict[str, float]:
        """Standard deviations of the constants, by name."""
        spread = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return dict(zip(self.values, map(float, spread), strict=True))

    def curve(self, count: int = 121) -> tuple[Array, Array, Array]:
        """Return quantity, torque and its standard deviation along the range, (count,) each.

        The motion is in the positive direction, at the highest speed and acceleration and at the
        upper end of all other quantities.
        """
        x = np.linspace(self.form.span.low, self.form.span.high, count)[:, None]
        others = [np.full((count, 1), span.high) for _, span in self.form.other_quantities]
        x = np.hstack([x, *others])
        values = np.array(list(self.values.values()))
        middle, steps = self._at(x, values), np.diag(1e-4 * np.maximum(np.abs(values), 1e-9))
        slope = np.array([(self._at(x, values + s) - middle) / s.sum() for s in steps])
        variance = np.einsum("kt,kl,lt->t", slope, self.covariance, slope)
        return x[:, 0], middle, np.sqrt(np.maximum(variance, 0.0))

    def _at(self, x: Array, values: Array) -> Array:
        known = dict(zip(self.values, values, strict=True))
        columns = self.form.shape.columns(x, self.form.constants_at(known, 0.0), is_quick=True)
        return np.asarray(columns @ [known[n] for n in self.form.shape.strengths])

    def declaration(self, source: str) -> dict[str, Any]:
        """Return the content of its effect file, with the estimates.

        Strengths keep the prior 0, at which the effect is absent, and have the estimate as typical
        value. The estimates of the other constants become their priors.
        """
        entries = {}
        for name, entry in self.form.entries().items():
            entries[name] = dict(entry)
            if name in self.values:
                interval = round_with_sd(self.values[name], NORMAL_95 * self.sd[name])
                said = f"; drafted as {interval} {entry['unit']}"
                entries[name]["description"] += said.rstrip()
                entries[name] |= self._numbers(name)
        return self.form.declaration(source, entries)

    def _numbers(self, name: str) -> dict[str, float]:
        """Return prior, standard deviation, bounds and typical value of one constant."""
        value, span = self.values[name], self.form.span
        kind = self.form.shape.searched.get(name)
        if kind is None:
            size = max(2.0 * abs(value), 1e-6)
            return {"sd": round_constant(size), "typical": round_constant(value)}
        if kind in ("length", "time"):
            low, high = value / _LENGTH_RATIO, value * _LENGTH_RATIO
        else:
            wide = _PLACE_IN_SPANS * span.width
            if "width" in self.values:
                wide = _PLACE_IN_WIDTHS * self.values["width"]
            reach = {
                "place": wide,
                "number": max(abs(value), _LEAST_REACH),
                "wavenumber": 2.0 * np.pi * _WAVES / span.width,
            }[kind]
            low, high = value - reach, value + reach
            if kind == "wavenumber":
                low = max(low, 0.5 * value)
        numbers = {"prior": value, "sd": 0.25 * (high - low), "lower": low, "upper": high}
        return {key: round_constant(one) for key, one in (numbers | {"typical": value}).items()}
