"""Recursive Newton-Euler equations of joints in a row or in a tree, written once.

The same lines serve symbols and numbers: with sympy symbols and a `Text` that names every
intermediate they become the text of generated code, with numbers they are evaluated at once.
All vectors of a link are in its own frame, at its joint; the inertia is about that point, so that
every force is linear in the ten inertial numbers of a link (Atkeson, An and Hollerbach 1986).
Gravity enters as an acceleration of the base (Luh, Walker and Paul 1980). Vectors are (3, m) and
matrices (3, 3, m), of m samples, or of one where all are equal.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Vector = tuple[Any, Any, Any]
Columns = NDArray[Any]
Entries = Sequence[Any] | Columns

INERTIAL = 10
"""Inertial numbers of a link: mass, first moment x y z, inertia xx xy xz yy yz zz."""
_TENSOR = np.array([[4, 5, 6], [5, 7, 8], [6, 8, 9]])
"""Place among them of each entry of the inertia."""


@dataclass(frozen=True)
class Link:
    """A joint and the body behind it, as numbers.

    Attributes:
        parent: index of the link before, -1 for the base.
        slides: whether the joint is prismatic.
        axis: unit vector of the joint, in the frame of this link.
        position: of the joint in the frame of the link before, m.
        rotation: matrix whose columns are this link's axes in the frame of the link before, at 0.
        follows: index of the link whose joint this one follows, -1 for one that moves by itself.
        ratio, zero: its position is ratio times that of the other plus zero.
    """

    parent: int
    slides: bool
    axis: Vector
    position: Vector
    rotation: tuple[Vector, ...]
    follows: int = -1
    ratio: float = 1.0
    zero: float = 0.0


class Algebra:
    """The algebra of the equations, here of numbers or columns of numbers."""

    kind: type = float
    sin: Any = staticmethod(np.sin)
    cos: Any = staticmethod(np.cos)

    def name(self, values: Columns) -> Columns:
        """Keep intermediates."""
        return values

    def table(self, rows: Any) -> Columns:
        """Return rows as an array; a row of a single entry, the same for all samples, as (1,)."""
        found: Columns = np.array(rows, dtype=self.kind)
        return found[:, None] if found.ndim == 1 else found


class Text(Algebra):
    """Symbols: names of intermediates and their values, in the order in which they are needed."""

    kind = object

    def __init__(self) -> None:
        import sympy as sp  # takes half a second, which derived code saves

        self.sin, self.cos = (np.frompyfunc(f, 1, 1) for f in (sp.sin, sp.cos))
        self._symbol, self._named = sp.Symbol, np.frompyfunc(self._name_entry, 1, 1)
        self.steps: list[tuple[Any, Any]] = []
        self._known: dict[Any, Any] = {}

    def name(self, values: Columns) -> Columns:
        """Return symbols for ``values``; numbers, symbols and their negatives stay."""
        return np.asarray(self._named(values), dtype=object)

    def _name_entry(self, value: Any) -> Any:
        if isinstance(value, int | float) or value.is_Symbol or value.is_Number:
            return value
        if value.is_Mul and len(value.args) == 2 and value.args[0] == -1:
            return -self._name_entry(-value)
        if value not in self._known:
            self._known[value] = self._symbol(f"r_{len(self.steps)}")
            self.steps.append((self._known[value], value))
        return self._known[value]


@dataclass(frozen=True)
class _LinkMotion:
    """A link in motion: its place in the frame before, and its motion in its own frame.

    Attributes:
        rotation, turn: matrices that rotate into the frame before, turn first.
        offset: from the joint before to this one, in the frame before.
        acceleration: of the joint, gravity in it. change: matrix W; W r is the acceleration of a
        point at r by rotation.
        rate, rate_change: angular velocity and acceleration.
    """

    rotation: Columns
    turn: Columns
    offset: Columns
    acceleration: Columns
    change: Columns
    rate: Columns
    rate_change: Columns

    def into_parent(self, vector: Columns) -> Columns:
        """Return a vector of this frame in the frame before."""
        return _multiply(self.rotation, _multiply(self.turn, vector))

    def from_parent(self, a: Algebra, vector: Columns) -> Columns:
        """Return a vector of the frame before in this one."""
        middle = a.name(_multiply(self.rotation.swapaxes(0, 1), vector))
        return _multiply(self.turn.swapaxes(0, 1), middle)


def joint_forces(
    algebra: Algebra,
    links: Sequence[Link],
    inertial: Sequence[Sequence[Any]],
    q: Entries,
    qd: Entries,
    qdd: Entries,
    gravity: Entries,
) -> Columns:
    """Return the generalised force of each joint that a motion requires, N.m or N.

    Args:
        algebra: symbols or numbers.
        links: parents before children.
        inertial: by link, mass, first moment and inertia about the joint, ten numbers, SI.
        q, qd, qdd: by joint that follows no other, rad or m and derivatives, one or m entries each.
        gravity: m/s2 in the frame of the base, three numbers or (3, m).

    Returns:
        Those of the same joints, (joints, m).
    """
    a, moving = algebra, _link_motions(algebra, links, q, qd, qdd, gravity)
    force, moment = [], []
    for at, numbers in zip(moving, map(a.table, inertial), strict=True):
        first, inertia = numbers[1:4], numbers[_TENSOR]
        force.append(a.name(numbers[0] * at.acceleration + _multiply(at.change, first)))
        spin = a.name(_multiply(inertia, at.rate))
        turning = _multiply(inertia, at.rate_change) + _cross(at.rate, spin)
        moment.append(a.name(turning + _cross(first, at.acceleration)))
    results: list[Any] = [0] * len(links)
    for i in reversed(range(len(links))):
        along = force[i] if links[i].slides else moment[i]
        results[i] = a.name(_dot(a.table(links[i].axis), along))
        parent = links[i].parent
        if parent >= 0:
            onward = a.name(moving[i].into_parent(force[i]))
            force[parent] = a.name(force[parent] + onward)
            lever = _cross(moving[i].offset, onward)
            moment[parent] = a.name(moment[parent] + moving[i].into_parent(moment[i]) + lever)
    return a.name(a.table(_gears(links).T) @ np.array(np.broadcast_arrays(*results)))


def _gears(links: Sequence[Link]) -> Columns:
    """Motion of each link's joint for one of each joint that follows no other, (links, joints)."""
    alone = [i for i, link in enumerate(links) if link.follows < 0]
    ratios = [
        [1 if i == k else link.ratio if link.follows == k else 0 for k in alone]
        for i, link in enumerate(links)
    ]
    return np.array(ratios, dtype=object).reshape(len(links), len(alone))


