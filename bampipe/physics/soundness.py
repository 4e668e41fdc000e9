"""Checks whether a model is finite along a motion, and the physical reason if it is not."""

import numpy as np

from bampipe.arrays import Array
from bampipe.errors import InputError
from bampipe.physics.model import Model
from bampipe.physics.system import System, compile_model

_SINGULAR = 1e-9
"""Least eigenvalue of a mass matrix, beside the largest inertias along the motion."""


def require_sound(
    system: System, q: Array, qd: Array, qdd: Array, u: Array, p: Array, t: Array, where: str
) -> None:
    """Refuse a motion on which the equations of motion cannot be solved.

    Args:
        q, qd, qdd: motion of the mechanism, (T, n_q), rad or m and derivatives.
        u: inputs, (T, n_u); p: parameters, (n_p,); t: time, (T,), s. where: name of the motion in
        messages.

    Raises:
        InputError: the mass matrix is singular at a pose of the motion, or a force is no number
            there; says at which pose, and by which effect.
    """
    mass = system.mass_matrix(q, p)
    if np.isfinite(mass).all():
        _require_inertia(system, q, mass, t, where)
    z = system.memory(q, qd, qdd, u, p, t)
    residual = system.residual(q, qd, qdd, z, u, p)
    lost = ~(np.isfinite(residual).all(axis=1) & np.isfinite(mass).all(axis=(1, 2)))
    if not lost.any():
        return
    row = int(np.argmax(lost))
    culprit = _find_culprit(system, q, qd, qdd, u, p, t)
    raise InputError(
        f"{culprit} gives no number at {_pose(system, q[row])}, {t[row]:.3f} s",
        where=where,
        remedy="look for a division by zero, a root or logarithm of a negative number there",
    )


def _require_inertia(system: System, q: Array, mass: Array, t: Array, where: str) -> None:
    scale = np.sqrt(np.max(np.abs(np.diagonal(mass, axis1=1, axis2=2)), axis=0))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(mass / np.outer(scale, scale))
    row = int(np.argmin(values[:, 0]))
    if values[row, 0] > _SINGULAR:
        return
    axis = system.coordinates[int(np.argmax(np.abs(vectors[row, :, 0])))]
    raise InputError(
        f"the mass matrix has no inverse at {_pose(system, q[row])}, {t[row]:.3f} s: {axis} has no"
        " inertia there, so that no force determines how it moves",
        where=where,
        remedy="give the device the inertia that remains there (rotors, gears), or leave out"
        " trials that pass this pose",
    )


def _find_culprit(
    system: System, q: Array, qd: Array, qdd: Array, u: Array, p: Array, t: Array
) -> str:
    """Return the effect without which the model is finite, or else the device."""
    model = system.model
    for bound in model.effects:
        alone = compile_model(Model(model.device, (bound.name,), (bound.effect,)))
        values = np.array([p[system.index(item.name)] for item in alone.parameters])
        inputs = u[:, [system.inputs.index(name) for name in alone.inputs]]
        z = alone.memory(q, qd, qdd, inputs, values, t)
        residual = alone.residual(q, qd, qdd, z, inputs, values)
        if not (np.isfinite(residual).all() and np.isfinite(alone.mass_matrix(q, values)).all()):
            return f"effect {bound.name!r}"
    return f"device {model.device.name!r}"


def _pose(system: System, q: Array) -> str:
    units = zip(system.coordinates, q, system.coordinate_units, strict=True)
    return ", ".join(f"{name} = {value:.4g} {unit}" for name, value, unit in units)
