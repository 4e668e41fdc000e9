"""``lab/lab.json`` and ``lab/trends.json``: a lab's sessions, and control charts over them."""

from typing import Literal

from pydantic import Field

from bampipe.results.record import Names, Record, Result, Share, Size
from bampipe.schema import Count


class LabResult(Result, file="lab.json", stage="lab"):
    """The sessions and tables of a lab's data set."""

    schema_: Literal["bampipe.lab/1"] = Field(alias="schema")
    sessions: Names = Field(description="In the order of their recording")
    skipped: Names = Field(description="Runs that could not be read, and why")
    tables: dict[str, Count] = Field(description="Rows of each table")


class ChartPoint(Record):
    """One session on a control chart."""

    session: str
    estimate: float
    sd: Size
    lower: float | None = Field(description="Control limit")
    upper: float | None
    outside_limits: bool


class ControlChart(Record):
    """A parameter of the base model, or ``stiffness.<axis>``, over all sessions of a device."""

    device: str
    name: str
    unit: str
    centre: float = Field(description="Median")
    between_sd: Size | None
    """Scatter between sessions, without the uncertainty within them"""
    slope_per_session: float | None
    slope_p: Share | None
    drifts: bool
    run: tuple[str, str] | None
    """First and last session of a run on one side of the centre, or null"""
    points: tuple[ChartPoint, ...]

    @property
    def has_limits(self) -> bool:
        """Whether there are enough sessions for control limits."""
        return self.points[0].lower is not None


class MovedParameter(Record):
    """A parameter beyond its control limits."""

    parameter: str
    estimate: float
    centre: float
    percent: float | None = Field(description="From the centre")
    unit: str


class SessionVerdict(Record):
    """The verdict on one session."""

    session: str
    device: str
    model: str = Field(description="The best confirmed model, whose errors are judged")
    recorded: str = Field(description='ISO 8601, or ""')
    verdict: str
    moved: tuple[MovedParameter, ...]
    effects: Names
    unexplained: Names = Field(description="Axes on which something unknown is missing")
    diagnosed: bool
    worst: tuple[float, str] | None
    """Largest held-out error of that model over its floor, and its axis; or null"""
    above_floor: bool = Field(description="Whether that model is above its floor on some axis")
    sentence: str
    remedy: str


class TrendsResult(Result, file="trends.json", stage="lab"):
    """Control charts of a lab's parameters, and a verdict on each session."""

    schema_: Literal["bampipe.trends/1"] = Field(alias="schema")
    fewest_sessions: int = Field(ge=1, description="Fewest sessions for control limits")
    series: tuple[ControlChart, ...]
    sessions: tuple[SessionVerdict, ...]
