"""Forward simulation of a compiled model: open loop, or held near a given motion by an arm.

Friction changes sign over a velocity as small as 1e-3 rad/s, so an axis near standstill is stiff:
its rate is (Coulomb + brake torque) / (inertia * width), 1e3 /s in free motion and 5e4 /s under a
60 N.m brake. Instead of an implicit method, which would need the model's Jacobian, each sampling
interval is divided as finely as this rate demands, and only while an axis is close enough to
standstill to stop within the interval: the rate is probed on the model itself.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import float64, int64, void
from scipy.interpolate import CubicSpline

from bampipe.arrays import Array, Indices
from bampipe.compiled import njit, part, record_type
from bampipe.errors import InputError
from bampipe.estimate.runge_kutta import runge_kutta
from bampipe.model_functions import DERIVATIVE

_V = float64[::1]
_M = float64[:, ::1]
_I = int64[::1]
_MOST_STEPS = 4000
MAX_STEP_S = 2.5e-4
"""Default of the longest integration step."""
_BRAKES_S = 0.01
"""Averaging time of the speed in the controller of the brakes."""
_WIDEST_GRID_S = 1e-3
"""Longest interval for linear interpolation of a continuous force: at a hundred samples a second, a
straight line takes 3 % off a component at 10 Hz, and at a thousand 0.03 %."""


class Runaway(InputError):
    """A simulated motion grows without bounds."""


class Arm(NamedTuple):
    """The arm that pulls the mechanism towards a reference motion.

    The arm demands the acceleration ``natural_frequency**2 * (q_ref - q) + 2 * damping_ratio *
    natural_frequency * (qd_ref - qd)`` of every coordinate; the handle force that would give it
    passes a critically damped second-order low-pass, as muscle does, so that the force has
    continuous derivatives.

    Attributes:
        q_ref, qd_ref: (T, n_q) motion that the arm follows.
        force: columns of the inputs with the handle force, N. If they are fewer than the
            coordinates, the arm's force is the least-squares one.
        rate, curvature: columns with its first and second derivative, to which those of the arm's
            force are added; in the order of ``force``, -1 for one that the model does not use.
        moved_first: (n_q, 2) indices in the state of the positions that the arm moves along
            ``q_ref``, and of their rates; by default those of the coordinates.
        natural_frequency: rad/s; 0 leaves the mechanism to the given force alone.
        damping_ratio: 1 is critical.
        bandwidth: of the low-pass on the force, rad/s.
    """

    q_ref: Array
    qd_ref: Array
    force: Sequence[int] | Indices
    rate: Sequence[int] | Indices = ()
    curvature: Sequence[int] | Indices = ()
    moved_first: Indices | None = None
    natural_frequency: float = 12.0
    damping_ratio: float = 1.0
    bandwidth: float = 120.0


_NOBODY = Arm(np.zeros((0, 0)), np.zeros((0, 0)), ())


class Plant(NamedTuple):
    """Data that kernels need besides the derivative.

    Attributes:
        p: (np,) parameters; w: (nw,) process noise, zeros.
        width: (n_q,) velocity over which friction changes sign, rad/s or m/s.
        max_step: longest integration step, s.
    """

    p: Array
    w: Array
    width: Array
    max_step: float


PLANT = record_type(Plant, _V, _V, _V, float64)
_ARM = record_type(Arm, _M, _M, _I, _I, _I, int64[:, ::1], *[float64] * 3)


@part()
def stable_steps(derivative, x, u, plant, dt, work):  # type: ignore[no-untyped-def]
    """Number of Runge-Kutta steps that ``dt`` requires from state ``x``.

    Steps are at most ``plant.max_step`` long, and no longer than the time constant of any axis. The
    derivative is probed at both sides of standstill if the axis may come to rest within ``dt``,
    otherwise at a rate nearby, since heavy damping on a small mass is stiff at any speed.

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


@njit(int64(DERIVATIVE, _M, _M, PLANT, float64))
def _count_steps(derivative, x, u, plant, dt):  # type: ignore[no-untyped-def]
    """Sum of `stable_steps` over states (K, nx) and inputs (K, nu)."""
    total, work = 0, np.zeros((8, x.shape[1]))
    for k in range(x.shape[0]):
        total += stable_steps(derivative, x[k], u[k], plant, dt, work)
    return total


