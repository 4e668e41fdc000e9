"""Hysteresis loops of known stiffness, simulated under an imposed torque."""

import numba
import numpy as np

from bampipe.arrays import Array


def load_cycles(cycles: int, amplitude: float, *, rate_hz: float = 500.0, seed: int = 0) -> Array:
    """Return the torque of a person who loads a handle back and forth, four seconds a cycle."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(cycles * 4.0 * rate_hz)) / rate_hz
    height = amplitude * (1.0 + 0.08 * np.sin(0.13 * t + rng.uniform(0, 6)))
    warp = t + 0.15 * np.sin(0.7 * t + rng.uniform(0, 6))
    return np.asarray(height * np.sin(2 * np.pi * warp / 4.0) + 0.02 * height * np.sin(3.1 * t))


@numba.njit
def elements(torque: Array, stiffness: float, friction: float, slips: Array) -> Array:
    """Return the deflection (T,) of a spring in parallel with Jenkins elements.

    Each element carries an equal share of ``friction`` and slides after one of ``slips``
    (deflection): one slip is a bilinear loop, many evenly spaced are Iwan's.
    """
    limit = friction / len(slips)
    slider = np.zeros(len(slips))
    deflection = np.zeros(len(torque))
    for k, load in enumerate(torque):
        low, high = (load - 2.0 * friction) / stiffness, (load + 2.0 * friction) / stiffness
        for _ in range(60):  # bisection of spring + friction = load, which rises with x
            x = 0.5 * (low + high)
            total = stiffness * x
            for e in range(len(slips)):
                total += limit * min(max((x - slider[e]) / slips[e], -1.0), 1.0)
            if total > load:
                high = x
            else:
                low = x
        for e in range(len(slips)):
            held = min(max((x - slider[e]) / slips[e], -1.0), 1.0)
            slider[e] = x - held * slips[e]
        deflection[k] = x
    return deflection


@numba.njit
def bouc_wen(
    torque: Array, stiffness: float, friction: float, slip: float, sharpness: float
) -> Array:
    """Return the deflection (T,) of a spring in parallel with Bouc and Wen's friction.

    torque = stiffness x + friction z, dz/dx = (1 - |z|**n (1 + sign(dx z)) / 2) / slip.
    """
    substeps = 20
    deflection = np.zeros(len(torque))
    x = z = previous = 0.0
    for k, load in enumerate(torque):
        increment = (load - previous) / substeps
        previous = load
        for _ in range(substeps):
            slope = 1.0 / slip
            if increment * z > 0.0:
                slope = (1.0 - abs(z) ** sharpness) / slip
            step = increment / (stiffness + friction * slope)
            x, z = x + step, z + slope * step
        deflection[k] = x
    return deflection


def measure(
    torque: Array, deflection: Array, resolution: float, noise_sd: float, seed: int = 0
) -> tuple[Array, Array]:
    """Return torque and deflection as a noisy force sensor and an encoder give them."""
    rng = np.random.default_rng(seed)
    noisy = torque + noise_sd * rng.standard_normal(len(torque))
    return noisy, np.floor(deflection / resolution) * resolution
