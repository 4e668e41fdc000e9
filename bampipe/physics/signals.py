"""The acting part of each logged input, after the effects between log and mechanism."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, get_args

from bampipe.errors import InputError
from bampipe.physics.device import INPUT_ORDERS, LAST_ORDER, Device, derivative
from bampipe.physics.effect import EACH, BoundEffect, Link

if TYPE_CHECKING:
    from bampipe.physics.vocabulary import Vocabulary

_ORDER = {link: number for number, link in enumerate(get_args(Link))}


def order_of_action(effects: Iterable[BoundEffect]) -> list[BoundEffect]:
    """Effects in the order in which they act, whatever the order in which they were added.

    The order is link by link, then effects on the mechanism itself, last those on all dry friction,
    weights or inertia, and behind them a mechanism ahead of its encoder; ties go by name.
    """

    def order_key(item: BoundEffect) -> tuple[int, bool, bool, str]:
        link = item.effect.acting_link
        effect = item.effect
        last = "dry" in effect.names or effect.uses_weight or effect.uses_inertia
        last |= effect.uses_support
        return (_ORDER[link] if link else len(_ORDER), last, effect.has_play, item.name)

    return sorted(effects, key=order_key)


def follows(item: BoundEffect, earlier: BoundEffect, device: Device) -> bool:
    """Whether the action of ``item`` changes, beyond first order, with ``earlier`` in the model.

    That holds behind a lag or a saturation of an input that it uses, behind effects on the same dry
    friction, behind springs if it acts on the pull, behind what changes the device's own torque if
    it acts on that, and for two effects of positions.
    """
    if item.effect.kind == "measurement" or earlier.effect.kind == "measurement":
        return item.effect.kind == earlier.effect.kind
    if "dry" in item.effect.names and not (earlier.axes and {*earlier.axes}.isdisjoint(item.axes)):
        return earlier.effect.kind in ("torque", "input")
    if "pull" in item.effect.terms and earlier.effect.pulls:
        return item.effect.scope == "device" or item.target == earlier.target
    if item.effect.uses_support and earlier.effect.is_part_of_support(device):
        return True
    if earlier.effect.acting_link not in ("lag", "saturation"):
        return False
    changed = {earlier.target} & set(device.channels) or set(device.forces)
    if item.effect.kind == "input":
        return item.target == earlier.target or not item.target
    by_load = bool(item.effect.terms & {"applied", "load", "side"}) and changed <= set(
        device.forces
    )
    return by_load or bool(item.effect.names & changed)


class ActingInputs:
    """The inputs that act, as expressions of the logged ones, and the internal states between.

    Attributes:
        logged, side: generalised force and side load, by axis, of the logged inputs.
        acting: by the symbol of a logged force or channel, its acting part, if that differs.
        rates, initial: of the internal states of the effects between, by symbol.
    """

    def __init__(self, d: "Vocabulary", effects: Iterable[BoundEffect]) -> None:
        """Chain the effects of kind ``input`` among ``effects``: those of the model, or some."""
        self._d, device = d, d.model.device
        self.logged = d.table(device.applied, "applied")
        self.side = d.table(device.side_load, "side_load")
        self.acting: dict[Any, Any] = {}
        self.rates: dict[Any, Any] = {}
        self.initial: dict[Any, Any] = {}
        for item in order_of_action(e for e in effects if e.effect.kind == "input"):
            self._add(item)

    def _add(self, item: BoundEffect) -> None:
        d, device = self._d, self._d.model.device
        known, found = (*device.forces, *device.channels), {}
        symbols = d.effect_symbols(item, self.logged, self.side)
        for key, tree in item.effect.expressions.items():
            place = key.partition(".")[2] or item.places[0]
            for name in device.forces if place == EACH else (place,):
                if name not in known:
                    raise InputError(f"effect {item.name!r}: device has no input {name!r}")
                if place == EACH:
                    for k in range(len(INPUT_ORDERS)):
                        symbols[derivative("f", k)] = d.channel[derivative(name, k)]
                found[d.channel[name]] = self.put_in(d.build(tree, symbols, key, item))
        for z, rate, initial in self.build_states(item, symbols):
            self.rates[z], self.initial[z] = rate, initial
        self.acting |= found

    @cached_property
    def applied(self) -> list[Any]:
        """Generalised force of the acting inputs, by axis."""
        return [self.put_in(e) for e in self.logged]

    @cached_property
    def input_map(self) -> list[list[Any]]:
        """d logged / d force, by axis."""
        return [[e.diff(f) for f in self._measured] for e in self.logged]

    @property
    def _measured(self) -> list[Any]:
        return [self._d.channel[f] for f in self._d.model.device.forces]

    def find_noise(self, w: Sequence[Any]) -> list[Any]:
        """Return the generalised force of noise ``w`` on each measured force, by axis."""
        noisy = {f: self.acting.get(f, f) + n for f, n in zip(self._measured, w, strict=False)}
        values = [*(self.acting | noisy).items()]
        present = [{s: v for s, v in values if s in e.free_symbols} for e in self.logged]
        triples = zip(self.logged, present, self.applied, strict=True)
        return [e.subs(v, simultaneous=True) - a for e, v, a in triples]

    def build_states(
        self, item: BoundEffect, symbols: Mapping[str, Any]
    ) -> Iterator[tuple[Any, Any, Any]]:
        """Yield the internal states of ``item``, each with its rate and its initial value."""
        for state in item.effect.states:
            what = f"states.{state.name}"
            rate = self._d.build(state.rate, symbols, f"{what}.rate", item)
            initial = self._d.build(state.initial, symbols, f"{what}.initial", item)
            # At the start, states between log and mechanism have their initial values.
            initial = self.put_in(initial).subs(self.initial, simultaneous=True)
            yield self._d.z[item.prefix, state.name], self.put_in(rate), initial

    def put_in(self, expr: Any) -> Any:
        """Return ``expr`` with the acting parts of logged inputs and derivatives in their place.

        Raises:
            InputError: it needs a derivative of an input that depends on the rates.
        """
        d, present = self._d, expr.free_symbols
        values = {symbol: value for symbol, value in self.acting.items() if symbol in present}
        for force in d.model.device.forces if self.acting else ():
            rates = [d.channel[derivative(force, k)] for k in range(1, LAST_ORDER + 1)]
            used = [k for k, rate in enumerate(rates, 1) if rate in present]
            value = self.acting.get(d.channel[force])
            for k in range(1, max(used) + 1) if used and value is not None else ():
                value = d.rate_along(value, self.rates)
                if value.has(*d.qdd):
                    raise InputError(f"the time derivative {k} of {force!r} is not known")
                values[d.channel[derivative(force, k)]] = value
        return expr.subs(values, simultaneous=True) if values else expr
