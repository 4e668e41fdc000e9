"""From declarations to equations of motion: Lagrange's equation on the model's energies (eqs 9-14).

M(q) qdd + h(q, qd) = Q_applied + Q_other, where Q_applied comes from the measured input (eq 19) and
Q_other from friction (eq 20), brakes (eq 18), compensators and the effects of kind ``torque``.
The bodies of a robot enter by Newton and Euler's equations instead: `newton_euler`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import sympy as sp

from bampipe.errors import InputError
from bampipe.physics.device import LAST_ORDER, derivative
from bampipe.physics.equations import Equations
from bampipe.physics.lagrange import allow, check_inertia, lagrange
from bampipe.physics.model import Model
from bampipe.physics.newton_euler import (
    INERTIAL,
    Algebra,
    Link,
    Text,
    Vector,
    joint_forces,
    mass_matrix,
    potential_energy,
)
from bampipe.physics.robot import gravity_vector
from bampipe.physics.roles import compensation, delays
from bampipe.physics.signals import ActingInputs, order_of_action
from bampipe.physics.time_limit import OutOfTime, time_limit
from bampipe.physics.vocabulary import Vocabulary, constant_symbol

LONGEST_S = 60.0
"""Processor time that a derivation may take: the BAM takes 1 s, a planar arm with four links 23 s.
Sympy's simplification has no bound of its own: 17 operations can take it an hour."""


def derive(model: Model, named_constants: bool = False) -> Equations:
    """Derive the equations of motion of ``model``.

    Args:
        model: the device and its effects.
        named_constants: leave the device's constants as symbols, for people to read.

    Raises:
        InputError: an expression uses a name that does not exist there, the mass matrix is
            singular everywhere, or the derivation takes more than `LONGEST_S`.
    """
    try:
        with time_limit(LONGEST_S):
            return _derive(model, named_constants)
    except OutOfTime:
        raise InputError(
            f"deriving the equations of motion takes more than {LONGEST_S:g} s",
            where=f"device {model.device.name!r}",
            remedy="use fewer or shorter expressions",
        ) from None


