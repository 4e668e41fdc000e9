"""Force zeros that differ between trials, because the sensor was zeroed anew before each.

Zeroing a sensor under load, in whatever pose the machine stands, removes the load of that pose from
the whole trial. A single offset for all trials leaves most of this error, which then appears as
weight or friction.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from bampipe.arrays import Array, Indices
from bampipe.estimate.least_squares import Stacked
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.trials.linear_problem import solve_scaled
from bampipe.trials.motion import Motion, trial_names
from bampipe.trials.residuals import fit_device, rms

_PARTS = 6
"""Parts of a trial: the scatter of the offsets found from each gives the standard error."""
_PLAIN = 5.0
"""Smallest median ratio of the offsets to their standard errors at which they are applied."""
_LEAVES = 0.7
"""Largest fraction of the mean squared error that may remain with an offset for each trial."""
_TOLD, _STILL_TOLD = 1e-3, 0.1
"""Identifiability of the other parameters. `_TOLD`: fraction of a parameter's information that must
remain beside a common offset for it to count as identifiable. `_STILL_TOLD`: fraction of that which
must remain beside offsets by trial. Trials in a single direction or pose cannot determine them."""


def find_force_offsets(
    system: System, motions: Sequence[Motion], band: Band, fitted: Sequence[int]
) -> dict[str, dict[str, float]]:
    """Find the force offset of each trial relative to the mean over the fitted trials.

    Offsets, parameters of the bare device and functions of the motion are fitted together, so that
    none absorbs the others. Only the trials numbered ``fitted`` determine them; the other trials
    get their offsets with these parameters.

    Returns:
        Offsets to subtract, N or N.m, by trial and force; empty if they are not significant.
    """
    forces = system.model.device.forces
    if len(fitted) < 2 or not forces or not (found := fit_device(system, motions, band, fitted)):
        return {}
    _, p, stacked = found
    some = [stacked[number] for number in fitted]
    size = rms((one.residual for one in some), [one.used for one in some])
    size = np.maximum(size, np.sqrt(np.finfo(float).tiny))
    trials = [
        _Trial.of(system, motion, band, one, p[:-1], size)
        for motion, one in zip(motions, stacked, strict=True)
    ]
    seen = [trials[number] for number in fitted]
    own = np.sum([one.own for one in seen], axis=0)
    whole = np.sum([one.whole for one in seen], axis=0)
    common = _beside_common_offset(seen, whole)
    if not _still_told(*(np.diag(x)[: stacked[0].slope.shape[2]] for x in (own, common, whole))):
        return {}
    step, step_without = _fit(own), _fit(common)
    offsets = np.array([one.offset @ step for one in trials])
    mean = offsets[list(fitted)].mean(axis=0)
    plain = np.abs(offsets - mean) / [one.error(step) for one in trials]
    chosen = np.median(plain[list(fitted)], axis=0) > _PLAIN
    left, without = step @ own @ step, step_without @ common @ step_without
    if left > _LEAVES * without or not chosen.any():
        return {}
    return {
        name: {
            force: float(value)
            for force, value, is_plain in zip(forces, offset - mean, chosen, strict=True)
            if is_plain
        }
        for name, offset in zip(trial_names(motions), offsets, strict=True)
    }


@dataclass(frozen=True)
class _Trial:
    """Least-squares offsets of one trial, as linear functions of the parameter step and 1.

    Attributes:
        offset: (n_force, n + 1) coefficients of the offsets; parts: the same for each part.
        whole: (n + 1, n + 1) products of slopes, functions of the motion and residual, in units of
            the error of each axis; own: the same after the trial's offsets are projected out.
        common: (n_force, n + 1) and (n_force, n_force), the products from which a common offset of
            several trials is projected out.
    """

    offset: Array
    parts: Array
    whole: Array
    own: Array
    common: tuple[Array, Array]

    @classmethod
    def of(
        cls, system: System, motion: Motion, band: Band, one: Stacked, p: Array, size: Array
    ) -> Self:
        """Compute the coefficients of a trial from the residual and slopes of its fit."""
        rows = band.thinned_rows(motion.t.size)
        gains = system.input_map(motion.q[rows], motion.inputs(system.inputs)[rows], p)
        weight = (one.used / size)[:, :, None]
        columns = [one.slope, _functions_of_motion(motion, band), one.residual[:, :, None]]
        both = np.concatenate(columns, axis=2) * weight
        both, forces = (x.reshape(-1, x.shape[2]) for x in (both, gains * weight))

        def solve(rows: Indices | slice) -> Array:
            return np.asarray(np.linalg.lstsq(forces[rows], both[rows], rcond=1e-9)[0])

        offset = solve(slice(None))
        rest = both - forces @ offset
        parts = [solve(rows) for rows in np.array_split(np.arange(len(both)), _PARTS)]
        return cls(
            offset,
            np.array(parts),
            both.T @ both,
            rest.T @ rest,
            (forces.T @ both, forces.T @ forces),
        )

    def error(self, step: Array) -> Array:
        """Standard errors of the offsets from their scatter over the parts, (n_force,)."""
        sd = np.std(self.parts @ step, axis=0, ddof=1) / np.sqrt(_PARTS)
        return np.asarray(np.maximum(sd, np.finfo(float).tiny))


def _functions_of_motion(motion: Motion, band: Band) -> Array:
    """Return what a missing effect may add on each axis, (K, n_q, 3 n_q).

    Friction that differs by direction and springs have a mean that differs between trials.
    """
    n = motion.q.shape[1]
    out = np.zeros((len(band.thinned_rows(len(motion.t))), n, n, 3))
    for axis, (q, qd) in enumerate(zip(motion.q.T, motion.qd.T, strict=True)):
        out[:, axis, axis] = band.thin(np.column_stack([np.abs(qd), q, q**2]), [axis] * 3)
    return out.reshape(len(out), n, 3 * n)


def _fit(products: Array) -> Array:
    """Return the step that minimises the error, and 1, from products as in `_Trial.own`."""
    return np.append(solve_scaled(products[:-1, :-1], -products[:-1, -1]), 1.0)


def _beside_common_offset(trials: Sequence[_Trial], whole: Array) -> Array:
    """Return the products of all trials after one common offset has been projected out."""
    across = np.sum([one.common[0] for one in trials], axis=0)
    squared = np.sum([one.common[1] for one in trials], axis=0)
    return np.asarray(whole - across.T @ np.linalg.lstsq(squared, across, rcond=1e-9)[0])


def _still_told(own: Array, common: Array, whole: Array) -> bool:
    """Whether parameters identifiable beside a common offset remain so beside one by trial."""
    counts = common > _TOLD * whole
    return bool(np.all(own[counts] > _STILL_TOLD * common[counts]))
