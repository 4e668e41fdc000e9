"""A parameter of a model: its unit, prior and bounds."""

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from bampipe.errors import InputError
from bampipe.schema import NamedDeclaration, fault

LARGEST = 1e12
"""Largest prior, sd or bound: larger squares would lose all digits of those of sensor noise."""


def _refuse_huge(value: Any) -> Any:
    if isinstance(value, int | float) and LARGEST < abs(value) != math.inf:
        raise fault(
            f"beyond what can be computed with, {LARGEST:.0e}",
            remedy="give a physically possible value in SI units",
        )
    return value


PhysicalNumber = Annotated[float, BeforeValidator(_refuse_huge)]


class Parameter(NamedDeclaration):
    """One number of a model that data can estimate; its name is such as ``viscous.yaw``."""

    unit: str = Field(description="Coherent SI; empty for a pure number")
    prior: PhysicalNumber = Field(description="Value assumed before seeing data, in its unit")
    sd: PhysicalNumber = Field(ge=0, description="Standard deviation of that assumption")
    lower: PhysicalNumber = Field(default=-math.inf, allow_inf_nan=True)
    """Physical bound"""
    upper: PhysicalNumber = Field(default=math.inf, allow_inf_nan=True)
    """Physical bound"""
    strength: bool = Field(default=False, description="The effect is absent if this is 0")
    offset: bool = Field(default=False, description="Marks a strength that adds a mere constant")
    fixed: bool = Field(default=False, description="Held at its prior, never estimated")
    needs_pull: bool = False
    """Held at its prior on an axis that nothing pulls by its position"""
    weighed: bool = False
    """Whether least squares weighs the prior like data, as for numbers of a drawing"""
    typical: PhysicalNumber | None = None
    """Size at which the effect is clearly visible; strength 1 of the simulator"""
    within: Literal["travel", "upper part", "lower part", "beyond"] | None = None
    """For a position on the axis: the part of the travel where the diagnosis looks; beyond: outside
    of it, on either side"""
    searched: bool = True
    """Whether a diagnosis tries several values of it, not the prior"""
    values: int = Field(default=0, ge=0)
    """Number of values that it tries first; 0: as many as the width of the range asks for"""
    description: str = Field(default="", description="Meaning, in a few words")

    def cross_faults(self) -> Iterator[InputError]:
        if not self.lower <= self.prior <= self.upper:
            yield InputError(f"prior {self.prior} lies outside [{self.lower}, {self.upper}]")

    @property
    def shape(self) -> bool:
        """Whether it shapes an effect instead of scaling it, so that it is meaningless at zero."""
        return not self.strength and not self.fixed

    def renamed(self, name: str, **changes: object) -> "Parameter":
        """Return the parameter under its full name in a model, with other fields."""
        copy = self.model_copy(update=changes)
        copy._name = name
        return copy
