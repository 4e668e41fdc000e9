"""How well a set-up explains the trials, and how believable the parameters are that it asks for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bampipe.errors import InputError
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.physics.parameter import Parameter
from bampipe.trials.evidence import Evidence, gather_evidence
from bampipe.trials.folds import Folds
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import applied_rms

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
_RIDGE = 1e-9
"""What holds the sizes of shapes that look alike, as a share of what the trials say of each."""
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
        usual: what they sum up to where all is well: each of many numbers that are known as data
            are is off by its deviation.
    """

    error: Array
    moving: Array
    p: Array
    objections: Array
    usual: float = 0.0

    @property
    def worst_error(self) -> float:
        """Of the axes that move."""
        return float(self.error[self.moving >= LEAST_MOVING].max(initial=0.0))

    def score(self, least: float) -> float:
        """The lower, the better; errors below ``least`` are as good as each other."""
        errors = np.log(np.hypot(self.error, least))
        return float(WEIGHT * errors.sum() + self.objections.sum())


def judge_setup(
    system: System,
    motions: Sequence[Motion],
    band: Band,
    folds: Folds,
    steps: int,
    posed: Sequence[int] = (),
) -> Plausibility | None:
    """Fit the bare device by least squares; None where it cannot be computed with.

    Args:
        system: the bare device; motions: as the set-up has them; band: of the residual.
        folds: which trials are fitted, which left out together; steps: of the fit, the most.
        posed: numbers of axes that are given a torque over their own position beside the device.
    """
    with np.errstate(all="ignore"):
        try:
            evidence = gather_evidence(
                system, motions, band, system.prior, folds, most_iterations=steps
            )
            found = _with_pose(evidence, posed)
            moving = _moving(evidence.used)
            size = applied_rms(system, motions, band, found.p, evidence.used)
        except (InputError, ValueError, np.linalg.LinAlgError):
            return None
        share = np.where(size > 0.0, found.error / size, 0.0)
        share = np.where(moving >= LEAST_MOVING, share, 1.0)
    if not np.isfinite(share).all():
        return None
    return Plausibility(share, moving, found.p, *_object_to(system.parameters, found))


def axes_without_pose(system: System, motions: Sequence[Motion]) -> list[int]:
    """Numbers of the axes at which no torque of the device follows their own position."""
    p = system.prior + np.array([item.sd for item in system.parameters])
    return [i for i in range(len(system.coordinates)) if not _follows(system, motions, p, i)]


def _follows(system: System, motions: Sequence[Motion], p: Array, axis: int) -> bool:
    for motion in motions:
        still = np.zeros_like(motion.q)
        u = np.zeros((len(motion.q), len(system.inputs)))
        z = system.memory(motion.q, still, still, u, p, motion.t)
        middle = motion.q.copy()
        middle[:, axis] = motion.q[:, axis].mean()
        held, moved = (system.residual(q, still, still, z, u, p) for q in (middle, motion.q))
        if not np.allclose(held[:, axis], moved[:, axis], rtol=1e-9, atol=1e-12):
            return True
    return False


@dataclass(frozen=True)
class _Fitted:
    """Error by axis, (n_q,), parameters, (n_p,), and their covariance, (n_p, n_p).

    The covariance is as if samples were independent, and zero of what is held.
    """

    error: Array
    p: Array
    covariance: Array


def _with_pose(evidence: Evidence, posed: Sequence[int]) -> _Fitted:
    """The fit with a torque over the position of the axes ``posed`` beside the device."""
    free, weight, sums = list(evidence.free), evidence.weight, evidence.sums
    step, more = np.zeros(len(free)), np.zeros(0)
    if posed:
        columns = [_pose_columns(evidence, k, posed) for k in range(len(evidence.residual))]
        nothing = [np.zeros_like(residual) for residual in evidence.residual]
        sums = sums.bordered(evidence.jacobian, columns, nothing, evidence.residual)
        # The device may have a constant of its own, and a short travel shows no more than a line.
        more = _RIDGE * np.einsum("q,kqii->i", weight, sums.xx)[len(free) :]
        part = sums.subset(evidence.folds.fitted_trials)
        ridge, wide = np.append(step, more), np.full(more.size, np.inf)
        step = replace(part, precision=part.precision + ridge).solve(
            weight, np.append(evidence.lower, -wide), np.append(evidence.upper, wide)
        )
    p, covariance = evidence.p.copy(), np.zeros((len(evidence.p),) * 2)
    p[free] += step[: len(free)]
    prior_sd = np.array([evidence.system.parameters[i].sd for i in free])
    size = np.append(
        np.maximum(prior_sd, np.finfo(float).tiny), np.sqrt(_RIDGE / np.maximum(more, _RIDGE))
    )
    least = np.append(np.full(len(free), VAGUE**-2.0), np.full(more.size, _RIDGE))
    normal = np.einsum("q,kqij->ij", weight, sums.xx)
    inverse = _inverse(normal * np.outer(size, size), least) * np.outer(size, size)
    covariance[np.ix_(free, free)] = inverse[: len(free), : len(free)]
    return _Fitted(np.sqrt(sums.mean_square(step)), p, covariance)


