"""Random motions inside a device's workspace, and variants of the BAM."""

import copy
from types import SimpleNamespace

import numpy as np
import sympy as sp

from bampipe.physics import registry
from bampipe.physics.derivation import derive
from bampipe.physics.device import LAST_ORDER, derivative
from bampipe.trials.motion import Motion

RATE = 250.0


def smooth_motion(system, seed=3):
    """A made-up smooth motion under load, 6 s: q, qd, qdd (T, n_q), u (T, n_u), t (T,).

    Systems of one device have the same one, whatever effects are in them.
    """
    device, rng, t = system.model.device, np.random.default_rng(seed), np.arange(1500) / RATE

    def waves(size):
        w = 2 * np.pi * rng.uniform(0.1, 1.2, 12)
        angle = w[:, None] * t + rng.uniform(0, 6.28, (12, 1))
        sizes = size * rng.normal(size=12) / (1 + w / 3)
        return [(sizes * w**k) @ np.sin(angle + k * np.pi / 2) for k in range(LAST_ORDER + 1)]

    rotary = device.coordinates[0].kind == "rotary"
    moved = [waves(0.25 if c.kind == "rotary" else 0.07)[:3] for c in device.coordinates]
    q, qd, qdd = (np.column_stack(part) for part in zip(*moved, strict=True))
    q += [np.mean(device.limits.get(c.name, (0.0, 0.0))) for c in device.coordinates]
    columns = {"t": t}
    for force in device.forces:
        for k, wave in enumerate(waves(8.0 if rotary else 60.0)):
            columns[derivative(force, k)] = wave
    columns |= {name: np.abs(waves(6.0)[0]) for name in device.brakes.values()}
    columns |= {name: np.abs(waves(3.0)[0]) for name in device.channels}
    return q, qd, qdd, np.column_stack([columns[name] for name in system.inputs]), t


def of_mechanism(system, q, qd, qdd, u, p, t):
    """The motion of the mechanism where encoders without filters read this; each (T, n_q)."""
    read = Motion("read", t, q, qd, qdd, np.zeros_like(q), {})
    return read.of_mechanism(system, u, p).kinematics


def residual(system, p, motion):
    """Applied less required force along a motion as encoders read it, (T, n_q)."""
    *read, u, t = motion
    at = of_mechanism(system, *read, u, p, t)
    z = system.memory(*at, u, p, t)
    return system.applied(*at, z, u, p) - system.required(*at, z, u, p)


def run_as_python(system, *modules):
    """The functions that ``modules`` of a model print for numba, run as the Python that they are.

    Numba takes seconds to compile what is compared in milliseconds.
    """
    scope = {}
    for name in modules:
        sources = system._whole.sources
        bodies = sources.get("compiled_bodies", "") if name == "derivative" else ""
        for text in (bodies, sources[name]):
            lines = [line for line in text.splitlines() if not line.startswith("from bampipe_")]
            plain = "njit = part = lambda *_, **__: lambda function: function"
            text = "\n".join(lines).replace("from bampipe.compiled import njit, part", plain)
            exec(text, scope)
    return SimpleNamespace(**scope)


def energies(system, q, qd, p):
    """Kinetic and potential energy as declared, each (T,), J."""
    e = derive(system.model)
    both = sp.lambdify([e.q, e.qd, e.p], [e.kinetic, e.potential])(q.T, qd.T, p)
    return [np.broadcast_to(energy, len(q)) for energy in both]


def random_motion(device, count, seed, speed=1.0):
    """Positions within the limits, rates and accelerations of order ``speed``; each (count, n)."""
    rng = np.random.default_rng(seed)
    limits = [device.limits.get(c.name, (-1.0, 1.0)) for c in device.coordinates]
    q = np.column_stack([rng.uniform(*pair, size=count) for pair in limits])
    qd, qdd = rng.normal(0.0, speed, size=(2, *q.shape))
    return q, qd, qdd


def random_inputs(system, count, seed):
    """Columns of u: forces and their rates of either sign, brake commands not negative."""
    rng = np.random.default_rng(seed)
    u = rng.normal(0.0, 8.0, size=(count, len(system.inputs)))
    for j, name in enumerate(system.inputs):
        if name.startswith("brake") or name == "t":
            u[:, j] = np.abs(u[:, j])
    return u


def memory_within_reason(system, count, seed):
    """Internal states of ordinary size, and rates of change, (count, n_z + n_changes)."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0.05, 0.9, size=(count, len(system.memory_names + system.changes)))


def declaration(name="bam"):
    """A copy of a built-in device's declaration, free to change."""
    return copy.deepcopy(dict(registry.device(name).declaration))


def made_up_device(kinetic, applied, parameters, **tables):
    """A device of axes that slide unless ``tables`` say otherwise.

    Args:
        kinetic: energy; applied: by axis, expressions in ``force_x`` unless ``inputs`` says others;
        parameters: unit, prior and sd by name.
    """
    keys = ("unit", "prior", "sd")
    content = {
        "name": "made_up",
        "coordinates": {axis: {"kind": "linear"} for axis in applied},
        "energy": {"kinetic": kinetic},
        "inputs": {"force": ["force_x"]},
        "applied": applied,
        "parameters": {n: dict(zip(keys, row, strict=True)) for n, row in parameters.items()},
    }
    return registry.device_from(content | tables)


def made_up_effect(scope, kind, parameters, **content):
    """An effect with ``parameters``, unit, prior and sd by name."""
    keys = ("unit", "prior", "sd")
    about = {"name": "made_up", "summary": "a test's", "looks_like": "itself", "source": "a test"}
    own = {n: dict(zip(keys, row, strict=True)) for n, row in parameters.items()}
    own = {"scope": scope, "kind": kind, "parameters": own}
    return registry.effect_from(about | own | content)


def conservative_bam():
    """The BAM without compensator, friction and brakes: energies and the hand only."""
    bare = declaration()
    bare["name"] = "conservative_bam"
    del bare["torque"], bare["friction"], bare["inputs"]["brakes"]
    return registry.device_from(bare)


def typical_parameters(system, strength=1.0):
    """Every effect at ``strength`` times its typical size, (n_p,)."""
    sizes = [p.prior if p.typical is None else p.typical for p in system.parameters]
    shares = [strength if p.strength else 1.0 for p in system.parameters]
    return np.array(sizes) * shares


def with_values(system, values):
    """The priors, with ``values`` by name put in, (n_p,)."""
    p = system.prior
    for name, value in values.items():
        p[system.index(name)] = value
    return p
