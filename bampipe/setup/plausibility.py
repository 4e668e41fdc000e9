"""How well a set-up explains the trials, and how believable the parameters are that it asks for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bampipe.errors import InputError
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.physics.parameter import Parameter
from bampipe.trials.folds import Folds
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import Evidence, gather_evidence

Array = NDArray[np.float64]

WEIGHT = 8.0
"""Of the logarithm of an axis' error: its third counts as much as a parameter that comes back from
beyond `FARTHEST` deviations of its prior."""
FARTHEST = 4.0
"""Standard deviations beyond which a parameter is as unbelievable as it can be."""
CERTAIN = 5.0
"""Standard deviations of the fit within which a parameter is taken to be where its prior is: those
of a model that lacks something are too small."""
VAGUE = 100.0
"""Deviations of its prior within which a parameter is even where the trials say nothing of it."""
LEAST_MOVING = 0.05
"""Share of the samples in which an axis must move for its equation to be judged."""


@dataclass(frozen=True)
class Plausibility:
    """What least squares with the bare device says of one set-up.

    Attributes:
        error: of the fit by axis as a share of the applied force, (n_q,); 1 where the axis hardly
            moves, 0 where nothing is applied. Gross as mistakes are, they show there; a trial left
            out would only be extrapolated to where a few slow ones determine little.
        moving: share of the samples in which each axis moves, (n_q,).
        p: parameters, (n_p,).
        objections: half the squared distance of each from its prior, in its deviations, (n_p,).
    """

    error: Array
    moving: Array
    p: Array
    objections: Array

    @property
    def worst_error(self) -> float:
        """Of the axes that move."""
        return float(self.error[self.moving >= LEAST_MOVING].max(initial=0.0))

    def score(self, least: float) -> float:
        """The lower, the better; errors below ``least`` are as good as each other."""
        errors = np.log(np.hypot(self.error, least))
        return float(WEIGHT * errors.sum() + self.objections.sum())


def judge_setup(
    system: System, motions: Sequence[Motion], band: Band, folds: Folds, steps: int
) -> Plausibility | None:
    """Fit the bare device by least squares; None where it cannot be computed with.

    Args:
        system: the bare device; motions: as the set-up has them; band: of the residual.
        folds: which trials are fitted, which left out together; steps: of the fit, the most.
    """
    with np.errstate(all="ignore"):
        try:
            evidence = gather_evidence(
                system, motions, band, system.prior, folds, most_iterations=steps
            )
            error, moving = evidence.rmse(), _moving(evidence.used)
            size = _applied(system, motions, band, evidence.p, evidence.used)
            sd = _standard_deviations(evidence)
        except (InputError, ValueError, np.linalg.LinAlgError):
            return None
        share = np.where(size > 0.0, error / size, 0.0)
        share = np.where(moving >= LEAST_MOVING, share, 1.0)
    if not np.isfinite(share).all():
        return None
    objections = [
        _objection(item, value, CERTAIN * spread)
        for item, value, spread in zip(system.parameters, evidence.p, sd, strict=True)
    ]
    return Plausibility(share, moving, evidence.p, np.array(objections))


def _standard_deviations(evidence: Evidence) -> Array:
    """Of the fitted parameters, (n_p,), as if samples were independent; zero of those held."""
    sums, free = evidence.sums, list(evidence.free)
    prior_sd = np.array([evidence.system.parameters[i].sd for i in free])
    normal = np.einsum("q,kqij->ij", evidence.weight, sums.xx)
    normal += np.diag(1.0 / np.maximum(VAGUE * prior_sd, np.finfo(float).tiny) ** 2)
    sd = np.zeros(len(evidence.p))
    sd[free] = np.sqrt(np.diag(np.linalg.inv(normal)))
    return sd


def _moving(used: Sequence[NDArray[np.bool_]]) -> Array:
    total = sum(len(u) for u in used)
    return np.asarray(sum(u.sum(axis=0) for u in used) / max(total, 1))


def _applied(
    system: System,
    motions: Sequence[Motion],
    band: Band,
    p: Array,
    used: Sequence[NDArray[np.bool_]],
) -> Array:
    """Root mean square of the applied force by axis where it moves, (n_q,)."""
    square, count = np.zeros(len(system.coordinates)), np.zeros(len(system.coordinates))
    for motion, moves in zip(motions, used, strict=True):
        u = motion.inputs(system.inputs)
        z = system.memory(motion.q, motion.qd, motion.qdd, u, p, motion.t)
        applied = band.thin(system.applied(motion.q, motion.qd, motion.qdd, z, u, p))
        square += np.sum(applied**2 * moves, axis=0)
        count += moves.sum(axis=0)
    return np.asarray(np.sqrt(square / np.maximum(count, 1)))


def distance_from_prior(item: Parameter, value: float) -> float:
    """How far a value is from what the device file expects, in deviations of that.

    What cannot be negative and is expected to be something is compared by its logarithm: a tenth
    is as far as ten times.
    """
    if item.fixed or item.sd == 0.0:
        return 0.0
    if item.lower >= 0.0 and item.prior > 0.0:
        if value <= 0.0:
            return -FARTHEST
        return math.log(value / item.prior) / math.log1p(item.sd / item.prior)
    return (value - item.prior) / item.sd


def _objection(item: Parameter, value: float, margin: float) -> float:
    nearest = min(max(item.prior, value - margin), value + margin)
    return 0.5 * min(distance_from_prior(item, nearest) ** 2, FARTHEST**2)
