"""What a candidate adds to the residual of a fitted model: columns of a linear problem."""

import numpy as np

from bampipe.arrays import Array
from bampipe.diagnosis.candidates import Candidate
from bampipe.trials.evidence import Evidence
from bampipe.trials.likelihood import NOTHING
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import ModelOnTrial


def added_columns(
    evidence: Evidence, item: Candidate, searched: Array
) -> tuple[list[Array], list[Array]]:
    """What a candidate adds at given values of its searched parameters, low-passed, by trial.

    Returns:
        Columns of its linear strengths, each (K, n_q, m), and where it has none of those the
        change of the residual, each (K, n_q).
    """
    e, system = evidence, item.system
    count, p = len(system.parameters) - len(item.parameters), parameters_with(e, item, searched)
    axes = list(range(len(system.coordinates)) if system.moves_sensors else system.touched)
    rows = [
        np.concatenate([r[:, axes] for r in _added_rows(item, p, count, base)], axis=1)
        for base in e.fitted
    ]
    probes = max(1, len(item.linear_indices))
    columns, changes = [], []
    for values, used in zip(e.band.thin_trials(rows, axes * probes), e.used, strict=True):
        thin = np.zeros((len(used), probes, used.shape[1]))
        thin[:, :, axes] = values.reshape(len(used), probes, len(axes)) * used[:, None, axes]
        if item.linear_indices:
            columns.append(thin.transpose(0, 2, 1))
            changes.append(np.zeros(used.shape))
        else:
            columns.append(np.zeros((*used.shape, 0)))
            changes.append(thin[:, 0])
    return columns, changes


def parameters_with(
    evidence: Evidence, item: Candidate, searched: Array, strengths: Array | float = 0.0
) -> Array:
    """The parameters of a candidate's system beside a fitted model, (n_p,)."""
    e, system = evidence, item.system
    count = len(system.parameters) - len(item.parameters)
    p = np.array([q.prior for q in system.parameters])
    beside_others = item.is_joint or _moves(item)
    for k, q in enumerate(system.parameters[:count]):
        # Where the fit took a parameter away, an effect of it would be none: its prior stands in.
        if beside_others or k not in e.free or e.p[k] - q.lower > NOTHING * q.sd:
            p[k] = e.p[k]
    p[[count + i for i in item.searched_indices]] = searched
    p[[count + i for i in item.linear_indices]] = strengths
    return p


def _added_rows(item: Candidate, p: Array, count: int, base: ModelOnTrial) -> list[Array]:
    """`added_residual` on one trial, with each linear strength at one; by ``p`` without any."""
    probes = [p.copy() for _ in item.linear_indices or (None,)]
    for probe, i in zip(probes, item.linear_indices, strict=False):
        probe[count + i] = 1.0
    if _moves(item):
        return [added_residual(item, probe, base) for probe in probes]
    motion = base.mechanism
    z = _states(item, motion, p)
    return [_added_along(item, probe, base, motion, z) for probe in probes]


def added_residual(item: Candidate, p: Array, base: ModelOnTrial) -> Array:
    """What a candidate adds to the residual of a model along a motion, (T, n_q), N.m or N.

    ``p`` are the parameters of its system, its own last; ``base`` is the model without it.
    """
    if not _moves(item):
        motion = base.mechanism
        return _added_along(item, p, base, motion, _states(item, motion, p))
    system, motion = item.system, base.motion
    u = motion.inputs(system.inputs)
    moved = motion.of_mechanism(system, u, p)
    if item.replaces_motion:
        at = moved.kinematics
        return base.system.residual(*at, base.memory, base.inputs, base.p) - base.residual
    at, z = moved.kinematics, _states(item, moved, p)
    return system.applied(*at, z, u, p) - system.required(*at, z, u, p) - base.residual


def _moves(item: Candidate) -> bool:
    """Whether the mechanism moves otherwise with a candidate: by its own offset, or by its load."""
    count = len(item.system.parameters) - len(item.parameters)
    return any(number >= count for number in item.system.moved_by)


def _added_along(item: Candidate, p: Array, base: ModelOnTrial, motion: Motion, z: Array) -> Array:
    """`added_residual` along the motion of the model without the candidate, with states ``z``."""
    system, at = item.system, motion.kinematics
    added = system.contribution(*at, z, motion.inputs(system.inputs), p)
    return added - base.contribution if item.is_joint else added


def _states(item: Candidate, motion: Motion, p: Array) -> Array:
    system = item.system
    return system.memory(*motion.kinematics, motion.inputs(system.inputs), p, motion.t)
