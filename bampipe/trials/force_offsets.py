"""Forces zeroed anew in each trial: how far each trial's zero is from that of the others.

A sensor that is zeroed wherever the machine happens to stand takes the load of that pose off the
whole trial. One offset for all trials leaves most of that, and it passes for weight or friction.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bampipe.errors import InputError
from bampipe.estimate.least_squares import Stacked, minimise, stacked_residual
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.trials.motion import Motion, trial_names
from bampipe.trials.residuals import problem_of

Array = NDArray[np.float64]

_PARTS = 6
"""Of a trial, from which its offset is found once more each: they tell its standard error."""
_PLAIN = 5.0
"""Median size of the offsets over their standard errors, the least."""
_LEAVES = 0.7
"""Share of the mean squared error that offsets by trial leave, the most."""
_STILL_TOLD = 0.1
"""Share of what tells any parameter beside one offset for all that is left beside offsets by trial,
the least: trials that each go one way, or each in a pose of their own, tell no offset."""


def find_force_offsets(
    system: System, motions: Sequence[Motion], band: Band, fitted: Sequence[int]
) -> dict[str, dict[str, float]]:
    """Find what the forces of each trial read too much, against the mean of the trials fitted.

    Offsets are found beside the parameters of the bare device, so that these do not take them up.

    Args:
        system: the bare device; motions: the free trials; band: of the residual.
        fitted: numbers of the trials that a fit may see; others get their own by what these found.

    Returns:
        N or N.m by force, by trial; empty where offsets by trial are not plain.
    """
    problem = problem_of(system, motions, band)
    if len(fitted) < 2 or not system.model.device.forces:
        return {}
    try:
        found = minimise(problem, np.append(system.prior, 0.0), fitted, 12, tolerance=1e-6)
    except (ValueError, InputError):
        return {}
    stacked = dict(zip(fitted, found.stacked, strict=True))
    size = np.sqrt(_mean_square([s.residual for s in found.stacked], found.stacked))
    trials = {}
    for number in range(len(motions)):
        one = stacked.get(number) or stacked_residual(problem, number, found.p)
        trials[number] = _Trial.of(system, motions[number], band, one, found.p[:-1], size)
    own = np.sum([trials[k].without_offset for k in fitted], axis=0)
    step = np.linalg.lstsq(own[:-1, :-1], -own[:-1, -1], rcond=1e-9)[0]
    if not _still_told([trials[k] for k in fitted], own):
        return {}
    offsets, errors = zip(*(trials[k].offset(step) for k in range(len(motions))), strict=True)
    left = sum(trials[k].left(step) for k in fitted)
    before = sum(float(trials[k].residual @ trials[k].residual) for k in fitted)
    mean = np.mean([offsets[k] for k in fitted], axis=0)
    plain = np.abs(np.array(offsets) - mean)[list(fitted)] / np.array(errors)[list(fitted)]
    chosen = np.median(plain, axis=0) > _PLAIN
    if left > _LEAVES * before or not chosen.any():
        return {}
    forces = system.model.device.forces
    return {
        name: {
            force: float(value)
            for force, value, is_plain in zip(forces, offset - mean, chosen, strict=True)
            if is_plain
        }
        for name, offset in zip(trial_names(motions), offsets, strict=True)
    }


class _Trial:
    """One trial in units of the error of each axis, its rows one under another.

    Attributes:
        residual: (N,); slope: (N, n_free); map: (N, n_force), what a force adds to the residual.
    """

    def __init__(self, residual: Array, slope: Array, map_: Array) -> None:
        self.residual, self.slope, self.map = residual, slope, map_
        both = np.column_stack([slope, residual])
        self._of_both = np.linalg.lstsq(map_, both, rcond=1e-9)[0]
        rest = both - map_ @ self._of_both
        self.without_offset = rest.T @ rest

    @classmethod
    def of(
        cls, system: System, motion: Motion, band: Band, one: Stacked, p: Array, size: Array
    ) -> _Trial:
        """From what `stacked_residual` gave."""
        rows = band.thinned_rows(motion.t.size)
        gains = system.input_map(motion.q[rows], motion.inputs(system.inputs)[rows], p)
        weight = one.used / size
        return cls(
            (one.residual * weight).reshape(-1),
            (one.slope * weight[:, :, None]).reshape(-1, one.slope.shape[2]),
            (gains * weight[:, :, None]).reshape(-1, gains.shape[2]),
        )

    def offset(self, step: Array) -> tuple[Array, Array]:
        """Offsets of forces, (n_force,), with parameters moved by ``step``, and their errors."""
        target = self.residual + self.slope @ step
        parts = np.array_split(np.arange(target.size), _PARTS)
        each = [np.linalg.lstsq(self.map[k], target[k], rcond=1e-9)[0] for k in parts]
        error = np.std(each, axis=0, ddof=1) / np.sqrt(_PARTS)
        whole = np.linalg.lstsq(self.map, target, rcond=1e-9)[0]
        return np.asarray(whole), np.maximum(error, 1e-300)

    def left(self, step: Array) -> float:
        """Sum of squares beside its offsets."""
        both = np.append(step, 1.0)
        return float(both @ self.without_offset @ both)


def _still_told(trials: Sequence[_Trial], own: Array) -> bool:
    """Whether offsets by trial leave what one offset for all leaves to tell the parameters."""
    slopes = sum(np.sum(one.slope**2, axis=0) for one in trials)
    across = sum(one.map.T @ one.slope for one in trials)
    squared = sum(one.map.T @ one.map for one in trials)
    common = slopes - np.sum(across * np.linalg.lstsq(squared, across, rcond=1e-9)[0], axis=0)
    counts = common > 1e-3 * slopes
    return bool(np.all(np.diag(own)[:-1][counts] > _STILL_TOLD * common[counts]))


def _mean_square(residuals: Sequence[Array], stacked: Sequence[Stacked]) -> Array:
    total = sum(np.sum(one**2, axis=0) for one in residuals)
    count = sum(one.used.sum(axis=0) for one in stacked)
    return np.asarray(np.maximum(total / np.maximum(count, 1), np.finfo(float).tiny))
