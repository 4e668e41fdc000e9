"""Guesses from the data themselves: units, rates, roles of columns, and drives of axes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import minimize_scalar

from bampipe.arrays import Array
from bampipe.data.angle_torque import (
    MOST_ROWS,
    AngleTorque,
    SmoothedMotion,
    angle_torque,
    correlated,
    least_squares,
)
from bampipe.data.quality.clock import rate_of
from bampipe.data.session.channels import SECONDS, Register
from bampipe.data.units import spelled

RATES_HZ = (4.0, 30_000.0)
"""Sample rates at which motion is logged."""

_DATES = ((30_000.0, 80_000.0), (720_000.0, 760_000.0))
"""Days since 1900 or 0, as spreadsheets and MATLAB count them."""
_SPANS, _STEP = (0.5, 10.0 * np.pi), 0.01
"""Angles that a joint spans while it is logged, rad, and a step of their logarithm."""
_WEIGHT_LEAVES, _SURE_TURNING = 0.5, 0.03
"""Largest residual of a sine over that of a straight line, and the relative standard error up to
which the scale of a reading is proposed."""
_LEAST_SIGN_BIT, _SIGN_GAP = 7, 0.7
"""Lowest bit that is taken for a sign, and the largest magnitude, as a share of it, by which an
empty range below the bit shows it."""

_NICE = (1, 1.2, 1.25, 1.5, 2, 2.5, 3, 4, 5, 6, 7.5, 8)
_DERIVATIVE = 0.98
"""Correlation of a column with the integral of another, both without drift, to be that of it."""
DRIVEN, _CLEAR = 0.5, 0.95
"""Share of a column that the motion must explain for the column to pass as its drive."""
MOVED, CLEARLY = 0.8, 0.5
"""Of two columns, the share of one that the motion of the other must explain, and how much less it
may leave than the other way round."""
_STEADY = 50.0
"""Longest step of a column of times, in median steps."""
_COPIED = 1e-3
"""Residual of a column regressed on a copy of it, over its standard deviation: rounding alone."""
MOST_IN_TURN, _GOES_ON, _LEAPS = 64, 0.2, 0.4
"""Quantities that take turns in one column, the most; change from one reading of a quantity to its
next, over that from row to row, the most; the latter, squared, over twice the variance, the least.
"""


def time_unit(t: np.ndarray, said: str) -> str:
    """Unit of a time column: as said, else the one that gives a rate at which motion is logged.

    "" if it counts something else, such as ticks, or no unit gives such a rate.
    """
    known = said if said == "datetime" else spelled(said, tuple(SECONDS))
    if said and known in (*SECONDS, "datetime", ""):
        return known
    steps = np.diff(t[np.isfinite(t)])
    step = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
    if step <= 0.0:
        return ""
    order = ("us", "ms", "ns", "s") if np.all(t == np.rint(t)) else ("s", "ms", "us", "ns")
    fitting = [u for u in order if RATES_HZ[0] <= 1.0 / (step * SECONDS[u]) <= RATES_HZ[1]]
    first, last = float(np.nanmin(t)), float(np.nanmax(t))
    dated = any(low < first <= last < min(high, first + 2.0) for low, high in _DATES)
    if not fitting and dated and RATES_HZ[0] <= 1.0 / (step * SECONDS["days"]) <= RATES_HZ[1]:
        return "days"
    return fitting[0] if fitting else ""


def likely_unit(si: str, values: np.ndarray) -> str:
    """Unit of a column that is ``si`` or a multiple, by the size of its values; "" if it is ``si``.

    No joint turns by ten turns while it is logged, no bench-top axis is five metres long, and no
    small motor takes a hundred amperes.
    """
    known = values[np.isfinite(values)]
    span = float(np.ptp(known)) if len(known) else 0.0
    limit, other = {"rad": (62.8, "deg"), "m": (5.0, "mm"), "A": (100.0, "mA")}.get(si, (0, ""))
    return other if other and span > limit else ""


def sample_rate(t: np.ndarray) -> float:
    """Rate of time stamps ``t`` (T,), s, in Hz: a round number where one is within 1 %."""
    rate = rate_of(t[np.isfinite(t)])
    decade = 10.0 ** math.floor(math.log10(rate))
    nearest = min((n * decade for n in (*_NICE, 10)), key=lambda nice: abs(nice - rate))
    return float(f"{nearest:.6g}") if abs(nearest / rate - 1) < 0.01 else float(f"{rate:.4g}")


def follows(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether ``second`` follows ``first`` a little later, as a machine does its reference."""
    slope = 0.5 * (np.gradient(first) + np.gradient(second))
    return float((first - second) @ slope) > 0.0


