"""Forms as candidates, with the columns that they add to the residual.

A `FormDictionary` has the interface of a `Dictionary` of compiled effects, but compiles nothing.
Its columns are computed at a few times the rate of the thinned residual and low-passed like it.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from itertools import combinations, product

import numpy as np

from bampipe.arrays import Array, Indices
from bampipe.diagnosis.dictionary import Atom, Key
from bampipe.diagnosis.drafts import forms
from bampipe.diagnosis.drafts.shapes import SHAPES
from bampipe.estimate.low_pass import low_pass_at
from bampipe.trials.linearisation import Linearisation
from bampipe.trials.samples import Samples

_FINER = 5
"""Smallest ratio of the rate at which columns are computed to the thinned rate."""
_RANGE = (0.002, 0.998)
"""Quantiles that define the range of a quantity."""
_LENGTHS = (0.02, 0.6, 6)
"""Grid of lengths, as shares of the range: smallest, largest, number."""
_LAGS = 12
_PLACES_APART = 0.05
"""Distance of neighbouring places of shapes without a length, as a share of the range."""
_NEAREST = 1.3
"""Distance of neighbouring places of other shapes, in lengths of the shape."""
_WAVES_APART = 0.4
"""Distance of neighbouring wavenumbers, in waves on the range; they are still correlated."""
_PARTS_OF_A_WAVE = (0.25, 0.4, 0.6, 0.8)
_MOST_WAVES, _MOST_WAVES_IN_TIME = 30.0, 300.0
_LOAD, _APPLIED = "load", "applied"
"""Names of the signals of the applied force, without and with its sign."""


class FormDictionary:
    """The forms that may act on one axis, beside one fitted model.

    Attributes:
        samples: samples of the residual that count; axis: index of the coordinate.
        candidates: forms by name.
        starts: initial constants of candidates without a grid.
    """

    def __init__(self, linearisation: Linearisation, samples: Sequence[Samples], axis: int) -> None:
        self.linearisation, self.samples, self.axis = linearisation, samples, axis
        self.candidates: dict[str, forms.Form] = {}
        self.starts: dict[str, Mapping[str, float]] = {}

    def add_grammar(self, curves: bool = False, left: Array | None = None) -> None:
        """Add every form of the grammar, or ``curves`` through points instead of formulas.

        The residual ``left`` (n,) of the axis limits the ranges of curves.
        """
        spans = self.spans
        if left is not None:
            spans = {n: self._where_left(n, span, left) for n, span in spans.items()}
        device = self.linearisation.system.model.device
        for quantity in forms.list_quantities(device, self.axis):
            if quantity.words not in spans:
                continue  # it does not vary
            for (kind, own, factor), shapes in (forms.CURVED if curves else forms.GRAMMAR).items():
                if (kind, own) != (quantity.quantity, quantity.axis == self.axis):
                    continue
                for shape in shapes:
                    if shape == "ripple" and kind == "position" and own and device.drive:
                        continue  # the library has the ripple of a motor
                    form = forms.Form(
                        device.coordinates[self.axis], self.axis, factor, SHAPES[shape], quantity,
                        spans[quantity.words], self.times, self.scales.get(factor, 1.0),
                    )  # fmt: skip
                    self.candidates[form.canonical_name] = form

    def grid(self, name: str) -> list[Key]:
        """Return the initial shapes of a form."""
        form = self.candidates[name]
        points = [self.starts[name]] if name in self.starts else self._points(form)
        return [self.key(name, point) for point in points]

    def key(self, name: str, searched: Mapping[str, float]) -> Key:
        """Return the key of a form at given values of its searched constants."""
        shape = []
        for constant, low, high, by_ratio in self._ranges(name):
            ends = [low, float(np.clip(searched[constant], low, high)), high]
            at = np.log(ends) if by_ratio else ends
            shape.append(float((at[1] - at[0]) / (at[2] - at[0])))
        return name, tuple(shape)

    def values(self, key: Key) -> dict[str, float]:
        """Return the searched constants of a form at one shape."""
        return {
            constant: float(low * (high / low) ** u if by_ratio else low + u * (high - low))
            for u, (constant, low, high, by_ratio) in zip(key[1], self._ranges(key[0]), strict=True)
        }

    def _ranges(self, name: str) -> list[tuple[str, float, float, bool]]:
        """Return searched constants, the ends of their ranges, and whether to step by ratios."""
        form = self.candidates[name]
        by_ratio = ("length", "time", "wavenumber")
        limits, kinds = form.limits().items(), form.shape.searched
        return [(n, low, high, kinds[n] in by_ratio) for n, (low, high, _) in limits]

    def priors(self, name: str) -> list[tuple[float, float, float]]:
        """Return infinite bounds of each strength of a form, and the applied force as its sd."""
        form = self.candidates[name]
        size = self._sizes[form.coordinate.words if form.factor == forms.READING else _LOAD]
        return [(-np.inf, np.inf, max(size, 1e-300))] * len(form.shape.strengths)

    def make(self, key: Key) -> Atom | None:
        """Compute a form at one shape; None if it has no effect in these trials."""
        form, searched = self.candidates[key[0]], self.values(key)
        constants = form.constants_at(searched, 1.0 / self._rate_hz)
        # An error of a reading acts on every axis that the force drives.
        axes = range(len(self.samples)) if form.factor == forms.READING else [self.axis]
        rows: dict[int, list[Array]] = {axis: [] for axis in axes}
        slopes: dict[int, list[Array]] = {axis: [] for axis in axes}
        for i, (_, kept) in enumerate(self._sampling):
            x = np.hstack([self._signals[q.words][i] for q, _ in form.quantities])
            with np.errstate(all="ignore"):
                values = form.shape.columns(x, constants)
            for axis in axes:
                lever = self._lever(form, axis, i) / form.scale
                acting = values * lever
                if form.factor == forms.INERTIA:
                    # Lagrange's equation for the kinetic energy.
                    turning = (
                        np.gradient(values, axis=0)
                        * self._rate_hz
                        * self._signals[forms.DAMPING][i]
                    )
                    acting = -acting - (0.5 if form.is_own else 1.0) * turning / form.scale
                cutoff = float(self.linearisation.band.cutoff_hz[axis])
                rows[axis].append(low_pass_at(acting, cutoff, self._rate_hz, kept))
                if form.coordinate.quantity in (_LOAD, forms.READING):
                    slope = _slopes(values, x[:, 0])[kept] * lever[kept]
                    slopes[axis].append(slope[:, None, :] * self._by_forces(form, i, kept))
        here = {axis: np.concatenate(r)[self.samples[axis].rows] for axis, r in rows.items()}
        found = {axis: r for axis, r in here.items() if r.any()}
        enough = found and all(np.isfinite(r).all() for r in found.values())
        if not enough or not np.any([r.any(axis=0) for r in found.values()], axis=0).all():
            return None
        by_force = {
            axis: np.concatenate(s)[self.samples[axis].rows] for axis, s in slopes.items() if s
        }
        return Atom(found, by_force, np.ones(len(self.samples)))

    def thin(self, words: str) -> Array:
        """Return a quantity, low-passed like the residual and at its samples, (n,)."""
        cutoff = float(self.linearisation.band.cutoff_hz[self.axis])
        found = [
            low_pass_at(signal, cutoff, self._rate_hz, kept)[:, 0]
            for signal, (_, kept) in zip(self._signals[words], self._sampling, strict=True)
        ]
        return np.asarray(np.concatenate(found)[self.samples[self.axis].rows])

    def _where_left(self, words: str, span: forms.Span, left: Array) -> forms.Span:
        """Return the part of the range of a quantity that contains nearly all of a residual."""
        at = self.thin(words)
        order = np.argsort(at, kind="stable")
        mass = np.cumsum(left[order] ** 2)
        ends = np.searchsorted(mass, mass[-1] * np.array([0.005, 0.995]))
        low, high = at[order][np.minimum(ends, len(at) - 1)] + 0.03 * span.width * np.array([-1, 1])
        return forms.Span(max(float(low), span.low), min(float(high), span.high))

    @cached_property
    def _sampling(self) -> list[tuple[slice, Indices]]:
        """Samples at which columns are computed, and which of them are kept, by trial."""
        band = self.linearisation.band
        fits = [d for d in range(1, band.step + 1) if band.step % d == 0]
        every = max(d for d in fits if d * _FINER <= band.step or d == 1)
        found = []
        for motion in self.linearisation.motions:
            kept = band.thinned_rows(len(motion.t))
            first = int(kept[0]) % every if len(kept) else 0
            found.append((slice(first, None, every), (kept - first) // every))
        return found

    @cached_property
    def _sizes(self) -> dict[str, float]:
        """Root mean square of each signal."""
        return {
            n: float(np.sqrt(np.mean(np.concatenate(s) ** 2))) for n, s in self._signals.items()
        }

    @property
    def _rate_hz(self) -> float:
        return float(self.linearisation.band.rate_hz / self._sampling[0][0].step)

    @cached_property
    def _signals(self) -> dict[str, list[Array]]:
        """Quantities by their words, and velocity and acceleration of the axis, each (T, 1)."""
        e, axis = self.linearisation, self.axis
        system, device = e.system, e.system.model.device
        found: dict[str, list[Array]] = {}
        for fitted, (rows, _) in zip(e.fitted, self._sampling, strict=True):
            motion = fitted.mechanism
            q, qd, qdd = motion.q[rows], motion.qd[rows], motion.qdd[rows]
            u, z = motion.inputs(system.inputs)[rows], fitted.memory[rows]
            applied = system.applied(q, qd, qdd, z, u, e.p)[:, axis]
            sign = np.tanh(qd[:, axis] / device.coordinates[axis].sign_width)
            values = {_APPLIED: applied, forms.FRICTION: sign}
            values |= {forms.DAMPING: qd[:, axis], forms.INERTIA: qdd[:, axis]}
            for c in forms.list_quantities(device, axis):
                by_quantity = {
                    "position": q[:, c.axis],
                    "speed": np.abs(qd[:, c.axis]),
                    "velocity": qd[:, c.axis],
                    "direction": sign,
                    _LOAD: np.abs(applied),
                    "time": motion.t[rows],
                }
                logged = motion.channels.get(c.channel, np.zeros(len(motion.t)))[rows]
                values[c.words] = logged if c.channel else by_quantity[c.quantity]
            for name, column in values.items():
                found.setdefault(name, []).append(column[:, None])
        return found

    @cached_property
    def _pulls(self) -> list[Array]:
        """Force on each axis by each measured force, by trial, (T, n_q, n_forces)."""
        e, found = self.linearisation, []
        for fitted, (rows, _) in zip(e.fitted, self._sampling, strict=True):
            motion = fitted.mechanism
            u = motion.inputs(e.system.inputs)[rows]
            found.append(np.asarray(e.system.input_map(motion.q[rows], u, e.p)))
        return found

    def _lever(self, form: forms.Form, axis: int, trial: int) -> Array:
        """Return the factor on the shape of a form on an axis, (T, 1)."""
        if form.factor == forms.READING:
            component = self.linearisation.system.model.device.forces.index(form.coordinate.channel)
            return -self._pulls[trial][:, axis, [component]]
        return np.ones((1, 1)) if form.factor == forms.FORCE else self._signals[form.factor][trial]

    def _by_forces(self, form: forms.Form, trial: int, kept: Indices) -> Array:
        """Return the slope of a form's quantity by the measured forces, (K, n_forces, 1)."""
        forces = self.linearisation.system.model.device.forces
        if form.factor == forms.READING:
            return np.array([[[float(f == form.coordinate.channel)] for f in forces]])
        pulls, applied = self._pulls[trial][kept, self.axis], self._signals[_APPLIED][trial][kept]
        return np.asarray(pulls * np.sign(applied))[:, :, None]

    @cached_property
    def spans(self) -> dict[str, forms.Span]:
        """The range of each quantity that varies."""
        device = self.linearisation.system.model.device
        words = [c.words for c in forms.list_quantities(device, self.axis)]
        ends = {n: np.quantile(np.concatenate(self._signals[n]), _RANGE) for n in words}
        return {n: forms.Span(float(a), float(b)) for n, (a, b) in ends.items() if b - a > 1e-9}

    @cached_property
    def scales(self) -> dict[str, float]:
        """Highest speed and acceleration of the axis."""
        largest = {
            f: float(np.quantile(np.abs(np.concatenate(self._signals[f])), _RANGE[1]))
            for f in (forms.DAMPING, forms.INERTIA)
        }
        return {f: value for f, value in largest.items() if value > 0.0}

    @cached_property
    def times(self) -> forms.Span:
        """Time between samples and of a trial, s."""
        trials = [motion.t for motion in self.linearisation.motions]
        return forms.Span(
            float(np.median(np.diff(trials[0]))), max(float(np.ptp(t)) for t in trials)
        )

    def _points(self, form: forms.Form) -> list[dict[str, float]]:
        """Return the grid of the searched constants of a form."""
        span, names = form.span, tuple(form.shape.searched)
        lengths, most = span.width * np.geomspace(*_LENGTHS), _MOST_WAVES
        if form.coordinate.quantity == "time":
            cutoff = float(self.linearisation.band.cutoff_hz[self.axis])
            most = min(span.width * cutoff, _MOST_WAVES_IN_TIME)
        waves = [*_PARTS_OF_A_WAVE, *np.arange(1.0, max(most, 2.0), _WAVES_APART)]
        grids: dict[tuple[str, ...], Iterable[Sequence[float]]] = {
            (): [()],
            ("place",): product(_places(span, _PLACES_APART * span.width)),
            ("place", "width"): [(at, w) for w in lengths for at in _places(span, w)],
            ("width",): product(lengths),
            ("width", "longer"): combinations(lengths, 2),
            ("lag",): product(np.geomspace(4.0 * self.times.low, self.times.high, _LAGS)),
            ("wavenumber",): product(2.0 * np.pi * np.array(waves) / span.width),
        }
        return [dict(zip(names, map(float, point), strict=True)) for point in grids[names]]


def _places(span: forms.Span, length: float) -> Array:
    """Return places along a span, close enough for a shape of the given length."""
    count = max(4, int(np.ceil(span.width / (_NEAREST * length))))
    return np.asarray(span.low + span.width * (np.arange(count) + 0.5) / count)


def _slopes(values: Array, x: Array) -> Array:
    """Return the slopes of columns (T, m) along a trial by their quantity, (T,)."""
    rate = np.gradient(x)[:, None]
    moves = np.abs(rate) > 1e-9 * max(float(np.ptp(x)), 1e-300)
    return np.divide(np.gradient(values, axis=0), rate, out=np.zeros_like(values), where=moves)
