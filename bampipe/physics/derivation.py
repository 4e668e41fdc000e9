"""From declarations to equations of motion: Lagrange's equation on the model's energies (eqs 9-14).

M(q) qdd + h(q, qd) = Q_applied + Q_other, where Q_applied comes from the measured input (eq 19) and
Q_other from friction (eq 20), brakes (eq 18), compensators and the effects of kind ``torque``.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import sympy as sp

from bampipe.errors import InputError
from bampipe.physics import expression
from bampipe.physics.device import INPUT_ORDERS, derivative
from bampipe.physics.effect import EACH, BoundEffect
from bampipe.physics.model import Model

Symbols = dict[str, Any]

LAST_ORDER = len(INPUT_ORDERS) - 1


@dataclass(frozen=True)
class Equations:
    """Symbolic equations of a model; lists are in the order of the names they belong to.

    Attributes:
        q, qd, qdd: coordinates and their rates.
        z, z_names: internal states of effects.
        u, inputs: input symbols that the model uses, and their channel names.
        p, w, noise: parameters; additive process noise and its names.
        mass: mass matrix, n by n.
        bias: h(q, qd): Coriolis, centrifugal and potential terms.
        other: Q_other, process noise included.
        applied: Q_applied; applied_noise: the same with noise on the measured force.
        input_map: d applied / d force of the device itself.
        rates, initial: of the internal states.
        offset, offset_rate, offset_acceleration: q_true - q_measured and its derivatives.
        kinetic, potential: energies, as declared, definitions put in.
        linear: for each parameter, whether the residual is linear in it.
        compensation: per coordinate, the part of Q_other that balances gravity there: see
            `_compensation`; zero where nothing does.
        delays: parameters that shift measured forces in time: see `_delays`.
    """

    q: list[Any]
    qd: list[Any]
    qdd: list[Any]
    z: list[Any]
    z_names: list[str]
    u: list[Any]
    inputs: list[str]
    p: list[Any]
    w: list[Any]
    noise: list[str]
    mass: list[list[Any]]
    bias: list[Any]
    other: list[Any]
    applied: list[Any]
    applied_noise: list[Any]
    input_map: list[list[Any]]
    rates: list[Any]
    initial: list[Any]
    offset: list[Any]
    offset_rate: list[Any]
    offset_acceleration: list[Any]
    kinetic: Any
    potential: Any
    linear: list[bool]
    compensation: list[Any]
    delays: list[str]


def constant_symbol(name: str) -> Any:
    """Symbol that stands for a constant where its number is not put in."""
    return sp.Symbol(f"constant {name}", real=True)


class _Derivation:
    """Working state while the equations of one model are put together."""

    def __init__(self, model: Model, named_constants: bool = False) -> None:
        self.model = model
        device = model.device
        self.axes = [c.name for c in device.coordinates]
        # Symbols are numbered, so that no name from a file is ever printed into generated code.
        self.q, self.qd, self.qdd = (
            [sp.Symbol(f"{kind}{i}", real=True) for i in range(len(self.axes))]
            for kind in ("q", "qd", "qdd")
        )
        self.channels = [derivative(f, k) for k in range(len(INPUT_ORDERS)) for f in device.forces]
        self.channels += [*device.brakes.values(), *device.channels, "t"]
        self.channel = {name: sp.Symbol(f"u{i}", real=True) for i, name in enumerate(self.channels)}
        self.p = {p.name: sp.Symbol(f"p{i}", real=True) for i, p in enumerate(model.parameters)}
        self.z: dict[tuple[str, str], Any] = {}
        for item in model.effects:
            for state in item.effect.states:
                symbol = sp.Symbol(f"z{len(self.z)}", real=True)
                self.z[item.prefix, state.name] = symbol
        self.special = {"sgn": self._sgn, "ddt": self.ddt}
        self.sizes: dict[str, int] = {}
        self.dry: list[Any] = [sp.S.Zero] * len(self.axes)
        self.base: Symbols = dict(zip(self.axes, self.q, strict=True))
        self.base |= {f"qd_{a}": s for a, s in zip(self.axes, self.qd, strict=True)}
        self.base |= {
            name: constant_symbol(name) if named_constants else sp.Float(c.value)
            for name, c in device.constants.items()
        }
        self.base |= {p.name: self.p[p.name] for p in device.parameters if "." not in p.name}
        self.base |= self.channel
        for name, tree in device.definitions.items():
            self.base[name] = self.build(tree, self.base, f"definitions.{name}")
            self.sizes[name] = expression.expanded_size(tree, self.sizes)

    def build(self, tree: ast.expr, symbols: Mapping[str, Any], what: str) -> Any:
        return self.rebuild(tree, symbols, f"device {self.model.device.name!r}: {what}")

    def rebuild(self, tree: ast.expr, symbols: Mapping[str, Any], where: str) -> Any:
        """`expression.build` of a tree that stays of bounded size with definitions put in."""
        if expression.expanded_size(tree, self.sizes) > expression.MAX_EXPANDED:
            raise InputError(
                f"the expression has more than {expression.MAX_EXPANDED} parts once the "
                "definitions are put in",
                where=where,
            )
        return expression.build(tree, symbols, where, self.special)

    def _sgn(self, argument: Any) -> Any:
        """Sign, smoothed over the axis' width where the argument is a coordinate's rate."""
        for c, rate in zip(self.model.device.coordinates, self.qd, strict=True):
            if argument == rate:
                return sp.tanh(argument / sp.Float(c.sign_width))
        return sp.sign(argument)

    def ddt(self, expr: Any) -> Any:
        """Total time derivative by the chain rule over motion and measured forces.

        Channels that are no forces, such as a supply voltage, count as slow: their rate is zero.
        """
        last = [
            *self.qdd,
            *(self.channel[derivative(f, LAST_ORDER)] for f in self.model.device.forces),
        ]
        if expr.has(*last):
            raise InputError("ddt() of an acceleration, or of a force's last derivative")
        brakes = [self.channel[b] for b in self.model.device.brakes.values()]
        if expr.has(*self.z.values(), *brakes):
            raise InputError("ddt() of an internal state or of a brake command")
        total = sp.S.Zero
        for a, b in (
            *zip(self.q, self.qd, strict=True),
            *zip(self.qd, self.qdd, strict=True),
        ):
            total += sp.diff(expr, a) * b
        for force in self.model.device.forces:
            for k in range(LAST_ORDER):
                low, high = (
                    self.channel[derivative(force, k)],
                    self.channel[derivative(force, k + 1)],
                )
                total += sp.diff(expr, low) * high
        total += sp.diff(expr, self.channel["t"])
        return total.replace(sp.DiracDelta, lambda *_: sp.S.Zero)

    def table(self, entries: Mapping[str, ast.expr], what: str) -> list[Any]:
        """One expression an axis, zero where the table has none."""
        return [
            self.build(entries[a], self.base, f"{what}.{a}") if a in entries else sp.S.Zero
            for a in self.axes
        ]

    def effect_symbols(self, item: BoundEffect, applied: list[Any], side: list[Any]) -> Symbols:
        """Every name that an expression of ``item`` may use."""
        device = self.model.device
        symbols = dict(self.base)
        for i, a in enumerate(self.axes):
            symbols |= {f"applied_{a}": applied[i], f"load_{a}": sp.Abs(applied[i])}
            for term in ("viscous", "coulomb"):
                symbols[f"{term}_{a}"] = self.p.get(f"{term}.{a}", sp.S.Zero)
        if item.effect.scope == "axis":
            i, a = self.axes.index(item.target), item.target
            symbols |= {"q": self.q[i], "qd": self.qd[i], "side_load": side[i]}
            symbols |= {n: symbols[f"{n}_{a}"] for n in ("applied", "load", "viscous", "coulomb")}
            symbols["dry"] = self.dry[i]
            symbols["brake"] = self.channel.get(device.brakes.get(a, ""), sp.S.Zero)
        elif item.effect.scope in ("force_component", "force_pair"):
            for letter, force in zip("fg", self.targeted(item), strict=False):
                for k, suffix in enumerate(("", "_rate", "_curvature")):
                    symbols[letter + suffix] = self.channel[derivative(force, k)]
        elif item.effect.scope == "channel":
            symbols["f"] = self.channel[item.target]
        symbols |= {s.name: self.z[item.prefix, s.name] for s in item.effect.states}
        for p in item.parameters:
            symbols[p.name.removeprefix(f"{item.prefix}.")] = self.p[p.name]
        return symbols

    def targeted(self, item: BoundEffect) -> tuple[str, ...]:
        """Force channels of a force effect: its own, and for a pair the one that leaks into it."""
        forces = self.model.device.forces
        if item.effect.scope == "force_component":
            return (forces[self.model.device.components.index(item.target)],)
        short = self.model.device.components
        return next(
            (forces[i], forces[j])
            for i, a in enumerate(short)
            for j, b in enumerate(short)
            if i != j and a + b == item.target
        )

    def own(self, item: BoundEffect, tree: ast.expr, symbols: Symbols, what: str) -> Any:
        return self.rebuild(tree, symbols, f"effect {item.name!r}: {what}")


_PRINTABLE = (
    sp.sin,
    sp.cos,
    sp.tan,
    sp.exp,
    sp.log,
    sp.tanh,
    sp.atan,
    sp.Abs,
    sp.sign,
    sp.Heaviside,
)
_INFINITE = (sp.nan, sp.oo, -sp.oo, sp.zoo, sp.I)


def _allow(what: str, exprs: list[Any], allowed: list[Any], words: str) -> None:
    """Raise InputError unless ``exprs`` use ``allowed`` symbols only and can be computed."""
    for expr in map(sp.sympify, exprs):
        if expr.free_symbols - set(allowed):
            raise InputError(f"{what} may depend on {words} only")
        odd = [f for f in expr.atoms(sp.Function, sp.Derivative) if not isinstance(f, _PRINTABLE)]
        if odd or expr.has(*_INFINITE):
            raise InputError(
                f"{what} is not smooth enough to be differentiated, or not finite",
                remedy="keep sgn, abs, heaviside, min and max out of energies and offsets",
            )


def _check_inertia(model: Model, mass: list[list[Any]], symbols: list[Any]) -> None:
    """Raise InputError where no pose gives every coordinate an inertia."""
    numbers = {s: 0.37 * (i + 1) % 1.3 for i, s in enumerate(symbols)}
    numbers |= {
        sp.Symbol(f"p{i}", real=True): p.prior or 1.0 for i, p in enumerate(model.parameters)
    }
    values = np.array([[float(m.subs(numbers)) for m in row] for row in mass])
    if np.linalg.matrix_rank(values) < len(values):
        bare = [
            c.name for c, v in zip(model.device.coordinates, values, strict=True) if not v.any()
        ]
        raise InputError(
            f"{'coordinate ' + bare[0] if bare else 'some coordinate'} has no inertia of its own",
            where=f"device {model.device.name!r}: energy.kinetic",
            remedy="the kinetic energy must grow with the rate of every coordinate",
        )


@cache
def _lagrange(
    kinetic: Any, potential: Any, q: tuple[Any, ...], qd: tuple[Any, ...]
) -> tuple[list[list[Any]], list[Any]]:
    """Mass matrix (eq 13) and bias (eq 12 with accelerations zero) of one pair of energies.

    Lagrange's equation is linear in the energies, so each effect's are derived on their own and
    the device's, which take seconds to simplify, only once.

    Raises:
        InputError: the kinetic energy is not quadratic in the rates.
    """
    mass = [[sp.expand_trig(sp.simplify(sp.diff(kinetic, a, b))) for b in qd] for a in qd]
    still = dict.fromkeys(qd, 0)
    lower = [kinetic.subs(still), *(sp.diff(kinetic, a).subs(still) for a in qd)]
    if any(e.has(*qd) for row in mass for e in row) or any(sp.simplify(e) != 0 for e in lower):
        raise InputError("the kinetic energy must be quadratic in the rates")
    # Christoffel's symbols of the simplified matrix: the same as d/dt dT/dqd - dT/dq, but compact.
    bias = []
    for i, a in enumerate(q):
        total = sp.diff(potential, a)
        for j, k in combinations_with_replacement(range(len(q)), 2):
            slope = sp.diff(mass[i][j], q[k]) + sp.diff(mass[i][k], q[j]) - sp.diff(mass[j][k], a)
            total += (slope / 2 if j == k else slope) * qd[j] * qd[k]
        bias.append(total)
    return mass, bias


def derive(model: Model, named_constants: bool = False) -> Equations:
    """Derive the equations of motion of ``model``.

    Args:
        model: the device and its effects.
        named_constants: leave the device's constants as symbols, for people to read.

    Raises:
        InputError: an expression uses a name that does not exist there, or the mass matrix is
            singular everywhere.
    """
    d = _Derivation(model, named_constants)
    constants = [constant_symbol(c) for c in model.device.constants if named_constants]
    device, axes = model.device, d.axes
    n = len(axes)
    raw_applied = d.table(device.applied, "applied")
    side = d.table(device.side_load, "side_load")
    forces = [d.channel[f] for f in device.forces]
    input_map = [[sp.diff(e, f) for f in forces] for e in raw_applied]

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
    other = [e.subs(truth, simultaneous=True) for e in d.table(device.torque, "torque")]
    for i, c in enumerate(device.coordinates):
        sign = d._sgn(d.qd[i])
        if c.name in device.frictional:
            other[i] -= d.p[f"viscous.{c.name}"] * d.qd[i] + d.p[f"coulomb.{c.name}"] * sign
        slid = sp.Dummy()
        d.dry[i] = -sp.diff(sp.sympify(other[i]).subs(sign, slid), slid)
        if c.name in device.brakes:
            other[i] -= d.channel[device.brakes[c.name]] * sign
    for k, name in enumerate(device.process_noise):
        gains = d.table(device.process_noise[name], f"process_noise.{name}")
        other = [e + g * w[len(device.forces) + k] for e, g in zip(other, gains, strict=True)]

    energies = [(kinetic, potential)]
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
            if key == "kinetic":
                energies.append((value, sp.S.Zero))
            elif key == "potential":
                energies.append((sp.S.Zero, value))
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
    kinetics, potentials = zip(*energies, strict=True)
    _allow("the kinetic energy", [*kinetics], [*motion, *free], "positions, rates and parameters")
    _allow("the potential energy", [*potentials], [*d.q, *free], "positions and parameters")
    _allow(
        "the effect of a force on the axes",
        gains,
        [*d.q, *others, *free],
        "positions, parameters and channels that are no forces",
    )
    _allow("a torque", other, [*motion, *u, *free, *memory, *w], words)
    _allow("the applied force", applied, [*motion, *u, *free, *memory], words)
    _allow("the rate of an internal state", rates, [*motion, *u, *free, *memory], words)
    _allow("an initial value", initial, [*d.q, *u, *free], "positions, inputs and parameters")
    _allow("an offset", offset, [*d.q, *force0, *free], "positions, forces and parameters")

    terms = [_lagrange(a, b, tuple(d.q), tuple(d.qd)) for a, b in energies]
    mass = [[sum(t[0][i][j] for t in terms) for j in range(n)] for i in range(n)]
    bias = [sum(t[1][i] for t in terms) for i in range(n)]
    for row, term in zip(mass, bias, strict=True):
        _allow("the equation of motion", [*row, term], [*motion, *free], "motion and parameters")
    _check_inertia(model, mass, [*d.q, *constants])
    kinetic, potential = (sum(parts) for parts in zip(*energies, strict=True))

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
        compensation=_compensation(d, potential), delays=_delays(d, applied),
    )  # fmt: skip


def _compensation(d: _Derivation, potential: Any) -> list[Any]:
    """Generalised force of what the device has against gravity, one expression a coordinate.

    That is a torque of the device's own table, on a coordinate that the potential energy depends
    on, that itself depends on the pose; with the effects that name it, or a constant or
    definition that nothing but that torque uses (a compensator that lags or is mistuned).
    """
    device = d.model.device
    torque = d.table(device.torque, "torque")
    balanced = [
        t.free_symbols & set(d.q) and potential.has(q) for t, q in zip(torque, d.q, strict=True)
    ]
    found = [t if kept else sp.S.Zero for t, kept in zip(torque, balanced, strict=True)]
    rest = [device.kinetic, device.potential, *device.applied.values(), *device.side_load.values()]
    own = _reached(device.torque.values(), device.definitions) - _reached(rest, device.definitions)
    raw_applied, side = d.table(device.applied, "applied"), d.table(device.side_load, "side_load")
    for item in (e for e in d.model.effects if e.effect.kind == "torque"):
        for key, tree in item.effect.expressions.items():
            place = d.axes.index(key.partition(".")[2] or item.target)
            if balanced[place] and expression.names(tree) & own:
                found[place] += d.own(item, tree, d.effect_symbols(item, raw_applied, side), key)
    return found


def _reached(trees: Iterable[ast.expr], definitions: Mapping[str, ast.expr]) -> set[str]:
    """Every name that expressions use, through definitions too."""
    found: set[str] = set()
    waiting = {name for tree in trees for name in expression.names(tree)}
    while waiting:
        name = waiting.pop()
        found.add(name)
        if name in definitions:
            waiting |= expression.names(definitions[name]) - found
    return found


def _delays(d: _Derivation, applied: list[Any]) -> list[str]:
    """Parameters that shift a measured force in time: small, they add its rate times themselves.

    To first order a shift by p seconds adds +-p times the rate of each force that it shifts,
    mapped to the joints as the force itself is.
    """
    own = [p for item in d.model.effects for p in item.parameters]
    absent = {d.p[p.name]: 0 for p in own if not p.fixed}
    found = []
    for p in own:
        slope = [sp.diff(e, d.p[p.name]).subs(absent) for e in applied]
        for force in d.model.device.forces:
            rate = d.channel[derivative(force, 1)]
            mapped = [sp.diff(e, d.channel[force]).subs(absent) for e in applied]
            ratio = {
                sp.simplify(sp.diff(a, rate) / b)
                for a, b in zip(slope, mapped, strict=True)
                if b != 0
            }
            if len(ratio) == 1 and next(iter(ratio)).is_number and next(iter(ratio)) != 0:
                found.append(p.name)
                break
    return found


def contribution(full: Equations, bare: Equations) -> list[Any]:
    """What the effects in ``full`` add to the residual of ``bare``, one expression an axis."""
    quiet = dict.fromkeys(full.w, 0)
    added = []
    for i in range(len(full.q)):
        inertia = sum(
            (m - n) * a for m, n, a in zip(full.mass[i], bare.mass[i], full.qdd, strict=True)
        )
        force = full.applied[i] - bare.applied[i] + full.other[i] - bare.other[i]
        added.append(sp.sympify(force - (full.bias[i] - bare.bias[i]) - inertia).subs(quiet))
    return added
