"""``models/<model>/viscous.json``: damping at the handle in the viscous trials."""

from typing import Annotated, Literal

from pydantic import Field

from bampipe.results.record import Names, Record, Result, Share, Size


class Damping(Record):
    """Damping along one component of the handle's force, N.s/m."""

    estimate: float = Field(description="Rendered by the brakes")
    sd: Size
    own_friction: float = Field(description="The device's own viscous friction, as felt there")
    felt: float = Field(description="Both together")
    unit: Literal["N.s/m"]
    commanded: float | None = None
    """null if it is not recorded, as are the following"""
    p_value: Share | None = None
    differs: bool | None = None
    felt_differs: bool | None = None
    verdict: str | None = None


class ViscousResult(Result, file="models/{model}/viscous.json", stage="viscous"):
    """Damping at the handle in the viscous trials."""

    model: str
    headline: str
    trials: Names
    blocks: Annotated[int, Field(ge=1)] | None = None
    """Number of stretches of time whose scatter gives the standard deviations"""
    directions: dict[str, Damping]
    """By component of the handle's force; empty without viscous trials"""
