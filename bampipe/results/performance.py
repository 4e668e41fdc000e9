"""``models/<model>/performance.json``: the device at its handle, and its constants."""

from pydantic import Field

from bampipe.results.record import Names, Record, Result, Size


class Quantity(Record):
    """A size and its unit."""

    value: Size
    unit: str


class Resolution(Record):
    """Step of an encoder; null where none is declared."""

    value: Size | None
    unit: str


class Range(Record):
    """From the lowest to the highest value."""

    lower: float
    upper: float
    unit: str


class DeviceConstant(Record):
    """A constant of the device file."""

    value: float
    unit: str
    source: str
    description: str


class Handle(Record):
    """The handle, if it can be pushed in as many directions as there are axes."""

    directions: Names
    workspace: Quantity = Field(description="Swept in the session")
    stiffness: Range | None = None
    friction: Range
    inertia: Range


class PerformanceResult(Result, file="models/{model}/performance.json", stage="performance"):
    """Stiffness, friction and inertia at the handle, and the numbers of the device file."""

    model: str
    headline: str
    constants: dict[str, DeviceConstant]
    range: dict[str, Range] = Field(min_length=1, description="By axis, over the moving trials")
    resolution: dict[str, Resolution] = Field(description="By axis")
    largest_force: Quantity | None
    """Largest that the sensor read (99.9 % quantile); null where there is none"""
    handle: Handle | None = None