def columns(
    links: Sequence[Link],
    q: Entries,
    qd: Entries,
    qdd: Entries,
    gravity: Entries,
) -> list[list[Any]]:
    """Return what one of each inertial number adds to each joint's force: [joint][link], (10, m).

    Arguments as in `joint_forces`, of numbers.
    """
    a, n = Algebra(), len(links)
    moving = _link_motions(a, links, q, qd, qdd, gravity)
    results: list[list[Any]] = [[np.zeros((INERTIAL, 1)) for _ in links] for _ in links]
    felt: list[dict[int, tuple[Columns, Columns]]] = []
    for i, (link, at) in enumerate(zip(links, moving, strict=True)):
        # Effect of a moment and a force at this joint on each joint before it, in this frame.
        here: dict[int, tuple[Columns, Columns]] = {}
        for j, (turn, push) in felt[link.parent].items() if link.parent >= 0 else ():
            onward = push + _cross(turn, at.offset)
            here[j] = at.from_parent(a, turn), at.from_parent(a, onward)
        axis, zero = a.table(link.axis), np.zeros((3, 1))
        here[i] = (zero, axis) if link.slides else (axis, zero)
        felt.append(here)
        force, moment = _unit_wrenches(at)
        for j, (turn, push) in here.items():
            results[j][i] = _dot(turn[:, None], moment) + _dot(push[:, None], force)
    return [
        [sum(ratio * results[k][i] for k, ratio in enumerate(gear) if ratio) for i in range(n)]
        for gear in _gears(links).T
    ]


