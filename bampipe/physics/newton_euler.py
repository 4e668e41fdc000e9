"""Recursive Newton-Euler equations of joints in a row or in a tree, written once.

The same lines serve symbols and numbers: with sympy symbols and a `Text` that names every
intermediate they become the text of generated code, with numpy arrays they are evaluated at once.
All vectors of a link are in its own frame, at its joint; the inertia is about that point, so that
every force is linear in the ten inertial numbers of a link (Atkeson, An and Hollerbach 1986).
Gravity enters as an acceleration of the base (Luh, Walker and Paul 1980).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Vector = tuple[Any, Any, Any]

ZERO: Vector = (0, 0, 0)
INERTIAL = 10
"""Inertial numbers of a link: mass, first moment x y z, inertia xx xy xz yy yz zz."""


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
    rotation: tuple[Vector, Vector, Vector]
    follows: int = -1
    ratio: float = 1.0
    zero: float = 0.0


class Algebra:
    """The algebra of the equations, here of numbers or columns of numbers."""

    sin: Any = staticmethod(np.sin)
    cos: Any = staticmethod(np.cos)

    def name(self, value: Any) -> Any:
        """Keep an intermediate."""
        return value


class Text(Algebra):
    """Symbols: names of intermediates and their values, in the order in which they are needed."""

    def __init__(self) -> None:
        import sympy as sp  # takes half a second, which derived code saves

        self.sin, self.cos, self._symbol = sp.sin, sp.cos, sp.Symbol
        self.steps: list[tuple[Any, Any]] = []
        self._known: dict[Any, Any] = {}

    def name(self, value: Any) -> Any:
        """Return a symbol for ``value``; numbers, symbols and their negatives stay."""
        if isinstance(value, int | float) or value.is_Symbol or value.is_Number:
            return value
        if value.is_Mul and len(value.args) == 2 and value.args[0] == -1:
            return -self.name(-value)
        if value not in self._known:
            self._known[value] = self._symbol(f"r_{len(self.steps)}")
            self.steps.append((self._known[value], value))
        return self._known[value]


@dataclass(frozen=True)
class _LinkMotion:
    """A link in motion: its rotation into the frame before, and its motion in its own frame.

    Attributes:
        into_parent: vector of this frame into the frame before; from_parent: the reverse.
        offset: from the joint before to this one, in the frame before.
        acceleration: of the joint, gravity in it. change: matrix W; W r is the acceleration of a
        point at r by rotation.
        rate, rate_change: angular velocity and acceleration.
    """

    into_parent: Callable[[Vector], Vector]
    from_parent: Callable[[Vector], Vector]
    offset: Vector
    acceleration: Vector
    change: tuple[Vector, Vector, Vector]
    rate: Vector
    rate_change: Vector


def joint_forces(
    algebra: Algebra,
    links: Sequence[Link],
    inertial: Sequence[Sequence[Any]],
    q: Sequence[Any],
    qd: Sequence[Any],
    qdd: Sequence[Any],
    gravity: Vector,
) -> list[Any]:
    """Return the generalised force of each joint that a motion requires, N.m or N.

    Args:
        algebra: symbols or numbers.
        links: parents before children.
        inertial: by link, mass, first moment and inertia about the joint, ten numbers, SI.
        q, qd, qdd: by joint that follows no other, rad or m and derivatives.
        gravity: m/s2 in the frame of the base.

    Returns:
        Those of the same joints.
    """
    a, moving = algebra, _link_motions(algebra, links, q, qd, qdd, gravity)
    force, moment = [], []
    for at, (mass, *rest) in zip(moving, inertial, strict=True):
        first, inertia = (rest[0], rest[1], rest[2]), _symmetric_matrix(rest[3:])
        force.append(
            _name_components(a, _add(_scale(mass, at.acceleration), _multiply(at.change, first)))
        )
        spin = _name_components(a, _multiply(inertia, at.rate))
        turning = _multiply(inertia, at.rate_change), _cross(at.rate, spin)
        moment.append(_name_components(a, _add(*turning, _cross(first, at.acceleration))))
    results: list[Any] = [0] * len(links)
    for i in reversed(range(len(links))):
        results[i] = a.name(_dot(links[i].axis, force[i] if links[i].slides else moment[i]))
        parent = links[i].parent
        if parent >= 0:
            onward = _name_components(a, moving[i].into_parent(force[i]))
            force[parent] = _name_components(a, _add(force[parent], onward))
            turned = moving[i].into_parent(moment[i])
            lever = _cross(moving[i].offset, onward)
            moment[parent] = _name_components(a, _add(moment[parent], turned, lever))
    return [
        a.name(sum(ratio * results[i] for i, ratio in turned))
        if len(turned) > 1
        else results[turned[0][0]]
        for turned in _list_turned_links(links)
    ]


def _list_turned_links(links: Sequence[Link]) -> list[list[tuple[int, float]]]:
    """By joint that follows no other: the links that it moves, itself first, with their ratios."""
    return [
        [(i, 1.0), *((k, link.ratio) for k, link in enumerate(links) if link.follows == i)]
        for i, own in enumerate(links)
        if own.follows < 0
    ]


def _extend_to_links(links: Sequence[Link], values: Sequence[Any], position: bool) -> list[Any]:
    """Positions, or their derivatives, of all joints by those of joints that follow no other."""
    results: list[Any] = [0] * len(links)
    for turned, value in zip(_list_turned_links(links), values, strict=True):
        for i, ratio in turned:
            results[i] = value if i == turned[0][0] else ratio * value
            if position and links[i].follows >= 0:
                results[i] = results[i] + links[i].zero
    return results


def columns(
    links: Sequence[Link],
    q: Sequence[Any],
    qd: Sequence[Any],
    qdd: Sequence[Any],
    gravity: Vector,
) -> list[list[list[Any]]]:
    """Return what one of each inertial number adds to each joint's force: [joint][link][number].

    Arguments as in `joint_forces`, of numbers.
    """
    moving = _link_motions(Algebra(), links, q, qd, qdd, gravity)
    results: list[list[list[Any]]] = [[[0] * INERTIAL for _ in links] for _ in links]
    felt: list[dict[int, tuple[Vector, Vector]]] = []
    for i, (link, at) in enumerate(zip(links, moving, strict=True)):
        # Effect of a moment and a force at this joint on each joint before it, in this frame.
        here: dict[int, tuple[Vector, Vector]] = {}
        for j, (turn, push) in felt[link.parent].items() if link.parent >= 0 else ():
            onward = _add(push, _cross(turn, at.offset))
            here[j] = at.from_parent(turn), at.from_parent(onward)
        here[i] = (ZERO, link.axis) if link.slides else (link.axis, ZERO)
        felt.append(here)
        by_number = _unit_wrenches(at)
        for j, (turn, push) in here.items():
            results[j][i] = [_dot(turn, moment) + _dot(push, force) for force, moment in by_number]
    table: list[list[list[Any]]] = []
    for (first, _), *others in _list_turned_links(links):
        rows = results[first]
        for i, ratio in others:
            pairs = [zip(*both, strict=True) for both in zip(rows, results[i], strict=True)]
            rows = [[x + ratio * y for x, y in numbers] for numbers in pairs]
        table.append(rows)
    return table


def _unit_wrenches(at: _LinkMotion) -> list[tuple[Vector, Vector]]:
    """Force and moment at the joint by each inertial number of the link."""
    x, y, z = at.rate
    dx, dy, dz = at.rate_change
    units: list[Vector] = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
    results: list[tuple[Vector, Vector]] = [(at.acceleration, ZERO)]
    results += [(_multiply(at.change, e), _cross(e, at.acceleration)) for e in units]
    moments: list[Vector] = [
        (dx, x * z, -x * y), (dy - x * z, dx + y * z, x * x - y * y),
        (dz + x * y, z * z - x * x, dx - y * z), (-y * z, dy, x * y),
        (y * y - z * z, dz - x * y, dy + x * z), (y * z, -x * z, dz),
    ]  # fmt: skip
    return results + [(ZERO, moment) for moment in moments]


def mass_matrix(
    algebra: Algebra, links: Sequence[Link], inertial: Sequence[Sequence[Any]], q: Sequence[Any]
) -> list[list[Any]]:
    """Return the mass matrix: column by column, the forces of a unit acceleration at rest."""
    n = len(q)
    mass: list[list[Any]] = [[0] * n for _ in range(n)]
    for j in range(n):
        unit = [int(i == j) for i in range(n)]
        forces = joint_forces(algebra, links, inertial, q, [0] * n, unit, ZERO)
        for i in range(j + 1):
            mass[i][j] = mass[j][i] = forces[i]
    return mass


def _link_motions(
    a: Algebra,
    links: Sequence[Link],
    q: Sequence[Any],
    qd: Sequence[Any],
    qdd: Sequence[Any],
    gravity: Vector,
) -> list[_LinkMotion]:
    results: list[_LinkMotion] = []
    still: tuple[Vector, Vector, Vector] = (ZERO, ZERO, ZERO)
    of_all = (_extend_to_links(links, values, k == 0) for k, values in enumerate((q, qd, qdd)))
    for link, x, v, w in zip(links, *of_all, strict=True):
        if link.parent >= 0:
            before = results[link.parent]
            rate, rate_change, change = before.rate, before.rate_change, before.change
            acceleration = before.acceleration
        else:
            rate, rate_change, change = ZERO, ZERO, still
            acceleration = _scale(-1, gravity)
        turn = _joint_rotation(a, link, x)

        def into(vector: Vector, link: Link = link, turn: Any = turn) -> Vector:
            return _multiply(link.rotation, _multiply(turn, vector))

        def out(vector: Vector, link: Link = link, turn: Any = turn) -> Vector:
            middle = _name_components(a, _multiply(_transpose(link.rotation), vector))
            return _multiply(_transpose(turn), middle)

        axis_before = _multiply(link.rotation, link.axis)
        offset = link.position
        if link.slides:
            offset = _name_components(a, _add(offset, _scale(x, axis_before)))
        here = _name_components(
            a, out(_name_components(a, _add(acceleration, _multiply(change, offset))))
        )
        own, own_change = _name_components(a, out(rate)), out(rate_change)
        if link.slides:
            along = _scale(2 * v, _cross(own, link.axis))
            here = _name_components(a, _add(here, _scale(w, link.axis), along))
            own_change = _name_components(a, own_change)
        else:
            twist = _scale(v, _cross(own, link.axis))
            own_change = _name_components(a, _add(own_change, twist, _scale(w, link.axis)))
            own = _name_components(a, _add(own, _scale(v, link.axis)))
        results.append(
            _LinkMotion(
                into, out, offset, here, _acceleration_matrix(a, own, own_change), own, own_change
            )
        )
    return results


def _joint_rotation(a: Algebra, link: Link, x: Any) -> tuple[Vector, Vector, Vector]:
    """Rotation about the joint's axis (Rodrigues); its columns are the turned axes."""
    if link.slides:
        return (1, 0, 0), (0, 1, 0), (0, 0, 1)
    s, c = a.name(a.sin(x)), a.name(a.cos(x))
    k = link.axis
    spin = ((0, -k[2], k[1]), (k[2], 0, -k[0]), (-k[1], k[0], 0))
    rows = []
    for i in range(3):
        row = []
        for j in range(3):
            square = k[i] * k[j]
            # For an axis along x, y or z only 0, 1, s and c remain.
            value = square if square in (0, 1) else square * (1 - c)
            if i == j and square != 1:
                value = value + c
            row.append(a.name(value + spin[i][j] * s) if spin[i][j] != 0 else a.name(value))
        rows.append((row[0], row[1], row[2]))
    return rows[0], rows[1], rows[2]