@part()
def _solve_goal(derivative, x, u, plant, arm, k, out):  # type: ignore[no-untyped-def]
    """Write the force that alone would give the acceleration which the arm demands at sample k."""
    p, w, force, at = plant.p, plant.w, arm.force, arm.moved_first
    frequency, damping = arm.natural_frequency, arm.damping_ratio
    nx, n, nf = x.shape[0], plant.width.shape[0], force.shape[0]
    still, moved, response = np.empty(nx), np.empty(nx), np.empty((n, nf))
    normal = np.empty((nf, nf))
    derivative(x, u, p, w, still)
    for j in range(nf):
        u[force[j]] += 1.0
        derivative(x, u, p, w, moved)
        u[force[j]] -= 1.0
        for i in range(n):
            response[i, j] = moved[at[i, 1]] - still[at[i, 1]]
    trace = 0.0
    for j in range(nf):
        out[j] = 0.0
        for other in range(nf):
            total = 0.0
            for i in range(n):
                total += response[i, j] * response[i, other]
            normal[j, other] = total
        trace += normal[j, j]
    for i in range(n):
        error = frequency * frequency * (arm.q_ref[k, i] - x[at[i, 0]])
        error += 2.0 * damping * frequency * (arm.qd_ref[k, i] - x[at[i, 1]])
        for j in range(nf):
            out[j] += response[i, j] * error
    size = trace
    for j in range(nf):
        size += abs(out[j])
        normal[j, j] += 1e-12 * trace + 1e-300  # finite where a force moves nothing
    if np.isfinite(size):  # else the motion has diverged: the caller reports it
        solved = np.linalg.solve(normal, out)
        for j in range(nf):
            out[j] = solved[j]


@njit(void(DERIVATIVE, _M, _M, PLANT, _ARM, _I, _M, float64))
def _run(derivative, x, u, plant, arm, brake, brake_gain, dt):  # type: ignore[no-untyped-def]
    """Fill the rows of ``x`` after the first and add arm force and brake commands to ``u``.

    Without columns of force there is no arm. ``brake`` holds the columns with the commands, and
    ``brake_gain`` (T, n_q) the damping.
    """
    force, rate, curvature, bandwidth = arm.force, arm.rate, arm.curvature, arm.bandwidth
    n, nf = plant.width.shape[0], force.shape[0]
    # Force of the arm, its rate, the target force; speed as the brakes' controller sees it.
    pull, pull_rate, goal, speed = np.zeros(nf), np.zeros(nf), np.zeros(nf), np.zeros(n)
    steps = np.zeros((9, max(x.shape[1], u.shape[1])))
    fade = np.exp(-bandwidth * dt)
    follow = 1.0 - np.exp(-dt / _BRAKES_S)
    for k in range(x.shape[0] - 1):
        if nf > 0:
            _solve_goal(derivative, x[k], u[k], plant, arm, k, goal)
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
        straight = steps[8, : u.shape[1]]
        runge_kutta(
            derivative, x[k + 1], u[k], u[k + 1], straight, straight, plant.p, plant.w, dt, count,
            steps,
        )  # fmt: skip


