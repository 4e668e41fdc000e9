"""A controller: how the force of a driven machine was commanded, declared in its device file.

A free run, a simulation of machine and controller together, needs it; nothing else does.
"""

import math
from collections.abc import Iterator

from pydantic import Field

from bampipe.errors import InputError
from bampipe.physics.expression import Expression, Name
from bampipe.schema import Declaration


class Integral(Declaration):
    """One state of a controller, such as the integral of its error; kept within its limits."""

    unit: str = Field(description="Coherent SI")
    rate: Expression = Field(
        description=(
            "Its rate of change, in the quantities that a command may use; its unit per second"
        )
    )
    lower: float = Field(default=-math.inf, allow_inf_nan=True, description="Where it stops")
    upper: float = Field(default=math.inf, allow_inf_nan=True, description="Where it stops")

    def cross_faults(self) -> Iterator[InputError]:
        if not self.lower < self.upper:
            yield InputError("lower must be below upper")


class Controller(Declaration):
    """A control law as its device file declares it."""

    channels: dict[Name, str] = Field(
        default={}, description="Recorded references and gains, name = unit"
    )
    rate_hz: float = Field(default=0.0, ge=0, le=1e6, description="How often it acts; 0 if unknown")
    states: dict[Name, Integral] = Field(
        default={}, description="Its states, such as the integral of its error"
    )
    command: dict[Name, Expression] = Field(
        description="The command, by force channel, from measured motion, channels and constants"
    )
    source: str = Field(default="", description="Source of the law")
