"""Source code of the internal states of effects along a motion, and the loops that follow them."""

from collections.abc import Sequence
from itertools import chain
from typing import Any

import sympy as sp

from bampipe.physics.codegen import SCALAR_HEADER, filling_function
from bampipe.physics.equations import Equations, join_overlapping
from bampipe.physics.memory import ACCURATE, LEAST_STEP, STEP_ERROR, STIFF_STEPS, TOLERANCE

_FEWEST = 3
"""Exponential steps per sample if the decay of a state depends on the motion."""

# Positions and inputs are linear between samples, rates are not: of a motion with eight samples a
# period a straight line takes a twentieth off the distance between them. Without a signature it is
# compiled with its caller, and not again by every process that finds that in the cache.
BETWEEN = '''

@part()
def between(q, qd, qdd, u, i, h, share, x, v, w):
    """Fills x, v, w with positions, rates and inputs between samples i and i + 1, h apart."""
    for j in range(len(x)):
        x[j] = q[i, j] + share * (q[i + 1, j] - q[i, j])
    for j in range(len(v)):
        d = qd[i + 1, j] - qd[i, j]
        bent = (1.0 - share) * (h * qdd[i, j] - d) - share * (h * qdd[i + 1, j] - d)
        v[j] = qd[i, j] + share * (d + (1.0 - share) * bent)
    for j in range(len(w)):
        w[j] = u[i, j] + share * (u[i + 1, j] - u[i, j])
'''

# Kutta-Merson steps (Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, II.4).
MEMORY_LOOP = '''

@njit(types.float64(M, M, M, M, V, V, V, M), error_model='numpy')
def memory(q, qd, qdd, u, p, t, z0, out):
    """Fourth-order steps along the samples of a motion, coupled ones as long as errors allow.

    Fills out (T, n_z). Returns 1, with the rest of out as it was, where exponential steps are
    called for; else 0.
    """
    n = len(z0)
    k1, k2, k3, k4, k5 = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    z, at, largest, share = z0.copy(), np.empty(n), np.abs(z0), 1.0
    a, b, c = q[0].copy(), qd[0].copy(), u[0].copy()
    out[0] = z
    for i in range(len(t) - 1):
        span, done, begun = t[i + 1] - t[i], 0.0, False
        while done < 1.0:
            share = min(share, 1.0 - done)
            h = share * span
            if not begun:
                between(q, qd, qdd, u, i, span, done, a, b, c)
                memory_rate(a, b, c, p, z, k1)
                begun = True
            for j in range(n):
                at[j] = z[j] + h / 3.0 * k1[j]
            between(q, qd, qdd, u, i, span, done + share / 3.0, a, b, c)
            memory_rate(a, b, c, p, at, k2)
            moved, turned, error = 0.0, 0.0, 0.0
            for j in range(n):
                at[j] = z[j] + h / 6.0 * (k1[j] + k2[j])
                moved += abs(k2[j] - k1[j])
            memory_rate(a, b, c, p, at, k3)
            for j in range(n):
                at[j] = z[j] + h / 8.0 * (k1[j] + 3.0 * k3[j])
                turned += abs(k3[j] - k2[j])
            if not COUPLED and 6.0 * turned >= ACCURATE * moved and turned > 1e-12 * moved:
                return 1.0
            between(q, qd, qdd, u, i, span, done + 0.5 * share, a, b, c)
            memory_rate(a, b, c, p, at, k4)
            for j in range(n):
                at[j] = z[j] + h / 2.0 * (k1[j] - 3.0 * k3[j] + 4.0 * k4[j])
            between(q, qd, qdd, u, i, span, done + share, a, b, c)
            memory_rate(a, b, c, p, at, k5)
            for j in range(n):
                missed = h / 30.0 * abs(2.0 * k1[j] - 9.0 * k3[j] + 8.0 * k4[j] - k5[j])
                error = max(error, missed / max(largest[j], 1e-300))
            if COUPLED and error > ERROR and share > LEAST:
                share *= 0.5
                continue
            for j in range(n):
                z[j] += h / 6.0 * (k1[j] + 4.0 * k4[j] + k5[j])
                largest[j] = max(largest[j], abs(z[j]))
            done, begun = done + share, False
            if 32.0 * error < ERROR or not COUPLED:
                share *= 2.0
        out[i + 1] = z
    return 0.0
'''


# If no state's rate depends on another state, steps are exact for the rate at the middle of a step,
# linearised in its state (exponential Rosenbrock-Euler, Hochbruck and Ostermann 2010, Acta Numerica
# 19). However stiff, it stays stable: a hysteresis over micrometres is passed many times between
# two samples. Where more steps make a difference, as at a reversal, there are more.
STIFF_MEMORY_LOOP = '''

@njit(types.void(M, M, M, M, V, V, V, M), error_model='numpy')
def stiff_memory(q, qd, qdd, u, p, t, z0, out):
    """Exponential steps along the samples of a motion; fills out (T, n_z)."""
    n = len(z0)
    rate, slope, coarse, largest = np.empty(n), np.empty(n), np.empty(n), np.abs(z0)
    z, x, v, w = z0.copy(), q[0].copy(), qd[0].copy(), u[0].copy()
    out[0] = z
    for i in range(len(t) - 1):
        for steps in STIFF_STEPS:
            coarse[:], z[:] = z, out[i]
            h = (t[i + 1] - t[i]) / steps
            for s in range(steps):
                between(q, qd, qdd, u, i, t[i + 1] - t[i], (s + 0.5) / steps, x, v, w)
                memory_rate(x, v, w, p, z, rate)
                memory_slope(x, v, w, p, z, slope)
                for j in range(n):
                    k = h * slope[j]
                    z[j] += h * rate[j] * (1.0 + k / 2.0 if abs(k) < 1e-5 else (exp(k) - 1.0) / k)
            settled = steps > 1
            for j in range(n):
                largest[j] = max(largest[j], abs(z[j]))
                settled &= abs(z[j] - coarse[j]) <= TOLERANCE * largest[j]
            if settled:
                break
        out[i + 1] = z
'''


