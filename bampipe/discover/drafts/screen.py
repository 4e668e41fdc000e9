"""The first pass of a search for a formula: every form by columns, without compiling any of them.

Columns are made at a few times the rate of the thinned residual, pass the same low-pass, and are
fitted beside the slopes by the model's own parameters. That is a thousandth of a refit's cost, so
that measured trials and replays can be searched alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from bampipe.discover.drafts.forms import (
    DAMPING,
    FORCE,
    FRICTION,
    INERTIA,
    READING,
    Form,
    forms,
)
from bampipe.discover.drafts.quantities import Span, coordinates
from bampipe.discover.drafts.shapes import hats
from bampipe.discover.settings import Settings
from bampipe.estimate.low_pass import low_pass_at
from bampipe.trials.folds import HELD_OUT
from bampipe.trials.residuals import Evidence

Array = NDArray[np.float64]

_FINER = 5
"""Times the thinned rate at which columns are made, at least."""
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
_NEGLIGIBLE = 1e-9
_APPLIED = "applied"
"""Of the signals: what drives the axis, with its sign."""
_STEP, _LEAST_SLOPE = 1e-6, 1e-3
"""Relative step of the drive; slope of the residual by it below which it counts as cancelled."""
_KNOWN = 2.0
"""Times the residual that the force must be beyond what the model's own parameters can do: it is
once where these scale with it, and more than three times on an arm of known inertia."""
_RANGE = (0.002, 0.998)
"""Quantiles of a coordinate between which it is said to vary."""
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
    """The residual of one axis, ready to be held against forms."""

    def __init__(self, evidence: Evidence, axis: int, curves: bool = False) -> None:
        """Take the fitted trials of ``evidence``.

        Args:
            evidence: of the model; axis: number of the coordinate.
            curves: whether curves through points are looked for in place of formulas.
        """
        self.evidence, self.axis, self._curves = evidence, axis, curves
        groups, fitted = evidence.folds.groups, evidence.folds.fitted
        self.trials = [k for k, fits in enumerate(fitted) if fits and groups[k] != HELD_OUT]
        self._rows = [evidence.used[k][:, axis] for k in self.trials]
        self._residual = np.concatenate(
            [evidence.residual[k][r, axis] for k, r in zip(self.trials, self._rows, strict=True)]
        )
        slopes = np.concatenate(
            [evidence.jacobian[k][r, axis] for k, r in zip(self.trials, self._rows, strict=True)]
        )
        size = np.linalg.norm(slopes, axis=0)
        self._slopes = slopes[:, size > 0.0] / size[size > 0.0]
        self._group = np.concatenate(
            [np.full(r.sum(), groups[k]) for k, r in zip(self.trials, self._rows, strict=True)]
        )
        self.independent = max(
            float(len(self._residual) * evidence.band.independent_share[axis]), 1.0
        )

    @cached_property
    def _basis(self) -> Array:
        """Orthonormal columns that span what the model's own parameters can do, (n, r)."""
        return _orthonormal(self._slopes)

    @cached_property
    def left(self) -> Array:
        """What they leave of the residual, (n,)."""
        return np.asarray(self._residual - self.taken(self._residual))

    def taken(self, values: Array) -> Array:
        """What the model's own parameters can do of ``values`` where the residual is, (n,)."""
        return np.asarray(self._basis @ (self._basis.T @ values))

    def thinned(self, name: str) -> Array:
        """A signal, low-passed as the residual is, (n,)."""
        cutoff = self.evidence.band.cutoff_hz[self.axis]
        found = [
            low_pass_at(self.signals[name][i], cutoff, self._rate_hz, kept)[rows, 0]
            for i, ((_, kept), rows) in enumerate(zip(self._sampling, self._rows, strict=True))
        ]
        return np.concatenate(found)

    @cached_property
    def _sampling(self) -> list[tuple[slice, NDArray[np.int64]]]:
        """By trial: the samples at which columns are made, and which of these are kept."""
        band = self.evidence.band
        fits = [d for d in range(1, band.step + 1) if band.step % d == 0]
        every = max(d for d in fits if d * _FINER <= band.step or d == 1)
        found = []
        for k in self.trials:
            kept = band.thinned_rows(len(self.evidence.motions[k].t))
            first = int(kept[0]) % every if len(kept) else 0
            found.append((slice(first, None, every), (kept - first) // every))
        return found

    @property
    def _rate_hz(self) -> float:
        every = self._sampling[0][0].step
        return float(self.evidence.band.rate_hz / every)

    @cached_property
    def signals(self) -> dict[str, list[Array]]:
        """The coordinates and factors of the axis by words, by trial, each (T, 1)."""
        evidence, axis = self.evidence, self.axis
        system = evidence.system
        device = system.model.device
        found: dict[str, list[Array]] = {}
        for k, (rows, _) in zip(self.trials, self._sampling, strict=True):
            motion = evidence.motions[k]
            q, qd, qdd = motion.q[rows], motion.qd[rows], motion.qdd[rows]
            u = motion.inputs(system.inputs)[rows]
            z = evidence.fitted[k].memory[rows]
            applied = system.applied(q, qd, qdd, z, u, evidence.p)[:, axis]
            width = device.coordinates[axis].sign_width
            values = {
                _APPLIED: applied,
                FORCE: np.ones(len(q)),
                FRICTION: np.tanh(qd[:, axis] / width),
                DAMPING: qd[:, axis],
                INERTIA: qdd[:, axis],
            }
            pulls = system.input_map(q, u, evidence.p)[:, axis]
            for name, pull in zip(device.components, pulls.T, strict=True):
                values[f"{READING} {name}"] = -pull
            for c in coordinates(device, axis):
                by_quantity = {
                    "position": q[:, c.axis],
                    "speed": np.abs(qd[:, c.axis]),
                    "velocity": qd[:, c.axis],
                    "direction": values[FRICTION],
                    "load": np.abs(applied),
                    "time": motion.t[rows],
                }
                logged = motion.channels.get(c.channel, np.zeros(len(motion.t)))[rows]
                values[c.words] = logged if c.channel else by_quantity[c.quantity]
            for name, column in values.items():
                found.setdefault(name, []).append(column[:, None])
        return found

    @cached_property
    def spans(self) -> dict[str, Span]:
        """The range of each coordinate that varies."""
        names = [c.words for c in coordinates(self.evidence.system.model.device, self.axis)]
        ends = {n: np.quantile(np.concatenate(self.signals[n]), _RANGE) for n in names}
        if self._curves:
            # The few points of a curve belong where something is left.
            ends = {n: self._where_left(n, *span) for n, span in ends.items()}
        return {n: Span(float(a), float(b)) for n, (a, b) in ends.items() if b - a > 1e-9}

    def _where_left(self, name: str, low: float, high: float) -> Array:
        """The part of the range of a coordinate that holds nearly all of what is left."""
        at = np.concatenate(
            [
                self.signals[name][i][kept, 0][rows]
                for i, ((_, kept), rows) in enumerate(zip(self._sampling, self._rows, strict=True))
            ]
        )
        order = np.argsort(at, kind="stable")
        mass = np.cumsum(self.left[order] ** 2)
        share = np.searchsorted(mass / max(float(mass[-1]), 1e-300), _LEFT)
        margin = _MARGIN * (high - low)
        ends = at[order][np.minimum(share, len(at) - 1)] + np.array([-margin, margin])
        return np.asarray(np.clip(ends, low, high))

    @cached_property
    def scales(self) -> dict[str, float]:
        """Highest speed and acceleration of the axis."""
        largest = {
            f: float(np.quantile(np.abs(np.concatenate(self.signals[f])), _RANGE[1]))
            for f in (DAMPING, INERTIA)
        }
        return {f: value for f, value in largest.items() if value > 0.0}

    def forms(self) -> list[Form]:
        """Every form that these trials can hold the residual against."""
        device = self.evidence.system.model.device
        found = forms(device, self.axis, self.spans, self.times, self.scales, self._curves)
        return [f for f in found if f.factor != READING or f.target in self._scaled_readings]

    @cached_property
    def _scaled_readings(self) -> set[str]:
        """Force components that act on the axis and whose scale the model knows.

        Where all parameters may shrink with the force, an error that cancels most of the force
        would seem to explain anything.
        """
        evidence, device = self.evidence, self.evidence.system.model.device
        by_component: dict[str, list[Array]] = {name: [] for name in device.components}
        left, slopes = [], []
        for k in self.trials:
            motion, used = evidence.motions[k], evidence.used[k]
            u = motion.inputs(evidence.system.inputs)
            pulls = evidence.system.input_map(motion.q, u, evidence.p)
            read = motion.inputs(device.forces)
            for c, name in enumerate(device.components):
                acting = evidence.band.thin(pulls[:, :, c] * read[:, c, None])
                by_component[name].append((acting / self._errors)[used])
            left.append((evidence.residual[k] / self._errors)[used])
            slopes.append((evidence.jacobian[k] / self._errors[:, None])[used])
        slope = np.concatenate(slopes)
        size = np.linalg.norm(slope, axis=0)
        basis = _orthonormal(slope[:, size > 0.0] / size[size > 0.0])
        error = float(np.linalg.norm(np.concatenate(left)))
        found = set()
        for name, parts in by_component.items():
            acting = np.concatenate(parts)
            beyond = float(np.linalg.norm(acting - basis @ (basis.T @ acting)))
            if beyond > _KNOWN * error and any(map(np.any, self.signals[f"{READING} {name}"])):
                found.add(name)
        return found

    @cached_property
    def _errors(self) -> Array:
        """Root mean square of the residual, by axis, (n_q,)."""
        return np.maximum(self.evidence.rmse(), 1e-12)

    @cached_property
    def times(self) -> Span:
        """Time between samples and of a trial, s."""
        trials = [self.evidence.motions[k].t for k in self.trials]
        return Span(float(np.median(np.diff(trials[0]))), max(float(np.ptp(t)) for t in trials))

    def columns(self, form: Form, searched: dict[str, Array]) -> Array:
        """What each strength adds to the low-passed residual, (m, n, G).

        Args:
            form: what acts; searched: its searched constants, each (G,).
        """
        constants = {name: value for name, (value, _) in form.fixed().items()} | searched
        constants["interval"] = 1.0 / self._rate_hz
        return self._acting(form, lambda x: form.shape.columns(x, constants))

    def _acting(self, form: Form, shape: Callable[[Array], Sequence[Array]]) -> Array:
        """Columns of ``shape`` of the form's coordinate, (m, n, G), acting as the form does."""
        cutoff = self.evidence.band.cutoff_hz[self.axis]
        by_trial = []
        for i, (_, kept) in enumerate(self._sampling):
            x = np.hstack([self.signals[q.words][i] for q, _ in form.quantities])
            factor = self.signals[form.lever][i] / form.scale
            values = np.stack(np.broadcast_arrays(*shape(x)))
            acting = values * factor
            if form.factor == INERTIA:
                # By Lagrange's equation of the kinetic energy.
                turning = np.gradient(values, axis=1) * self._rate_hz * self.signals[DAMPING][i]
                acting = -acting - (0.5 if form.is_own else 1.0) * turning / form.scale
            stacked = np.moveaxis(acting, 0, 1).reshape(len(x), -1)
            thin = low_pass_at(stacked, cutoff, self._rate_hz, kept)[self._rows[i]]
            by_trial.append(np.moveaxis(thin.reshape(len(thin), len(values), -1), 1, 0))
        return np.concatenate(by_trial, axis=1)

    def _explained(self, columns: Array) -> tuple[Array, Array]:
        """Sum of squares that columns (m, n, G) take beside the model, (G,), and strengths."""
        m, _, count = columns.shape
        inside = [self._basis.T @ column for column in columns]
        normal, size = np.empty((count, m, m)), np.empty((count, m))
        for a in range(m):
            size[:, a] = np.einsum("ng,ng->g", columns[a], columns[a])
            for b in range(a, m):
                full = size[:, a] if a == b else np.einsum("ng,ng->g", columns[a], columns[b])
                normal[:, a, b] = normal[:, b, a] = full - np.sum(inside[a] * inside[b], axis=0)
        # What the model's own parameters can do as well is no explanation.
        scale = np.sqrt(np.maximum(size, 1e-30))
        normal = normal / scale[:, :, None] / scale[:, None, :] + _NEGLIGIBLE * np.eye(m)
        moment = -np.stack([self.left @ column for column in columns], axis=1) / scale
        strengths = np.linalg.solve(normal, moment[:, :, None])[:, :, 0]
        return np.sum(strengths * moment, axis=1), strengths / scale

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
            points = np.geomspace(4.0 * self.times.low, self.times.high, _LAGS)[None]
        elif names == ("wavenumber",):
            most = _MOST_WAVES
            if form.coordinate.quantity == "time":
                most = span.width * self.evidence.band.cutoff_hz[self.axis]
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
            explained, _ = self._explained(self.columns(form, grid))
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
            return -float(self._explained(self.columns(form, searched))[0][0])

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
        columns = self.columns(form, searched)
        strengths = self._explained(columns)[1][0]
        values = dict(zip(form.shape.strengths, map(float, strengths), strict=True)) | at
        gain = self._gain(columns[:, :, 0].T) + self.independent * self._slope(form, values)
        return Screened(form, values, gain)

    def _slope(self, form: Form, values: dict[str, float]) -> float:
        """Mean of log |d residual / d drive| with a form, of which the model alone has one.

        What follows the load can cancel the drive, which is to be explained: the residual is then
        small whatever the device does. As the score of an effect, a gain has that taken off.
        """
        by_load = [q.quantity == "load" for q, _ in form.quantities]
        if not any(by_load):
            return 0.0
        constants = {name: value for name, (value, _) in form.fixed().items()} | values
        constants["interval"] = 1.0 / self._rate_hz
        found = []
        for i in range(len(self._sampling)):
            x = np.hstack([self.signals[q.words][i] for q, _ in form.quantities])
            more = x * np.where(by_load, 1.0 + _STEP, 1.0)
            size = np.array([values[name] for name in form.shape.strengths])
            here, there = (
                np.tensordot(size, np.stack(form.shape.columns(at, constants)), 1)
                for at in (x, more)
            )
            applied = self.signals[_APPLIED][i]
            step = np.where(applied == 0.0, np.inf, _STEP * applied)
            slope = 1.0 + (there - here) / step * self.signals[form.lever][i] / form.scale
            found.append(np.log(np.maximum(np.abs(slope), _LEAST_SLOPE)))
        return float(np.mean(np.concatenate(found)))

    def curve_bound(self, form: Form) -> tuple[int, float]:
        """What no formula of the form's coordinate, acting as it does, could do better.

        Curves through ever more points: the number of the best, and the share of the held-out error
        that it leaves.
        """
        before, found = self._held_out(self._basis), []
        span = form.span
        for count in _KNOTS:
            spacing = span.width / (count - 1)

            def knots(x: Array, spacing: float = spacing, count: int = count) -> list[Array]:
                inside = np.clip(x, span.low, span.high)
                return [c[:, None] for c in hats(inside, span.low, spacing, count).T]

            columns = self._acting(form, knots)[:, :, 0].T
            after = self._held_out(np.column_stack([self._basis, columns]))
            found.append((float(np.sqrt(after / before)), count))
        share, count = min(found)
        return count, share

    def _gain(self, columns: Array) -> float:
        """Log likelihood ratio, on trials left out, of columns (n, m) beside the model's own."""
        before = self._held_out(self._basis)
        after = self._held_out(np.column_stack([self._basis, columns]))
        return 0.5 * self.independent * float(np.log(before / after))

    def _held_out(self, columns: Array) -> float:
        """Sum of squares on each group of trials, fitted by the columns to all others."""
        total = 0.0
        size = np.maximum(np.linalg.norm(columns, axis=0), 1e-30)
        z = columns / size
        for group in np.unique(self._group):
            own = self._group == group
            weight = np.where(own, Settings().held_out_weight, 1.0)[:, None] * z
            normal = weight.T @ z + _NEGLIGIBLE * np.eye(z.shape[1])
            step = np.linalg.solve(normal, weight.T @ self._residual)
            total += float(np.sum((self._residual[own] - z[own] @ step) ** 2))
        return max(total, 1e-300)


def _orthonormal(columns: Array) -> Array:
    """Orthonormal columns that span those given, (n, r)."""
    left, size, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(left[:, size > 1e-6 * size.max(initial=0.0)])


def _places(span: Span, length: float) -> Array:
    """Places along a span, near enough that none of that length is missed."""
    count = max(4, int(np.ceil(span.width / (_NEAREST * length))))
    return np.asarray(span.low + span.width * (np.arange(count) + 0.5) / count)