def _derive(model: Model, named_constants: bool) -> Equations:
    d = Vocabulary(model, named_constants)
    constants = [constant_symbol(c) for c in model.device.constants if named_constants]
    device, axes = model.device, d.axes
    n = len(axes)
    raw_applied = d.table(device.applied, "applied")
    side = d.table(device.side_load, "side_load")
    forces = [d.channel[f] for f in device.forces]
    input_map = [
        [sp.diff(e, f) if f in e.free_symbols else sp.S.Zero for f in forces] for e in raw_applied
    ]

    signals = ActingInputs(d, model.effects, raw_applied, side)
    applied = [signals.put_in(e) for e in raw_applied]

    noise = [*device.forces, *device.process_noise]
    w = [sp.Symbol(f"w{i}", real=True) for i in range(len(noise))]
    noisy = signals.acting | {f: signals.acting.get(f, f) + w[i] for i, f in enumerate(forces)}
    applied_noise = [e.subs(noisy, simultaneous=True) for e in raw_applied]

    kinetic = d.build(device.kinetic, d.base, "energy.kinetic")
    potential = d.build(device.potential, d.base, "energy.potential")
    other = _device_torque(d, w)

    label = f"device {device.name!r}: energy.kinetic"
    energies = [(label, device.kinetic, kinetic, potential)] if device.energy else []
    offset = [sp.S.Zero] * n
    # An offset is differentiated. It cannot follow the rates, so what a motor's back EMF takes off
    # is left out of its load; nor states, so a lagging force counts as logged; and a delayed force
    # is delayed to one order less in it.
    prompt = ActingInputs(d, [e for e in model.effects if not e.effect.states], raw_applied, side)
    lost = [d.channel[derivative(f, LAST_ORDER)] for f in device.forces]
    none = dict.fromkeys([*d.qd, *lost], 0)
    still = [prompt.put_in(e).subs(none) for e in raw_applied]
    # Up to where the logged inputs are replaced by what acts of them, all is in terms of these.
    delivered = list(raw_applied)
    pulling = [sp.S.Zero] * n
    of_states: dict[Any, tuple[Any, Any]] = {
        z: (r, signals.initial[z]) for z, r in signals.rates.items()
    }
    for item in order_of_action(model.effects):
        if "dry" in item.effect.names:
            d.dry = _dry_friction(d, other)
        if item.effect.uses_weight:
            d.weight = [sp.diff(sum(v for *_, v in energies), q) for q in d.q]
            d.pull = [w - t for w, t in zip(d.weight, pulling, strict=True)]
        measures = item.effect.kind == "measurement"
        symbols = d.effect_symbols(item, still if measures else delivered, side)
        for key, tree in item.effect.expressions.items():
            place = item.target_of(key)
            if item.effect.kind == "input":
                continue
            value = d.rebuild_for(item, tree, symbols, key)
            label = f"effect {item.name!r}: {key}"
            if key == "kinetic":
                energies.append((label, tree, value, sp.S.Zero))
            elif key == "potential":
                energies.append((label, tree, sp.S.Zero, value))
            elif place not in axes:
                raise InputError(f"effect {item.name!r}: {key}: device has no axis {place!r}")
            elif measures:
                behind = {q: q + o for q, o in zip(d.q, offset, strict=True) if o != 0}
                offset[axes.index(place)] += value.subs(behind, simultaneous=True)
            else:
                other[axes.index(place)] += value
                if item.effect.pulls:
                    pulling[axes.index(place)] += value
                if item.effect.acting_link:
                    delivered[axes.index(place)] += value
        for state in item.effect.states if item.effect.kind != "input" else ():
            rate = d.rebuild_for(item, state.rate, symbols, f"states.{state.name}.rate")
            first = d.rebuild_for(item, state.initial, symbols, f"states.{state.name}.initial")
            z = d.z[item.prefix, state.name]
            of_states[z] = signals.put_in(rate), signals.put_in_initial(first)
    other = [signals.put_in(e) for e in other]
    z_names = [".".join(key) for key in d.z]
    rates, initial = ([of_states[z][k] for z in d.z.values()] for k in (0, 1))
    others = [d.channel[c] for c in device.channels]
    free, u = [*d.p.values(), *constants], [*d.channel.values()]
    force0 = [d.channel[derivative(f, k)] for f in device.forces for k in range(LAST_ORDER)]
    force0 += [*others, d.channel["t"]]
    motion, memory = [*d.q, *d.qd], [*d.z.values()]
    gains = [entry for row in input_map for entry in row]
    words = "motion, inputs, parameters and internal states"
    kinetics, potentials = [e[2] for e in energies], [e[3] for e in energies]
    allow("the kinetic energy", [*kinetics], [*motion, *free], "positions, rates and parameters")
    allow("the potential energy", [*potentials], [*d.q, *free], "positions and parameters")
    allow(
        "the effect of a force on the axes",
        gains,
        [*d.q, *others, *free],
        "positions, parameters and channels that are no forces",
    )
    allow("a torque", other, [*motion, *u, *free, *memory, *w], words)
    allow("the applied force", applied, [*motion, *u, *free, *memory], words)
    allow("the rate of an internal state", rates, [*motion, *u, *free, *memory], words)
    allow("an initial value", initial, [*d.q, *u, *free], "positions, inputs and parameters")
    allow("an offset", offset, [*d.q, *force0, *free], "positions, forces and parameters")

    terms = []
    for label, tree, a, b in energies:
        try:
            terms.append(lagrange(a, b, tuple(d.q), tuple(d.qd)))
        except OutOfTime:
            raise d.too_long(tree, label) from None
    mass = [[sum((t[0][i][j] for t in terms), sp.S.Zero) for j in range(n)] for i in range(n)]
    bias = [sum((t[1][i] for t in terms), sp.S.Zero) for i in range(n)]
    for row, term in zip(mass, bias, strict=True):
        allow("the equation of motion", [*row, term], [*motion, *free], "motion and parameters")
    kinetic, potential = sum(kinetics, sp.S.Zero), sum(potentials, sp.S.Zero)
    dynamics = [
        h + sum(m * x for m, x in zip(row, d.qdd, strict=True))
        for h, row in zip(bias, mass, strict=True)
    ]
    bodies = _bodies(d)
    if bodies is None:
        check_inertia(model, mass, [*d.q, *constants])
    else:
        mass = [
            [m + b for m, b in zip(*rows, strict=True)]
            for rows in zip(mass, bodies.mass, strict=True)
        ]
        bias = [h + b for h, b in zip(bias, bodies.bias, strict=True)]
        dynamics = [h + b for h, b in zip(dynamics, bodies.dynamics, strict=True)]
        kinetic, potential = kinetic + bodies.kinetic, potential + bodies.potential

    offset_rate = [d.ddt(e) for e in offset]
    parts = [
        *applied_noise,
        *other,
        *rates,
        *initial,
        *offset,
        *offset_rate,
    ]
    used = set().union(*(e.free_symbols for e in [*parts, *raw_applied]))
    inputs = [c for c in d.channels if d.channel[c] in used or c in device.forces]
    residual = [a + o - f for a, o, f in zip(applied, other, dynamics, strict=True)]
    linear: list[bool] = []
    products: list[tuple[int, int]] = []
    constant: list[bool] = []
    unforced: list[bool] = []
    lasting: list[dict[int, Any] | None] = []
    varying = {*d.p.values(), *d.z.values()}
    # An expression has few of a robot's hundred parameters, and sympy is slow to find a slope zero.
    present = [(i, e, e.free_symbols) for i, e in enumerate(residual)]
    elsewhere: set[Any] = set().union(*(e.free_symbols for e in [*rates, *offset]))
    steps = bodies.steps if bodies else []
    bodily: set[Any] = set().union(*(value.free_symbols for _, value in steps))
    of_bodies: list[int] = []
    named, quiet = {name for name, _ in steps}, dict.fromkeys(w, 0)
    for i, symbol in enumerate(d.p.values()):
        by_axis = {k: sp.diff(e, symbol) for k, e, symbols in present if symbol in symbols}
        slopes = list(by_axis.values())
        left: set[Any] = set().union(*(s.free_symbols for s in slopes))
        curved = symbol in left and any(sp.diff(slope, symbol) != 0 for slope in slopes)
        linear.append(not curved and symbol not in elsewhere)
        constant.append(linear[i] and not left & varying)
        unforced.append(constant[i] and left.isdisjoint(d.channel.values()))
        if symbol in bodily and not by_axis:
            of_bodies.append(i)
        lasting.append(
            {k: s.subs(quiet) for k, s in by_axis.items()}
            if constant[i] and symbol not in bodily and left.isdisjoint(named)
            else None
        )
        for j, earlier in enumerate([*d.p.values()][:i]):
            if earlier in left and any(sp.diff(slope, earlier) != 0 for slope in slopes):
                products.append((j, i))
    return Equations(
        q=d.q, qd=d.qd, qdd=d.qdd, z=[*d.z.values()], z_names=z_names,
        u=[d.channel[c] for c in inputs], inputs=inputs,
        p=list(d.p.values()), w=w, noise=noise,
        steps=steps,
        mass=mass, bias=bias, dynamics=dynamics, other=other,
        applied=applied, applied_noise=applied_noise,
        input_map=input_map, rates=rates, initial=initial,
        offset=offset, offset_rate=offset_rate,
        kinetic=kinetic, potential=potential, linear=linear, products=products, constant=constant,
        unforced=unforced, lasting=lasting, of_bodies=of_bodies,
        compensation=compensation(d, potential), delays=delays(d, applied),
    )  # fmt: skip


