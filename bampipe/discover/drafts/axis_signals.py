"""What one axis did in the trials that are fitted, and how a form acts on its residual.

Columns are made at a few times the rate of the thinned residual, and pass the same low-pass.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.drafts.forms import DAMPING, FORCE, FRICTION, INERTIA, READING, Form
from bampipe.discover.drafts.linear_fit import LinearFit, orthonormal
from bampipe.discover.drafts.quantities import Span, coordinates
from bampipe.estimate.low_pass import low_pass_at
from bampipe.physics.device import Device
from bampipe.trials.evidence import Evidence
from bampipe.trials.folds import HELD_OUT

Array = NDArray[np.float64]

_FINER = 5
"""Times the thinned rate at which columns are made, at least."""
_APPLIED = "applied"
"""Of the signals: what drives the axis, with its sign."""
_STEP, _LEAST_SLOPE = 1e-6, 1e-3
"""Relative step of the drive; slope of the residual by it below which it counts as cancelled."""
_KNOWN = 2.0
"""Times the residual that the force must be beyond what the model's own parameters can do: it is
once where these scale with it, and more than three times on an arm of known inertia."""
_RANGE = (0.002, 0.998)
"""Quantiles of a coordinate between which it is said to vary."""


class AxisSignals:
    """The signals of one axis, by the words of the grammar."""

    def __init__(self, evidence: Evidence, axis: int) -> None:
        """Take the fitted trials of ``evidence``, of the model; axis: number of the coordinate."""
        self._evidence, self.axis = evidence, axis
        groups, fitted = evidence.folds.groups, evidence.folds.fitted
        self._trials = [k for k, fits in enumerate(fitted) if fits and groups[k] != HELD_OUT]
        self._rows = [evidence.used[k][:, axis] for k in self._trials]

    @property
    def device(self) -> Device:
        """Of the axis."""
        return self._evidence.system.model.device

    @property
    def cutoff_hz(self) -> float:
        """Of the low-pass of the residual."""
        return float(self._evidence.band.cutoff_hz[self.axis])

    def residual(self) -> LinearFit:
        """The residual where the axis moves, with the slopes by the model's own parameters."""
        evidence, axis = self._evidence, self.axis
        chosen = list(zip(self._trials, self._rows, strict=True))
        residual = np.concatenate([evidence.residual[k][r, axis] for k, r in chosen])
        slopes = np.concatenate([evidence.jacobian[k][r, axis] for k, r in chosen])
        group = np.concatenate([np.full(r.sum(), evidence.folds.groups[k]) for k, r in chosen])
        independent = max(float(len(residual) * evidence.band.independent_share[axis]), 1.0)
        return LinearFit(residual, slopes, group, independent)

    def thinned(self, name: str) -> Array:
        """A signal, low-passed as the residual is, (n,)."""
        found = [
            low_pass_at(self._signals[name][i], self.cutoff_hz, self._rate_hz, kept)[rows, 0]
            for i, ((_, kept), rows) in enumerate(zip(self._sampling, self._rows, strict=True))
        ]
        return np.concatenate(found)

    def samples(self, name: str) -> Array:
        """A signal as it is where the residual is, (n,)."""
        found = [
            self._signals[name][i][kept, 0][rows]
            for i, ((_, kept), rows) in enumerate(zip(self._sampling, self._rows, strict=True))
        ]
        return np.concatenate(found)

    @cached_property
    def _sampling(self) -> list[tuple[slice, NDArray[np.int64]]]:
        """By trial: the samples at which columns are made, and which of these are kept."""
        band = self._evidence.band
        fits = [d for d in range(1, band.step + 1) if band.step % d == 0]
        every = max(d for d in fits if d * _FINER <= band.step or d == 1)
        found = []
        for k in self._trials:
            kept = band.thinned_rows(len(self._evidence.motions[k].t))
            first = int(kept[0]) % every if len(kept) else 0
            found.append((slice(first, None, every), (kept - first) // every))
        return found

    @property
    def _rate_hz(self) -> float:
        every = self._sampling[0][0].step
        return float(self._evidence.band.rate_hz / every)

    @cached_property
    def _signals(self) -> dict[str, list[Array]]:
        """The coordinates and factors of the axis by words, by trial, each (T, 1)."""
        evidence, axis = self._evidence, self.axis
        system = evidence.system
        found: dict[str, list[Array]] = {}
        for k, (rows, _) in zip(self._trials, self._sampling, strict=True):
            motion = evidence.fitted[k].mechanism
            q, qd, qdd = motion.q[rows], motion.qd[rows], motion.qdd[rows]
            u = motion.inputs(system.inputs)[rows]
            z = evidence.fitted[k].memory[rows]
            applied = system.applied(q, qd, qdd, z, u, evidence.p)[:, axis]
            width = self.device.coordinates[axis].sign_width
            values = {
                _APPLIED: applied,
                FORCE: np.ones(len(q)),
                FRICTION: np.tanh(qd[:, axis] / width),
                DAMPING: qd[:, axis],
                INERTIA: qdd[:, axis],
            }
            pulls = system.input_map(q, u, evidence.p)[:, axis]
            for name, pull in zip(self.device.components, pulls.T, strict=True):
                values[f"{READING} {name}"] = -pull
            for c in coordinates(self.device, axis):
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
    def ranges(self) -> dict[str, Array]:
        """Quantiles between which each coordinate lies, (2,)."""
        names = [c.words for c in coordinates(self.device, self.axis)]
        return {n: np.quantile(np.concatenate(self._signals[n]), _RANGE) for n in names}

    @cached_property
    def scales(self) -> dict[str, float]:
        """Highest speed and acceleration of the axis."""
        largest = {
            f: float(np.quantile(np.abs(np.concatenate(self._signals[f])), _RANGE[1]))
            for f in (DAMPING, INERTIA)
        }
        return {f: value for f, value in largest.items() if value > 0.0}

    @cached_property
    def times(self) -> Span:
        """Time between samples and of a trial, s."""
        trials = [self._evidence.motions[k].t for k in self._trials]
        return Span(float(np.median(np.diff(trials[0]))), max(float(np.ptp(t)) for t in trials))

    @cached_property
    def scaled_readings(self) -> set[str]:
        """Force components that act on the axis and whose scale the model knows.

        Where all parameters may shrink with the force, an error that cancels most of the force
        would seem to explain anything.
        """
        evidence, device = self._evidence, self.device
        by_component: dict[str, list[Array]] = {name: [] for name in device.components}
        left, slopes = [], []
        errors = np.maximum(evidence.rmse(), 1e-12)
        for k in self._trials:
            motion, used = evidence.motions[k], evidence.used[k]
            u = motion.inputs(evidence.system.inputs)
            pulls = evidence.system.input_map(motion.q, u, evidence.p)
            read = motion.inputs(device.forces)
            for c, name in enumerate(device.components):
                acting = evidence.band.thin(pulls[:, :, c] * read[:, c, None])
                by_component[name].append((acting / errors)[used])
            left.append((evidence.residual[k] / errors)[used])
            slopes.append((evidence.jacobian[k] / errors[:, None])[used])
        basis = orthonormal(np.concatenate(slopes))
        error = float(np.linalg.norm(np.concatenate(left)))
        found = set()
        for name, parts in by_component.items():
            acting = np.concatenate(parts)
            beyond = float(np.linalg.norm(acting - basis @ (basis.T @ acting)))
            if beyond > _KNOWN * error and any(map(np.any, self._signals[f"{READING} {name}"])):
                found.add(name)
        return found

    def columns(self, form: Form, searched: dict[str, Array]) -> Array:
        """What each strength adds to the low-passed residual, (m, n, G).

        Args:
            form: what acts; searched: its searched constants, each (G,).
        """
        constants = self._constants(form) | searched
        return self.acting(form, lambda x: form.shape.columns(x, constants))

    def _constants(self, form: Form) -> dict[str, float]:
        fixed = {name: value for name, (value, _) in form.fixed().items()}
        return fixed | {"interval": 1.0 / self._rate_hz}

    def acting(self, form: Form, shape: Callable[[Array], Sequence[Array]]) -> Array:
        """Columns of ``shape`` of the form's coordinate, (m, n, G), acting as the form does."""
        by_trial = []
        for i, (_, kept) in enumerate(self._sampling):
            x = self._followed(form, i)
            factor = self._signals[form.lever][i] / form.scale
            values = np.stack(np.broadcast_arrays(*shape(x)))
            acting = values * factor
            if form.factor == INERTIA:
                # By Lagrange's equation of the kinetic energy.
                turning = np.gradient(values, axis=1) * self._rate_hz * self._signals[DAMPING][i]
                acting = -acting - (0.5 if form.is_own else 1.0) * turning / form.scale
            stacked = np.moveaxis(acting, 0, 1).reshape(len(x), -1)
            thin = low_pass_at(stacked, self.cutoff_hz, self._rate_hz, kept)[self._rows[i]]
            by_trial.append(np.moveaxis(thin.reshape(len(thin), len(values), -1), 1, 0))
        return np.concatenate(by_trial, axis=1)

    def _followed(self, form: Form, i: int) -> Array:
        """What the form follows in trial ``i``, (T, number of quantities)."""
        return np.hstack([self._signals[q.words][i] for q, _ in form.quantities])

    def drive_slope(self, form: Form, values: Mapping[str, float]) -> float:
        """Mean of log |d residual / d drive| with a form, of which the model alone has one.

        What follows the load can cancel the drive, which is to be explained: the residual is then
        small whatever the device does. As the score of an effect, a gain has that taken off.
        """
        by_load = [q.quantity == "load" for q, _ in form.quantities]
        if not any(by_load):
            return 0.0
        constants = self._constants(form) | dict(values)
        found = []
        for i in range(len(self._sampling)):
            x = self._followed(form, i)
            more = x * np.where(by_load, 1.0 + _STEP, 1.0)
            size = np.array([values[name] for name in form.shape.strengths])
            here, there = (
                np.tensordot(size, np.stack(form.shape.columns(at, constants)), 1)
                for at in (x, more)
            )
            applied = self._signals[_APPLIED][i]
            step = np.where(applied == 0.0, np.inf, _STEP * applied)
            slope = 1.0 + (there - here) / step * self._signals[form.lever][i] / form.scale
            found.append(np.log(np.maximum(np.abs(slope), _LEAST_SLOPE)))
        return float(np.mean(np.concatenate(found)))
