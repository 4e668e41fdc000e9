"""Checks whether a model is finite along trials, and the physical reason if it is not."""

from collections.abc import Sequence

import numpy as np

from bampipe.arrays import Array, Flags
from bampipe.errors import InputError
from bampipe.physics import Model, System, compile_model
from bampipe.trials.motion import Motion
from bampipe.trials.residuals import ModelOnTrial

_SINGULAR = 1e-9
"""Least eigenvalue of a mass matrix, beside the largest inertias along the motion."""


def require_sound(system: System, motions: Sequence[Motion]) -> None:
    """Refuse trials on which the equations of motion cannot be solved at the prior parameters.

    Raises:
        InputError: the mass matrix is singular at a pose of a trial, or a force is no number there;
            says at which pose, and by which effect.
    """
    for motion in motions:
        mass = system.mass_matrix(motion.q, system.prior)
        if np.isfinite(mass).all():
            _require_inertia(system, motion, mass)
        lost = ~_find_finite(system, motion, mass)
        if lost.any():
            row, culprit = int(np.argmax(lost)), _find_culprit(system, motion)
            raise InputError(
                f"{culprit} gives no number at {_pose(system, motion, row)}",
                where=f"trial {motion.trial_id}",
                remedy="look for a division by zero, a root or logarithm of a negative number"
                " there",
            )


def _require_inertia(system: System, motion: Motion, mass: Array) -> None:
    scale = np.sqrt(np.max(np.abs(np.diagonal(mass, axis1=1, axis2=2)), axis=0))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(mass / np.outer(scale, scale))
    row = int(np.argmin(values[:, 0]))
    if values[row, 0] > _SINGULAR:
        return
    axis = system.coordinates[int(np.argmax(np.abs(vectors[row, :, 0])))]
    raise InputError(
        f"the mass matrix has no inverse at {_pose(system, motion, row)}: {axis} has no"
        " inertia there, so that no force determines how it moves",
        where=f"trial {motion.trial_id}",
        remedy="give the device the inertia that remains there (rotors, gears), or leave out"
        " trials that pass this pose",
    )


def _find_finite(system: System, motion: Motion, mass: Array) -> Flags:
    """Find the samples at which residual and ``mass`` matrix, (T, n_q, n_q), are finite, (T,)."""
    residual = ModelOnTrial(system, system.prior, [motion]).residual
    return np.asarray(np.isfinite(np.dstack([residual, mass])).all(axis=(1, 2)))


def _find_culprit(system: System, motion: Motion) -> str:
    """Return the effect that is not finite alone on the device, or else the device."""
    device = system.model.device
    for bound in system.model.effects:
        alone = compile_model(Model(device, (bound.name,), (bound.effect,)))
        if not _find_finite(alone, motion, alone.mass_matrix(motion.q, alone.prior)).all():
            return f"effect {bound.name!r}"
    return f"device {device.name!r}"


def _pose(system: System, motion: Motion, row: int) -> str:
    units = zip(system.coordinates, motion.q[row], system.coordinate_units, strict=True)
    pose = ", ".join(f"{name} = {value:.4g} {unit}" for name, value, unit in units)
    return f"{pose}, {motion.t[row]:.3f} s"
