"""Columns of candidates: what each adds to the residual, over a grid of its shapes, made once."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.signal import csd

from bampipe.diagnosis.candidates import Candidate
from bampipe.diagnosis.columns import added_columns
from bampipe.diagnosis.ranges import MachineScale, SearchRange
from bampipe.trials.evidence import Evidence
from bampipe.trials.likelihood import Samples, take_samples

Array = NDArray[np.float64]

_ALONE, _SEVERAL = 7, 5
"""Values of a shape on the grid: of an effect with one, and of each of an effect with several."""
_WIDE = 300.0
"""Ratio of the ends of a range from which on its grid has `_MORE` values more."""
_MORE = 4
_MOST, _MOST_OF_STATES = 60, 120
"""Shapes on a grid: of an effect without and with internal states, whose shape decides when things
happen, not only how large they are."""
_DIVERGED = 1e30
"""An internal state that is too stiff to be integrated at the sampling rate ends above this."""
_SEGMENT = 128
"""Thinned samples of a segment from which the gain of a filter is found."""

Key = tuple[str, tuple[float, ...]]
"""A candidate and its shape: each searched parameter as a share, 0 to 1, of its range."""


@dataclass(frozen=True)
class Atom:
    """A candidate with one shape.

    Attributes:
        columns: by the number of each axis that it changes, (n, m) for its m strengths.
        slopes: derivative of what it adds by each measured force, by axis, (n, n_forces, m), for
            each of its strengths at one; empty where what it adds does not depend on the force of
            that moment.
        log_gain: mean over the band of the logarithm of its gain where it filters the measured
            force, by axis, (n_q,); else zero.
    """

    columns: Mapping[int, Array]
    slopes: Mapping[int, Array]
    log_gain: Array

    @property
    def width(self) -> int:
        """Number of its strengths."""
        return int(next(iter(self.columns.values())).shape[1])


@dataclass
class Dictionary:
    """The candidates beside one fitted model.

    Attributes:
        evidence: the model on the trials; samples: of it that count.
        candidates: by name.
        scale: sizes of the machine.
    """

    evidence: Evidence
    samples: Sequence[Samples]
    candidates: Mapping[str, Candidate]
    scale: MachineScale
    ranges: Mapping[str, tuple[SearchRange, ...]] = field(init=False)

    def __post_init__(self) -> None:
        self.ranges = {
            name: tuple(
                self.scale.range_of(c.system.model.effects[-1], c.parameters[i])
                for i in c.searched_indices
            )
            for name, c in self.candidates.items()
        }

    def grid(self, name: str) -> list[Key]:
        """The shapes of a candidate at which its columns are made to begin with."""
        ranges = self.ranges[name]
        each = _ALONE if len(ranges) == 1 else _SEVERAL
        counts = [each + _MORE * (r.by_ratio and r.high / r.low > _WIDE) for r in ranges]
        states = self.candidates[name].system.model.effects[-1].effect.states
        while np.prod(counts) > (_MOST_OF_STATES if states else _MOST):
            dense = [(n - 1) / r.extent for n, r in zip(counts, ranges, strict=True)]
            counts[int(np.argmax(dense))] -= 1
        # Few values are better off amid the parts of a range than at its ends.
        axes = [np.linspace(0.0, 1.0, n) if n > 3 else (np.arange(n) + 0.5) / n for n in counts]
        return [(name, tuple(map(float, shape))) for shape in itertools.product(*axes)]

    def values(self, key: Key) -> Array:
        """The searched parameters of a candidate, in its unit."""
        name, shape = key
        pairs = zip(self.ranges[name], shape, strict=True)
        return np.array([r.value_at(r.within(share)) for r, share in pairs])

    def bounds(self, name: str) -> list[tuple[float, float]]:
        """Least and largest strength of each column of a candidate."""
        c = self.candidates[name]
        if not c.linear_indices:
            # What may have either sign is as good as linear below the least on the grid.
            least = 0.0 if any(r.low < 0.0 for r in self.ranges[name]) else _MULTIPLE[0]
            return [(least, _MULTIPLE[1])]
        return [(c.parameters[i].lower, c.parameters[i].upper) for i in c.linear_indices]

    def spreads(self, name: str) -> list[float]:
        """Standard deviation of each strength before any data, by the effect's file."""
        c = self.candidates[name]
        if not c.linear_indices:
            return [1.0]
        return [c.parameters[i].sd for i in c.linear_indices]

    def make(self, key: Key) -> Atom | None:
        """Compute a candidate at one shape; None where it does nothing in these trials."""
        e, item, values = self.evidence, self.candidates[key[0]], self.values(key)
        with np.errstate(all="ignore"):
            columns, change = added_columns(e, item, values)
        by_trial = columns if item.linear_indices else [c[:, :, None] for c in change]
        found = {}
        for axis, here in enumerate(self.samples):
            rows = take_samples(by_trial, here, axis)
            if not (np.abs(rows) < _DIVERGED).all():
                return None
            if rows.any():
                found[axis] = rows
        if not found or not all(
            any(f[:, k].any() for f in found.values())
            for k in range(next(iter(found.values())).shape[1])
        ):
            return None
        system, nothing = item.system, np.zeros(len(self.samples))
        filters = not item.linear_indices and system.model.effects[-1].effect.kind == "input"
        if system.driven:
            return Atom(found, self._slopes(item, values), nothing)
        if filters:
            p = self._parameters(item, values, np.zeros(0))
            return Atom(found, {}, self._log_gain(item, p))
        return Atom(found, {}, nothing)

    def make_all(self, keys: Iterable[Key]) -> list[tuple[Key, Atom | None]]:
        """`make` each."""
        return [(key, self.make(key)) for key in keys]

    def _parameters(self, item: Candidate, searched: Array, strengths: Array) -> Array:
        count = len(item.system.parameters) - len(item.parameters)
        p = np.concatenate([self.evidence.p[:count], [q.prior for q in item.parameters]])
        p[[count + i for i in item.searched_indices]] = searched
        p[[count + i for i in item.linear_indices]] = strengths
        return p

    def _slopes(self, item: Candidate, searched: Array) -> dict[int, Array]:
        one_each = np.eye(len(item.linear_indices)) if item.linear_indices else np.zeros((1, 0))
        each = [self._slopes_at(item, self._parameters(item, searched, b)) for b in one_each]
        return {
            axis: values
            for axis in range(len(self.samples))
            if (values := np.stack([slopes[axis] for slopes in each], axis=2)).any()
        }

    def _slopes_at(self, item: Candidate, p: Array) -> list[Array]:
        """The same at given parameters, (n_p,), by axis, each (n, n_forces)."""
        e, system, rows = self.evidence, item.system, []
        for motion in e.motions:
            kept, u = e.band.thinned_rows(len(motion.t)), motion.inputs(system.inputs)
            motion = motion.of_mechanism(system, u, p)
            z = system.memory(*motion.kinematics, u, p, motion.t)
            at = motion.q[kept], motion.qd[kept], motion.qdd[kept], z[kept]
            here = system.contribution(*at, u[kept], p)
            slope = np.zeros((*here.shape, len(system.model.device.forces)))
            for j, force in enumerate(system.model.device.forces):
                moved, column = u[kept].copy(), system.inputs.index(force)
                step = 1e-6 * max(float(np.abs(moved[:, column]).max()), 1e-6)
                moved[:, column] += step
                slope[:, :, j] = (system.contribution(*at, moved, p) - here) / step
            rows.append(slope)
        return [take_samples(rows, here, a) for a, here in enumerate(self.samples)]

    def _log_gain(self, item: Candidate, p: Array) -> Array:
        """Kolmogorov: what a filter takes off the innovations of all that goes through it."""
        e, system, through = self.evidence, item.system, []
        for motion in e.motions:
            u = motion.inputs(system.inputs)
            z = system.memory(*motion.kinematics, u, p, motion.t)
            through.append(e.band.thin(system.applied(*motion.kinematics, z, u, p)))
        found = np.zeros(len(self.samples))
        for axis, auto in enumerate(self._power):
            pairs = [(x[:, axis], y[:, axis]) for x, y in zip(self._plain, through, strict=True)]
            if any(not np.array_equal(x, y) for x, y in pairs):
                gain = np.abs(sum(_spectrum(x, y) for x, y in pairs)) / np.maximum(auto, 1e-300)
                found[axis] = min(float(np.mean(np.log(np.clip(gain[1:], 1e-2, 1e2)))), 0.0)
        return found

    @cached_property
    def _plain(self) -> list[Array]:
        """The applied force by the model, low-passed, by trial, each (K, n_q)."""
        return [self.evidence.band.thin(fitted.applied) for fitted in self.evidence.fitted]

    @cached_property
    def _power(self) -> list[Array]:
        """Its power spectrum, by axis."""
        columns = ([x[:, a] for x in self._plain] for a in range(len(self.samples)))
        return [np.abs(sum(_spectrum(x, x) for x in each)) for each in columns]


def _spectrum(x: Array, y: Array) -> NDArray[np.complex128]:
    """Cross spectral density of two series, (_SEGMENT // 2,)."""
    n = min(_SEGMENT, len(x))
    found = csd(x, y, nperseg=n, nfft=_SEGMENT, detrend="linear")[1]
    return np.asarray(found[: _SEGMENT // 2])


_MULTIPLE = (0.5, 2.0)
"""Of an effect that is not linear in its strength, by how much what it adds may be more or less
than at its shape on the grid."""
