"""Forces zeroed anew in each trial: how far each trial's zero is from that of the others.

A sensor that is zeroed wherever the machine happens to stand takes the load of that pose off the
whole trial. One offset for all trials leaves most of that, and it passes for weight or friction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array, Indices
from bampipe.estimate.least_squares import Stacked
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.trials.motion import Motion, trial_names
from bampipe.trials.residuals import fit_device, rms

_PARTS = 6
"""Of a trial, from which its offset is found once more each: they tell its standard error."""
_PLAIN = 5.0
"""Median size of the offsets over their standard errors, the least."""
_LEAVES = 0.7
"""Share of the mean squared error that offsets by trial leave, the most."""
_TOLD, _STILL_TOLD = 1e-3, 0.1
"""Share of its slope beside one offset for all by which a parameter is told at all, and of that,
what is left beside offsets by trial, the least: trials that each go one way, or each in a pose of
their own, tell no offset."""


def find_force_offsets(
    system: System, motions: Sequence[Motion], band: Band, fitted: Sequence[int]
) -> dict[str, dict[str, float]]:
    """Find what the forces of each trial read too much, against the mean of the trials fitted.

    Offsets are found beside the parameters of the bare device, so that these do not take them up.

    A fit sees the trials numbered ``fitted``; others get their own by what these found.

    Returns:
        N or N.m by force, by trial; empty where offsets by trial are not plain.
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
    if not _still_told(seen, own, whole):
        return {}
    step = np.append(np.linalg.lstsq(own[:-1, :-1], -own[:-1, -1], rcond=1e-9)[0], 1.0)
    offsets = np.array([one.offset @ step for one in trials])
    mean = offsets[list(fitted)].mean(axis=0)
    plain = np.abs(offsets - mean) / [one.error(step) for one in trials]
    chosen = np.median(plain[list(fitted)], axis=0) > _PLAIN
    if step @ own @ step > _LEAVES * whole[-1, -1] or not chosen.any():
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
    """What one trial says of its offsets, linear in a step of the free parameters and 1.

    Attributes:
        offset: (n_force, n_free + 1) that offsets are; parts: of each of its parts, the same.
        whole: (n_free + 1, n_free + 1) sums of squares and products of slopes and residual, in
            units of the error of each axis; own: the same beside its offsets.
        common: (n_force, n_free + 1) and (n_force, n_force) what one offset for all needs of it.
    """

    offset: Array
    parts: Array
    whole: Array
    own: Array
    common: tuple[Array, Array]

    @classmethod
    def of(
        cls, system: System, motion: Motion, band: Band, one: Stacked, p: Array, size: Array
    ) -> _Trial:
        """From what `stacked_residual` gave."""
        rows = band.thinned_rows(motion.t.size)
        gains = system.input_map(motion.q[rows], motion.inputs(system.inputs)[rows], p)
        weight = (one.used / size)[:, :, None]
        both = np.concatenate([one.slope, one.residual[:, :, None]], axis=2) * weight
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
        """Standard errors of the offsets, (n_force,), by its parts."""
        sd = np.std(self.parts @ step, axis=0, ddof=1) / np.sqrt(_PARTS)
        return np.asarray(np.maximum(sd, np.finfo(float).tiny))


def _still_told(trials: Sequence[_Trial], own: Array, whole: Array) -> bool:
    """Whether offsets by trial leave what one offset for all leaves to tell the parameters."""
    across = np.sum([one.common[0] for one in trials], axis=0)
    squared = np.sum([one.common[1] for one in trials], axis=0)
    common = np.diag(whole - across.T @ np.linalg.lstsq(squared, across, rcond=1e-9)[0])[:-1]
    counts = common > _TOLD * np.diag(whole)[:-1]
    return bool(np.all(np.diag(own)[:-1][counts] > _STILL_TOLD * common[counts]))
