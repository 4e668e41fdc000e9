"""The first pass of a search for a formula: every form by columns, without compiling any of them.

They are fitted beside the slopes by the model's own parameters. That is a thousandth of a refit's
cost, so that measured trials and replays can be searched alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from bampipe.discover.drafts.axis_signals import AxisSignals
from bampipe.discover.drafts.forms import READING, Form, forms
from bampipe.discover.drafts.quantities import Span
from bampipe.discover.drafts.shapes import hats
from bampipe.trials.evidence import Evidence

Array = NDArray[np.float64]

_LENGTHS = (0.02, 0.6, 6)
"""Of the range, from, to, how many."""
_LAGS = 12
_PLACES_APART = 0.05
"""Of the range, for shapes without a length of their own."""
_NEAREST = 1.3
"""Distance of neighbouring places, in lengths of the shape."""
_WAVES_APART = 0.4
"""Between neighbouring wavenumbers, in waves on the range: they still resemble each other."""
_KNOTS = (8, 16, 32, 64)
"""Points of the curves that bound what a formula could do."""
_PARTS_OF_A_WAVE = (0.25, 0.4, 0.6, 0.8)
_MOST_WAVES, _MOST_WAVES_IN_TIME = 30.0, 300.0
_REFINED = 12
"""Forms whose searched constants are refined, the best on the grid."""
_TRIES = 90
"""Evaluations in refining one."""
_LEFT, _MARGIN = (0.005, 0.995), 0.03
"""Shares of the squared residual between which a curve is put, and what is added at either end, of
the range."""


@dataclass(frozen=True)
class Screened:
    """A form as the first pass found it.

    Attributes:
        form: what it is.
        values: strengths, then searched constants, in the order of the form's shape.
        gain: log likelihood ratio on trials left out, in independent samples.
    """

    form: Form
    values: dict[str, float]
    gain: float


class Screen:
    """The residual of one axis, ready to be held against forms.

    Attributes:
        signals: of the axis; fit: its residual beside what the model's own parameters can do.
    """

    def __init__(self, evidence: Evidence, axis: int, curves: bool = False) -> None:
        """Take the fitted trials of ``evidence``.

        Args:
            evidence: of the model; axis: number of the coordinate.
            curves: whether curves through points are looked for in place of formulas.
        """
        self.signals, self._curves = AxisSignals(evidence, axis), curves
        self.fit = self.signals.residual()

    @cached_property
    def spans(self) -> dict[str, Span]:
        """The range of each coordinate that varies."""
        ends = self.signals.ranges
        if self._curves:
            # The few points of a curve belong where something is left.
            ends = {n: self._where_left(n, *span) for n, span in ends.items()}
        return {n: Span(float(a), float(b)) for n, (a, b) in ends.items() if b - a > 1e-9}

    def _where_left(self, name: str, low: float, high: float) -> Array:
        """The part of the range of a coordinate that holds nearly all of what is left."""
        at = self.signals.samples(name)
        order = np.argsort(at, kind="stable")
        mass = np.cumsum(self.fit.left[order] ** 2)
        share = np.searchsorted(mass / max(float(mass[-1]), 1e-300), _LEFT)
        margin = _MARGIN * (high - low)
        ends = at[order][np.minimum(share, len(at) - 1)] + np.array([-margin, margin])
        return np.asarray(np.clip(ends, low, high))

    def forms(self) -> list[Form]:
        """Every form that these trials can hold the residual against."""
        of = self.signals
        found = forms(of.device, of.axis, self.spans, of.times, of.scales, self._curves)
        return [f for f in found if f.factor != READING or f.target in of.scaled_readings]

    def _grid(self, form: Form) -> dict[str, Array]:
        """Values of the searched constants to try, each (G,)."""
        span, names = form.span, tuple(form.shape.searched)
        lengths = span.width * np.geomspace(*_LENGTHS)
        if names == ("place", "width"):
            apart = [_places(span, width) for width in lengths]
            points = np.array(
                [
                    np.concatenate(apart),
                    np.concatenate(
                        [np.full(len(a), w) for a, w in zip(apart, lengths, strict=True)]
                    ),
                ]
            )
        elif names == ("place",):
            points = _places(span, _PLACES_APART * span.width)[None]
        elif names == ("width",):
            points = lengths[None]
        elif names == ("width", "longer"):
            points = np.array(list(combinations(lengths, 2))).T
        elif names == ("lag",):
            points = np.geomspace(4.0 * self.signals.times.low, self.signals.times.high, _LAGS)[
                None
            ]
        elif names == ("wavenumber",):
            most = _MOST_WAVES
            if form.coordinate.quantity == "time":
                most = span.width * self.signals.cutoff_hz
            many = np.arange(1.0, max(min(most, _MOST_WAVES_IN_TIME), 2.0), _WAVES_APART)
            waves = np.concatenate([_PARTS_OF_A_WAVE, many])
            points = 2.0 * np.pi * waves[None] / span.width
        else:
            return {}
        return dict(zip(names, points, strict=True))

    def search(self) -> list[Screened]:
        """Every form at its best on the grid, the best of them refined; best first."""
        found = []
        for form in self.forms():
            grid = self._grid(form)
            explained, _ = self.fit.explained(self.signals.columns(form, grid))
            best = int(np.argmax(explained))
            at = {name: float(values[best]) for name, values in grid.items()}
            found.append((float(explained[best]), form, at))
        found.sort(key=lambda entry: -entry[0])
        screened = [self.refined(form, at) for _, form, at in found[:_REFINED]]
        return sorted(screened, key=lambda s: -s.gain)

    def refined(self, form: Form, at: dict[str, float]) -> Screened:
        """A form with its searched constants at their best, near ``at``."""
        limits = form.limits()
        names = list(at)
        low = np.array([limits[n][0] for n in names])
        high = np.array([limits[n][1] for n in names])

        def lost(x: Array) -> float:
            inside = np.clip(x, low, high)
            searched = {n: np.array([v]) for n, v in zip(names, inside, strict=True)}
            return -float(self.fit.explained(self.signals.columns(form, searched))[0][0])

        if names:
            start = np.array([at[n] for n in names])
            step = {"place": 0.02, "wavenumber": 0.15 * 2.0 * np.pi}
            sizes = []
            for name, kind in form.shape.searched.items():
                width = form.span.width
                size = step.get(kind, 0.0)
                sizes.append(size / width if kind == "wavenumber" else size * width)
                if kind in ("length", "time"):
                    sizes[-1] = 0.25 * at[name]
                if kind == "number":
                    sizes[-1] = 0.1 * max(abs(at[name]), 0.3)
            simplex = np.vstack([start, start + np.diag(sizes)])
            options = {"maxfev": _TRIES, "initial_simplex": simplex, "xatol": 1e-6, "fatol": 0.0}
            best = minimize(lost, start, method="Nelder-Mead", options=options).x
            at = dict(zip(names, map(float, np.clip(best, low, high)), strict=True))
        return self.at(form, at)

    def at(self, form: Form, at: dict[str, float]) -> Screened:
        """A form with its searched constants ``at`` given values."""
        searched = {n: np.array([v]) for n, v in at.items()}
        columns = self.signals.columns(form, searched)
        strengths = self.fit.explained(columns)[1][0]
        values = dict(zip(form.shape.strengths, map(float, strengths), strict=True)) | at
        gain = self.fit.gain(columns[:, :, 0].T)
        gain += self.fit.independent * self.signals.drive_slope(form, values)
        return Screened(form, values, gain)

    def curve_bound(self, form: Form) -> tuple[int, float]:
        """What no formula of the form's coordinate, acting as it does, could do better.

        Curves through ever more points: the number of the best, and the share of the held-out error
        that it leaves.
        """
        span, found = form.span, []
        for count in _KNOTS:
            spacing = span.width / (count - 1)

            def knots(x: Array, spacing: float = spacing, count: int = count) -> list[Array]:
                inside = np.clip(x, span.low, span.high)
                return [c[:, None] for c in hats(inside, span.low, spacing, count).T]

            columns = self.signals.acting(form, knots)[:, :, 0].T
            found.append((self.fit.share_left(columns), count))
        share, count = min(found)
        return count, share


def _places(span: Span, length: float) -> Array:
    """Places along a span, near enough that none of that length is missed."""
    count = max(4, int(np.ceil(span.width / (_NEAREST * length))))
    return np.asarray(span.low + span.width * (np.arange(count) + 0.5) / count)
