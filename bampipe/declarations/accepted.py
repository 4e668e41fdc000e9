"""The file ``accepted/<device>.json``: reference values for later sessions of a device."""

from typing import Any, Literal

from pydantic import Field

from bampipe.schema import Declaration, Text


class Accepted(Declaration):
    """Values that `bampipe accept` stores and gates with against = "accepted" read."""

    schema_: Literal["bampipe.accepted/1"] = Field(default="bampipe.accepted/1", alias="schema")
    device: Text = Field(description="Name of the device")
    session: str = Field(description="Session whose values were accepted")
    recorded_at: str | None = Field(default=None, description="Time of that session's recording")
    model: Text = Field(description="Model version whose values were accepted")
    results: dict[str, dict[str, dict[str, dict[str, Any]]]]
    """By file of the run folder, with {model} unresolved: accepted values from it"""
