"""From declarations to equations of motion: Lagrange's equation on the model's energies (eqs 9-14).

M(q) qdd + h(q, qd) = Q_applied + Q_other, where Q_applied comes from the measured input (eq 19) and
Q_other from friction (eq 20), brakes (eq 18), compensators and the effects of kind ``torque``.
The bodies of a robot enter by Newton and Euler's equations instead: `newton_euler`.
"""

import ast
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from bampipe.errors import InputError
from bampipe.physics.device import LAST_ORDER, derivative
from bampipe.physics.effect import Ahead, BoundEffect
from bampipe.physics.equations import Dependence, Equations
from bampipe.physics.lagrange import allow, check_inertia, lagrange
from bampipe.physics.model import Model
from bampipe.physics.newton_euler import INERTIAL, Link, Text, Vector, joint_forces
from bampipe.physics.robot import gravity_vector
from bampipe.physics.signals import ActingInputs, order_of_action
from bampipe.physics.time_limit import OutOfTime, time_limit
from bampipe.physics.vocabulary import Symbols, Vocabulary

LONGEST_S = 60.0
"""Processor time that a derivation may take: the BAM takes 1 s, a planar arm with four links 23 s.
Sympy's simplification has no bound of its own: 17 operations can take it an hour."""
_LARGE = 100
"""A slope with more operations than this is not differentiated again."""


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
            return _assemble_equations(Vocabulary(model, named_constants))
    except OutOfTime:
        raise InputError(
            f"deriving the equations of motion takes more than {LONGEST_S:g} s",
            where=f"device {model.device.name!r}",
            remedy="use fewer or shorter expressions",
        ) from None


def _assemble_equations(d: Vocabulary) -> Equations:
    device, acting = d.model.device, ActingInputs(d, d.model.effects)
    noise = [*device.forces, *device.process_noise]
    w = [sp.Symbol(f"w{i}", real=True) for i in range(len(noise))]
    noise_force = acting.find_noise(w)
    for name, symbol in zip(device.process_noise, w[len(device.forces) :], strict=True):
        gains = d.table(device.process_noise[name].torque, f"process_noise.{name}")
        noise_force = [e + g * symbol for e, g in zip(noise_force, gains, strict=True)]
    terms = _collect_terms(d, acting)
    inertia = _take_inertia(d, terms.other)
    _check_dependence(d, acting, terms, noise_force, w)
    motion = _combine_motion(d, terms.energies, inertia)
    offset_rate = [d.ddt(e) if e != 0 else e for e in terms.offset]
    rates, initial = ([entry[k] for entry in terms.states.values()] for k in (0, 1))
    force = _add(acting.applied, terms.other)
    parts = [*force, *noise_force, *rates, *initial, *terms.offset, *offset_rate]
    used_symbols = _collect_symbols([*parts, *acting.logged])
    inputs = [c for c in d.channels if d.channel[c] in used_symbols or c in device.forces]
    residual = [f - r for f, r in zip(force, motion.dynamics, strict=True)]
    kinetic, potential = (sp.Add(*(e[k] for e in terms.energies)) for k in (2, 3))
    return Equations(
        q=d.q, qd=d.qd, qdd=d.qdd, z=[*d.z.values()], z_names=[".".join(key) for key in d.z],
        changes=d.changes,
        u=[d.channel[c] for c in inputs], inputs=inputs,
        p=list(d.p.values()), w=w, noise=noise,
        steps=motion.steps, mass=motion.mass, bias=motion.bias, dynamics=motion.dynamics,
        other=terms.other, applied=acting.applied, noise_force=noise_force,
        input_map=acting.input_map, rates=rates, initial=initial,
        offset=terms.offset, offset_rate=offset_rate,
        kinetic=kinetic, potential=potential,
        dependence=_find_dependence(d, residual, [*rates, *terms.offset], motion.steps),
        compensation=_find_compensation(d, potential, acting),
        delays=_find_delays(d, [*acting.applied, *rates]),
    )  # fmt: skip


def _collect_symbols(expressions: Iterable[Any]) -> set[Any]:
    return set().union(*(e.free_symbols for e in expressions))


class _Energy(NamedTuple):
    """A contribution to the energies, and its declared expression, for messages."""

    label: str
    tree: ast.expr
    kinetic: Any
    potential: Any