def simulate(
    derivative: Any,
    plant: Plant,
    x0: Array,
    u: Array,
    dt: float,
    *,
    arm: Arm | None = None,
    brake: Sequence[int] = (),
    brake_gain: Array | None = None,
    smooth: Sequence[int] = (),
) -> tuple[Array, Array]:
    """Integrate the model from ``x0`` (nx,) under given inputs, without process noise.

    An arm may hold it near a given motion. That simulates a recording with the friction, including
    sticking, of a fitted model: the recorded forces act, and the arm adds the force that keeps the
    motion from drifting away. The returned inputs include the arm's force, so that with the
    returned motion they form one consistent recording.

    Args:
        derivative: compiled f(x, u, p, w, dx), positions first in x, then rates, then states.
        plant: the rest of what is simulated; see `make_plant`.
        u: (T, nu) inputs at samples ``dt`` seconds apart, linear in between, without the arm's
            force; copied. Its columns ``smooth`` follow cubic splines instead, as forces do.
        brake: columns with the brake command of each coordinate, in their order, or none.
        brake_gain: (T, n_q) damping that the brakes render: each command is this times the
            speed, low-passed as a controller sees it. N.m.s/rad or N.s/m.

    Returns:
        states (T, nx) and inputs (T, nu) with the total handle force and the brake commands.

    Raises:
        Runaway: the motion grows without bounds.
    """
    arm, n = arm or _NOBODY, len(plant.width)
    u, fine_dt = read_finely(u, dt, smooth)
    finer, dt = round(dt / fine_dt), fine_dt
    gain = np.zeros((0, 0)) if brake_gain is None else brake_gain
    q_ref, qd_ref = arm.q_ref, arm.qd_ref
    if finer > 1:
        axes = range(q_ref.shape[1])
        q_ref, qd_ref = (_read_between(ref, finer, axes) for ref in (q_ref, qd_ref))
        gain = _read_between(gain, finer)
    x = np.zeros((len(u), len(x0)))
    x[0] = x0
    total = np.array(u, dtype=np.float64, order="C")
    first = np.arange(2 * n).reshape(2, n).T if arm.moved_first is None else arm.moved_first
    indices = (arm.force, arm.rate, arm.curvature, first)
    # Copies: columns of a table are read-only.
    references = (np.array(ref, dtype=np.float64, order="C") for ref in (q_ref, qd_ref))
    columns = (np.array(some, dtype=np.int64, order="C") for some in indices)
    sizes = map(float, (arm.natural_frequency, arm.damping_ratio, arm.bandwidth))
    pull = Arm._make((*references, *columns, *sizes))
    brakes = np.array(brake[: gain.shape[1]], dtype=np.int64)
    _run(derivative, x, total, plant, pull, brakes, np.ascontiguousarray(gain), dt)
    require_finite(x, dt)
    return np.ascontiguousarray(x[::finer]), np.ascontiguousarray(total[::finer])


def read_finely(u: Array, dt: float, smooth: Sequence[int]) -> tuple[Array, float]:
    """Resample inputs (T, n_u, ...) as finely as smooth ones require; return also the step, s."""
    finer = int(np.ceil(dt / _WIDEST_GRID_S - 1e-6)) if len(smooth) else 1
    return (u, dt) if finer == 1 else (_read_between(u, finer, smooth), dt / finer)


def _read_between(values: Array, finer: int, smooth: Sequence[int] = ()) -> Array:
    """Interpolate columns (T, n, ...) ``finer`` times: linearly, or by cubic splines if smooth."""
    coarse = np.arange(len(values))
    fine = np.arange((len(values) - 1) * finer + 1) / finer
    between = np.empty((len(fine), *values.shape[1:]))
    curved = list(smooth) if len(values) > 3 else []
    if curved:
        between[:, curved] = CubicSpline(coarse, values[:, curved])(fine)
    for place in np.ndindex(values.shape[1:]):
        if place[0] not in curved:
            between[:, *place] = np.interp(fine, coarse, values[:, *place])
    return between


def make_plant(p: Array, n_noise: int, width: Array, max_step: float = MAX_STEP_S) -> Plant:
    """Return the plant in the form of the compiled functions.

    Args:
        p: (np,) parameters; n_noise: length of the model's process noise w.
        width: (n_q,) velocity over which friction changes sign, rad/s or m/s.
        max_step: longest integration step, s.
    """
    return Plant(
        np.ascontiguousarray(p, dtype=np.float64), np.zeros(n_noise),
        np.ascontiguousarray(width, dtype=np.float64), max_step,
    )  # fmt: skip


def count_steps(derivative: Any, plant: Plant, x: Array, u: Array, dt: float) -> float:
    """Mean number of integration steps from one sample to the next, over some states.

    Args:
        x: (K, nx) states; u: (K, nu) inputs there; the others as in `simulate`.
    """
    rows = np.ascontiguousarray(x), np.ascontiguousarray(u)
    return float(_count_steps(derivative, *rows, plant, dt) / len(x))


def require_finite(x: Array, dt: float) -> None:
    """Raise Runaway if a simulated motion (T, nx), sampled every ``dt`` s, has diverged."""
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if len(bad):
        raise Runaway(
            f"the simulated motion grows without bounds after {bad[0] * dt:.3f} s",
            remedy="check the sizes of the parameters: a mass near zero under friction cannot be "
            "followed, so give it a lower bound",
        )