# For a state whose rate is c + b*z, with b of motion and inputs, steps are exact for c and b
# constant in a step, and for linear c if b depends on parameters alone. However stiff, it stays
# stable.
LINEAR_MEMORY_LOOP = '''

@njit(types.float64(M, M, M, M, V, V, V, M), error_model='numpy')
def memory(q, qd, qdd, u, p, t, z0, out):
    """Exponential steps along the samples of a motion; fills out (T, n_z).

    Returns 0: however fast a state decays, such steps follow it.
    """
    n = len(z0)
    c0, b0, c1, b1 = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    z, x, v, w = z0.copy(), q[0].copy(), qd[0].copy(), u[0].copy()
    out[0] = z
    memory_terms(x, v, w, p, c0, b0)
    steps = 1 if RAMP and len(v) == 0 else FEWEST
    for i in range(len(t) - 1):
        h = (t[i + 1] - t[i]) / steps
        for s in range(steps):
            share = (s + 1) / steps
            between(q, qd, qdd, u, i, t[i + 1] - t[i], share, x, v, w)
            memory_terms(x, v, w, p, c1, b1)
            for j in range(n):
                k = 0.5 * h * (b0[j] + b1[j])
                if abs(k) < 1e-3:
                    mean, ramp = 1.0 + k / 2.0 + k * k / 6.0, 0.5 + k / 6.0 + k * k / 24.0
                else:
                    mean = (exp(k) - 1.0) / k
                    ramp = (mean - 1.0) / k
                added = c0[j] * mean + (c1[j] - c0[j]) * (ramp if RAMP else 0.5 * mean)
                z[j] = z[j] * (1.0 + k * mean) + h * added
                c0[j], b0[j] = c1[j], b1[j]
        out[i + 1] = z
    return 0.0
'''


def group_states(e: Equations) -> list[list[int]]:
    """Return the numbers of the internal states, in groups whose rates depend on each other.

    States of one effect share a group, which is integrated in one loop.
    """
    effects = [name.rpartition(".")[0] for name in e.z_names]
    joined = (
        {k for k, z in enumerate(e.z) if z in rate.free_symbols or effects[k] == effect}
        for rate, effect in zip(e.rates, effects, strict=True)
    )
    return sorted(sorted(group) for group in join_overlapping(joined))


def memory_source(e: Equations, places: Sequence[int]) -> tuple[str, dict[str, list[int]]]:
    """Source of compiled internal states along a motion, and the columns that it takes.

    It knows its columns by number only: the states of an effect have the same text on every joint
    and in every model, which is compiled once.

    Args:
        e: the equations; places: numbers of the states, a group of `group_states`.

    Returns:
        The source, and by group (q, qd, u, p) the numbers of the columns that are passed; those of
        qdd are those of qd.
    """
    z_all, rates = [e.z[i] for i in places], [e.rates[i] for i in places]
    slopes = [sp.diff(rate, z) for rate, z in zip(rates, z_all, strict=True)]
    others = [set(z_all) - {z} for z in z_all]
    coupled = any(r.free_symbols & o for r, o in zip(rates, others, strict=True))
    groups = {"q": e.q, "qd": e.qd, "u": e.u, "p": e.p}
    used_symbols = set().union(*(sp.sympify(rate, strict=True).free_symbols for rate in rates))
    uses = {g: [i for i, s in enumerate(some) if s in used_symbols] for g, some in groups.items()}
    known = {g: [some[i] for i in uses[g]] for g, some in groups.items()} | {"z": z_all}
    passed = {
        g: [sp.Symbol(f"{g}_{k:03d}", real=True) for k in range(len(some))]
        for g, some in known.items()
    }
    numbered = dict(zip(chain(*known.values()), chain(*passed.values()), strict=True))

    def number_columns(expressions: Sequence[Any]) -> list[Any]:
        return [sp.sympify(x, strict=True).xreplace(numbered) for x in expressions]

    if coupled or any(slope.free_symbols & set(z_all) for slope in slopes):
        rate = filling_function("memory_rate", passed, {"dz": number_columns(rates)}, "")
        head = f"import numpy as np\nCOUPLED, ACCURATE = {coupled}, {ACCURATE}\n"
        head += f"ERROR, LEAST = {STEP_ERROR}, {LEAST_STEP}\n"
        head += f"STIFF_STEPS, TOLERANCE = {STIFF_STEPS}, {TOLERANCE}\n"
        source = SCALAR_HEADER + head + rate + BETWEEN + MEMORY_LOOP
        if not coupled:
            results = {"slope": number_columns(slopes)}
            source += filling_function("memory_slope", passed, results, "") + STIFF_MEMORY_LOOP
        return source, uses
    rates_at_zero = [rate.subs(z, 0) for rate, z in zip(rates, z_all, strict=True)]
    columns = {"c": number_columns(rates_at_zero), "b": number_columns(slopes)}
    del passed["z"]
    terms = filling_function("memory_terms", passed, columns, "")
    steady = not any(slope.free_symbols & {*e.q, *e.qd, *e.u} for slope in slopes)
    head = f"import numpy as np\nRAMP = {steady}\nFEWEST = {_FEWEST}\n"
    return SCALAR_HEADER + head + terms + BETWEEN + LINEAR_MEMORY_LOOP, uses