@dataclass(frozen=True)
class _Terms:
    """Terms of device and effects in the equations beside the applied force and bodies.

    Attributes:
        energies: contributions to the energies.
        other: Q_other, an expression an axis; offset: true position minus measured.
        states: by symbol of an internal state, its rate and its initial value.
    """

    energies: list[_Energy]
    other: list[Any]
    offset: list[Any]
    states: dict[Any, tuple[Any, Any]]


def _collect_terms(d: Vocabulary, inputs: ActingInputs) -> _Terms:
    """Build the expressions of the device and of each effect, in the order in which they act."""
    device = d.model.device
    acting = [e for e in order_of_action(d.model.effects) if e.effect.kind != "input"]
    kinetic = d.build(device.kinetic, d.base, "energy.kinetic")
    potential = d.build(device.potential, d.base, "energy.potential")
    label = f"device {device.name!r}: energy.kinetic"
    energies = [_Energy(label, device.kinetic, kinetic, potential)] if device.energy else []
    torque = d.table(device.torque, "torque")
    d.support, other = [*torque], _add_friction(d, torque)
    offset = [sp.S.Zero for _ in d.axes]
    measures = any(e.effect.kind == "measurement" for e in acting)
    prompt_force = _find_prompt_forces(d) if measures else []
    # All is in terms of the logged inputs until they are replaced by their acting parts.
    delivered_force, pull = list(inputs.logged), [sp.S.Zero for _ in d.axes]
    states = {z: (rate, inputs.initial[z]) for z, rate in inputs.rates.items()}
    for item in acting:
        effect, by_axis = item.effect, offset if item.effect.kind == "measurement" else other
        if "dry" in effect.names:
            _fill_dry_friction(d, other, d.axes.index(item.target))
        if effect.uses_weight:
            d.weight = [sp.diff(sum(e.potential for e in energies), q) for q in d.q]
            d.pull = [w - t for w, t in zip(d.weight, pull, strict=True)]
        if effect.uses_inertia:
            known = _apply_lagrange(d, energies)
            d.inertia = [row[i] for i, row in enumerate(known.mass)]
            d.bias = [h - t for h, t in zip(known.bias, torque, strict=True)]
            if not d.changes:  # an effect with play knows of no other
                d.torque = [e - t for e, t in zip(other, torque, strict=True)]
        symbols = d.effect_symbols(
            item, prompt_force if by_axis is offset else delivered_force, inputs.side
        )
        if effect.ahead is not None:
            for i, added in enumerate(_move_bias(d, item, effect.ahead, symbols)):
                other[i] += added
        for key, tree in effect.expressions.items():
            value, place = d.build(tree, symbols, key, item), item.target_of(key)
            label = f"effect {item.name!r}: {key}"
            if effect.kind == "energy":
                pair = (value, sp.S.Zero) if key == "kinetic" else (sp.S.Zero, value)
                energies.append(_Energy(label, tree, *pair))
                continue
            if place not in d.axes:
                raise InputError(f"{label}: device has no axis {place!r}")
            axis = d.axes.index(place)
            if by_axis is offset:
                behind = {q: q + o for q, o in zip(d.q, offset, strict=True) if o != 0}
                value = value.subs(behind, simultaneous=True)
            by_axis[axis] += value
            if effect.pulls:
                pull[axis] += value
            if effect.is_part_of_support(device):
                d.support[axis] += value
            if by_axis is other and effect.acting_link:
                delivered_force[axis] += value
        states |= {z: (rate, start) for z, rate, start in inputs.build_states(item, symbols)}
    other = [inputs.put_in(e) for e in other]
    return _Terms(energies, other, offset, {z: states[z] for z in d.z.values()})


def _move_bias(d: Vocabulary, item: BoundEffect, ahead: Ahead, symbols: Symbols) -> list[Any]:
    """Evaluate the bias at the mechanism, ahead of an encoder; return the added terms, by axis."""
    i = d.axes.index(item.target)
    position = d.build(ahead.position, symbols, "ahead.position", item)
    rate = d.build(ahead.rate, symbols, "ahead.rate", item)
    true = {d.q[i]: d.q[i] + position, d.qd[i]: d.qd[i] + rate}
    moved = [h.subs(true, simultaneous=True) for h in d.bias]
    symbols["axis_bias"] = moved[i]
    d.with_definitions(item, symbols)
    share = d.build(ahead.share, symbols, "ahead.share", item)
    return [share * (h - m) for h, m in zip(d.bias, moved, strict=True)]