def _acceleration_matrix(
    a: Algebra, rate: Vector, rate_change: Vector
) -> tuple[Vector, Vector, Vector]:
    x, y, z = rate
    dx, dy, dz = rate_change
    xx, yy, zz = a.name(x * x), a.name(y * y), a.name(z * z)
    xy, xz, yz = a.name(x * y), a.name(x * z), a.name(y * z)
    return (
        _name_components(a, (-yy - zz, xy - dz, xz + dy)),
        _name_components(a, (xy + dz, -xx - zz, yz - dx)),
        _name_components(a, (xz - dy, yz + dx, -xx - yy)),
    )


def _name_components(a: Algebra, vector: Vector) -> Vector:
    return a.name(vector[0]), a.name(vector[1]), a.name(vector[2])


def _symmetric_matrix(values: Sequence[Any]) -> tuple[Vector, Vector, Vector]:
    xx, xy, xz, yy, yz, zz = values
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def _dot(one: Vector, other: Vector) -> Any:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _multiply(matrix: tuple[Vector, Vector, Vector], vector: Vector) -> Vector:
    return _dot(matrix[0], vector), _dot(matrix[1], vector), _dot(matrix[2], vector)


def _transpose(matrix: tuple[Vector, Vector, Vector]) -> tuple[Vector, Vector, Vector]:
    first, second, third = zip(*matrix, strict=True)
    return first, second, third


def _scale(factor: Any, vector: Vector) -> Vector:
    return factor * vector[0], factor * vector[1], factor * vector[2]


def _add(*vectors: Vector) -> Vector:
    first, second, third = (sum(parts[1:], parts[0]) for parts in zip(*vectors, strict=True))
    return first, second, third


def _cross(one: Vector, other: Vector) -> Vector:
    return (
        one[1] * other[2] - one[2] * other[1],
        one[2] * other[0] - one[0] * other[2],
        one[0] * other[1] - one[1] * other[0],
    )