def _unit_wrenches(at: _LinkMotion) -> tuple[Columns, Columns]:
    """Force and moment at the joint by each inertial number of the link, (3, 10, m) each."""
    rate, rate_change, along = np.broadcast_arrays(at.rate, at.rate_change, at.acceleration)
    (x, y, z), (dx, dy, dz), (ax, ay, az) = rate, rate_change, along
    none = np.zeros_like(x)
    force = np.zeros((3, INERTIAL, len(none)))
    force[:, 0], force[:, 1:4] = along, at.change
    moment = np.array([
        [none, none, az, -ay, dx, dy - x * z, dz + x * y, -y * z, y * y - z * z, y * z],
        [none, -az, none, ax, x * z, dx + y * z, z * z - x * x, dy, dz - x * y, -x * z],
        [none, ay, -ax, none, -x * y, x * x - y * y, dx - y * z, x * y, dy + x * z, dz],
    ])  # fmt: skip
    return force, moment


def _link_motions(
    a: Algebra,
    links: Sequence[Link],
    q: Entries,
    qd: Entries,
    qdd: Entries,
    gravity: Entries,
) -> list[_LinkMotion]:
    still, gears = a.table([0, 0, 0]), a.table(_gears(links))
    square = still[:, None] * still
    base = _LinkMotion(square, square, still, -a.table(gravity), square, still, still)
    follow = a.table([link.zero if link.follows >= 0 else 0 for link in links])
    of_all = gears @ a.table(q) + follow, gears @ a.table(qd), gears @ a.table(qdd)
    results: list[_LinkMotion] = []
    for link, x, v, w in zip(links, *of_all, strict=True):
        before = results[link.parent] if link.parent >= 0 else base
        rotation, turn = a.table(link.rotation)[..., None], _joint_rotation(a, link, x)
        axis, offset = a.table(link.axis), a.table(link.position)
        if link.slides:
            offset = a.name(offset + x * _multiply(rotation, axis))
        at = replace(base, rotation=rotation, turn=turn, offset=offset)
        at_joint = a.name(before.acceleration + _multiply(before.change, offset))
        here = a.name(at.from_parent(a, at_joint))
        own = a.name(at.from_parent(a, before.rate))
        own_change = at.from_parent(a, before.rate_change)
        if link.slides:
            here = a.name(here + w * axis + 2 * v * _cross(own, axis))
            own_change = a.name(own_change)
        else:
            own_change = a.name(own_change + v * _cross(own, axis) + w * axis)
            own = a.name(own + v * axis)
        change = _acceleration_matrix(a, own, own_change)
        motion = {"acceleration": here, "change": change, "rate": own, "rate_change": own_change}
        results.append(replace(at, **motion))
    return results


def _joint_rotation(a: Algebra, link: Link, x: Columns) -> Columns:
    """Rotation about the joint's axis (Rodrigues); its columns are the turned axes."""
    if link.slides:
        return a.table(np.eye(3, dtype=int))[..., None]
    s, c, k = a.name(a.sin(x)), a.name(a.cos(x)), link.axis
    spin = ((0, -k[2], k[1]), (k[2], 0, -k[0]), (-k[1], k[0], 0))

    def entry(i: int, j: int) -> Columns:
        square = k[i] * k[j]
        # For an axis along x, y or z only 0, 1, s and c remain.
        value = square + 0 * c if square in (0, 1) else square * (1 - c)
        return np.asarray(value + int(i == j and square != 1) * c + spin[i][j] * s)

    return a.name(np.array([[entry(i, j) for j in range(3)] for i in range(3)]))


def _acceleration_matrix(a: Algebra, rate: Columns, rate_change: Columns) -> Columns:
    dx, dy, dz = rate_change
    (xx, xy, xz), (_, yy, yz), (*_, zz) = a.name(rate[:, None] * rate)
    rows = [-yy - zz, xy - dz, xz + dy], [xy + dz, -xx - zz, yz - dx], [xz - dy, yz + dx, -xx - yy]
    return a.name(np.array(rows))


def _dot(one: Columns, other: Columns) -> Columns:
    return np.asarray(one[0] * other[0] + one[1] * other[1] + one[2] * other[2])


def _multiply(matrix: Columns, vector: Columns) -> Columns:
    return np.asarray(
        matrix[:, 0] * vector[0] + matrix[:, 1] * vector[1] + matrix[:, 2] * vector[2]
    )


def _cross(one: Columns, other: Columns) -> Columns:
    (a, b, c), (x, y, z) = one, other
    return np.array([b * z - c * y, c * x - a * z, a * y - b * x])
