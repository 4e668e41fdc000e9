"""Random motions inside a device's workspace, and variants of the BAM."""

import copy
from types import SimpleNamespace

import numpy as np
import sympy as sp

from bampipe.physics import registry
from bampipe.physics.derivation import derive
from bampipe.trials.motion import Motion


def of_mechanism(system, q, qd, qdd, u, p, t):
    """The motion of the mechanism where encoders without filters read this; each (T, n_q)."""
    read = Motion("read", t, q, qd, qdd, np.zeros_like(q), {})
    return read.of_mechanism(system, u, p).kinematics


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
    """Internal states of ordinary size, (count, n_z)."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0.05, 0.9, size=(count, len(system.memory_names)))


def declaration(name="bam"):
    """A copy of a built-in device's declaration, free to change."""
    return copy.deepcopy(dict(registry.device(name).declaration))


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
