"""Quantities that the residual of an axis may follow, and their ranges."""

from dataclasses import dataclass

from bampipe.physics.device import Device

_NEAR = 2
"""Axes whose motion may matter, in the order of the coordinates; see `effect.pairs`."""


@dataclass(frozen=True)
class Quantity:
    """A quantity that a residual may follow.

    Attributes:
        words: what it is, such as ``position``, ``extension speed``.
        name: the same as part of a name.
        text: in an expression of an effect.
        quantity: ``position``, ``speed``, ``velocity``, ``direction``, ``load``, ``time``,
            ``command`` (of a brake or of an input that is no force), ``reading`` (of a force).
        axis: number of the coordinate that it is of; of the axis itself where of no other.
        unit: SI.
        channel: of a command or a reading, where it is logged.
    """

    words: str
    name: str
    text: str
    quantity: str
    axis: int
    unit: str
    channel: str = ""


@dataclass(frozen=True)
class Span:
    """The range of a coordinate in the trials."""

    low: float
    high: float

    @property
    def width(self) -> float:
        """From end to end."""
        return self.high - self.low

    @property
    def middle(self) -> float:
        """Half-way."""
        return 0.5 * (self.low + self.high)


def coordinates(device: Device, axis: int) -> tuple[Quantity, ...]:
    """What the residual of ``axis`` may follow."""
    own = device.coordinates[axis]
    found = [
        Quantity("position", "position", "q", "position", axis, own.unit),
        Quantity("speed", "speed", "abs(qd)", "speed", axis, f"{own.unit}/s"),
        Quantity("velocity", "velocity", "qd", "velocity", axis, f"{own.unit}/s"),
        Quantity("direction", "direction", "sgn(qd)", "direction", axis, ""),
        Quantity("load", "load", "load", "load", axis, own.torque_unit),
        Quantity("time", "time", "t", "time", axis, "s"),
    ]
    if own.name in device.brakes:
        brake, unit = device.brakes[own.name], own.torque_unit
        found.append(Quantity("brake command", "brake", "brake", "command", axis, unit, brake))
    for name, unit in device.channels.items():
        found.append(Quantity(name, name, name, "command", axis, unit, name))
    for name, channel in zip(device.components, device.forces, strict=True):
        words, unit = f"{name} reading", device.force_unit
        found.append(Quantity(words, "reading", "f", "reading", axis, unit, channel))
    for k, other in enumerate(device.coordinates):
        if 0 < abs(k - axis) <= _NEAR:
            n, u = other.name, other.unit
            found += [
                Quantity(f"{n} position", f"{n}_position", n, "position", k, u),
                Quantity(f"{n} speed", f"{n}_speed", f"abs(qd_{n})", "speed", k, f"{u}/s"),
                Quantity(f"{n} velocity", f"{n}_velocity", f"qd_{n}", "velocity", k, f"{u}/s"),
            ]
    return tuple(found)
