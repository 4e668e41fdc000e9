"""The fitted model in place of the machine: recordings that contain nothing the model lacks.

Chance levels come from here. The model is driven along nearly the measured motion by the measured
force plus an arm, and what it does is read by the same encoders and force sensor.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.butterworth import zero_phase
from bampipe.estimate.simulation import simulate_tracking
from bampipe.physics import System
from bampipe.physics.device import derivative
from bampipe.trials.observation import Motion, Recording, Sensors

Array = NDArray[np.float64]

FOLLOWED_HZ = 10.0
"""Highest frequency of the motion to follow where encoder and handle move apart."""


def replay(
    system: System, p: Array, motion: Motion, sensors: Sensors, rng: np.random.Generator
) -> Recording:
    """Simulate one trial of a fitted model and read it with the session's sensors.

    Args:
        system: the model; effects of kind ``measurement`` act on what the encoders read.
        p: its parameters, (n_p,).
        motion: the measured trial to follow.
        sensors: resolution, noise and rate.
        rng: source of the force noise and of where the encoders' counts fall.

    Raises:
        Runaway: the simulated motion grows without bounds.
    """
    u = motion.inputs(system.inputs)
    n = len(system.coordinates)
    q, qd = _reference(system, p, motion, u, sensors.rate_hz)
    start = np.concatenate([q[0], qd[0], system.initial_memory(q[0], u[0], p)])
    at = {name: i for i, name in enumerate(system.inputs)}
    forces = system.model.device.forces
    widths = np.array([c.sign_width for c in system.model.device.coordinates])
    x, total = simulate_tracking(
        system.derivative, start, u, p, 1.0 / sensors.rate_hz, q, qd,
        width=widths, n_noise=len(system.noise),
        force=[at[f] for f in forces],
        rate=[at.get(derivative(f, 1), -1) for f in forces],
        curvature=[at.get(derivative(f, 2), -1) for f in forces],
    )  # fmt: skip
    seen = np.empty((len(x), n))
    reading = np.empty(2 * n)
    for i in range(len(x)):
        system.measure(x[i], total[i], p, reading)
        seen[i] = reading[:n]
    offset = rng.uniform(0.0, 1.0, n) * sensors.resolution
    counts = np.floor((seen + offset) / sensors.resolution)
    force = total[:, [at[f] for f in forces]]
    force = force + rng.normal(size=force.shape) * sensors.force_sd
    brakes = system.model.device.brakes
    brake = np.zeros((len(x), n))
    for i, axis in enumerate(system.coordinates):
        if axis in brakes:
            brake[:, i] = motion.channels[brakes[axis]]
    other = {name: motion.channels[name] for name in system.model.device.channels}
    read = (counts + 0.5) * sensors.resolution - offset
    return Recording(motion.trial_id, read, force, brake, other)


def _reference(
    system: System, p: Array, motion: Motion, u: Array, rate_hz: float
) -> tuple[Array, Array]:
    """Positions and rates of the handle to follow, each (T, n_q).

    Where play or wind-up lies between encoder and handle, the handle's motion is the encoder's
    plus what the model puts between them. That jumps where a gap is crossed, a little before or
    after the logged jump; a handle with inertia does not follow the difference of the two.
    """
    if not system.moves_sensors:
        return motion.q, motion.qd
    q, _, _ = system.true_motion(motion.q, motion.qd, motion.qdd, u, p)
    smooth = [zero_phase(column, rate_hz, min(FOLLOWED_HZ, 0.2 * rate_hz)) for column in q.T]
    return np.column_stack([c[0] for c in smooth]), np.column_stack([c[1] for c in smooth])
