"""Plausibility of a set-up: the error that it leaves, and the parameters that it implies."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np

from bampipe.arrays import Array
from bampipe.errors import InputError
from bampipe.estimate.low_pass import Band
from bampipe.estimate.normal_equations import NormalEquations
from bampipe.physics import System
from bampipe.physics.parameter import Parameter
from bampipe.trials.folds import Folds
from bampipe.trials.linearisation import Linearisation, linearise_fit
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import rms

WEIGHT = 8.0
"""Weight of the logarithm of an axis' error: a third of the error counts as much as a parameter
that returns from beyond `FARTHEST` deviations of its prior."""
FARTHEST = 4.0
"""Prior standard deviations beyond which parameters are equally implausible."""
CERTAIN = 5.0
"""Standard deviations of the fit within which a parameter may have its prior value: those of a
model that lacks something are too small."""
VAGUE = 100.0
"""Largest uncertainty of a parameter, in prior deviations, if the trials contain no information."""
LEAST_MOVING = 0.05
"""Smallest fraction of samples in motion with which an axis can be judged."""
_EVEN = 1e-6
"""Relative deviation of a force from its mean below which there is no variation to explain."""


@dataclass(frozen=True)
class Plausibility:
    """Result of a least-squares fit of the bare device under one set-up.

    Attributes:
        error: of the fit by axis, relative to the applied force, or to that of inertia if nothing
            is applied, (n_q,); 1 if the axis hardly moves. Mistakes are so gross that the fit shows
            them; held-out trials would be extrapolated from a few slow ones that determine little.
        moving: fraction of the samples in which each axis moves, (n_q,).
        p: parameters, (n_p,).
        objections: half the squared distance of each parameter from its prior, in prior
            deviations, (n_p,).
        unexplained: the error relative to the applied force's standard deviation, (n_q,); None for
            a comparison with drawn bodies.
    """

    error: Array
    moving: Array
    p: Array
    objections: Array
    unexplained: Array | None = None

    @property
    def worst_error(self) -> float:
        """Largest error among the axes that move."""
        return float(self.error[self.moving >= LEAST_MOVING].max(initial=0.0))

    @property
    def left(self) -> Array:
        """Error relative to the applied force or to its variation, whichever is larger, (n_q,)."""
        return self.error if self.unexplained is None else np.maximum(self.error, self.unexplained)

    def score(self, least: float) -> float:
        """Score of the set-up, lower being better; errors below ``least`` count as equal."""
        errors = np.log(np.hypot(self.error, least))
        return float(WEIGHT * errors.sum() + self.objections.sum())

    def with_nothing_explained(self) -> "Plausibility":
        """The plausibility of a set-up under which the device cannot be computed."""
        nothing, objections = np.full_like(self.error, 1e3), np.full_like(self.objections, 0.5)
        return replace(self, error=nothing, moving=np.ones_like(nothing), objections=objections)


def judge_setup(
    system: System,
    motions: Sequence[Motion],
    band: Band,
    folds: Folds,
    steps: int,
    posed: Sequence[int] = (),
) -> Plausibility | None:
    """Fit the bare device by least squares; None if it cannot be computed.

    Args:
        system: the bare device; band: of the residual; steps: largest number of steps.
        posed: numbers of axes that get a torque over their own position beside the device.
    """
    with np.errstate(all="ignore"):
        try:
            linearisation = linearise_fit(
                system, motions, band, system.prior, folds, most_iterations=steps
            )
            error = _errors_with_pose(linearisation, posed) if posed else linearisation.rmse()
            applied = [band.thin(on_trial.applied) for on_trial in linearisation.fitted]
            size, used = rms(applied, linearisation.used), np.concatenate(linearisation.used)
            sums = np.sum(np.concatenate(applied), axis=0, where=used)
            middle = sums / np.maximum(used.sum(axis=0), 1)
            varied = np.sqrt(np.maximum(size**2 - middle**2, 0.0))
            if not size.all():
                mass = [system.mass_matrix(m.q, linearisation.p) for m in motions]
                inertial = map(np.einsum, repeat("tij,tj->ti"), mass, [m.qdd for m in motions])
                size = np.where(size > 0.0, size, rms(map(band.thin, inertial), linearisation.used))
        except (InputError, ValueError, np.linalg.LinAlgError):
            return None
        moving = np.mean(used, axis=0)
        share = np.where(moving >= LEAST_MOVING, error / np.maximum(size, 1e-300), 1.0)
        unexplained = np.where(varied > _EVEN * size, error / varied, 0.0)
    if not np.isfinite(share).all():
        return None
    spread = CERTAIN * _standard_errors(linearisation)
    priors = np.array([item.prior for item in system.parameters])
    nearest = np.clip(priors, linearisation.p - spread, linearisation.p + spread)
    distance = np.array(list(map(distance_from_prior, system.parameters, nearest)))
    objections = 0.5 * np.minimum(distance**2, FARTHEST**2)
    return Plausibility(share, moving, linearisation.p, objections, unexplained)


def axes_without_pose(system: System, motions: Sequence[Motion]) -> list[int]:
    """Numbers of the axes on which no torque of the device depends on their own position."""
    p = system.prior + np.array([item.sd for item in system.parameters])
    free = set(range(len(system.coordinates)))
    for motion in motions:
        still, u = np.zeros_like(motion.q), np.zeros((len(motion.q), len(system.inputs)))
        z = system.memory(motion.q, still, still, u, p, motion.t)
        for axis in tuple(free):
            middle = motion.q.copy()
            middle[:, axis] = motion.q[:, axis].mean()
            held, moved = (system.residual(q, still, still, z, u, p) for q in (middle, motion.q))
            if not np.allclose(held[:, axis], moved[:, axis], rtol=1e-9, atol=1e-12):
                free.remove(axis)
    return sorted(free)


def _errors_with_pose(linearisation: Linearisation, posed: Sequence[int]) -> Array:
    """Errors (n_q,) of the fit with an additional torque over position on the axes ``posed``."""
    columns = [
        np.concatenate([slopes, _pose_columns(linearisation, k, posed)], axis=2)
        for k, slopes in enumerate(linearisation.jacobian)
    ]
    residual, used, no_prior = linearisation.residual, linearisation.used, np.zeros(0)
    sums = NormalEquations.from_samples(columns, residual, used, no_prior, no_prior)
    wide = np.full(4 * len(posed), np.inf)
    lower, upper = np.append(linearisation.lower, -wide), np.append(linearisation.upper, wide)
    fitted = sums.subset(linearisation.folds.fitted_trials)
    step = fitted.solve(linearisation.weight, lower, upper)
    return np.asarray(np.sqrt(sums.mean_square(step)))


def _pose_columns(linearisation: Linearisation, trial: int, posed: Sequence[int]) -> Array:
    """Columns of a torque over its own position on each axis ``posed``, (K, n_q, P).

    They are a constant and a line, with sine and cosine for a rotary axis, or square and cube for a
    linear one.
    """
    motion = linearisation.motions[trial]
    found = np.zeros((*linearisation.residual[trial].shape, 4 * len(posed)))
    for number, axis in enumerate(posed):
        q = motion.q[:, axis]
        turning = linearisation.system.model.device.coordinates[axis].kind == "rotary"
        curves = (np.sin(q), np.cos(q)) if turning else (q**2, q**3)
        shapes = np.column_stack([np.ones_like(q), q, *curves])
        thinned = linearisation.band.thin(shapes, [axis] * 4) * linearisation.used[trial][:, [axis]]
        found[:, axis, 4 * number : 4 * number + 4] = thinned
    return found


def _standard_errors(linearisation: Linearisation) -> Array:
    """Standard errors of the fit for independent samples, (n_p,); zero for fixed parameters."""
    free, found = list(linearisation.free), np.zeros(len(linearisation.p))
    prior_sd = np.array([linearisation.system.parameters[i].sd for i in free])
    size = np.maximum(prior_sd, np.finfo(float).tiny)
    normal = np.einsum("q,kqij->ij", linearisation.weight, linearisation.sums.xx)
    normal = normal * np.outer(size, size) + VAGUE**-2.0 * np.eye(len(free))
    values, directions = np.linalg.eigh(normal)
    # Rounding may give negative information to combinations that the trials do not show.
    found[free] = size * np.sqrt(directions**2 @ (1.0 / np.maximum(values, VAGUE**-2.0)))
    return found


def distance_from_prior(item: Parameter, value: float) -> float:
    """Distance of a value from its prior in the device file, in prior deviations.

    Positive parameters with a positive prior are compared by their logarithms: a tenth is as far as
    ten times. If the prior of a non-negative parameter is zero, its deviation is a conceivable
    size, and each doubling beyond counts as one.
    """
    if item.fixed or item.sd == 0.0:
        return 0.0
    if item.lower >= 0.0 and item.prior > 0.0:
        if value <= 0.0:
            return -FARTHEST
        return math.log(value / item.prior) / math.log1p(item.sd / item.prior)
    if item.lower >= 0.0 and item.prior == 0.0 and value > 0.0:
        return math.log2(1.0 + value / item.sd)
    return (value - item.prior) / item.sd
