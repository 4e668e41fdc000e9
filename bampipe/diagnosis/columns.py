"""The change of a fitted model's residual by a candidate, as columns of a linear problem."""

from collections.abc import Sequence

import numpy as np

from bampipe.arrays import Array
from bampipe.diagnosis.candidates import Candidate
from bampipe.trials.linear_problem import NOTHING
from bampipe.trials.linearisation import Linearisation
from bampipe.trials.residuals import ModelOnTrial


def compute_columns(linearisation: Linearisation, item: Candidate, searched: Array) -> Array:
    """Return the low-passed change of the residual by each linear strength, (n, n_q, m).

    The rows are those of all trials. A candidate without a linear strength has one column, its
    whole change of the residual. ``searched`` are the values of its searched parameters.
    """
    e, system = linearisation, item.system
    count, p = len(system.parameters) - len(item.parameters), make_parameters(e, item, searched)
    axes = list(range(len(system.coordinates)) if system.moves_sensors else system.touched)
    probes = [p.copy() for _ in item.linear_indices or (None,)]
    for probe, i in zip(probes, item.linear_indices, strict=False):
        probe[count + i] = 1.0
    rows = (
        values[part]
        for base in e.along
        for values in [np.hstack([r[:, axes] for r in _compute_changes(item, probes, base)])]
        for part in base.motion.parts
    )
    values = np.concatenate(e.band.thin_trials(rows, axes * len(probes)))
    used = np.concatenate(e.used)
    thin = np.zeros((len(used), len(probes), used.shape[1]))
    thin[:, :, axes] = values.reshape(len(used), -1, len(axes)) * used[:, None, axes]
    return thin.transpose(0, 2, 1)


def make_parameters(
    linearisation: Linearisation, item: Candidate, searched: Array, strengths: Array | float = 0.0
) -> Array:
    """Return the parameters of a candidate's system, the model's own as fitted, (n_p,)."""
    e, system = linearisation, item.system
    count = len(system.parameters) - len(item.parameters)
    p = np.array([q.prior for q in system.parameters])
    beside_others = item.is_joint or _moves(item)
    for k, q in enumerate(system.parameters[:count]):
        # An effect that scales a parameter needs its prior if the fit put it at its lower bound.
        if beside_others or k not in e.free or e.p[k] - q.lower > NOTHING * q.sd:
            p[k] = e.p[k]
    p[[count + i for i in item.searched_indices]] = searched
    p[[count + i for i in item.linear_indices]] = strengths
    return p


def compute_added_residual(item: Candidate, p: Array, base: ModelOnTrial) -> Array:
    """Return the change of a model's residual by a candidate along a motion, (T, n_q), N.m or N.

    ``p`` are the parameters of the candidate's system; ``base`` is the model without the candidate.
    """
    return _compute_changes(item, [p], base)[0]


def _compute_changes(item: Candidate, probes: Sequence[Array], base: ModelOnTrial) -> list[Array]:
    """Return `compute_added_residual` for each of ``probes``, which share their internal states."""
    system, moves = item.system, _moves(item)
    motion = base.motion if moves else base.mechanism
    u = motion.inputs(system.inputs)
    if not moves:
        at, z = motion.kinematics, motion.memory(system, probes[0])
        added = [system.contribution(*at, z, u, p) for p in probes]
        return [each - base.contribution for each in added] if item.is_joint else added
    added = []
    for p in probes:
        if item.replaces_motion:
            at = motion.of_mechanism(system, u, p).kinematics
            left = base.system.residual(*at, base.memory, base.inputs, base.p)
        else:
            left = ModelOnTrial(system, p, [motion]).residual_once
        added.append(left - base.residual)
    return added


def _moves(item: Candidate) -> bool:
    """Return whether a candidate's parameters change the motion of the mechanism."""
    count = len(item.system.parameters) - len(item.parameters)
    return any(number >= count for number in item.system.moved_by)