def _find_prompt_forces(d: Vocabulary) -> list[Any]:
    """Generalised forces that an offset may follow, by axis.

    An offset is differentiated. It cannot follow the rates, so its load excludes a motor's back
    EMF; nor states, so a lagging force counts as logged; and a delayed force is delayed to one
    order less in it.
    """
    inputs = ActingInputs(d, (e for e in d.model.effects if not e.effect.states))
    lost = [d.channel[derivative(f, LAST_ORDER)] for f in d.model.device.forces]
    zeros = dict.fromkeys([*d.qd, *lost], 0)
    return [e.subs(zeros) for e in inputs.applied]


def _add_friction(d: Vocabulary, torque: Sequence[Any]) -> list[Any]:
    """Q_other of the device without effects: its own ``torque``, friction, brakes."""
    device, other = d.model.device, [*torque]
    for i, c in enumerate(device.coordinates):
        sign = d.sgn(d.qd[i])
        if c.name in device.friction:
            other[i] -= d.p[f"viscous.{c.name}"] * d.qd[i] + d.p[f"coulomb.{c.name}"] * sign
        if c.name in device.brakes:
            other[i] -= d.channel[device.brakes[c.name]] * sign
    return other


def _fill_dry_friction(d: Vocabulary, other: Sequence[Any], axis: int) -> None:
    """Fill `Vocabulary.dry` of an axis from the terms ``other``, one an axis."""
    sign = d.sgn(d.qd[axis])
    back, rest, ahead = (other[axis].subs(sign, s) for s in (-1, 0, 1))
    d.dry[axis] = (back - ahead) / 2, rest - (back + ahead) / 2


def _check_dependence(
    d: Vocabulary, inputs: ActingInputs, terms: _Terms, noise_force: list[Any], w: list[Any]
) -> None:
    """Refuse expressions with names that their place in the equations does not allow."""
    device = d.model.device
    others = [d.channel[c] for c in device.channels]
    prompt_force = [d.channel[derivative(f, k)] for f in device.forces for k in range(LAST_ORDER)]
    free, u, motion = [*d.p.values(), *d.constants], [*d.channel.values()], [*d.q, *d.qd]
    states = [*motion, *u, *free, *d.z.values()]
    all_symbols = [*states, *d.changes.values()]
    words = "motion, inputs, parameters and internal states"
    rates, initial = ([entry[k] for entry in terms.states.values()] for k in (0, 1))
    kinetic, potential = ([getattr(e, k) for e in terms.energies] for k in ("kinetic", "potential"))
    gains = [gain for row in inputs.input_map for gain in row]
    by_gain = "positions, parameters and channels that are no forces"
    allow("the kinetic energy", kinetic, [*motion, *free], "positions, rates and parameters")
    allow("the potential energy", potential, [*d.q, *free], "positions and parameters")
    allow("the effect of a force on the axes", gains, [*d.q, *others, *free], by_gain)
    allow("a torque", terms.other, all_symbols, words)
    allow("a process noise", noise_force, [*all_symbols, *w], words)
    allow("the applied force", inputs.applied, all_symbols, words)
    allow("the rate of an internal state", rates, states, words)
    allow("an initial value", initial, [*motion, *u, *free], "motion, inputs and parameters")
    symbols_allowed = [*d.q, *prompt_force, *others, d.channel["t"], *free]
    allow("an offset", terms.offset, symbols_allowed, "positions, forces and parameters")


class _Motion(NamedTuple):
    """The left side of the equations of motion, by names in ``steps``: all as in `Equations`."""

    steps: list[tuple[Any, Any]]
    mass: list[list[Any]]
    bias: list[Any]
    dynamics: list[Any]