def is_copy(values: np.ndarray, of: np.ndarray) -> bool:
    """Whether readings (T,), wild ones apart, are those ``of`` another column in another unit."""
    low, high = np.nanquantile(values, (0.01, 0.99))
    usual = (low <= values) & (values <= high) & np.isfinite(of)
    x, y = values[usual], of[usual]
    if len(x) < 3 or np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return False
    return bool(1.0 - float(np.corrcoef(x, y)[0, 1]) ** 2 < _COPIED**2)


def take_turns(values: np.ndarray, keys: Sequence[np.ndarray]) -> bool:
    """Whether several quantities stand in one column (T,) in turn.

    Readings leap from row to row, but not between rows with one of a key (T,), or every so many.
    """
    leaps = float(np.mean(np.diff(values) ** 2)) if len(values) > 10 * MOST_IN_TURN else 0.0
    if not leaps > 2.0 * _LEAPS * float(np.var(values)):
        return False
    rows, turns = np.arange(len(values)), range(2, MOST_IN_TURN + 1)
    orders = (np.argsort(key, kind="stable") for key in (*keys, *(rows % n for n in turns)))
    return any(np.mean(np.diff(values[each]) ** 2) < _GOES_ON**2 * leaps for each in orders)


@dataclass(frozen=True)
class Driven:
    """Dependence of a column on the motion of an axis, by least squares on one log.

    Attributes:
        share: part of its variance that acceleration, velocity, its sign and position explain,
            0 to 1; a force, a current or a voltage that moves a mass with friction has much.
        inertia, viscous, coulomb: coefficients of acceleration, velocity and its sign.
        pose: the part that follows the position, if that is an angle; otherwise None.
    """

    share: float
    inertia: float = 0.0
    viscous: float = 0.0
    coulomb: float = 0.0
    pose: AngleTorque | None = None

    @property
    def feeds(self) -> bool:
        """Whether mass and friction come out negative, as by a drive whose sign is turned."""
        return self.share > _CLEAR and max(self.inertia, self.viscous, self.coulomb) < 0.0


def driven(t: np.ndarray, q: np.ndarray, column: np.ndarray, angle: bool = False) -> Driven:
    """Hold a column against the motion.

    Args:
        t: (T,) s; q: (T,) position; column: (T,).
        angle: whether the position is an angle in rad, on which gravity may depend.
    """
    motion = SmoothedMotion.of(t, q)
    if motion is None:
        return Driven(0.0)
    moving = np.column_stack([motion.moving, np.ones_like(q)])[motion.inner]
    position = motion.position[motion.inner]
    target = motion.smooth(column)[motion.inner]
    spread = float(np.sum((target - target.mean()) ** 2)) if len(target) else 0.0
    if spread == 0.0:
        return Driven(0.0)
    found, rest = least_squares(np.column_stack([moving, position]), target)
    share = max(0.0, 1.0 - float(rest @ rest) / spread)
    pose = angle_torque(moving, position, target) if angle else None
    if pose is not None and pose.is_gravity:
        # Friction apart, this is what a link that hangs on the axis shows most.
        found = pose.beside
    inertia, viscous, coulomb = (float(value) for value in found[:3])
    return Driven(share, inertia, viscous, coulomb, pose)


@dataclass(frozen=True)
class Turning:
    """Scale of the readings of a position, by the weight that goes with the sine of the angle.

    Attributes:
        size: raw units of one radian of the joint; sd: its standard error.
        zero: reading where the joint hangs.
    """

    size: float
    sd: float
    zero: float


