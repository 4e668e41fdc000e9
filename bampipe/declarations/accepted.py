"""The file ``accepted/<device>.json``: what later sessions of a device are held against."""

from typing import Any, Literal

from pydantic import Field

from bampipe.schema import Declaration, Text


class Accepted(Declaration):
    """What `bampipe accept` keeps, and gates with against = "accepted" read."""

    schema_: Literal["bampipe.accepted/1"] = Field(default="bampipe.accepted/1", alias="schema")
    device: Text = Field(description="Its name")
    session: str = Field(description="Session whose values were accepted")
    recorded_at: str | None = Field(default=None, description="When it was recorded")
    model: Text = Field(description="Model version whose values were accepted")
    results: dict[str, dict[str, dict[str, dict[str, Any]]]] = Field(
        description="By file of the run folder, {model} unresolved: its values as there"
    )