@dataclass(frozen=True)
class _Bodies:
    """What the bodies of a robot put into the equations, by names in ``steps``."""

    steps: list[tuple[Any, Any]]
    mass: list[list[Any]]
    bias: list[Any]
    dynamics: list[Any]
    kinetic: Any
    potential: Any


def _bodies(d: Vocabulary) -> _Bodies | None:
    """Newton and Euler's equations of the bodies; None where the device is no robot."""
    robot = d.model.device.robot
    if robot is None:
        return None
    numbers = tuple(d.p[p.name] for p in robot.parameters)
    motion = tuple(d.q), tuple(d.qd), tuple(d.qdd)
    return _newton_euler(robot.links, gravity_vector(robot), numbers, motion)


@cache
def _newton_euler(
    links: tuple[Link, ...],
    gravity: Vector,
    numbers: tuple[Any, ...],
    motion: tuple[tuple[Any, ...], ...],
) -> _Bodies:
    """Every candidate effect of a robot has the same bodies: written once a process."""
    q, qd, qdd = motion
    text = Text()
    algebra = Algebra.symbols(text)
    inertial = [numbers[k : k + INERTIAL] for k in range(0, len(numbers), INERTIAL)]
    still = [0] * len(q)
    # Names for all of it: one compiled function gives them to every model of this robot.
    mass = [[text.name(m) for m in row] for row in mass_matrix(algebra, links, inertial, q)]
    bias, dynamics = (
        [text.name(f) for f in joint_forces(algebra, links, inertial, q, qd, a, gravity)]
        for a in (still, qdd)
    )
    momentum = [sum(m * v for m, v in zip(row, qd, strict=True)) for row in mass]
    return _Bodies(
        text.steps,
        mass,
        bias,
        dynamics,
        sum(p * v for p, v in zip(momentum, qd, strict=True)) / 2,
        potential_energy(algebra, links, inertial, q, gravity),
    )


def _device_torque(d: Vocabulary, w: list[Any]) -> list[Any]:
    """Q_other of the device without effects: its own torques, friction, brakes, process noise."""
    device = d.model.device
    other = d.table(device.torque, "torque")
    for i, c in enumerate(device.coordinates):
        sign = d.sgn(d.qd[i])
        if c.name in device.friction:
            other[i] -= d.p[f"viscous.{c.name}"] * d.qd[i] + d.p[f"coulomb.{c.name}"] * sign
        if c.name in device.brakes:
            other[i] -= d.channel[device.brakes[c.name]] * sign
    for k, name in enumerate(device.process_noise):
        gains = d.table(device.process_noise[name].torque, f"process_noise.{name}")
        other = [e + g * w[len(device.forces) + k] for e, g in zip(other, gains, strict=True)]
    return other


def _dry_friction(d: Vocabulary, other: list[Any]) -> list[Any]:
    """What of ``other`` turns with the sign of the motion, by axis."""
    slid = sp.Dummy()
    signs = [d.sgn(rate) for rate in d.qd]
    return [-sp.diff(e.subs(sign, slid), slid) for e, sign in zip(other, signs, strict=True)]
