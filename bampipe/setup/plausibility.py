"""How well a set-up explains the trials, and how believable the parameters are that it asks for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from bampipe.arrays import Array
from bampipe.errors import InputError
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.physics.parameter import Parameter
from bampipe.trials.evidence import Evidence, gather_evidence
from bampipe.trials.folds import Folds
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import ModelOnTrial, rms

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
_EVEN = 1e-6
"""Deviation of a force over its root mean square below which there is none to explain."""


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
        unexplained: the error as a share of the applied force's deviation from its mean, (n_q,);
            None where it is that of bodies as drawn.
    """

    error: Array
    moving: Array
    p: Array
    objections: Array
    unexplained: Array | None = None

    @property
    def worst_error(self) -> float:
        """Of the axes that move."""
        return float(self.error[self.moving >= LEAST_MOVING].max(initial=0.0))

    @property
    def left(self) -> Array:
        """Share (n_q,) of the applied force, or of how it varies where that is more."""
        return self.error if self.unexplained is None else np.maximum(self.error, self.unexplained)

    def score(self, least: float) -> float:
        """The lower, the better; errors below ``least`` are as good as each other."""
        errors = np.log(np.hypot(self.error, least))
        return float(WEIGHT * errors.sum() + self.objections.sum())

    def with_nothing_explained(self) -> Plausibility:
        """The same device with a set-up that it cannot be computed with."""
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
    """Fit the bare device by least squares; None where it cannot be computed with.

    Args:
        system: the bare device; band: of the residual; steps: of the fit, the most.
        posed: numbers of axes that are given a torque over their own position beside the device.
    """
    with np.errstate(all="ignore"):
        try:
            evidence = gather_evidence(
                system, motions, band, system.prior, folds, most_iterations=steps
            )
            error = _errors_with_pose(evidence, posed) if posed else evidence.rmse()
            on_trials = (ModelOnTrial(system, evidence.p, [motion]) for motion in motions)
            applied = [band.thin(on_trial.applied) for on_trial in on_trials]
            size, used = rms(applied, evidence.used), np.concatenate(evidence.used)
            varied = np.std(np.concatenate(applied), axis=0, where=used)
        except (InputError, ValueError, np.linalg.LinAlgError):
            return None
        moving = np.mean(used, axis=0)
        share = np.where(size > 0.0, error / size, 0.0)
        share = np.where(moving >= LEAST_MOVING, share, 1.0)
        unexplained = np.where(varied > _EVEN * size, error / varied, 0.0)
    if not np.isfinite(share).all():
        return None
    spread = CERTAIN * _standard_errors(evidence)
    priors = np.array([item.prior for item in system.parameters])
    nearest = np.clip(priors, evidence.p - spread, evidence.p + spread)
    distance = np.array(list(map(distance_from_prior, system.parameters, nearest)))
    objections = 0.5 * np.minimum(distance**2, FARTHEST**2)
    return Plausibility(share, moving, evidence.p, objections, unexplained)


def axes_without_pose(system: System, motions: Sequence[Motion]) -> list[int]:
    """Numbers of the axes at which no torque of the device follows their own position."""
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


def _errors_with_pose(evidence: Evidence, posed: Sequence[int]) -> Array:
    """Errors (n_q,) of the fit with a torque over the position of the axes ``posed`` beside it."""
    count = len(evidence.free)
    wide = np.full(4 * len(posed), np.inf)
    columns = [
        np.concatenate([slopes, _pose_columns(evidence, k, posed)], axis=2)
        for k, slopes in enumerate(evidence.jacobian)
    ]
    root = np.sqrt(evidence.weight)[:, None]
    fitted = evidence.folds.fitted_trials
    design = np.concatenate([(root * columns[k]).reshape(-1, count + wide.size) for k in fitted])
    target = np.concatenate([(evidence.residual[k] * root[:, 0]).ravel() for k in fitted])
    scale = np.maximum(np.linalg.norm(design, axis=0), np.finfo(float).tiny)
    lower, upper = np.append(evidence.lower, -wide), np.append(evidence.upper, wide)
    step = lsq_linear(design / scale, -target, (lower * scale - 1e-12, upper * scale + 1e-12)).x
    left = [r + c @ (step / scale) for r, c in zip(evidence.residual, columns, strict=True)]
    used = np.maximum(np.concatenate(evidence.used).sum(axis=0), 1.0)
    return np.asarray(np.sqrt(np.sum(np.concatenate(left) ** 2, axis=0) / used))


def _pose_columns(evidence: Evidence, trial: int, posed: Sequence[int]) -> Array:
    """What a torque over the own position of each axis ``posed`` is made of, (K, n_q, P).

    A constant and a line; with a wave a turn long where the axis turns, a cubic where it slides.
    """
    motion = evidence.motions[trial]
    found = np.zeros((*evidence.residual[trial].shape, 4 * len(posed)))
    for number, axis in enumerate(posed):
        q = motion.q[:, axis]
        turning = evidence.system.model.device.coordinates[axis].kind == "rotary"
        curves = (np.sin(q), np.cos(q)) if turning else (q**2, q**3)
        shapes = np.column_stack([np.ones_like(q), q, *curves])
        thinned = evidence.band.thin(shapes, [axis] * 4) * evidence.used[trial][:, [axis]]
        found[:, axis, 4 * number : 4 * number + 4] = thinned
    return found


def _standard_errors(evidence: Evidence) -> Array:
    """Of the fit, (n_p,), as if samples were independent; zero of what is held."""
    free, found = list(evidence.free), np.zeros(len(evidence.p))
    prior_sd = np.array([evidence.system.parameters[i].sd for i in free])
    size = np.maximum(prior_sd, np.finfo(float).tiny)
    normal = np.einsum("q,kqij->ij", evidence.weight, evidence.sums.xx) * np.outer(size, size)
    values, directions = np.linalg.eigh(normal + VAGUE**-2.0 * np.eye(len(free)))
    # Rounding may give less than nothing to combinations that do not show.
    found[free] = size * np.sqrt(directions**2 @ (1.0 / np.maximum(values, VAGUE**-2.0)))
    return found


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
