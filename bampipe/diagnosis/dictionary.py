"""The columns that candidates add to the residual, each computed once per shape."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bampipe.arrays import Array
from bampipe.diagnosis.candidates import Candidate
from bampipe.diagnosis.columns import compute_columns, make_parameters
from bampipe.diagnosis.ranges import MachineScale, SearchRange
from bampipe.trials.linearisation import Linearisation
from bampipe.trials.samples import Samples, take_samples
from bampipe.trials.scale import NO_SLOPE, Spectra, gain_of_filter, slopes_by_force

_ALONE, _SEVERAL = 7, 5
"""Grid values per shape, for an effect with one shape and with several."""
_WIDE = 300.0
_MORE = 4
"""A range whose ends have a ratio above `_WIDE` gets `_MORE` more grid values."""
_MOST, _MOST_OF_THREE, _MOST_OF_STATES = 60, 120, 300
"""Largest grid of an effect without internal states, with up to three shapes and with more. States
need a finer grid, since their shapes decide when something happens, not only how strongly."""
_DIVERGED = 1e30
"""An internal state too stiff for the sampling rate exceeds this value."""

Key = tuple[str, tuple[float, ...]]
"""A candidate and its shape: each searched parameter as a share, 0 to 1, of its range."""


@dataclass(frozen=True)
class Atom:
    """A candidate with one shape.

    Attributes:
        columns: by the index of each axis that it changes, (n, m) for its m strengths.
        slopes: derivative of the columns by each measured force, by axis, (n, n_forces, m); empty
            if a constant force passes unchanged.
        gain: share of the variance of white force noise that passes its filter within the band, by
            axis, (n_q,); one without a filter.
    """

    columns: Mapping[int, Array]
    slopes: Mapping[int, Array]
    gain: Array

    @property
    def width(self) -> int:
        """Number of its strengths."""
        return int(next(iter(self.columns.values())).shape[1])


@dataclass
class Dictionary:
    """The candidates of one fitted model by name, and the samples of the model that count."""

    linearisation: Linearisation
    samples: Sequence[Samples]
    candidates: Mapping[str, Candidate]
    scale: MachineScale

    @cached_property
    def ranges(self) -> Mapping[str, tuple[SearchRange, ...]]:
        """Ranges of the searched parameters of each candidate."""
        return {
            name: tuple(
                self.scale.range_of(c.system.model.effects[-1], c.parameters[i])
                for i in c.searched_indices
            )
            for name, c in self.candidates.items()
        }

    def grid(self, name: str) -> list[Key]:
        """Return the initial shapes of a candidate."""
        ranges = self.ranges[name]
        each = _ALONE if len(ranges) == 1 else _SEVERAL
        counts = [
            r.count or max(each + _MORE * (r.by_ratio and r.high / r.low > _WIDE), r.grid_size)
            for r in ranges
        ]
        states = self.candidates[name].system.model.effects[-1].effect.states
        most = (_MOST_OF_STATES if len(ranges) > 3 else _MOST_OF_THREE) if states else _MOST
        while np.prod(counts) > most:
            dense = [(n - 1) / r.extent for n, r in zip(counts, ranges, strict=True)]
            counts[int(np.argmax(dense))] -= 1
        # If there are few values, they lie in the middle of equal parts of the range.
        axes = [np.linspace(0.0, 1.0, n) if n > 3 else (np.arange(n) + 0.5) / n for n in counts]
        return [(name, tuple(map(float, shape))) for shape in itertools.product(*axes)]

    def values(self, key: Key) -> Array:
        """Return the searched parameters of a candidate, each in its unit."""
        name, shape = key
        pairs = zip(self.ranges[name], shape, strict=True)
        return np.array([r.value_at(r.interpolate(share)) for r, share in pairs])

    def priors(self, name: str) -> list[tuple[float, float, float]]:
        """Return the bounds of each strength of a candidate, and its prior standard deviation."""
        c = self.candidates[name]
        if not c.linear_indices:
            # An effect of either sign is nearly linear below the smallest strength on the grid.
            least = 0.0 if any(r.low < 0.0 for r in self.ranges[name]) else _MULTIPLE[0]
            return [(least, _MULTIPLE[1], 1.0)]
        return [(q.lower, q.upper, q.sd) for q in (c.parameters[i] for i in c.linear_indices)]

    def make(self, key: Key) -> Atom | None:
        """Compute a candidate at one shape; None if it has no effect in these trials."""
        e, item, values = self.linearisation, self.candidates[key[0]], self.values(key)
        with np.errstate(all="ignore"):
            columns = compute_columns(e, item, values)
        found = {}
        for axis, here in enumerate(self.samples):
            rows = columns[here.rows, axis]
            if not (np.abs(rows) < _DIVERGED).all():
                return None
            if rows.any():
                found[axis] = rows
        if not found or not np.any([f.any(axis=0) for f in found.values()], axis=0).all():
            return None
        one_each = np.eye(len(item.linear_indices)) if item.linear_indices else np.zeros((1, 0))
        slopes = self._slopes(item, [make_parameters(e, item, values, b) for b in one_each])
        return Atom(found, slopes, self._gain(item, make_parameters(e, item, values), slopes))

    def _slopes(self, item: Candidate, probes: Sequence[Array]) -> dict[int, Array]:
        """Return `Atom.slopes` at the m ``probes``, (n_p,) each, which share internal states."""
        e, system = self.linearisation, item.system
        if not (system.driven or system.force_fed):
            return {}
        rows = slopes_by_force(system, e.joined, e.band, probes)
        if item.is_joint:
            own = e.slopes_by_force
            rows = tuple(r - o[..., None] for r, o in zip(rows, own, strict=True))
        return self._by_axis(rows)

    def _by_axis(self, rows: Sequence[Array]) -> dict[int, Array]:
        found = [take_samples(rows, here, a) for a, here in enumerate(self.samples)]
        return {axis: slope for axis, slope in enumerate(found) if (np.abs(slope) > NO_SLOPE).any()}

    def _gain(self, item: Candidate, p: Array, slopes: Mapping[int, Array]) -> Array:
        """Return `Atom.gain`; a candidate with ``slopes`` is no filter."""
        if slopes or item.linear_indices or not item.system.force_fed:
            return np.ones(len(self.samples))
        e = self.linearisation
        return gain_of_filter(self._spectra, e.spectra_of(item.system, p), e.band)

    @cached_property
    def _spectra(self) -> Spectra:
        """Spectra of the force that the model applies."""
        return self.linearisation.spectra_of(self.linearisation.system, self.linearisation.p)

    def scale_without(
        self, name: str, absence: Mapping[int, float]
    ) -> tuple[dict[int, Array], Array]:
        """Return `Atom.slopes` and `Atom.gain` of the removal of one of the model's effects.

        ``absence`` is the change of each free parameter that removes it.
        """
        e, unchanged = self.linearisation, np.ones(len(self.samples))
        moved = {e.free[place]: change for place, change in absence.items() if change}
        if not (e.system.parameters_by_force & moved.keys()):
            return {}, unchanged
        p = e.p.copy()
        p[list(moved)] += list(moved.values())
        rows = slopes_by_force(e.system, e.joined, e.band, [p])
        slopes = self._by_axis(
            [r[..., 0] - own for r, own in zip(rows, e.slopes_by_force, strict=True)]
        )
        if slopes or all(e.system.linear[i] for i in moved):
            return slopes, unchanged
        return slopes, 1.0 / gain_of_filter(e.spectra_of(e.system, p), self._spectra, e.band)


_MULTIPLE = (0.5, 2.0)
"""Bounds of the factor on the column of an effect that is not linear in its strength."""
