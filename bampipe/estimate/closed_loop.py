"""Machine and controller simulated together: the motion in closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import float64, int64, void
from numpy.typing import NDArray

from bampipe.compiled import njit
from bampipe.estimate.runge_kutta import runge_kutta
from bampipe.estimate.simulation import require_finite, stable_steps
from bampipe.model_functions import COMMAND, DERIVATIVE, MEASURE

Array = NDArray[np.float64]

_V = float64[::1]
_M = float64[:, ::1]
_I = int64[::1]


@njit(void(_V, _V, int64, _M, float64), cache=True)
def _remember(kept, told, nf, limits, dt):  # type: ignore[no-untyped-def]
    """Advance the states of the controller by the rates that follow its commands in ``told``."""
    for i in range(kept.shape[0]):
        kept[i] = min(max(kept[i] + dt * told[nf + i], limits[i, 0]), limits[i, 1])


@njit(
    void(
        DERIVATIVE, MEASURE, COMMAND, _M, _M, _M, _V, _V, int64, _V, float64, float64,
        int64, _I, _M, _M, _V, _M,
    ),
    cache=True,
)  # fmt: skip
def _close(  # type: ignore[no-untyped-def]
    derivative, measure, command, x, u, r, p, w, n, width, dt, max_step, ticks, force, seen, work,
    kept, limits,
):  # fmt: skip
    """Fill the rows of ``x`` after the first, the commands in ``u``, the readings in ``seen``."""
    nu, nr, nf, ns = u.shape[1], r.shape[1], force.shape[0], kept.shape[0]
    start, end = np.empty(nu), np.empty(nu)
    given, told = np.empty(nr), np.empty(nf + ns)
    for k in range(x.shape[0]):
        if k > 0:
            for j in range(nf):  # the encoders may be moved by the load
                u[k, force[j]] = told[j]
        measure(x[k], u[k], p, seen[k])
        command(seen[k], r[k], kept, told)
        _remember(kept, told, nf, limits, dt / ticks)
        for j in range(nf):
            u[k, force[j]] = told[j]
        if k + 1 == x.shape[0]:
            break
        x[k + 1] = x[k]
        for tick in range(ticks):
            for j in range(nu):
                start[j] = u[k, j] + (u[k + 1, j] - u[k, j]) * tick / ticks
                end[j] = u[k, j] + (u[k + 1, j] - u[k, j]) * (tick + 1) / ticks
            for j in range(nf):
                start[force[j]] = told[j]
            if tick > 0:
                for j in range(nr):
                    given[j] = r[k, j] + (r[k + 1, j] - r[k, j]) * tick / ticks
                measure(x[k + 1], start, p, seen[k + 1])
                command(seen[k + 1], given, kept, told)
                _remember(kept, told, nf, limits, dt / ticks)
            for j in range(nf):
                start[force[j]] = told[j]
                end[force[j]] = told[j]
            steps = stable_steps(
                derivative, x[k + 1], start, p, w, n, width, dt / ticks, max_step, work
            )
            runge_kutta(derivative, x[k + 1], start, end, p, w, dt / ticks, steps, work)


def simulate_controlled(
    derivative: Any,
    measure: Any,
    command: Any,
    x0: Array,
    u: Array,
    r: Array,
    p: Array,
    dt: float,
    *,
    width: Array,
    n_noise: int,
    force: Sequence[int],
    rate_hz: float = 0.0,
    limits: Sequence[tuple[float, float]] = (),
    max_step: float = 2.5e-4,
) -> tuple[Array, Array, Array]:
    """Integrate machine and controller together from ``x0``: a free run in closed loop.

    The controller reads the encoders, computes its command and holds it until it acts again. What
    it integrates starts where its first command is nearest to the recorded one.

    Args:
        derivative, x0, p, dt, width, n_noise, max_step: as in `simulate`.
        measure: compiled h(x, u, p, y): what the encoders read.
        command: compiled c(y, r, s, out): commands from readings, references, gains and the states
            of the controller; and the rates of these.
        u: (T, nu) inputs; the columns ``force`` are replaced by the commands.
        r: (T, nr) references, gains and other channels of the law, linear between samples.
        force: columns of ``u`` that the controller commands, in the order of its output.
        rate_hz: how often the controller acts, rounded to whole times a sample; where it is 0,
            once a millisecond or oftener.
        limits: (n_s, 2) between which each state of the controller is kept.

    Returns:
        states (T, nx), inputs with the commands (T, nu), readings (T, 2 n_q).

    Raises:
        InputError: the motion grows without bounds.
    """
    n = len(width)
    x, total = np.zeros((len(u), len(x0))), np.array(u, dtype=np.float64, order="C")
    x[0] = x0
    told = total[0, list(force)].copy()
    total[:, list(force)] = 0.0
    seen = np.zeros((len(u), 2 * n))
    bounds = np.array(limits, dtype=np.float64).reshape(-1, 2)
    measure(x[0], total[0], np.ascontiguousarray(p, dtype=np.float64), seen[0])
    kept = _first_states(command, seen[0], np.array(r[0], dtype=np.float64), told, bounds)
    ticks = max(1, round(dt * rate_hz) if rate_hz > 0.0 else int(np.ceil(dt / 1e-3 - 1e-9)))
    _close(
        derivative, measure, command, x, total, np.array(r, dtype=np.float64, order="C"),
        np.ascontiguousarray(p, dtype=np.float64), np.zeros(n_noise), n,
        np.ascontiguousarray(width, dtype=np.float64), dt, max_step, ticks,
        np.array(force, dtype=np.int64), seen, np.zeros((8, max(len(x0), total.shape[1]))),
        kept, bounds,
    )  # fmt: skip
    require_finite(x, dt)
    return x, total, seen


def _first_states(command: Any, y: Array, r: Array, told: Array, limits: Array) -> Array:
    """States (n_s,) of the controller at which it commands what was recorded, within ``limits``.

    By one step of Newton's method from zero, which is exact where the command is linear in them;
    of several that will do, the smallest.
    """
    count, nf = len(limits), len(told)
    kept, out = np.clip(np.zeros(count), *limits.T), np.zeros(nf + count)
    if count == 0:
        return kept
    command(y, r, kept, out)
    now, slope = out[:nf].copy(), np.zeros((nf, count))
    for i in range(count):
        other = kept.copy()
        other[i] += 1e-6
        command(y, r, other, out)
        slope[:, i] = (out[:nf] - now) / 1e-6
    step = np.linalg.lstsq(slope, told - now, rcond=None)[0]
    return np.asarray(np.clip(kept + step, *limits.T))