def _combine_motion(d: Vocabulary, energies: Sequence[_Energy], taken: Sequence[Any]) -> _Motion:
    """Add the terms of the energies, of a robot's bodies and of `_take_inertia`."""
    motion, robot = _apply_lagrange(d, energies), d.model.device.robot
    if robot is None:
        check_inertia(d.model, motion.mass, [*d.q, *d.constants])
    else:
        numbers = tuple(d.p[p.name] for p in robot.parameters)
        coordinates = tuple(d.q), tuple(d.qd), tuple(d.qdd)
        bodies = _apply_newton_euler(robot.links, gravity_vector(robot), numbers, coordinates)
        motion = _Motion(
            bodies.steps, [_add(*rows) for rows in zip(motion.mass, bodies.mass, strict=True)],
            _add(motion.bias, bodies.bias), _add(motion.dynamics, bodies.dynamics),
        )  # fmt: skip
    mass = [
        [m - (taken[i] if i == j else 0) for j, m in enumerate(row)]
        for i, row in enumerate(motion.mass)
    ]
    parts = zip(motion.dynamics, taken, d.qdd, strict=True)
    return motion._replace(mass=mass, dynamics=[f - x * qdd for f, x, qdd in parts])


def _take_inertia(d: Vocabulary, other: list[Any]) -> list[Any]:
    """Remove the effects' coefficients of their own axis' acceleration from Q_other; by axis."""
    found: list[Any] = [sp.S.Zero for _ in d.axes]
    for i in {d.axes.index(e.target) for e in d.model.effects if "qdd" in e.effect.names}:
        found[i], other[i] = sp.diff(other[i], d.qdd[i]), other[i].subs(d.qdd[i], 0)
    allowed = [*d.q, *d.p.values(), *d.constants]
    allow("what a torque has per acceleration", found, allowed, "positions and parameters")
    return found


def _add(one: Sequence[Any], other: Sequence[Any]) -> list[Any]:
    return [a + b for a, b in zip(one, other, strict=True)]


def _apply_lagrange(d: Vocabulary, energies: Sequence[_Energy]) -> _Motion:
    """Lagrange's equation of all energies, one after the other."""
    n = len(d.axes)
    mass, bias = [[sp.S.Zero] * n for _ in range(n)], [sp.S.Zero] * n
    for label, tree, kinetic, potential in energies:
        try:
            own_mass, own_bias = lagrange(kinetic, potential, tuple(d.q), tuple(d.qd))
        except OutOfTime:
            raise d.too_long(tree, label) from None
        mass = [_add(*rows) for rows in zip(mass, own_mass, strict=True)]
        bias = _add(bias, own_bias)
    symbols_allowed = [*d.q, *d.qd, *d.p.values(), *d.constants]
    for row, term in zip(mass, bias, strict=True):
        allow("the equation of motion", [*row, term], symbols_allowed, "motion and parameters")
    dynamics = [
        h + sum(m * x for m, x in zip(row, d.qdd, strict=True))
        for h, row in zip(bias, mass, strict=True)
    ]
    return _Motion([], mass, bias, dynamics)


@cache
def _apply_newton_euler(
    links: tuple[Link, ...],
    gravity: Vector,
    numbers: tuple[Any, ...],
    motion: tuple[tuple[Any, ...], ...],
) -> _Motion:
    """Newton and Euler's equations of a robot's bodies, once a process for all its models."""
    q, qd, qdd = motion
    text = Text()
    inertial = [numbers[k : k + INERTIAL] for k in range(0, len(numbers), INERTIAL)]
    zeros = [0] * len(q)
    # Everything has a name: one compiled function serves every model of this robot.
    # The mass matrix: column by column, the forces of a unit acceleration at rest.
    units, at_rest = np.eye(len(q), dtype=int), (links, inertial, q, zeros)
    columns = np.hstack([joint_forces(text, *at_rest, unit, (0, 0, 0)) for unit in units])
    mass = text.name(np.triu(columns) + np.triu(columns, 1).T).tolist()
    bias, dynamics = (
        text.name(joint_forces(text, links, inertial, q, qd, a, gravity))[:, 0].tolist()
        for a in (zeros, qdd)
    )
    return _Motion(text.steps, mass, bias, dynamics)


@lru_cache(maxsize=4096)
def _slope(term: Any, symbol: Any) -> Any:
    """Its derivative, kept: models of one device have most of their terms in common."""
    return term.diff(symbol)


