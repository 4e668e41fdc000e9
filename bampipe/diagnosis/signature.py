"""The residual of a model that lacks one effect, along a standard motion."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.ndimage import convolve1d

from bampipe.arrays import Array
from bampipe.diagnosis.shape import number_bins, share_between
from bampipe.physics import Model, compile_model
from bampipe.physics.device import Coordinate, Device
from bampipe.physics.effect import Effect
from bampipe.physics.system import System
from bampipe.trials.motion import Motion, input_derivatives
from bampipe.trials.residuals import ModelOnTrial

DURATION_S, RATE_HZ = 16.0, 250.0
SMOOTHING_S = 0.3
BINS = 24
BRAKE_DAMPING = 10.0
"""Damping of the brakes for an effect that shows only with brakes on, N.m.s/rad or N.s/m."""


@dataclass(frozen=True)
class Signature:
    """The residual of a device that lacks one effect.

    Attributes:
        axis: axis on which the residual is largest, relative to the force needed there.
        rms: root mean square of the residual by axis, N.m or N.
        against: name of the quantity that explains most of it; abscissa: its values, (T,).
        share: share of the residual's variance that a curve over the abscissa explains.
        residual: residual on ``axis``, (T,), in ``unit``.
        braked: whether the brakes were on.
    """

    axis: str
    unit: str
    rms: Mapping[str, float]
    against: str
    against_unit: str
    share: float
    abscissa: Array
    residual: Array
    braked: bool


def signature(device: Device, effect: Effect, target: str) -> Signature | None:
    """Return the residual of the bare device without ``effect`` of typical size, if there is any.

    Each axis follows three sinusoids of 0.1 to 1 Hz over the middle of its range, driven by a force
    as smooth as a hand's. ``target`` is empty for a device-wide effect.
    """
    name = f"{effect.name}:{target}" if target else effect.name
    bare = compile_model(Model(device))
    full = compile_model(Model(device, (name,), (effect,)))
    found = (_compute_signature(device, bare, full, braked) for braked in (False, True))
    return next((one for one in found if one is not None), None)


def _compute_signature(
    device: Device, bare: System, full: System, braked: bool
) -> Signature | None:
    t = np.arange(0.0, DURATION_S, 1.0 / RATE_HZ)
    motion = [_motion(c, device.limits.get(c.name), n, t) for n, c in enumerate(device.coordinates)]
    q, qd, qdd = (np.column_stack([part[order] for part in motion]) for order in range(3))
    channels: defaultdict[str, Array] = defaultdict(partial(np.zeros_like, t))
    for number, axis in enumerate(bare.coordinates):
        if axis in device.brakes:
            channels[device.brakes[axis]] = braked * BRAKE_DAMPING * np.abs(qd[:, number])
    channels |= {name: np.ones_like(t) for name in device.channels}
    p, trial = bare.prior, Motion("", t, q, qd, qdd, np.zeros_like(q), channels)
    idle = ModelOnTrial(bare, p, [trial])
    needed = bare.required(*trial.kinematics, idle.memory, idle.inputs, p)
    force = _smooth(bare.least_force(q, needed - idle.applied, idle.inputs, p))
    for label, values in zip(device.forces, force.T, strict=True):
        rates = values
        channels[label] = values
        for name in input_derivatives(label):
            channels[name] = rates = np.gradient(rates, t)

    def leave(system: System, p: Array) -> Array:
        return ModelOnTrial(system, p, [trial.with_channels({})]).residual_once

    by_size = [item.sd if item.strength else item.prior for item in full.parameters]
    pairs = zip(full.parameters, by_size, strict=True)
    values = np.array([size if item.typical is None else item.typical for item, size in pairs])
    values[: len(p)] = p
    residual = leave(bare, p) - leave(full, values)
    rms = np.sqrt(np.mean(residual**2, axis=0))
    scale = np.sqrt(np.mean(needed**2, axis=0)) + 1e-12
    worst = int(np.argmax(rms / scale))
    if rms[worst] <= 1e-9 * scale[worst]:
        return None
    length = bare.coordinate_units[worst]
    axis = bare.coordinates[worst]
    choices = [
        (f"{other} velocity", f"{unit}/s", qd[:, number])
        for number, (other, unit) in enumerate(
            zip(bare.coordinates, bare.coordinate_units, strict=True)
        )
    ]
    choices.sort(key=lambda choice: not choice[0].startswith(axis))
    choices += [
        (f"{axis} position", length, q[:, worst]),
        (f"{axis} acceleration", f"{length}/s2", qdd[:, worst]),
        (f"load on {axis}", bare.torque_units[worst], needed[:, worst]),
        *(
            (f"rate of {label}", f"{device.force_unit}/s", np.gradient(force[:, n], t))
            for n, label in enumerate(device.forces)
        ),
        ("time", "s", t),
    ]
    shares = [
        share_between(residual[:, worst], number_bins(abscissa, BINS)) for _, _, abscissa in choices
    ]
    best = int(np.argmax(np.round(shares, 2)))
    return Signature(
        axis=axis,
        unit=bare.torque_units[worst],
        rms=dict(zip(bare.coordinates, rms.tolist(), strict=True)),
        against=choices[best][0],
        against_unit=choices[best][1],
        share=shares[best],
        abscissa=choices[best][2],
        residual=residual[:, worst],
        braked=braked,
    )


def _motion(
    coordinate: Coordinate, limits: tuple[float, float] | None, number: int, t: Array
) -> tuple[Array, Array, Array]:
    lower, upper = limits if limits is not None else (-0.5, 0.5)
    middle, size = (lower + upper) / 2.0, (upper - lower) / 4.0
    q, qd, qdd = np.full_like(t, middle), np.zeros_like(t), np.zeros_like(t)
    # No two axes share a frequency, so that axes can be distinguished.
    for order, frequency in enumerate((0.11, 0.37, 0.83)):
        w = 2.0 * np.pi * frequency * (1.0 + 0.13 * number)
        a, phase = size / (1.0 + 2.0 * order), 0.7 * number + order
        q += a * np.sin(w * t + phase)
        qd += a * w * np.cos(w * t + phase)
        qdd -= a * w**2 * np.sin(w * t + phase)
    return q, qd, qdd


def _smooth(force: Array) -> Array:
    """Return ``force`` without its jumps at reversals, which a hand cannot follow."""
    window = np.hanning(int(SMOOTHING_S * RATE_HZ) | 1)
    return np.asarray(convolve1d(force, window / window.sum(), axis=0, mode="nearest"))
