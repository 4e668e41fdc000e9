"""A controller: how the force of a driven machine was commanded, declared in its device file.

A free run, a simulation of machine and controller together, needs it; nothing else does.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bampipe.errors import InputError, did_you_mean
from bampipe.physics import expression

KEYS = ("source", "channels", "rate_hz", "states", "command")


@dataclass(frozen=True)
class Integral:
    """One state of a controller, such as the integral of its error; kept within its limits.

    Attributes:
        unit: of the state.
        rate: its rate of change, of what a command may use; ``unit`` per second.
        lower, upper: where it stops, in ``unit``; infinite where it does not.
    """

    unit: str
    rate: ast.expr
    lower: float = -math.inf
    upper: float = math.inf


@dataclass(frozen=True)
class Controller:
    """A control law as its device file declares it.

    Attributes:
        channels: recorded references and gains that the law uses, with units.
        command: the law, by force channel, of measured motion, channels and constants.
        rate_hz: how often the controller acts; 0 where that is not known.
        states: what it remembers from one action to the next, by name.
        source: where the law comes from.
    """

    channels: Mapping[str, str]
    command: Mapping[str, ast.expr]
    rate_hz: float
    states: Mapping[str, Integral]
    source: str


def controller_from(
    entry: Mapping[str, Any] | None, forces: tuple[str, ...], where: str
) -> Controller | None:
    """Check the table ``[controller]`` of a device file; None where there is none.

    Args:
        entry: the table.
        forces: the device's force channels, all of which the law must command.
        where: file and table, for messages.

    Raises:
        InputError: something is missing, unknown or of the wrong type.
    """
    if entry is None:
        return None
    if not isinstance(entry, Mapping):
        raise InputError("expected a table", where=where)
    for key in entry:
        if key not in KEYS:
            raise InputError(f"unknown key {key!r}{did_you_mean(key, KEYS)}", where=where)
    channels, law = entry.get("channels", {}), entry.get("command")
    if not isinstance(channels, Mapping) or not all(isinstance(u, str) for u in channels.values()):
        raise InputError("channels must be a table, name = unit", where=where)
    rate = entry.get("rate_hz", 0.0)
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not 0.0 <= rate <= 1e6:
        raise InputError("rate_hz must be a number of times a second", where=where)
    if not isinstance(law, Mapping) or set(law) != set(forces):
        raise InputError(
            f"[controller.command] must have one expression for each of {', '.join(forces)}",
            where=where,
        )
    return Controller(
        channels=dict(channels),
        command={f: expression.parse(law[f], f"{where}.command.{f}") for f in forces},
        rate_hz=float(rate),
        states=_states(entry.get("states", {}), f"{where}.states"),
        source=str(entry.get("source", "")),
    )


def _states(entries: object, where: str) -> dict[str, Integral]:
    if not isinstance(entries, Mapping):
        raise InputError("expected a table, name = { unit, rate }", where=where)
    states = {}
    for name, entry in entries.items():
        at = f"{where}.{name}"
        if not isinstance(entry, Mapping) or not isinstance(entry.get("unit"), str):
            raise InputError('expected { unit = "rad.s", rate = "goal - joint" }', where=at)
        for key in entry:
            if key not in ("unit", "rate", "lower", "upper"):
                raise InputError(f"unknown key {key!r}", where=at)
        limits = [entry.get("lower", -math.inf), entry.get("upper", math.inf)]
        if any(isinstance(v, bool) or not isinstance(v, int | float) for v in limits):
            raise InputError("lower and upper must be numbers", where=at)
        if not limits[0] < limits[1]:
            raise InputError("lower must be below upper", where=at)
        rate = expression.parse(entry.get("rate"), f"{at}.rate")
        states[name] = Integral(entry["unit"], rate, float(limits[0]), float(limits[1]))
    return states
