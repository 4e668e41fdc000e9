"""True motion and force of simulated trials: free, locked, and in a viscous field."""

from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array
from bampipe.estimate.simulation import Arm, make_plant, simulate
from bampipe.physics.device import Coordinate, Device, derivative
from bampipe.simulator.specimen import Config, Specimen, find_input_column

REACH = {"rotary": 0.65, "linear": 0.8}
"""Largest intended motion as a share of half the range."""

HASTE = {"rotary": 15.0, "linear": 6.0}
"""Largest intended acceleration, rad/s2 and m/s2: about 40 N at the handle of the BAM."""

LOCKED_LOAD = {"rotary": 50.0, "linear": 120.0}
"""Peak load of a locked trial, N.m and N."""

LOCKED_BRAKE = 200.0
LOCKED_PERIOD, LOCKED_CYCLES = 4.0, 6
BAND = (0.1, 2.0)
"""Frequencies of the intended motion, Hz (Section II-E)."""


@dataclass(frozen=True)
class TrueTrial:
    """True course of one trial: t (T,) s; q, qd (T, n_q); force (T, n_f); brake (T, n_b)."""

    t: Array
    q: Array
    qd: Array
    force: Array
    brake: Array


def _draw_wanted_motion(
    device: Device, config: Config, rng: np.random.Generator, t: Array, share: float
) -> tuple[Array, Array]:
    """Draw intended position and velocity: band-limited noise on each axis, from rest."""
    q = np.empty((len(t), len(device.coordinates)))
    qd = np.empty_like(q)
    rise = np.clip(t / 1.0, 0.0, 1.0)
    fade, fade_rate = rise**2 * (3 - 2 * rise), 6 * rise * (1 - rise)
    for i, c in enumerate(device.coordinates):
        middle, half = _middle_and_half_range(device, c)
        frequency = 2 * np.pi * rng.uniform(*BAND, size=40)
        # A hand moves far only when it moves slowly.
        size = rng.normal(size=40) / (1.0 + (frequency / (2 * np.pi * 0.6)) ** 2) ** 2
        phase = np.outer(t, frequency) + rng.uniform(0.0, 2 * np.pi, size=40)
        wave, rate = np.sin(phase) @ size, np.cos(phase) @ (size * frequency)
        reach = half * REACH[c.kind] * config.amplitude * share * rng.uniform(0.7, 1.0)
        acceleration = np.sin(phase) @ (size * frequency**2)
        scale = min(reach / np.abs(wave).max(), HASTE[c.kind] / np.abs(acceleration).max())
        q[:, i] = middle + scale * (wave[0] + fade * (wave - wave[0]))
        qd[:, i] = scale * (fade * rate + fade_rate * (wave - wave[0]))
    return q, qd


def simulate_moving_trial(
    specimen: Specimen, config: Config, rng: np.random.Generator, viscous: bool
) -> TrueTrial:
    """Simulate a free trial, or one in a viscous field."""
    system, device = specimen.motion, specimen.device
    dt = 1.0 / config.sample_rate
    t = np.arange(round(config.duration * config.sample_rate), dtype=np.float64) * np.float64(dt)
    q_ref, qd_ref = _draw_wanted_motion(device, config, rng, t, 0.6 if viscous else 1.0)
    u = np.zeros((len(t), len(system.inputs)))
    if "t" in system.inputs:
        u[:, system.inputs.index("t")] = t
    force = [system.inputs.index(f) for f in device.forces]
    slopes = [[find_input_column(system, derivative(f, k)) for f in device.forces] for k in (1, 2)]
    n = len(device.coordinates)
    brakes = [system.inputs.index(device.brakes[c.name]) for c in device.coordinates] if (
        viscous or set(device.brakes) == {c.name for c in device.coordinates}
    ) else []  # fmt: skip
    p = specimen.p(system)
    plant = make_plant(p, len(system.noise), system.sign_widths)
    arm = Arm(
        q_ref, qd_ref, force, slopes[0], slopes[1], system.moved_first,
        natural_frequency=rng.uniform(7.0, 10.0), damping_ratio=1.0, bandwidth=50.0,
    )  # fmt: skip
    rest = np.zeros(n)
    x0 = np.concatenate([q_ref[0], rest, system.initial_memory(q_ref[0], rest, u[0], p)])
    pose = q_ref
    # The field J^T K J depends on the pose, which settles after a few iterations.
    for _ in range(4 if viscous else 1):
        gain = config.viscous_damping * (system.input_map(pose) ** 2).sum(axis=2)
        x, total = simulate(
            system.derivative, plant, x0, u, dt, arm=arm, brake=brakes,
            brake_gain=gain if viscous else None,
        )  # fmt: skip
        pose = x[:, :n]
    brake = [system.inputs.index(b) for b in device.brakes.values()]
    return TrueTrial(t, x[:, :n], x[:, n : 2 * n], total[:, force], total[:, brake])


def simulate_locked_trial(
    specimen: Specimen, config: Config, rng: np.random.Generator, axis: str
) -> TrueTrial:
    """Simulate a locked trial: the brake holds an axis, and the loaded transmission winds up.

    The load is stiffness times deflection plus friction that builds up over a tenth of the
    deflection (Dahl), which gives the loop of Fig. 3.
    """
    device = specimen.device
    names = [c.name for c in device.coordinates]
    i = names.index(axis)
    kind = device.coordinates[i].kind
    stiffness = specimen.stiffness[axis]
    t = np.arange(round(LOCKED_PERIOD * LOCKED_CYCLES * config.sample_rate)) / config.sample_rate
    peak = LOCKED_LOAD[kind] / stiffness
    deflection = peak * (1 - 0.03 * rng.uniform()) * np.sin(2 * np.pi * t / LOCKED_PERIOD)
    friction = 1.5 * specimen.values.get(f"coulomb.{axis}", 0.02 * LOCKED_LOAD[kind])
    share = np.empty(len(t))
    share[0] = 0.0
    for k, step in enumerate(np.diff(deflection)):
        aim = np.sign(step)
        share[k + 1] = aim + (share[k] - aim) * np.exp(-abs(step) / (0.1 * peak))
    middle = [_middle_and_half_range(device, c) for c in device.coordinates]
    pose = np.array([m + 0.05 * half for m, half in middle])
    q = np.tile(pose, (len(t), 1))
    q[:, i] += deflection
    load = np.zeros((len(t), len(names)))
    load[:, i] = stiffness * deflection + friction * share
    force = specimen.motion.least_force(q, load)
    wander = rng.uniform(0.0, 2 * np.pi, size=force.shape[1])
    others = np.abs(force).max(axis=0) < 0.05 * np.abs(force).max()
    force += np.where(others, 1.2 * np.sin(2 * np.pi * 0.17 * t[:, None] + wander), 0.0)
    brake = np.zeros((len(t), len(device.brakes)))
    brake[:, list(device.brakes).index(axis)] = LOCKED_BRAKE
    return TrueTrial(t, q, np.zeros_like(q), force, brake)


def _middle_and_half_range(device: Device, c: Coordinate) -> tuple[float, float]:
    """Return middle and half width of the range of an axis."""
    lower, upper = device.limits.get(c.name, (-1.0, 1.0) if c.kind == "rotary" else (-0.2, 0.2))
    return (lower + upper) / 2, (upper - lower) / 2
