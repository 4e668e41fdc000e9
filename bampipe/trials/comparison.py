"""What a model requires against what was measured, by trial: residuals, and errors by axis."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array, Flags
from bampipe.errors import InputError
from bampipe.physics import System
from bampipe.results.validate import AxisError
from bampipe.trials.evidence import Evidence, gather_evidence
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.motion import force_columns
from bampipe.trials.replay import UNLIKE, StandIn, replay_motions
from bampipe.trials.residuals import ModelOnTrial, rms

_EXPECTED_SEED = 3
"""After the user's: of the replay that shows how the published parameters would look if true."""


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


def compare_trial(evidence: Evidence, number: int, p: Array, late_s: float = 0.0) -> ComparedTrial:
    """Compare one trial with the model as published, held out, and without friction.

    ``p`` (n_p,) and ``late_s`` are published; the latter as far as it is not taken off the trials.
    """
    system, motion = evidence.system, evidence.motions[number]
    timed = [motion.with_input_timing(late_s)]
    dry = (effect for effect in system.model.effects if effect.effect.is_dry_friction)
    strengths = {item.name for effect in dry for item in effect.parameters if item.strength}
    frictionless = p.copy()
    for i, item in enumerate(system.parameters):
        if item.name in strengths or item.name.startswith(("viscous.", "coulomb.")):
            frictionless[i] = 0.0
    band, folds = evidence.band, evidence.folds
    u = motion.inputs(system.inputs)
    applied = ModelOnTrial(system, p, [motion]).applied
    rows = band.thinned_rows(len(motion.t))
    residual = band.thin(ModelOnTrial(system, p, timed).residual)
    return ComparedTrial(
        trial_id=motion.trial_id,
        t=motion.t[rows],
        used=evidence.used[number],
        measured=band.thin(applied),
        residual=residual,
        residual_held_out=evidence.held_out_residual(number),
        residual_without_friction=band.thin(ModelOnTrial(system, frictionless, timed).residual),
        force=band.thin_input(u[:, force_columns(system)]),
        force_residual=system.least_force(motion.q[rows], residual, u[rows], p),
        judged=folds.judged[number] and not folds.nothing_held_out,
    )


def _percent(error: float, size: float) -> float:
    """Relative error: norm of the residual over norm of the measured torque, per cent."""
    return 100.0 * error / size if size > 0.0 else 100.0


def axis_errors(system: System, compared: Sequence[ComparedTrial]) -> dict[str, AxisError]:
    """Return the errors of each axis over some trials."""
    used = [c.used for c in compared]
    rmse = rms([c.residual for c in compared], used)
    without = rms([c.residual_without_friction for c in compared], used)
    size = rms([c.measured for c in compared], used)
    unseen = [c for c in compared if c.judged] or compared
    where = [c.used for c in unseen]
    held_out = rms([c.residual_held_out for c in unseen], where)
    published = published_rmse(compared)
    count = np.maximum(sum(keep.sum(axis=0) for keep in where), 1)
    mean = sum(np.sum(c.measured * c.used, axis=0) for c in unseen) / count
    spread = rms([c.measured - mean for c in unseen], where)
    unseen_size = rms([c.measured for c in unseen], where)
    # Of an axis that nothing drives, such as a pole on a cart, no force is there to explain.
    return {
        axis: AxisError(
            rmse=rmse[i],
            rmse_without_friction=without[i],
            held_out_rmse=held_out[i],
            published_rmse=published[i],
            relative_error_percent=_percent(rmse[i], size[i]),
            held_out_relative_error_percent=_percent(held_out[i], unseen_size[i]),
            fit_percent=100.0 * (1.0 - held_out[i] / spread[i]) if spread[i] > 0.0 else None,
            unit=system.torque_units[i],
        )
        for i, axis in enumerate(system.coordinates)
    }


def published_rmse(compared: Sequence[ComparedTrial]) -> Array:
    """Error of the published parameters by axis on the trials that are judged, (n_q,)."""
    unseen = [c for c in compared if c.judged] or compared
    return rms([c.residual for c in unseen], [c.used for c in unseen])


def expected_published_ratio(
    evidence: Evidence, trials: MeasuredTrials, p: Array, seed: int
) -> Array:
    """Return published over held-out error, at least 1, were the published parameters true, (n_q,).

    A refit takes on what filtering does to a change of direction; the truth does not. How much
    worse it therefore looks, a replay of it shows.
    """
    nothing = np.ones(len(evidence.system.coordinates))
    published = StandIn(evidence.system, p, evidence.motions, trials.sensors.rate_hz)
    try:
        replays = replay_motions(
            published, trials.sensors, trials.kinematics, (seed, _EXPECTED_SEED)
        )
        again = gather_evidence(
            evidence.system, replays, evidence.band, evidence.p, evidence.folds, held=evidence.held
        )
    except InputError:
        return nothing
    if np.any(again.held_out_rmse > UNLIKE * evidence.held_out_rmse):
        return nothing
    replayed = [compare_trial(again, number, p) for number in range(len(again.motions))]
    return np.maximum(published_rmse(replayed) / np.maximum(again.held_out_rmse, 1e-300), 1.0)