def _inverse(normal: Array, least: Array) -> Array:
    """The inverse of ``normal``, (n, n), with ``least`` on its diagonal, (n,).

    Of the bodies of a robot many combinations do not show, to which rounding may give less than
    nothing.
    """
    values, directions = np.linalg.eigh(normal + np.diag(least))
    inverse = directions / np.maximum(values, least.min()) @ directions.T
    return np.asarray(inverse)


def _pose_columns(evidence: Evidence, trial: int, posed: Sequence[int]) -> Array:
    """What a torque over the own position of each axis ``posed`` is made of, (K, n_q, P).

    A constant and a line; with a wave a turn long where the axis turns, a cubic where it slides.
    """
    motion, n_q = evidence.motions[trial], len(evidence.system.coordinates)
    found = np.zeros((*evidence.residual[trial].shape, 4 * len(posed)))
    for number, axis in enumerate(posed):
        q = motion.q[:, axis]
        turning = evidence.system.model.device.coordinates[axis].kind == "rotary"
        curves = (np.sin(q), np.cos(q)) if turning else (q**2, q**3)
        shapes = (np.ones_like(q), q, *curves)
        for place, shape in enumerate(shapes, start=4 * number):
            column = np.zeros((len(q), n_q))
            column[:, axis] = shape
            found[..., place] = evidence.band.thin(column) * evidence.used[trial]
    return found


def _moving(used: Sequence[NDArray[np.bool_]]) -> Array:
    total = sum(len(u) for u in used)
    return np.asarray(sum(u.sum(axis=0) for u in used) / max(total, 1))


def distance_from_prior(item: Parameter, value: float) -> float:
    """How far a value is from what the device file expects, in deviations of that.

    What cannot be negative and is expected to be something is compared by its logarithm: a tenth
    is as far as ten times. Where nothing is expected of it, its deviation is no more than a size
    that is thinkable: each doubling beyond that is one more.
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


def _object_to(parameters: Sequence[Parameter], found: _Fitted) -> tuple[Array, float]:
    """Half the squared distance of each parameter from its prior, (n_p,); what is usual of all.

    Numbers that are known as data are, such as those of drawn bodies, are taken together.
    """
    spread = CERTAIN * np.sqrt(np.diag(found.covariance))
    objections = np.array(
        [
            _objection(item, value, margin)
            for item, value, margin in zip(parameters, found.p, spread, strict=True)
        ]
    )
    usual = 0.0
    known = [i for i, p in enumerate(parameters) if p.weighed and not p.fixed and p.sd > 0.0]
    if known:
        prior = np.array([parameters[i].prior for i in known])
        sd = np.array([parameters[i].sd for i in known])
        covariance = found.covariance[np.ix_(known, known)] / np.outer(sd, sd)
        objections[known], usual = _joint_objections(found.p[known] / sd, prior / sd, covariance)
    return objections, usual


def _objection(item: Parameter, value: float, margin: float) -> float:
    nearest = min(max(item.prior, value - margin), value + margin)
    return 0.5 * min(distance_from_prior(item, nearest) ** 2, FARTHEST**2)


def _joint_objections(found: Array, prior: Array, covariance: Array) -> tuple[Array, float]:
    """Objections to parameters of which the trials only show combinations, (n,).

    Each alone can be what it is expected to be, as the mass of one link can at the cost of the
    next, and all together not: so the combinations are judged, in their deviations. These are
    wider where no factor brings what is found and what is expected closer than they say (Birge
    1932): the trials may lack something else than the right units.

    Args:
        found, prior: in deviations of the prior; covariance: of the fit, likewise.

    Returns:
        The objections, and what they sum up to on average where all is well.
    """
    variance, directions = np.linalg.eigh(covariance)
    shown = 1.0 / (1.0 + CERTAIN**2 * np.maximum(variance, 0.0))
    said, expected = directions.T @ found, directions.T @ prior
    factor = (shown * said) @ expected / max((shown * expected) @ expected, np.finfo(float).tiny)
    apart = float(shown @ (said - factor * expected) ** 2)
    birge = min(1.0, float(shown.sum()) / apart) if apart > 0.0 else 1.0
    each = 0.5 * np.minimum(birge * shown * (said - expected) ** 2, FARTHEST**2)
    return directions**2 @ each, 0.5 * float(shown.sum())
