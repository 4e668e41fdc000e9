"""From declarations to equations of motion: Lagrange's equation on the model's energies (eqs 9-14).

M(q) qdd + h(q, qd) = Q_applied + Q_other, where Q_applied comes from the measured input (eq 19) and
Q_other from friction (eq 20), brakes (eq 18), compensators and the effects of kind ``torque``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import sympy as sp

from bampipe.errors import InputError
from bampipe.physics.device import INPUT_ORDERS, LAST_ORDER, derivative
from bampipe.physics.effect import EACH
from bampipe.physics.equations import Equations
from bampipe.physics.lagrange import allow, check_inertia, lagrange
from bampipe.physics.model import Model
from bampipe.physics.roles import compensation, delays
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
    input_map = [[sp.diff(e, f) for f in forces] for e in raw_applied]

    corrections = _corrections(d, raw_applied, side)
    truth = {d.channel[f]: d.channel[f] + c for f, c in corrections.items() if c != 0}
    applied = [e.subs(truth, simultaneous=True) for e in raw_applied]

    noise = [*device.forces, *device.process_noise]
    w = [sp.Symbol(f"w{i}", real=True) for i in range(len(noise))]
    noisy = truth | {
        d.channel[f]: d.channel[f] + corrections[f] + w[i] for i, f in enumerate(device.forces)
    }
    applied_noise = [e.subs(noisy, simultaneous=True) for e in raw_applied]

    kinetic = d.build(device.kinetic, d.base, "energy.kinetic")
    potential = d.build(device.potential, d.base, "energy.potential")
    other = _device_torque(d, truth, w)

    label = f"device {device.name!r}: energy.kinetic"
    energies = [(label, device.kinetic, kinetic, potential)]
    offset = [sp.S.Zero] * n
    z, z_names, rates, initial = [], [], [], []
    # An offset is differentiated twice. It cannot follow the rates, so what a motor's back EMF
    # takes off is left out of its load; nor states, so a lagging force counts as logged; and a
    # delayed force is delayed to two orders less in it.
    known = {f: e for f, e in truth.items() if not e.has(*d.z.values())}
    offset_orders = range(LAST_ORDER - 1)
    lost = [
        d.channel[derivative(f, k)] for f in device.forces for k in (LAST_ORDER - 1, LAST_ORDER)
    ]
    none = dict.fromkeys([*d.qd, *lost], 0)
    still = [e.subs(known, simultaneous=True).subs(none) for e in raw_applied]
    for item in model.effects:
        loaded = still if item.effect.kind == "measurement" else applied
        symbols = d.effect_symbols(item, loaded, side)
        for key, tree in item.effect.expressions.items():
            place = key.partition(".")[2] or item.target
            if item.effect.kind == "input":
                continue
            value = d.own(item, tree, symbols, key)
            label = f"effect {item.name!r}: {key}"
            if key == "kinetic":
                energies.append((label, tree, value, sp.S.Zero))
            elif key == "potential":
                energies.append((label, tree, sp.S.Zero, value))
            elif place not in axes:
                raise InputError(f"effect {item.name!r}: {key}: device has no axis {place!r}")
            elif item.effect.kind == "torque":
                other[axes.index(place)] += value
            else:
                offset[axes.index(place)] += value
        for state in item.effect.states:
            z.append(d.z[item.prefix, state.name])
            z_names.append(f"{item.prefix}.{state.name}")
            rates.append(d.own(item, state.rate, symbols, f"states.{state.name}.rate"))
            initial.append(d.own(item, state.initial, symbols, f"states.{state.name}.initial"))
    others = [d.channel[c] for c in device.channels]
    free, u = [*d.p.values(), *constants], [*d.channel.values()]
    force0 = [d.channel[derivative(f, k)] for f in device.forces for k in offset_orders]
    force0 += [*others, d.channel["t"]]
    motion, memory = [*d.q, *d.qd], [*d.z.values()]
    gains = [entry for row in input_map for entry in row]
    words = "motion, inputs, parameters and internal states"
    _, _, kinetics, potentials = zip(*energies, strict=True)
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
    mass = [[sum(t[0][i][j] for t in terms) for j in range(n)] for i in range(n)]
    bias = [sum(t[1][i] for t in terms) for i in range(n)]
    for row, term in zip(mass, bias, strict=True):
        allow("the equation of motion", [*row, term], [*motion, *free], "motion and parameters")
    check_inertia(model, mass, [*d.q, *constants])
    kinetic, potential = sum(kinetics), sum(potentials)

    offset_rate = [d.ddt(e) for e in offset]
    offset_acceleration = [d.ddt(e) for e in offset_rate]
    parts = [
        *applied_noise,
        *other,
        *rates,
        *initial,
        *offset,
        *offset_rate,
        *offset_acceleration,
    ]
    used = set().union(*(e.free_symbols for e in [*parts, *raw_applied]))
    inputs = [c for c in d.channels if d.channel[c] in used or c in device.forces]
    residual = [
        a + o - h - sum(m * x for m, x in zip(row, d.qdd, strict=True))
        for a, o, h, row in zip(applied, other, bias, mass, strict=True)
    ]
    moved = [*offset, *offset_rate, *offset_acceleration]
    linear = []
    for p in model.parameters:
        symbol = d.p[p.name]
        curved = any(sp.diff(e, symbol, 2) != 0 for e in residual)
        linear.append(not curved and not any(e.has(symbol) for e in [*rates, *moved]))
    return Equations(
        q=d.q, qd=d.qd, qdd=d.qdd, z=z, z_names=z_names,
        u=[d.channel[c] for c in inputs], inputs=inputs,
        p=list(d.p.values()), w=w, noise=noise,
        mass=mass, bias=bias, other=other, applied=applied, applied_noise=applied_noise,
        input_map=input_map, rates=rates, initial=initial,
        offset=offset, offset_rate=offset_rate, offset_acceleration=offset_acceleration,
        kinetic=kinetic, potential=potential, linear=linear,
        compensation=compensation(d, potential), delays=delays(d, applied),
    )  # fmt: skip


def _corrections(d: Vocabulary, raw_applied: list[Any], side: list[Any]) -> dict[str, Any]:
    """What effects of kind ``input`` add to each force and channel that they act on."""
    model, device = d.model, d.model.device
    corrections = dict.fromkeys((*device.forces, *device.channels), sp.S.Zero)
    for item in (e for e in model.effects if e.effect.kind == "input"):
        for key, tree in item.effect.expressions.items():
            symbols = d.effect_symbols(item, raw_applied, side)
            force = key.partition(".")[2]
            if not force:
                force = item.target if item.effect.scope == "channel" else d.targeted(item)[0]
            for name in device.forces if force == EACH else (force,):
                if name not in corrections:
                    raise InputError(f"effect {item.name!r}: device has no input {name!r}")
                if force == EACH:
                    orders = range(len(INPUT_ORDERS))
                    symbols |= {derivative("f", k): d.channel[derivative(name, k)] for k in orders}
                corrections[name] += d.own(item, tree, symbols, key) - d.channel[name]
    return corrections


def _device_torque(d: Vocabulary, truth: Mapping[Any, Any], w: list[Any]) -> list[Any]:
    """Q_other of the device without effects: its own torques, friction, brakes, process noise.

    Dry friction, what turns with the sign of the motion, is noted in ``d.dry``.
    """
    device = d.model.device
    other = [e.subs(truth, simultaneous=True) for e in d.table(device.torque, "torque")]
    for i, c in enumerate(device.coordinates):
        sign = d.sgn(d.qd[i])
        if c.name in device.friction:
            other[i] -= d.p[f"viscous.{c.name}"] * d.qd[i] + d.p[f"coulomb.{c.name}"] * sign
        slid = sp.Dummy()
        d.dry[i] = -sp.diff(sp.sympify(other[i]).subs(sign, slid), slid)
        if c.name in device.brakes:
            other[i] -= d.channel[device.brakes[c.name]] * sign
    for k, name in enumerate(device.process_noise):
        gains = d.table(device.process_noise[name].torque, f"process_noise.{name}")
        other = [e + g * w[len(device.forces) + k] for e, g in zip(other, gains, strict=True)]
    return other
