"""From names in declarations to symbols: the vocabulary of devices and effects."""

import ast
from collections.abc import Mapping
from typing import Any

import sympy as sp

from bampipe.errors import InputError
from bampipe.physics import expression
from bampipe.physics.device import INPUT_ORDERS, LAST_ORDER, derivative
from bampipe.physics.effect import PAIR, BoundEffect
from bampipe.physics.model import Model
from bampipe.physics.time_limit import OutOfTime

Symbols = dict[str, Any]


def constant_symbol(name: str) -> Any:
    """Symbol of a constant that its number does not replace."""
    return sp.Symbol(f"constant {name}", real=True)


class Vocabulary:
    """The symbols of one model, and expressions of its device and effects built from them.

    Attributes:
        model: the device and its effects.
        constants: symbols of the device's constants, unless numbers replace them.
        axes: names of the coordinates.
        q, qd, qdd: their symbols and those of their rates.
        channels: every input there may be; channel: their symbols.
        p, z: symbols of the parameters, and of effects' internal states.
        changes: of the states whose rate of change an expression asks for, by symbol, its symbol.
        dry: by coordinate, the mean dry friction of both directions, and half their difference;
            filled while torques are put together, before the first effect that uses it.
        weight: by coordinate, slope of the potential energy; filled like `dry`.
        pull: by coordinate, the same less the torque of springs and the like; filled like `dry`.
        inertia: by coordinate, its entry on the diagonal of the mass matrix; filled like `dry`.
        bias: by coordinate, the energies' terms without acceleration, less the device's own
            torques; torque: all torques beside those; filled like `dry`.
        base: names that every expression of the device may use.
    """

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
        self.changes: dict[Any, Any] = {}
        self.special = {"sgn": self.sgn, "ddt": self.ddt}
        self.sizes: dict[str, int] = {}
        zeros = [sp.S.Zero] * len(self.axes)
        self.weight, self.pull, self.inertia, self.bias = (zeros for _ in range(4))
        self.support, self.torque, self.dry = zeros, zeros, list(zip(zeros, zeros, strict=True))
        self.base: Symbols = dict(zip(self.axes, self.q, strict=True))
        self.base |= {f"qd_{a}": s for a, s in zip(self.axes, self.qd, strict=True)}
        self.constants = [constant_symbol(name) for name in device.constants if named_constants]
        values = self.constants or [sp.Float(c.value) for c in device.constants.values()]
        self.base |= dict(zip(device.constants, values, strict=True))
        self.base |= {p.name: self.p[p.name] for p in device.parameters if "." not in p.name}
        self.base |= self.channel
        for name, tree in device.definitions.items():
            self.base[name] = self.build(tree, self.base, f"definitions.{name}")
            size = expression.expanded_size(tree, self.sizes)
            self.sizes[name] = max(size, int(sp.count_ops(self.base[name])))

    def build(
        self,
        tree: ast.expr,
        symbols: Mapping[str, Any],
        what: str,
        item: BoundEffect | None = None,
    ) -> Any:
        """`expression.build` of a tree that stays of bounded size with definitions put in.

        Args:
            what: the field, for messages; item: the effect that it is of, None for the device.

        Raises:
            InputError: it does not, or takes longer than the limit that the caller has set.
        """
        device = self.model.device
        owner = f"device {device.name!r}" if item is None else f"effect {item.name!r}"
        where = f"{owner}: {what}"
        size = expression.expanded_size(tree, self.sizes)
        if size <= expression.MAX_EXPANDED:
            try:
                value = expression.build(tree, symbols, where, self.special)
                size = sp.count_ops(value)
            except OutOfTime:
                raise self.too_long(tree, where) from None
        if size > expression.MAX_EXPANDED:
            raise InputError(
                f"more than {expression.MAX_EXPANDED} operations after definitions and rates are"
                " expanded",
                where=where,
                remedy=self._shorten(tree),
            )
        return value

    def too_long(self, tree: ast.expr, where: str) -> InputError:
        """Return the error if deriving equations from the expression ``tree`` exceeds its limit."""
        return InputError(
            "deriving the equations of motion takes too long: "
            f"{expression.expanded_size(tree, self.sizes)} operations with definitions put in",
            where=where,
            remedy=self._shorten(tree),
        )

    def _shorten(self, tree: ast.expr) -> str:
        used = [name for name in sorted(expression.names(tree)) if name in self.sizes]
        longest = max(used, key=self.sizes.__getitem__, default="")
        above = f", above all definition {longest!r}" if longest else ""
        return f"shorten it{above}: fewer nested functions, lower powers"

    def sgn(self, argument: Any) -> Any:
        """Sign, smoothed over the axes' widths where the argument is a rate or a sum of rates."""
        width, rest = sp.S.Zero, sp.sympify(argument, strict=True)
        for c, rate in zip(self.model.device.coordinates, self.qd, strict=True):
            if rate in rest.free_symbols:
                slope = sp.diff(argument, rate)
                if not slope.is_number:
                    return sp.sign(argument)
                width += abs(slope) * sp.Float(c.sign_width)
                rest -= slope * rate
        if width == 0 or sp.expand(rest) != 0:
            return sp.sign(argument)
        return sp.tanh(argument / width)

    def ddt(self, expr: Any) -> Any:
        """Total time derivative by the chain rule over motion and measured forces.

        Channels that are no forces, such as a supply voltage, count as slow: their rate is zero.
        That of an internal state gets a symbol of its own, since an impact passes between samples.
        """
        last = [self.channel[derivative(f, LAST_ORDER)] for f in self.model.device.forces]
        if expr.has(*self.qdd, *last):
            raise InputError("ddt() of an acceleration, or of a force's last derivative")
        brakes = [self.channel[b] for b in self.model.device.brakes.values()]
        if expr.has(*brakes, *self.changes.values()):
            raise InputError("ddt() of a brake command, or twice of an internal state")
        for k, z in enumerate(self.z.values()):
            if expr.has(z):
                self.changes[z] = sp.Symbol(f"dz{k}", real=True)
        return self.rate_along(expr, self.changes).replace(sp.DiracDelta, lambda *_: sp.S.Zero)

    def rate_along(self, expr: Any, further: Mapping[Any, Any]) -> Any:
        """Return the time derivative along the motion, to the last known derivative of a force.

        Args:
            expr: of motion, inputs and time; further: rates of other symbols in it.
        """
        rates = dict(zip([*self.q, *self.qd], [*self.qd, *self.qdd], strict=True))
        for force in self.model.device.forces:
            for k in range(LAST_ORDER):
                low, high = derivative(force, k), derivative(force, k + 1)
                rates[self.channel[low]] = self.channel[high]
        rates |= {self.channel["t"]: sp.S.One, **further}
        present = expr.free_symbols
        return sp.Add(*(sp.diff(expr, s) * rate for s, rate in rates.items() if s in present))

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
            symbols |= {f"weight_{a}": self.weight[i], f"pull_{a}": self.pull[i]}
            symbols[f"support_{a}"] = self.support[i]
            for term in ("viscous", "coulomb"):
                symbols[f"{term}_{a}"] = self.p.get(f"{term}.{a}", sp.S.Zero)
        if item.effect.scope == "axis":
            i, a = self.axes.index(item.target), item.target
            symbols |= {"q": self.q[i], "qd": self.qd[i], "side_load": side[i]}
            own = ("applied", "load", "viscous", "coulomb", "weight", "pull", "support")
            symbols |= {n: symbols[f"{n}_{a}"] for n in own}
            symbols["dry"], symbols["dry_difference"] = self.dry[i]
            symbols["qdd"] = self.qdd[i]
            symbols |= {"axis_inertia": self.inertia[i], "axis_bias": self.bias[i]}
            symbols["axis_torque"] = self.torque[i]
            symbols["brake"] = self.channel.get(device.brakes.get(a, ""), sp.S.Zero)
        elif item.effect.scope == "axis_pair":
            for letter, axis in zip(PAIR, item.axes, strict=True):
                i = self.axes.index(axis)
                symbols |= {f"q_{letter}": self.q[i], f"qd_{letter}": self.qd[i]}
                middle = sum(device.limits.get(axis, (0.0, 0.0))) / 2.0
                symbols[f"middle_{letter}"] = sp.Float(middle)
        elif item.effect.scope in ("force_component", "force_pair"):
            for letter, force in zip("fg", item.places, strict=False):
                for k in range(len(INPUT_ORDERS)):
                    symbols[derivative(letter, k)] = self.channel[derivative(force, k)]
        elif item.effect.scope == "channel":
            symbols["f"] = self.channel[item.target]
        symbols |= {s.name: self.z[item.prefix, s.name] for s in item.effect.states}
        for p in item.parameters:
            symbols[p.name.removeprefix(f"{item.prefix}.")] = self.p[p.name]
        return self.with_definitions(item, symbols)

    def with_definitions(self, item: BoundEffect, symbols: Symbols) -> Symbols:
        """``symbols`` and the definitions of ``item`` in their terms."""
        for name, tree in item.effect.definitions.items():
            symbols[name] = self.build(tree, symbols, f"definitions.{name}", item)
        return symbols