def find_turning(t: np.ndarray, q: np.ndarray, drive: np.ndarray) -> Turning | None:
    """Raw units of a radian at which a drive goes best with the sine of the angle.

    Args:
        t: (T,) s; q: (T,) position in counts, or of a motor before its gear; drive: (T,).

    Returns:
        None if weight does not show it, or not to a few per cent.
    """
    motion = SmoothedMotion.of(t, q)
    if motion is None or np.ptp(q) == 0.0:
        return None
    rows = np.arange(len(q))[motion.inner][:: max(1, len(q) // MOST_ROWS)]
    moving = np.column_stack([motion.moving, np.ones_like(q)])[rows]
    position, target = motion.position[rows], motion.smooth(drive)[rows]
    middle, span = float(np.median(position)), float(np.ptp(position))

    def fitted(x: float) -> tuple[np.ndarray, np.ndarray]:
        angle = np.exp(x) / span * (position - middle)
        return least_squares(np.column_stack([moving, np.sin(angle), np.cos(angle)]), target)

    def left(x: float) -> float:
        rest = fitted(x)[1]
        return float(rest @ rest)

    # The travel of the joint, by its logarithm: from half a radian to five turns.
    tried = np.linspace(math.log(_SPANS[0]), math.log(_SPANS[1]), 110)
    costs = [left(x) for x in tried]
    best = int(np.argmin(costs))
    if best in (0, len(tried) - 1):
        return None
    found = minimize_scalar(left, bounds=(tried[best - 1], tried[best + 1]), method="bounded")
    x, least = float(found.x), float(found.fun)
    line = least_squares(np.column_stack([moving, position]), target)[1]
    coefficients, rest = fitted(x)
    curvature = (left(x + _STEP) - 2.0 * least + left(x - _STEP)) / _STEP**2
    freedom = max(len(rest) / correlated(rest) - 7.0, 1.0)
    if least > _WEIGHT_LEAVES * float(line @ line) or curvature <= 0.0:
        return None
    sd = float(np.sqrt(2.0 * least / freedom / curvature))
    if sd > _SURE_TURNING:
        return None
    *beside, sine, cosine = coefficients[[1, 2, 4, 5]]
    hangs = np.arctan2(-cosine, sine) if sum(beside) >= 0.0 else np.arctan2(cosine, -sine)
    size = span / float(np.exp(x))
    return Turning(size, sd * size, middle + size * float(hangs))


def find_register(values: np.ndarray) -> Register | None:
    """Form in which an unsigned register holds its sign, None if it holds none.

    Two's complement leaves the middle of the range empty, sign and magnitude the upper part of
    either half. In both the readings leap where the number crosses 0, and not once they are signed.
    """
    known = values[np.isfinite(values)]
    if len(known) == 0 or known.min() < 0 or not np.all(known == np.rint(known)):
        return None
    for bits in (16, 32):
        top, half = 2.0**bits, 2.0 ** (bits - 1)
        if half < known.max() < top and np.any(known < half) and np.any(known > 0.75 * top):
            middle = np.mean((known > 0.25 * top) & (known < 0.75 * top))
            return Register(bits=bits) if middle < 0.01 else None
    bit = int(np.log2(max(known.max(), 1.0)))
    half, register = 2.0**bit, Register(sign_bit=bit)
    above, below = known[known > half] - half, known[known < half]
    if bit < _LEAST_SIGN_BIT or min(len(above), len(below)) < 3:
        return None
    leaps, steps = (np.abs(np.diff(v)) for v in (known, register.signed(known)))
    # A gap below the bit that no reading crosses; or, of what fills it, no leap.
    empty = max(above.max(), below.max()) < _SIGN_GAP * half
    return register if empty or steps.max() < 0.25 * leaps.max() else None


def stretches(t: np.ndarray, q: np.ndarray) -> list[float]:
    """Times, s, at which to cut a record, (T,) positions at (T,) s from 0: rests evenly spaced."""
    parts = min(5, int(t[-1] // 4.0))
    if parts < 2:
        return []
    speed = np.abs(np.gradient(q))  # a sample: stamps may stand twice
    cuts = []
    for k in range(1, parts):
        near = np.abs(t - t[-1] * k / parts) < 0.15 * t[-1] / parts
        slowest = np.flatnonzero(near)[int(np.argmin(speed[near]))]
        cuts.append(round(float(t[slowest]), 2))
    return cuts


def find_roles(values: Mapping[str, Array], t: Array | None) -> dict[str, str]:
    """Roles of columns (T,) by their looks; those that look like nothing are left out.

    ``t``: (T,) time, None if no column is known to be one. Roles are "time", "position",
    "velocity", "acceleration" or "force" (what drives the motion).
    """
    found: dict[str, str] = {}
    sound = {name: v[:MOST_ROWS] for name, v in values.items() if np.all(np.isfinite(v))}
    if t is None:
        clock = next((name for name, v in sound.items() if is_time(v)), "")
        found |= {clock: "time"} if clock else {}
        t = sound.pop(clock, None)
    if len(sound) < 2:
        return found
    matrix = np.column_stack(list(sound.values()))
    t = np.arange(len(matrix), dtype=float) if t is None else t[:MOST_ROWS]
    if not np.all(np.isfinite(t)):
        return found
    names = list(sound)
    derivative = _derivatives(matrix, t)
    rates = set(derivative.values())
    for k, rate in derivative.items():
        if k not in rates:
            found |= {names[k]: "position", names[rate]: "velocity"}
            if rate in derivative:
                found[names[derivative[rate]]] = "acceleration"
    positions = [k for k in derivative if k not in rates]
    left = [k for k, name in enumerate(names) if name not in found]
    seconds = (t - t[0]) * SECONDS.get(time_unit(t, ""), 1.0)
    if len(positions) == 1:
        q = matrix[:, positions[0]]
        share = {
            k: driven(seconds, q, matrix[:, k]).share
            for k in left
            if abs(float(np.corrcoef(q, matrix[:, k])[0, 1])) < _DERIVATIVE
        }
        best = max(share, key=lambda k: share[k], default=-1)
        if best >= 0 and share[best] >= DRIVEN:
            found[names[best]] = "force"
    elif positions and len(left) == len(positions):
        found |= {names[k]: "force" for k in left}
    elif not positions and len(left) == 2:
        explained = [driven(seconds, matrix[:, k], matrix[:, 1 - k]).share for k in left]
        moved = int(explained[1] > explained[0])
        least, most = sorted(explained)
        if most >= MOVED and 1.0 - most < CLEARLY * (1.0 - least):
            found |= {names[moved]: "position", names[1 - moved]: "force"}
    return found


def describe(name: str, values: Array) -> str:
    """Describe the numbers of a column to a person who knows what was logged."""
    known = values[np.isfinite(values)]
    if is_time(known):
        return f"{name} increases as a time does"
    return f"{name} from {known.min():.4g} to {known.max():.4g}" if len(known) else f"{name} empty"


def is_time(values: Array) -> bool:
    """Whether readings (T,) rise evenly."""
    steps = np.diff(values)
    rises = len(steps) > 3 and bool(np.all(steps > 0))
    return rises and float(steps.max()) < _STEADY * float(np.median(steps))


def _derivatives(matrix: Array, t: Array) -> dict[int, int]:
    """Columns (T, n) by the column that is their derivative, the likeliest each.

    A column is held against the integrals of the others: noise spoils derivatives.
    """
    since = t - t[0]
    integrals = cumulative_trapezoid(matrix, since, axis=0, initial=0.0)
    # Without a parabola, too: a warming signal would be the integral of any that drifts.
    base, _ = np.linalg.qr(np.column_stack([np.ones_like(since), since, since**2]))
    p, i = (each - base @ (base.T @ each) for each in (matrix, integrals))
    size = np.outer(np.linalg.norm(p, axis=0), np.linalg.norm(i, axis=0))
    alike = np.divide(p.T @ i, size, out=np.zeros_like(size), where=size > 0.0)
    np.fill_diagonal(alike, 0.0)
    found: dict[int, int] = {}
    # If columns repeat each other, the first one counts, whatever the rounding.
    order = np.argsort(-np.round(alike, 9), axis=None, kind="stable")
    for k, rate in zip(*np.unravel_index(order, alike.shape), strict=True):
        if alike[k, rate] < _DERIVATIVE:
            break
        if int(k) not in found and int(rate) not in found.values():
            found[int(k)] = int(rate)
    return found
