"""The symbolic equations of motion of a model, and the terms of its effects."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import sympy as sp


@dataclass(frozen=True)
class Dependence:
    """How the residual of a model depends on each of its parameters, by number.

    Attributes:
        linear: whether it is linear in the parameter.
        products: pairs of parameters of which it has a product.
        constant: whether its slope depends on no parameter and no internal state.
        lasting: that slope by axis, None if it is not constant or involves `Equations.steps`.
        of_bodies: parameters that appear in those steps alone.
    """

    linear: list[bool]
    products: list[tuple[int, int]]
    constant: list[bool]
    lasting: list[dict[int, Any] | None]
    of_bodies: list[int]


@dataclass(frozen=True)
class Equations:
    """Symbolic equations of a model; lists are in the order of the names they belong to.

    Attributes:
        q, qd, qdd: coordinates and their rates.
        z, z_names: internal states of effects; changes: by state, the symbol of its rate of change
        along a motion, where a torque depends on that.
        u, inputs: input symbols that the model uses, and their channel names.
        p, w, noise: parameters; additive process noise and its names. steps: named intermediates of
        a robot's bodies, and their values; each may use earlier ones, and everything below may use
        them.
        mass: mass matrix, n by n.
        bias: h(q, qd): Coriolis, centrifugal and potential terms.
        dynamics: mass times acceleration plus bias.
        other: Q_other; applied: Q_applied; noise_force: the generalised force of the process noise.
        input_map: d applied / d force of the device itself.
        rates, initial: of the internal states.
        offset, offset_rate: q_true - q_measured and its time derivative.
        kinetic, potential: declared energies, definitions put in; without those of a robot's
            bodies.
        dependence: of the residual on each parameter.
        compensation: per coordinate, the part of Q_other that balances gravity there;
            zero without one.
        delays: parameters that shift measured forces in time.
    """

    q: list[Any]
    qd: list[Any]
    qdd: list[Any]
    z: list[Any]
    z_names: list[str]
    changes: dict[Any, Any]
    u: list[Any]
    inputs: list[str]
    p: list[Any]
    w: list[Any]
    noise: list[str]
    steps: list[tuple[Any, Any]]
    mass: list[list[Any]]
    bias: list[Any]
    dynamics: list[Any]
    other: list[Any]
    applied: list[Any]
    noise_force: list[Any]
    input_map: list[list[Any]]
    rates: list[Any]
    initial: list[Any]
    offset: list[Any]
    offset_rate: list[Any]
    kinetic: Any
    potential: Any
    dependence: Dependence
    compensation: list[Any]
    delays: list[str]

    def groups(self, names: str) -> dict[str, list[Any]]:
        """Symbols by argument of a function, ``names`` between spaces; `changes` follow ``z``."""
        found = {name: getattr(self, name) for name in names.split()}
        return found | ({"z": [*self.z, *self.changes.values()]} if "z" in found else {})

    @property
    def other_now(self) -> list[Any]:
        """``other`` at an instant, with the rates of change of the states from their equations."""
        now = {change: self.rates[self.z.index(z)] for z, change in self.changes.items()}
        return [sp.sympify(e, strict=True).subs(now) for e in self.other]

    @property
    def required(self) -> list[Any]:
        """The generalised force that a motion requires, by axis."""
        return [f - o for f, o in zip(self.dynamics, self.other, strict=True)]

    @property
    def residual(self) -> list[Any]:
        """Q_applied less that."""
        return [a - r for a, r in zip(self.applied, self.required, strict=True)]


def contribution(full: Equations, bare: Equations) -> list[Any]:
    """Return the terms of the effects in ``full`` beyond the residual of ``bare``, by axis."""
    added = []
    for i in range(len(full.q)):
        inertia = sum(
            (m - n) * a for m, n, a in zip(full.mass[i], bare.mass[i], full.qdd, strict=True)
        )
        force = full.applied[i] - bare.applied[i] + full.other[i] - bare.other[i]
        added.append(sp.sympify(force - (full.bias[i] - bare.bias[i]) - inertia, strict=True))
    return added


def join_overlapping(sets: Iterable[set[Any]]) -> list[set[Any]]:
    """Join sets that share an element."""
    joined: list[set[Any]] = []
    for one in sets:
        touching = [s for s in joined if s & one]
        joined = [s for s in joined if not s & one] + [one.union(*touching)]
    return joined
