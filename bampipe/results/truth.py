"""``<session>.truth.json``: the truth about a session made by `bampipe simulate`."""

from typing import Any, Literal

from pydantic import Field

from bampipe.results.record import Result


class TruthResult(Result, file="{session}.truth.json", stage="simulate"):
    """The hidden effects and parameters of a simulated session."""

    schema_: Literal["bampipe.truth/1"] = Field(alias="schema")
    device: str
    effects: dict[str, float] = Field(description="Hidden effects and their strengths")
    configuration: dict[str, Any] = Field(description="Every setting of the simulation")
    parameters: dict[str, float]
    stiffness: dict[str, float] = Field(description="By axis; empty without locked trials")
