"""The comparison of two sessions of one device by `bampipe compare A B`."""

from pydantic import Field

from bampipe.results.diagnose import AxisVerdict, ResidualMap
from bampipe.results.record import Names, Record, Share, Size

FAMILY_ERROR = 0.05
"""Probability of one or more false findings in each family of comparisons (Holm 1979)."""


class SessionOfPair(Record):
    """One of the two sessions; its verdicts in words by axis, none if it is not diagnosed."""

    session: str
    model: str
    verdicts: dict[str, str]


class ParameterChange(Record):
    """A parameter that both models have."""

    first: float
    first_sd: Size
    second: float
    second_sd: Size
    unit: str
    standard_errors: float = Field(description="Difference over its standard error")
    p_value: Share = Field(description="Corrected by Holm for all parameters")
    changed: bool = Field(description="Whether p_value is below 0.05")


class StateChange(Record):
    """Residual of the first model on both sessions by one variable, in the same bins."""

    axis: str
    variable: str
    first: ResidualMap
    second: ResidualMap
    p_values: tuple[Share, ...] = Field(description="By bin, corrected by Holm for all maps")

    @property
    def changed(self) -> int:
        """Number of bins in which the residual changed beyond chance."""
        return sum(p < FAMILY_ERROR for p in self.p_values)


class Travel(Record):
    """Error of a model of one session on the trials of the other, one axis."""

    error: Size
    own_error: Size = Field(description="Held-out error of the model of the trials' own session")
    noise_floor: Size | None
    uncertainty: Size = Field(description="Part of the error that the parameters' sd accounts for")
    limit: Size
    """Largest error of a model that travels, from the floor there, or from own_error if the model
    is above the floor of its own session"""
    unit: str
    travels: bool


class Refit(Record):
    """Some parameters of a model refitted to the other session, the others unchanged."""

    changes: dict[str, float] = Field(description="By parameter, in its unit")
    errors: dict[str, Size] = Field(description="By axis, on trials left out of the refit")
    travels: Names = Field(description="Axes on which the refitted model travels")


class Journey(Record):
    """The model of one session on the trials of the other."""

    model_of: str
    trials_of: str
    effects: Names = Field(description="Of the model")
    axes: dict[str, Travel]
    alone: tuple[Refit, ...] = Field(default=(), description="Single parameters, best first")
    together: Refit | None = None
    """Parameters added one at a time, the most useful first"""
    lacking: dict[str, AxisVerdict] = Field(default={})
    """By axis: verdict on a model with the same effects in the other session, where no refit
    reaches the limit or the own model is above its floor"""
    reason: str = Field(default="", description="Reason why these are not known")

    @property
    def failed(self) -> list[str]:
        """Axes on which the model does not travel."""
        return [axis for axis, entry in self.axes.items() if not entry.travels]


class PairResult(Record):
    """Two sessions of one device side by side."""

    device: str
    first: SessionOfPair
    second: SessionOfPair
    parameters: dict[str, ParameterChange]
    states: tuple[StateChange, ...]
    journeys: tuple[Journey, ...]
    notes: Names
    sentences: Names = ()
