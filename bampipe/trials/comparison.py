"""Measured forces and residuals of each trial, and from them the errors of each axis."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array, Flags
from bampipe.estimate.standstill import find_moving_samples
from bampipe.physics import System
from bampipe.results.validate import AxisError
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.motion import force_columns
from bampipe.trials.residuals import ModelOnTrial, rms, standstill_of


@dataclass(frozen=True)
class ComparedTrial:
    """One trial, low-passed and thinned; torques (K, n_q), N.m or N, forces (K, n_f), N.

    ``used`` (K, n_q) is false where an axis stands still: there Coulomb friction balances
    whatever the load is, and no model predicts it.
    """

    trial_id: str
    t: Array
    used: Flags
    measured: Array
    residual: Array
    residual_held_out: Array
    residual_without_friction: Array
    force: Array
    force_residual: Array
    judged: bool


def compare_trial(
    system: System, trials: MeasuredTrials, number: int, published: Array, unseen: Array
) -> ComparedTrial:
    """Compare one trial with the model as published, held out, and without friction.

    ``published`` (n_p + 1,) are parameters, followed by the change of the input delay from that
    compensated in the trials, s; ``unseen`` is the same from the other trials.
    """
    motion, band, folds = trials.motions[number], trials.band, trials.folds
    dry = (effect for effect in system.model.effects if effect.effect.is_dry_friction)
    strengths = {item.name for effect in dry for item in effect.parameters if item.strength}
    frictionless = published.copy()
    for i, item in enumerate(system.parameters):
        if item.name in strengths or item.name.startswith(("viscous.", "coulomb.")):
            frictionless[i] = 0.0

    def residual_of(p: Array) -> Array:
        timed = motion.with_input_timing(float(p[-1]))
        return band.thin(ModelOnTrial(system, p[:-1], [timed]).residual)

    u = motion.inputs(system.inputs)
    applied = ModelOnTrial(system, published[:-1], [motion]).applied
    rows = band.thinned_rows(len(motion.t))
    used = find_moving_samples(standstill_of(motion, system, band.rate_hz), band)
    residual = residual_of(published)
    return ComparedTrial(
        trial_id=motion.trial_id,
        t=motion.t[rows],
        used=used,
        measured=band.thin(applied),
        residual=residual,
        residual_held_out=residual_of(unseen) * used,
        residual_without_friction=residual_of(frictionless),
        force=band.thin_input(u[:, force_columns(system)]),
        force_residual=system.least_force(motion.q[rows], residual, u[rows], published[:-1]),
        judged=folds.judged[number] and not folds.nothing_held_out,
    )


def _percent(error: float, size: float) -> float:
    """Relative error: norm of the residual over norm of the measured torque, per cent."""
    return 100.0 * error / size if size > 0.0 else 100.0


def axis_errors(system: System, compared: Sequence[ComparedTrial]) -> dict[str, AxisError]:
    """Return the errors of each axis over some trials."""
    every = range(len(compared))
    unseen = [k for k, c in enumerate(compared) if c.judged] or every

    def rms_of(which: Sequence[int], part: Callable[[ComparedTrial], Array]) -> Array:
        # The compared trials of a long session are on disk: read one at a time.
        return rms((part(compared[k]) for k in which), (compared[k].used for k in which))

    rmse = rms_of(every, lambda c: c.residual)
    without = rms_of(every, lambda c: c.residual_without_friction)
    size = rms_of(every, lambda c: c.measured)
    held_out = rms_of(unseen, lambda c: c.residual_held_out)
    count = np.maximum(sum(compared[k].used.sum(axis=0) for k in unseen), 1)
    measured = (np.sum(compared[k].measured * compared[k].used, axis=0) for k in unseen)
    mean = sum(measured) / count
    spread = rms_of(unseen, lambda c: c.measured - mean)
    unseen_size = rms_of(unseen, lambda c: c.measured)
    # An axis that nothing drives, such as a pole on a cart, has no applied force to explain.
    return {
        axis: AxisError(
            rmse=rmse[i],
            rmse_without_friction=without[i],
            held_out_rmse=held_out[i],
            relative_error_percent=_percent(rmse[i], size[i]),
            held_out_relative_error_percent=_percent(held_out[i], unseen_size[i]),
            fit_percent=100.0 * (1.0 - held_out[i] / spread[i]) if spread[i] > 0.0 else None,
            unit=system.torque_units[i],
        )
        for i, axis in enumerate(system.coordinates)
    }
