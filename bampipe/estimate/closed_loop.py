"""Simulation of a machine together with its controller, in closed loop."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import float64, int64, void

from bampipe.arrays import Array
from bampipe.compiled import njit, part
from bampipe.estimate.runge_kutta import runge_kutta
from bampipe.estimate.simulation import PLANT, Plant, require_finite, stable_steps
from bampipe.model_functions import COMMAND, DERIVATIVE, MEASURE

_V = float64[::1]
_M = float64[:, ::1]


@part()
def _act(command, states, limits, y, r, dt, out):  # type: ignore[no-untyped-def]
    """Write commands from readings and references, and advance the controller by ``dt``.

    ``out`` (nf + n_s,) receives the commands, then the rates of its states, which stay within
    ``limits`` (n_s, 2).
    """
    command(y, r, states, out)
    for i in range(-states.shape[0], 0):
        states[i] = min(max(states[i] + dt * out[i], limits[i, 0]), limits[i, 1])


@njit(
    void(
        DERIVATIVE, MEASURE, COMMAND, _M, _M, _M, _M, PLANT, int64[::1], _V, _M, int64, float64
    ),
)  # fmt: skip
def _close(  # type: ignore[no-untyped-def]
    derivative, measure, command, x, u, r, readings, plant, columns, states, limits, ticks, dt
):
    """Fill the rows of ``x`` after the first, the commands in ``u``, and the readings.

    The controller commands ``columns`` of ``u`` and acts ``ticks`` times in a sample.
    """
    p, w = plant.p, plant.w
    nu, nr, nf = u.shape[1], r.shape[1], columns.shape[0]
    start, end, given, straight = np.empty(nu), np.empty(nu), np.empty(nr), np.zeros(nu)
    out, work = np.zeros(nf + states.shape[0]), np.zeros((8, max(x.shape[1], nu)))
    tick_s = dt / ticks
    for k in range(x.shape[0]):
        ahead = min(k + 1, x.shape[0] - 1)  # at the last sample, the controller only acts
        for i in range(x.shape[1]):  # a slice that is assigned takes seconds to compile
            x[ahead, i] = x[k, i]
        for tick in range(ticks if k < ahead else 1):
            for j in range(nu):
                start[j] = u[k, j] + (u[ahead, j] - u[k, j]) * tick / ticks
                end[j] = u[k, j] + (u[ahead, j] - u[k, j]) * (tick + 1) / ticks
            for j in range(nr):
                given[j] = r[k, j] + (r[ahead, j] - r[k, j]) * tick / ticks
            for j in range(nf):  # the encoders may be moved by the load
                start[columns[j]] = out[j]
            seen = readings[ahead if tick > 0 else k]
            measure(x[ahead], start, p, seen)
            _act(command, states, limits, seen, given, tick_s, out)
            for j in range(nf):
                start[columns[j]] = end[columns[j]] = out[j]
                if tick == 0:
                    u[k, columns[j]] = out[j]
            if k < ahead:
                steps = stable_steps(derivative, x[ahead], start, plant, tick_s, work)
                runge_kutta(
                    derivative, x[ahead], start, end, straight, straight, p, w, tick_s, steps, work
                )


def simulate_controlled(
    derivative: Any,
    measure: Any,
    command: Any,
    plant: Plant,
    x0: Array,
    u: Array,
    r: Array,
    dt: float,
    *,
    force: Sequence[int],
    rate_hz: float = 0.0,
    limits: Sequence[tuple[float, float]] = (),
) -> tuple[Array, Array, Array]:
    """Integrate machine and controller together from ``x0``: a free run in closed loop.

    The controller reads the encoders, computes its command and holds it until it acts again. The
    integrals start at values for which its first command is nearest to the recorded one.

    Args:
        derivative, plant, x0, dt: as in `simulate`.
        measure: compiled h(x, u, p, y), the encoder readings.
        command: compiled c(y, r, s, out): the commands from readings, references, gains and the
            states of the controller, followed by the rates of these states.
        u: (T, nu) inputs; the columns ``force`` are replaced by the commands, in their order.
        r: (T, nr) references, gains and other channels of the law, linear between samples.
        rate_hz: rate at which the controller acts, rounded to a multiple of the sampling rate; 0
            for once a millisecond or more often.
        limits: (n_s, 2) lower and upper limit of each state of the controller.

    Returns:
        states (T, nx), inputs with the commands (T, nu), readings (T, 2 n_q).

    Raises:
        InputError: the motion grows without bounds.
    """
    x, total = np.zeros((len(u), len(x0))), np.array(u, dtype=np.float64, order="C")
    columns, references = np.array(force, dtype=np.int64), np.array(r, dtype=np.float64, order="C")
    x[0] = x0
    recorded = total[0, columns]
    total[:, columns] = 0.0
    readings = np.zeros((len(u), 2 * len(plant.width)))
    bounds = np.array(limits, dtype=np.float64).reshape(-1, 2)
    measure(x[0], total[0], plant.p, readings[0])
    states = _first_states(command, readings[0], references[0], recorded, bounds)
    ticks = max(1, round(dt * rate_hz) if rate_hz > 0.0 else int(np.ceil(dt / 1e-3 - 1e-9)))
    _close(
        derivative, measure, command, x, total, references, readings, plant, columns, states,
        bounds, ticks, dt,
    )  # fmt: skip
    require_finite(x, dt)
    return x, total, readings


def _first_states(command: Any, y: Array, r: Array, recorded: Array, limits: Array) -> Array:
    """Return states (n_s,) of the controller that give the recorded command, within ``limits``.

    It takes one Newton step from zero, which is exact for a command linear in the states; of
    several solutions it returns the smallest.
    """
    count, nf = len(limits), len(recorded)
    states, out = np.clip(np.zeros(count), *limits.T), np.zeros(nf + count)
    if count == 0:
        return states
    command(y, r, states, out)
    now, slope = out[:nf].copy(), np.zeros((nf, count))
    for i in range(count):
        other = states.copy()
        other[i] += 1e-6
        command(y, r, other, out)
        slope[:, i] = (out[:nf] - now) / 1e-6
    step = np.linalg.lstsq(slope, recorded - now, rcond=None)[0]
    return np.asarray(np.clip(states + step, *limits.T))