def _find_dependence(
    d: Vocabulary,
    residual: Sequence[Any],
    beside: Sequence[Any],
    steps: Sequence[tuple[Any, Any]],
) -> Dependence:
    """Find how the residual depends on each parameter.

    Args:
        residual: one expression an axis; beside: other expressions of the model, in which a
            parameter makes it nonlinear; steps: named intermediates in the residual.
    """
    step_names, numbers = {name for name, _ in steps}, _collect_symbols(v for _, v in steps)
    found = Dependence([], [], [], [], [])
    p, varying = [*d.p.values()], {*d.p.values(), *d.z.values(), *d.changes.values()}
    elsewhere = _collect_symbols(beside)
    # A term has few of the model's parameters, and sympy is slow to find a slope zero.
    terms = [[(t, t.free_symbols) for t in sp.Add.make_args(e)] for e in residual]
    for i, symbol in enumerate(p):
        by_term = [[_slope(t, symbol) for t, own in row if symbol in own] for row in terms]
        by_axis = {k: sp.Add(*row) for k, row in enumerate(by_term) if row}
        slopes = [*by_axis.values()]
        slope_symbols, bodily = _collect_symbols(slopes), symbol in numbers
        candidates = slope_symbols.intersection(p[: i + 1])
        sized = [(slope, slope.count_ops() > _LARGE) for slope in slopes]
        small = [slope for slope, is_large in sized if not is_large]
        # A large slope is assumed to vary with every symbol in it: terms cancel only in small ones.
        curving = candidates & _collect_symbols(slope for slope, is_large in sized if is_large)
        curving |= {s for s in candidates - curving if any(_slope(e, s) != 0 for e in small)}
        linear = symbol not in curving and symbol not in elsewhere
        constant = linear and not slope_symbols & varying
        lasts = constant and not bodily and slope_symbols.isdisjoint(step_names)
        found.linear.append(linear)
        found.constant.append(constant)
        found.lasting.append(by_axis if lasts else None)
        found.products.extend((j, i) for j in range(i) if p[j] in curving)
        if bodily and not by_axis:
            found.of_bodies.append(i)
    return found


def _find_compensation(d: Vocabulary, potential: Any, inputs: ActingInputs) -> list[Any]:
    """Return the generalised force of a gravity compensator, one expression per coordinate.

    That is a torque of the device's own table, on a coordinate that the potential energy depends
    on, that itself depends on the pose; with the effects on it (a compensator that lags or is
    mistuned).

    ``potential`` is the energy of the model, whose terms have been collected.
    """
    torque = d.table(d.model.device.torque, "torque")
    balanced = [
        t.free_symbols & set(d.q) and potential.has(q) for t, q in zip(torque, d.q, strict=True)
    ]
    results = [s if kept else sp.S.Zero for s, kept in zip(d.support, balanced, strict=True)]
    for item in (e for e in d.model.effects if e.effect.uses_support and not e.effect.has_play):
        for key, tree in item.effect.expressions.items():
            place = d.axes.index(item.target_of(key))
            if balanced[place]:
                symbols = d.effect_symbols(item, inputs.logged, inputs.side)
                results[place] += d.build(tree, symbols, key, item)
    return results


def _find_delays(d: Vocabulary, applied: list[Any]) -> list[str]:
    """Return parameters that shift a measured force in time, adding its rate times a small shift.

    To first order a shift by p seconds adds +-p times the rate of each force that it shifts,
    mapped to the joints as the force itself is.
    """
    own = [p for item in d.model.effects for p in item.parameters]
    absent = {d.p[p.name]: 0 for p in own if not p.fixed}
    rates = {d.channel[derivative(force, 1)] for force in d.model.device.forces}
    results = []
    for p in own:
        # Sympy is slow to find a slope zero.
        if not any(d.p[p.name] in e.free_symbols and rates & e.free_symbols for e in applied):
            continue
        slope = [sp.diff(e, d.p[p.name]).subs(absent) for e in applied]
        for force in d.model.device.forces:
            rate = d.channel[derivative(force, 1)]
            mapped = [sp.diff(e, d.channel[force]).subs(absent) for e in applied]
            pairs = ((a, b) for a, b in zip(slope, mapped, strict=True) if b != 0)
            ratio = {sp.simplify(sp.diff(a, rate) / b) for a, b in pairs}
            if len(ratio) == 1 and next(iter(ratio)).is_number and next(iter(ratio)) != 0:
                results.append(p.name)
                break
    return results
