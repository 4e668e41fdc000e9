"""The grammar of drafts: a form is a factor times a shape of one quantity.

With estimates of its constants, a form is an effect file like any other.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal

import numpy as np

from bampipe.diagnosis.drafts.shapes import KNOTS, Shape
from bampipe.lists import join_names
from bampipe.physics.device import Coordinate as Axis
from bampipe.physics.device import Device

FORCE: Final = "force"
FRICTION: Final = "friction"
DAMPING: Final = "damping"
INERTIA: Final = "inertia"
READING: Final = "reading"
Factor = Literal["force", "friction", "damping", "inertia", "reading"]
FACTORS: Mapping[Factor, str] = {
    FORCE: "{shape}",
    FRICTION: "({shape})*sgn({rate})",
    DAMPING: "({shape})*{rate}/top_speed",
    INERTIA: "({shape})*{rate}**2/(2*top_acceleration)",
    READING: "f - ({shape})",
}

# Shapes by quantity, by whether it belongs to the axis itself, and by factor. Effects of the
# library are left out: springs and stops, rippling friction, drag, friction by load or by pose.
_CURVES = ("parabola", "cubic", "bump", "snag", "step")
_MEMORY = ("hysteresis", "two_hystereses")
GRAMMAR: Mapping[tuple[str, bool, Factor], tuple[str, ...]] = {
    ("position", True, FORCE): (*_CURVES, "dead_zone", "ripple", "relaxing", "play", *_MEMORY),
    ("position", True, FRICTION): ("slope", "parabola", "cubic", "bump", "step", "rise", "fall"),
    ("position", True, DAMPING): ("slope", "parabola", "bump", "step"),
    ("position", True, INERTIA): ("slope", "bump"),
    ("position", False, FORCE): ("slope", *_CURVES, "rise", "fall", "ripple"),
    ("position", False, FRICTION): ("parabola", "bump", "step", "rise", "fall"),
    ("position", False, DAMPING): ("parabola", "bump", "step"),
    ("position", False, INERTIA): ("slope", "parabola"),
    ("speed", True, FORCE): ("parabola", "bump", "decay"),
    ("speed", True, FRICTION): ("cubic", "bump", "decay", "rise", "lagging"),
    ("speed", False, FRICTION): ("slope", "decay"),
    ("velocity", False, FORCE): ("slope", "step"),
    ("velocity", True, FORCE): ("lagging",),
    ("direction", True, FORCE): ("lagging",),
    ("load", True, FRICTION): ("parabola", "rise"),
    ("time", True, FORCE): ("slope", "decay", "ripple"),
    ("time", True, FRICTION): ("slope", "decay"),
    ("time", True, DAMPING): ("slope", "decay"),
    ("command", True, FORCE): ("slope", "parabola", "step", *_MEMORY),
    ("command", True, FRICTION): ("slope", "parabola", "rise", *_MEMORY),
    ("command", True, DAMPING): ("slope", "parabola"),
    ("reading", True, READING): ("parabola", "cubic", "dead_zone", *_MEMORY),
}
CURVED: Mapping[tuple[str, bool, Factor], tuple[str, ...]] = {
    (quantity, own, factor): ("curve",)
    for quantity, own in (("position", True), ("position", False), ("speed", True))
    for factor in (FORCE, FRICTION)
}
"""Curves through points instead of formulas."""
_ACTS_AND_SHOWS = {
    FORCE: ("A force on the axis", "the same in both directions of motion"),
    FRICTION: ("Friction on the axis", "opposite in the two directions of motion"),
    DAMPING: ("Damping on the axis", "in proportion to velocity"),
    INERTIA: ("Inertia on the axis", "in proportion to acceleration"),
    READING: ("An error of the sensor", "as an error of the measured force"),
}


_NEAR = 2
"""Largest distance of another axis in the order of the coordinates; see `effect.pairs`."""


@dataclass(frozen=True)
class Quantity:
    """A quantity on which a residual may depend.

    Attributes:
        words: name in a sentence, such as ``position`` or ``extension speed``.
        text: name in the expression of an effect.
        quantity: kind: ``position``, ``speed``, ``velocity``, ``direction``, ``load``, ``time``,
            ``command`` (to a brake or another input that is no force) or ``reading`` (of a force).
        axis: index of its coordinate, by default the axis of the residual.
        channel: logged channel of a command or a reading.
    """

    words: str
    text: str
    quantity: str
    axis: int
    unit: str
    channel: str = ""

    @property
    def name(self) -> str:
        """Words as part of a name."""
        return self.words.removesuffix(" command").replace(" ", "_")


@dataclass(frozen=True)
class Span:
    """The range of a quantity in the trials."""

    low: float
    high: float

    @property
    def width(self) -> float:
        """Distance of the ends."""
        return self.high - self.low

    @property
    def middle(self) -> float:
        """Middle of the range."""
        return 0.5 * (self.low + self.high)


def list_quantities(device: Device, axis: int) -> tuple[Quantity, ...]:
    """Return the quantities on which the residual of ``axis`` may depend."""
    own, brake = device.coordinates[axis], device.brakes.get(device.coordinates[axis].name)
    found = [
        Quantity("position", "q", "position", axis, own.unit),
        Quantity("speed", "abs(qd)", "speed", axis, f"{own.unit}/s"),
        Quantity("velocity", "qd", "velocity", axis, f"{own.unit}/s"),
        Quantity("direction", "sgn(qd)", "direction", axis, ""),
        Quantity("load", "load", "load", axis, own.torque_unit),
        Quantity("time", "t", "time", axis, "s"),
    ]
    if brake is not None:
        found.append(Quantity("brake command", "brake", "command", axis, own.torque_unit, brake))
    for name, unit in device.channels.items():
        found.append(Quantity(name, name, "command", axis, unit, name))
    for name, channel in zip(device.components, device.forces, strict=True):
        unit = device.force_unit
        found.append(Quantity(f"{name} reading", "f", "reading", axis, unit, channel))
    for k, other in enumerate(device.coordinates):
        if 0 < abs(k - axis) <= _NEAR:
            n, u = other.name, other.unit
            found += [
                Quantity(f"{n} position", n, "position", k, u),
                Quantity(f"{n} speed", f"abs(qd_{n})", "speed", k, f"{u}/s"),
                Quantity(f"{n} velocity", f"qd_{n}", "velocity", k, f"{u}/s"),
            ]
    return tuple(found)


@dataclass(frozen=True)
class Form:
    """A factor times a shape of a quantity, acting on one axis.

    Attributes:
        axis, number: axis that it acts on, and its index.
        coordinate, span: quantity that it depends on, and its range in the trials.
        times: time between samples, and duration of a trial, s.
        scale: highest speed or acceleration of the axis if that is the factor, else 1.
        other_quantities: further quantities, ``x2``, ``x3`` in the shape, and their ranges.
        prefix: prefix of its name if the model has a form of that name already.
        takes_timing: always false, since no form delays a force.
        combines: always 1, see `Candidate.combines`.
    """

    axis: Axis
    number: int
    factor: Factor
    shape: Shape
    coordinate: Quantity
    span: Span
    times: Span
    scale: float
    other_quantities: tuple[tuple[Quantity, Span], ...] = ()
    prefix: str = ""
    takes_timing: ClassVar[bool] = False
    combines: ClassVar[int] = 1

    @property
    def quantities(self) -> tuple[tuple[Quantity, Span], ...]:
        """All quantities that it depends on, with their ranges."""
        return ((self.coordinate, self.span), *self.other_quantities)

    @property
    def name(self) -> str:
        """Name of the effect: ``bump_by_position``, ``slope_by_extension_position_on_yaw``."""
        if self.factor == READING:
            return f"{self.prefix}{self.shape.name}_of_reading"
        head = self.prefix + ("" if self.factor == FORCE else f"{self.factor}_")
        tail = "" if self.is_own else f"_on_{self.axis.name}"
        by = "" if self.other_quantities else f"_by_{self.coordinate.name}"
        return f"{head}{self.shape.name}{by}{tail}"

    @property
    def is_own(self) -> bool:
        """Whether it involves one axis only, so that its file fits any axis."""
        own = all(quantity.axis == self.number for quantity, _ in self.quantities)
        return own and self.factor != READING

    @property
    def target(self) -> str:
        """Axis or force component that its file applies to; empty if the file names its axes."""
        if self.factor == READING:
            return self.coordinate.words.removesuffix(" reading")
        return self.axis.name if self.is_own else ""

    @property
    def canonical_name(self) -> str:
        """Name in a model, ``name:target``."""
        return f"{self.name}:{self.target}" if self.target else self.name

    @property
    def unit(self) -> str:
        """Unit of the strengths."""
        return self.coordinate.unit if self.factor == READING else self.axis.torque_unit

    @property
    def parameters(self) -> dict[str, str]:
        """Names of the estimated parameters in a model, strengths first, by short name."""
        head = self.canonical_name.replace(":", ".")
        return {n: f"{head}.{n}" for n in (*self.shape.strengths, *self.shape.searched)}

    @property
    def expression(self) -> str:
        """Expression of an effect file: the torque, or the kinetic energy of an inertia."""
        rate = "qd" if self.is_own else f"qd_{self.axis.name}"
        shape = self._of_coordinate(self.shape.text)
        return FACTORS[self.factor].format(shape=shape, rate=rate)

    def _of_coordinate(self, text: str) -> str:
        def written(found: re.Match[str]) -> str:
            quantity, _ = self.quantities[_number_of(found[0])]
            if not self.is_own and quantity.axis == self.number:
                # In a file that names its axes, no quantity may omit its axis.
                known = _OF_AXIS.get(quantity.text, quantity.channel or quantity.text)
                return known.format(axis=self.axis.name)
            return quantity.text

        return re.sub(r"\bx\d*\b", written, text)

    @property
    def _words(self) -> str:
        words = join_names([quantity.words for quantity, _ in self.quantities])
        return self.shape.words.format(x=words)

    @property
    def summary(self) -> str:
        """Description in one sentence."""
        return f"{_ACTS_AND_SHOWS[self.factor][0]} that {self._words}"

    @property
    def looks_like(self) -> str:
        """Appearance in a residual."""
        seen = "" if self.other_quantities else f", {_ACTS_AND_SHOWS[self.factor][1]}"
        return f"residual that {self._words}{seen}"

    def fixed_constants(self) -> dict[str, tuple[float, str]]:
        """Return the constants that are not estimated, with their units."""
        found = {}
        for name in self.shape.fixed:
            quantity, span = self.quantities[_number_of(name)]
            known = {
                "middle": (span.middle, quantity.unit),
                "reach": (0.5 * span.width, quantity.unit),
                "start": (span.low, quantity.unit),
                "spacing": (span.width / (KNOTS - 1), quantity.unit),
                "settling": (0.5 * self.times.low, "s"),
            }
            value, unit = known[name.rstrip("0123456789")]
            found[name] = (round_constant(value), unit)
        if self.factor == DAMPING:
            found["top_speed"] = (round_constant(self.scale), f"{self.axis.unit}/s")
        if self.factor == INERTIA:
            found["top_acceleration"] = (round_constant(self.scale), f"{self.axis.unit}/s2")
        return found

    def constants_at(self, searched: Mapping[str, float], interval: float) -> dict[str, float]:
        """Return all constants of the shape, and the time between samples, s."""
        fixed = {name: value for name, (value, _) in self.fixed_constants().items()}
        return fixed | {"interval": interval} | dict(searched)

    def limits(self) -> dict[str, tuple[float, float, str]]:
        """Return lower and upper bound and unit of the searched constants."""
        low, width, unit = self.span.low, self.span.width, self.coordinate.unit
        by_kind = {
            "place": (low - 0.25 * width, low + 1.25 * width, unit),
            "length": (0.003 * width, 2.0 * width, unit),
            "wavenumber": (0.4 * np.pi / width, 1e4 * np.pi / width, f"1/{unit}"),
            "time": (2.0 * self.times.low, 2.0 * self.times.high, "s"),
            "number": (-_LARGEST, _LARGEST, ""),
        }
        return {name: by_kind[kind] for name, kind in self.shape.searched.items()}

    def entries(self) -> dict[str, dict[str, Any]]:
        """Return the parameters of its effect file before any estimate."""
        found: dict[str, dict[str, Any]] = {}
        for name, words in self.shape.strengths.items():
            found[name] = {
                "unit": self.unit, "prior": 0.0, "sd": 1.0, "strength": True, "description": words,
            }  # fmt: skip
        for name, (low, high, of) in self.limits().items():
            low, high = round_constant(low), round_constant(high)
            middle = 0.5 * (low + high) if low <= 0.0 else float(np.sqrt(low * high))
            found[name] = {
                "unit": of, "prior": round_constant(middle),
                "sd": round_constant(0.1 * (high - low)), "lower": low, "upper": high,
                "description": KINDS_IN_WORDS[self.shape.searched[name]],
            }  # fmt: skip
        for name, (value, of) in self.fixed_constants().items():
            found[name] = {
                "unit": of, "prior": value, "sd": 0.0, "fixed": True,
                "description": "scales the formula",
            }  # fmt: skip
        return found

    def declaration(
        self, source: str, entries: Mapping[str, Mapping[str, Any]] | None = None
    ) -> dict[str, Any]:
        """Return the content of its effect file, with parameters ``entries`` or else `entries`."""
        parameters: dict[str, Any] = {}
        for key, entry in (entries or self.entries()).items():
            numbers = {k: value for k, value in entry.items() if k != "description"}
            # An axis has the units of its kind, rotational or linear.
            held = {self.axis.kind: numbers} if self.is_own else numbers
            parameters[key] = {"description": entry["description"], **held}
        scope = "axis" if self.is_own else "device"
        acts: dict[str, Any] = {"kind": "torque", "torque": self.expression}
        if self.factor == INERTIA:
            acts = {"kind": "energy", "kinetic": self.expression}
        elif self.factor == READING:
            scope, acts = "force_component", {"kind": "input", "input": self.expression}
        elif not self.is_own:
            acts["torque"] = {self.axis.name: self.expression}
        return {
            "schema": "bampipe.effect/1",
            "name": self.name,
            "summary": self.summary,
            "scope": scope,
            "looks_like": self.looks_like,
            "source": source,
            **acts,
            "parameters": parameters,
            **self._states(),
        }

    def _states(self) -> dict[str, Any]:
        unit: dict[str, Any] = {"unit": self.coordinate.unit}
        held = {self.axis.kind: unit} if self.is_own else unit
        states = {
            name: {key: self._of_coordinate(text) for key, text in of.items()} | held
            for name, state in self.shape.states.items()
            for of in [{"rate": state.rate, "initial": state.initial}]
        }
        return {"states": states} if states else {}


_OF_AXIS = {"q": "{axis}", "qd": "qd_{axis}", "sgn(qd)": "sgn(qd_{axis})", "load": "load_{axis}"}
_LARGEST = 50.0
"""Largest pure number in a formula, whose quantities are ratios."""


def _number_of(name: str) -> int:
    """Return the index of the quantity of a name such as ``x``, ``x2`` or ``middle2``."""
    digits = name[len(name.rstrip("0123456789")) :]
    return int(digits) - 1 if digits else 0


KINDS_IN_WORDS = {
    "place": "position",
    "length": "width",
    "time": "time constant",
    "number": "pure number of the formula",
    "wavenumber": "2 pi over the distance of two ripples",
}


def round_constant(value: float) -> float:
    """Round to six digits, so that a constant is the same on every machine."""
    return float(f"{value:.6g}")
