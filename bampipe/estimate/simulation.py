"""Forward simulation of a compiled model: open loop, or held near a given motion by an arm.

Axes that something stiff moves follow that motion to the letter: the force it takes is solved for.

Friction changes sign over a velocity as small as 1e-3 rad/s, so an axis near standstill is stiff:
its rate is (Coulomb + brake torque) / (inertia * width), 1e3 /s in free motion and 5e4 /s under a
60 N.m brake. Instead of an implicit method, which would need the model's Jacobian, each sampling
interval is divided as finely as this rate demands, and only while an axis is close enough to
standstill to stop within the interval: the rate is probed on the model itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import boolean, float64, int64, void
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from bampipe.compiled import njit, record_type
from bampipe.errors import InputError
from bampipe.estimate.runge_kutta import runge_kutta
from bampipe.estimate.triangular import cholesky, forward_substitute
from bampipe.model_functions import DERIVATIVE

Array = NDArray[np.float64]

_V = float64[::1]
_M = float64[:, ::1]
_I = int64[::1]
_MOST_STEPS = 4000
_WIDEST_GRID_S = 1e-3
"""Longest time over which a continuous force may run straight: at a hundred samples a second, a
straight line takes 3 % off what acts at 10 Hz, and at a thousand 0.03 %."""


class Runaway(InputError):
    """A simulated motion grows without bounds: such a model cannot be moved."""


@dataclass(frozen=True)
class Impedance:
    """The arm that pulls the mechanism towards a reference motion.

    The arm demands the acceleration ``natural_frequency**2 * (q_ref - q) + 2 * damping_ratio *
    natural_frequency * (qd_ref - qd)`` of every coordinate; the handle force that would give it
    passes a critically damped second-order low-pass, as muscle does, so that the force has
    continuous derivatives.

    Attributes:
        natural_frequency: rad/s; 0 leaves the mechanism to the given force alone.
        damping_ratio: 1 is critical.
        bandwidth: of the low-pass on the force, rad/s.
    """

    natural_frequency: float = 12.0
    damping_ratio: float = 1.0
    bandwidth: float = 120.0


class Holding(NamedTuple):
    """Axes that something stiff moves, such as a robot's joints by fast position controllers.

    Attributes:
        axes: (h,) their numbers.
        along: (h, nf) forces that are a unit of generalised force on one of them, none on others.
        acceleration: (T, n_q) of the motion that they follow, rad/s2 or m/s2.
    """

    axes: Sequence[int]
    along: Array
    acceleration: Array


class Plant(NamedTuple):
    """What kernels simulate besides the derivative.

    Attributes:
        p: (np,) parameters; w: (nw,) process noise, zeros.
        width: (n_q,) velocity over which friction changes sign, rad/s or m/s.
        max_step: longest integration step, s.
    """

    p: Array
    w: Array
    width: Array
    max_step: float


class _Arm(NamedTuple):
    """The arm: columns of the inputs with its force and derivatives, and its `Impedance`."""

    force: NDArray[np.int64]
    rate: NDArray[np.int64]
    curvature: NDArray[np.int64]
    natural_frequency: float
    damping_ratio: float
    bandwidth: float


class _Brakes(NamedTuple):
    """Columns with the commands, gain (T, n_q) and the time over which the speed is averaged, s."""

    columns: NDArray[np.int64]
    gain: Array
    time: float


class _Solver(NamedTuple):
    """Forces that come nearest to giving some axes the accelerations that are wanted of them.

    Attributes:
        columns: (nf,) of the inputs, with forces; along: (m, nf) the directions that they may take.
        axes: (a,) whose acceleration counts.
        wanted: (a,) beyond what acts already; found: (m,) force along each direction.
        response: (a, m) acceleration by force; normal, factor: (m, m).
    """

    columns: NDArray[np.int64]
    along: Array
    axes: NDArray[np.int64]
    wanted: Array
    found: Array
    response: Array
    normal: Array
    factor: Array

    @classmethod
    def of(cls, columns: Sequence[int], along: Array, axes: Sequence[int]) -> _Solver:
        """With its memory."""
        m, a = len(along), len(axes)
        return cls(
            np.array(columns, dtype=np.int64), np.array(along, dtype=np.float64, order="C"),
            np.array(axes, dtype=np.int64), np.zeros(a), np.zeros(m),
            np.empty((a, m)), np.empty((m, m)), np.zeros((m, m)),
        )  # fmt: skip


class _Workspace(NamedTuple):
    """Memory.

    Attributes:
        steps: rows of a step's states, (8, nx or nu).
        ends: inputs at both ends of a substep, (2, nu).
        pull, pull_rate: (nf,) force of the arm, its rate.
        speed: (n,) as the brakes' controller sees it.
    """

    steps: Array
    ends: Array
    pull: Array
    pull_rate: Array
    speed: Array


PLANT = record_type(Plant, _V, _V, _V, float64)
_ARM = record_type(_Arm, _I, _I, _I, float64, float64, float64)
_SOLVER = record_type(_Solver, _I, _M, _I, _V, _V, _M, _M, _M)
_WORKSPACE = record_type(_Workspace, _M, _M, _V, _V, _V)


@njit(int64(DERIVATIVE, _V, _V, PLANT, float64, _M), cache=True)
def stable_steps(derivative, x, u, plant, dt, work):  # type: ignore[no-untyped-def]
    """Number of Runge-Kutta steps that ``dt`` needs from state ``x`` on.

    At most ``plant.max_step`` long, and no longer than the time constant of any axis: the
    derivative is probed at both sides of standstill where it may come to rest within ``dt``, else
    at a rate nearby, for heavy damping on a small mass is stiff at any speed.

    Args:
        derivative: f(x, u, p, w, dx).
        x: (nx,) positions, rates, internal states; u: (nu,) inputs.
        plant: the rest of what is simulated; dt: s.
        work: (8, >= nx) scratch; rows 5 to 7 are used.
    """
    p, w, width = plant.p, plant.w, plant.width
    nx, n = x.shape[0], width.shape[0]
    moved = work[5, :nx]
    dx = work[6, :nx]
    probe = work[7, :nx]
    fastest = 1.0 / plant.max_step
    derivative(x, u, p, w, dx)
    for i in range(nx):
        probe[i] = x[i]
    for i in range(n):
        if abs(x[n + i]) > 3.0 * abs(dx[n + i]) * dt + 5.0 * width[i]:
            step = 1e-3 * x[n + i]
            probe[n + i] = x[n + i] + step
            derivative(probe, u, p, w, moved)
            fastest = max(fastest, (dx[n + i] - moved[n + i]) / step)
        else:
            probe[n + i] = 0.1 * width[i]
            derivative(probe, u, p, w, moved)
            above = moved[n + i]
            probe[n + i] = -0.1 * width[i]
            derivative(probe, u, p, w, moved)
            fastest = max(fastest, (moved[n + i] - above) / (0.2 * width[i]))
        probe[n + i] = x[n + i]
    return min(int(np.ceil(dt * fastest)), _MOST_STEPS)


@njit(void(DERIVATIVE, _V, _V, PLANT, _SOLVER, _WORKSPACE), cache=True)
def _solve_force(derivative, x, u, plant, solver, work):  # type: ignore[no-untyped-def]
    """Find the forces of a `_Solver` where ``u`` acts: ``solver.found``."""
    p, w, out = plant.p, plant.w, solver.found
    columns, along, axes, wanted = solver.columns, solver.along, solver.axes, solver.wanted
    response, normal, factor = solver.response, solver.normal, solver.factor
    nx, n, m = x.shape[0], plant.width.shape[0], along.shape[0]
    still = work.steps[6, :nx]
    moved = work.steps[7, :nx]
    derivative(x, u, p, w, still)
    for j in range(m):
        for c in range(columns.shape[0]):
            u[columns[c]] += along[j, c]
        derivative(x, u, p, w, moved)
        for c in range(columns.shape[0]):
            u[columns[c]] -= along[j, c]
        for i in range(axes.shape[0]):
            response[i, j] = moved[n + axes[i]] - still[n + axes[i]]
    trace = 0.0
    for j in range(m):
        out[j] = 0.0
        for k in range(m):
            total = 0.0
            for i in range(axes.shape[0]):
                total += response[i, j] * response[i, k]
            normal[j, k] = total
        trace += normal[j, j]
    for i in range(axes.shape[0]):
        for j in range(m):
            out[j] += response[i, j] * wanted[i]
    for j in range(m):  # keeps the solution finite where a force moves nothing
        normal[j, j] += 1e-12 * trace + 1e-300
    if not (np.isfinite(trace) and cholesky(normal, factor)):
        for j in range(m):  # the motion has run away: the caller says so
            out[j] = np.nan
        return
    forward_substitute(factor, m, out)
    for j in range(m - 1, -1, -1):
        for k in range(j + 1, m):
            out[j] -= factor[k, j] * out[k]
        out[j] /= factor[j, j]


@njit(void(DERIVATIVE, _V, _V, _V, PLANT, _SOLVER, _WORKSPACE), cache=True)
def _hold(derivative, x, u, acceleration, plant, holder, work):  # type: ignore[no-untyped-def]
    """Solve for the force that gives held axes their ``acceleration`` (n,) where ``u`` acts."""
    n, nx = plant.width.shape[0], x.shape[0]
    now = work.steps[6, :nx]
    derivative(x, u, plant.p, plant.w, now)
    for i in range(holder.axes.shape[0]):
        axis = holder.axes[i]
        holder.wanted[i] = acceleration[axis] - now[n + axis]
    _solve_force(derivative, x, u, plant, holder, work)


@njit(
    void(DERIVATIVE, _M, _M, _M, int64, PLANT, _SOLVER, _M, _M, _M, float64, int64, _WORKSPACE),
    cache=True,
)
def _step_held(  # type: ignore[no-untyped-def]
    derivative, x, u, held_by, k, plant, holder, q_ref, qd_ref, qdd_ref, dt, count, work
):
    """Take row ``k`` of ``x`` (T, nx) to the next with some axes on the motion to be followed.

    The force that holds them stays as it is for one of ``count`` steps; the first one's goes into
    row ``k`` of ``held_by`` (T, nf). Inputs run straight between samples.
    """
    n, here = plant.width.shape[0], x[k + 1]
    first, last, acceleration = work.ends[0], work.ends[1], work.steps[5, :n]
    for step in range(count):
        before, after = step / count, (step + 1.0) / count
        for i in range(u.shape[1]):
            first[i] = u[k, i] + before * (u[k + 1, i] - u[k, i])
            last[i] = u[k, i] + after * (u[k + 1, i] - u[k, i])
        for i in range(n):
            acceleration[i] = qdd_ref[k, i] + before * (qdd_ref[k + 1, i] - qdd_ref[k, i])
        _hold(derivative, here, first, acceleration, plant, holder, work)
        for c in range(holder.columns.shape[0]):
            force = 0.0
            for j in range(holder.along.shape[0]):
                force += holder.along[j, c] * holder.found[j]
            first[holder.columns[c]] += force
            last[holder.columns[c]] += force
            if step == 0:
                held_by[k, c] = force
        runge_kutta(derivative, here, first, last, plant.p, plant.w, dt / count, 1, work.steps)
        for i in range(holder.axes.shape[0]):
            axis = holder.axes[i]
            here[axis] = q_ref[k, axis] + after * (q_ref[k + 1, axis] - q_ref[k, axis])
            here[n + axis] = qd_ref[k, axis] + after * (qd_ref[k + 1, axis] - qd_ref[k, axis])


@njit(
    void(
        DERIVATIVE, _M, _M, PLANT, _ARM, _SOLVER, _SOLVER, record_type(_Brakes, _I, _M, float64),
        _M, _M, _M, _M, float64, boolean, _WORKSPACE,
    ),
    cache=True,
)  # fmt: skip
def _run(  # type: ignore[no-untyped-def]
    derivative,
    x,
    u,
    plant,
    arm,
    puller,
    holder,
    brakes,
    q_ref,
    qd_ref,
    qdd_ref,
    held_by,
    dt,
    hold,
    work,
):
    """Fill the rows of ``x`` after the first and add arm force and brake commands to ``u``.

    Without columns of force there is no arm, and what is to be followed is not read; without axes
    that are held, ``qdd_ref`` and ``held_by`` (T, nf), the force that holds them, are not.
    """
    force, rate, curvature, bandwidth = arm.force, arm.rate, arm.curvature, arm.bandwidth
    frequency, damping = arm.natural_frequency, arm.damping_ratio
    pull, pull_rate, goal, speed = work.pull, work.pull_rate, puller.found, work.speed
    brake, brake_gain, steps = brakes.columns, brakes.gain, work.steps
    n, nf, held = plant.width.shape[0], force.shape[0], holder.axes.shape[0] > 0
    fade = np.exp(-bandwidth * dt)
    follow = 1.0 - np.exp(-dt / brakes.time)
    for k in range(x.shape[0] - 1):
        if nf > 0:
            for i in range(n):
                error = frequency * frequency * (q_ref[k, i] - x[k, i])
                error += 2.0 * damping * frequency * (qd_ref[k, i] - x[k, n + i])
                puller.wanted[i] = error
            _solve_force(derivative, x[k], u[k], plant, puller, work)
        for j in range(nf):  # the low-pass, exact for a goal that is constant over dt
            gap = pull[j] - goal[j]
            slope = pull_rate[j] + bandwidth * gap
            pull[j] = goal[j] + (gap + slope * dt) * fade
            pull_rate[j] = (pull_rate[j] - bandwidth * slope * dt) * fade
            u[k + 1, force[j]] += pull[j]
            if rate.shape[0] > 0 and rate[j] >= 0:
                u[k + 1, rate[j]] += pull_rate[j]
            if curvature.shape[0] > 0 and curvature[j] >= 0:
                second = bandwidth * (goal[j] - pull[j]) - 2.0 * pull_rate[j]
                u[k + 1, curvature[j]] += bandwidth * second
        for i in range(brake.shape[0]):
            speed[i] += follow * (x[k, n + i] - speed[i])
            u[k + 1, brake[i]] += brake_gain[k, i] * abs(speed[i])
        for i in range(x.shape[1]):
            x[k + 1, i] = x[k, i]
        count = stable_steps(derivative, x[k], u[k], plant, dt, steps)
        if held:
            _step_held(
                derivative, x, u, held_by, k, plant, holder, q_ref, qd_ref, qdd_ref, dt, count, work
            )
            continue
        end = u[k] if hold else u[k + 1]
        runge_kutta(derivative, x[k + 1], u[k], end, plant.p, plant.w, dt, count, steps)
    if held:
        last = x.shape[0] - 1
        _hold(derivative, x[last], u[last], qdd_ref[last], plant, holder, work)
        for c in range(nf):
            for j in range(holder.along.shape[0]):
                held_by[last, c] += holder.along[j, c] * holder.found[j]


def simulate(
    derivative: Any,
    x0: Array,
    u: Array,
    p: Array,
    dt: float,
    *,
    width: Array,
    n_noise: int,
    hold: bool = False,
    smooth: Sequence[int] = (),
    max_step: float = 2.5e-4,
) -> Array:
    """Integrate the model from ``x0`` under given inputs, without process noise.

    Args:
        derivative: compiled f(x, u, p, w, dx), positions first in x, then rates, then states.
        x0: (nx,) state at the first sample.
        u: (T, nu) inputs at the samples, linear in between, but for those that are ``smooth``.
        p: (np,) parameters.
        dt: sampling interval, s.
        width: (n_q,) velocity over which friction changes sign, rad/s or m/s.
        n_noise: length of the model's process noise w.
        hold: keep each input constant over its interval instead.
        smooth: columns of ``u`` that follow a cubic spline between samples, as forces do.
        max_step: longest integration step, s.

    Returns:
        (T, nx) states at the samples.

    Raises:
        Runaway: the motion grows without bounds.
    """
    nobody = np.zeros((0, 0))
    return _integrate(
        derivative, x0, u, p, dt, nobody, nobody, width, n_noise, max_step, hold=hold,
        smooth=smooth,
    )[0]  # fmt: skip


def simulate_tracking(
    derivative: Any,
    x0: Array,
    u: Array,
    p: Array,
    dt: float,
    q_ref: Array,
    qd_ref: Array,
    *,
    width: Array,
    n_noise: int,
    force: Sequence[int],
    rate: Sequence[int] = (),
    curvature: Sequence[int] = (),
    impedance: Impedance | None = None,
    brake: Sequence[int] = (),
    brake_gain: Array | None = None,
    brake_time: float = 0.01,
    smooth: Sequence[int] = (),
    max_step: float = 2.5e-4,
    holding: Holding | None = None,
) -> tuple[Array, Array]:
    """Integrate the model under given inputs plus an arm that holds it near a given motion.

    Replays a recording with the friction, sticking included, of a fitted model: the recorded
    forces act, and the arm adds what keeps the motion from drifting away. The arm's share is in
    the returned inputs, so these with the returned motion are one consistent recording.

    Args:
        derivative, x0, p, dt, width, n_noise, smooth, max_step: as in `simulate`.
        u: (T, nu) inputs without the arm's share; copied.
        q_ref, qd_ref: (T, n_q) motion that the arm wants.
        force: columns of ``u`` with the handle force, N. They may be fewer than coordinates; the
            arm's force is then the least-squares one.
        rate, curvature: columns with its first and second derivative, where the model has them;
            they receive those of the arm's force. In the order of ``force``, -1 for one
            that the model does not use.
        impedance: of the arm; by default 12 rad/s, critically damped.
        brake: columns with the brake command of each coordinate, in their order, or none.
        brake_gain: (T, n_q) damping that the brakes render: each command is this times the
            speed, low-passed over ``brake_time`` (s) as a controller sees it. N.m.s/rad or N.s/m.
        holding: axes that follow the motion to the letter; the arm holds the others.

    Returns:
        states (T, nx) and inputs (T, nu) with the total handle force and the brake commands.

    Raises:
        Runaway: the motion grows without bounds.
    """
    return _integrate(
        derivative, x0, u, p, dt, q_ref, qd_ref, width, n_noise, max_step,
        force=force, rate=rate, curvature=curvature, arm=impedance or Impedance(),
        brake=brake if brake_gain is not None else (), brake_gain=brake_gain,
        brake_time=brake_time, smooth=smooth, holding=holding,
    )  # fmt: skip


def _integrate(
    derivative: Any,
    x0: Array,
    u: Array,
    p: Array,
    dt: float,
    q_ref: Array,
    qd_ref: Array,
    width: Array,
    n_noise: int,
    max_step: float,
    *,
    hold: bool = False,
    force: Sequence[int] = (),
    rate: Sequence[int] = (),
    curvature: Sequence[int] = (),
    arm: Impedance = Impedance(),
    brake: Sequence[int] = (),
    brake_gain: Array | None = None,
    brake_time: float = 0.01,
    smooth: Sequence[int] = (),
    holding: Holding | None = None,
) -> tuple[Array, Array]:
    """Give `_run` its arrays and its memory; return states (T, nx) and inputs (T, nu)."""
    n, nf = len(width), len(force)
    qdd_ref = np.zeros((0, 0)) if holding is None else holding.acceleration
    finer = int(np.ceil(dt / _WIDEST_GRID_S - 1e-6)) if len(smooth) else 1
    if finer > 1:
        dt /= finer
        u = _read_between(u, finer, smooth)
        everything = range(q_ref.shape[1])
        q_ref, qd_ref = (_read_between(ref, finer, everything) for ref in (q_ref, qd_ref))
        qdd_ref = qdd_ref if holding is None else _read_between(qdd_ref, finer, everything)
        brake_gain = None if brake_gain is None else _read_between(brake_gain, finer)
    x = np.zeros((len(u), len(x0)))
    x[0] = x0
    total = np.array(u, dtype=np.float64, order="C")
    gain = np.zeros((0, 0)) if brake_gain is None else np.ascontiguousarray(brake_gain)
    held_by = np.zeros((0 if holding is None else len(u), nf))
    _run(
        derivative, x, total, make_plant(p, n_noise, width, max_step),
        _Arm(
            np.array(force, dtype=np.int64), np.array(rate, dtype=np.int64),
            np.array(curvature, dtype=np.int64),
            arm.natural_frequency, arm.damping_ratio, arm.bandwidth,
        ),
        _Solver.of(force, np.eye(nf), range(n)),
        _Solver.of(force, np.zeros((0, nf)), ())
        if holding is None else _Solver.of(force, holding.along, holding.axes),
        _Brakes(np.array(brake, dtype=np.int64), gain, brake_time),
        np.array(q_ref, dtype=np.float64, order="C"),  # a copy: columns of a table are read-only
        np.array(qd_ref, dtype=np.float64, order="C"),
        np.array(qdd_ref, dtype=np.float64, order="C"), held_by, dt, hold,
        _Workspace(
            np.zeros((8, max(len(x0), total.shape[1]))), np.empty((2, total.shape[1])),
            np.zeros(nf), np.zeros(nf), np.zeros(n),
        ),
    )  # fmt: skip
    if holding is not None:
        total[:, list(force)] += held_by
    require_finite(x, dt)
    return np.ascontiguousarray(x[::finer]), np.ascontiguousarray(total[::finer])


def _read_between(values: Array, finer: int, smooth: Sequence[int] = ()) -> Array:
    """Columns (T, n) on a grid that is ``finer`` times as fine: linear, or cubic where smooth."""
    coarse = np.arange(len(values))
    fine = np.arange((len(values) - 1) * finer + 1) / finer
    between = np.empty((len(fine), values.shape[1]))
    for column in range(values.shape[1]):
        given = values[:, column]
        if column in smooth and len(values) > 3:
            between[:, column] = CubicSpline(coarse, given)(fine)
        else:
            between[:, column] = np.interp(fine, coarse, given)
    return between


def make_plant(p: Array, n_noise: int, width: Array, max_step: float) -> Plant:
    """Return what is simulated as kernels take it; without process noise."""
    return Plant(
        np.ascontiguousarray(p, dtype=np.float64), np.zeros(n_noise),
        np.ascontiguousarray(width, dtype=np.float64), max_step,
    )  # fmt: skip


def require_finite(x: Array, dt: float) -> None:
    """Raise Runaway where a simulated motion (T, nx), sampled every ``dt`` s, has diverged."""
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if len(bad):
        raise Runaway(
            f"the simulated motion grows without bounds after {bad[0] * dt:.3f} s",
            remedy="check the sizes of the parameters: a mass near zero under friction cannot be "
            "followed, so give it a lower bound",
        )
