"""A parameter of a model: its name, unit, prior and bounds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from bampipe.errors import InputError

_KEYS = frozenset(
    {
        "unit",
        "prior",
        "sd",
        "lower",
        "upper",
        "strength",
        "fixed",
        "typical",
        "description",
    }
)


@dataclass(frozen=True)
class Parameter:
    """One number of the model that data can estimate.

    Attributes:
        name: full name, such as ``viscous.yaw`` or ``stribeck.yaw.force``.
        unit: SI unit as text, ``""`` where dimensionless.
        prior: value assumed before seeing data, in ``unit``.
        sd: standard deviation of that assumption, in ``unit``.
        lower, upper: physical bounds, in ``unit``; infinite where there are none.
        strength: the effect is absent when this parameter is zero.
        fixed: held at ``prior``, never estimated.
        typical: size at which the effect is clearly there; used by the simulator.
        description: one sentence for a person.
    """

    name: str
    unit: str
    prior: float
    sd: float
    lower: float = -math.inf
    upper: float = math.inf
    strength: bool = False
    fixed: bool = False
    typical: float | None = None
    description: str = ""

    @property
    def shape(self) -> bool:
        """Whether it shapes an effect instead of scaling it, so that it is meaningless at zero."""
        return not self.strength and not self.fixed


LARGEST = 1e12
"""Of a prior, its sd or a bound: beyond, squares beside those of sensor noise lose all digits."""


def parameter_from(name: str, entry: object, where: str) -> Parameter:
    """Check one ``[parameters.*]`` entry and make a `Parameter` of it.

    Args:
        name: full name to give it.
        entry: the mapping read from TOML.
        where: file and field, for messages.

    Raises:
        InputError: a key is unknown or missing, a value is not a finite number, or the prior
            lies outside the bounds.
    """
    if not isinstance(entry, Mapping):
        raise InputError("expected a table { unit = ..., prior = ..., sd = ... }", where=where)
    unknown = sorted(set(entry) - _KEYS)
    if unknown:
        raise InputError(
            f"unknown key {unknown[0]!r}",
            where=where,
            remedy=f"known keys: {sorted(_KEYS)}",
        )
    for key in ("unit", "prior", "sd"):
        if key not in entry:
            raise InputError(f"{key!r} is missing", where=where, remedy="give unit, prior and sd")
    numbers = {}
    for key in ("prior", "sd", "lower", "upper", "typical"):
        if key in entry:
            value = entry[key]
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise InputError(f"{key} must be a number, found {value!r}", where=where)
            endless = isinstance(value, float) and math.isinf(value)
            if value != value or (endless and key in ("prior", "sd", "typical")):
                raise InputError(f"{key} must be finite, found {value!r}", where=where)
            if not endless and abs(value) > LARGEST:
                raise InputError(
                    f"{key} is beyond what can be computed with, {LARGEST:.0e}",
                    where=where,
                    remedy="give what is physically possible, in SI units",
                )
            numbers[key] = float(value)
    for key in ("strength", "fixed"):
        if not isinstance(entry.get(key, False), bool):
            raise InputError(f"{key} must be true or false", where=where)
    if not isinstance(entry["unit"], str):
        raise InputError(f"unit must be text, found {entry['unit']!r}", where=where)
    parameter = Parameter(
        name=name,
        unit=entry["unit"],
        prior=numbers["prior"],
        sd=numbers["sd"],
        lower=numbers.get("lower", -math.inf),
        upper=numbers.get("upper", math.inf),
        strength=entry.get("strength", False),
        fixed=entry.get("fixed", False),
        typical=numbers.get("typical"),
        description=str(entry.get("description", "")),
    )
    if not parameter.lower <= parameter.prior <= parameter.upper:
        raise InputError(
            f"prior {parameter.prior} lies outside [{parameter.lower}, {parameter.upper}]",
            where=where,
        )
    if parameter.sd < 0:
        raise InputError(f"sd must not be negative, found {parameter.sd}", where=where)
    return parameter
