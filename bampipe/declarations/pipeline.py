"""Pipeline files: stages to run, their settings, and limits for the results."""

from collections.abc import Iterator
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, PrivateAttr, StringConstraints

from bampipe.errors import InputError
from bampipe.schema import Declaration, Distinct, Number, Several, Text, checked_by, fault
from bampipe.stages import base


def _in_order(stages: tuple[str, ...]) -> tuple[str, ...]:
    order = [base.STAGES.index(stage) for stage in stages]
    if order != sorted(set(order)):
        raise fault(
            "each stage must stand once, and in order",
            remedy=f"the order is {', '.join(base.STAGES)}",
        )
    return stages


StageName = Annotated[str, AfterValidator(checked_by(base.check_stage_name))]
NumberPath = Annotated[
    str,
    StringConstraints(pattern=r"^[^*]*(\*[^*]*)?$"),
    Field(description="a dotted path of a number; one * stands for every key at its place"),
]


class Gate(Declaration):
    """A limit for one number of a result, or for that number on each axis."""

    name: Text = Field(description="Purpose of the gate, in a few words")
    result: Annotated[
        str,
        StringConstraints(pattern=r"^[^/].*\.json$"),
        Field(description="a JSON file in the run folder; {model} is the model that is judged"),
    ]
    value: NumberPath
    divide_by: NumberPath = Field(
        default="", description="a dotted path of a number by which the value is divided"
    )
    against: Literal["", "accepted"] = ""
    """Judge the change from the accepted values instead, in percent; a change beyond the limit, but
    within two standard deviations, only warns"""
    judged_by: NumberPath = Field(
        default="", description="a dotted path of a word that says whether the value passes"
    )
    passes: Distinct[Text] = Field(default=(), description="Words of judged_by that pass")
    max: Number | None = None
    """Largest value that passes; for a list, the most entries"""
    min: Number | None = Field(default=None, description="Smallest value that passes")
    level: Literal["fail", "warn"] = "fail"
    """fail: exit code 1; warn: reported, but the run counts as good"""
    optional: bool = Field(default=False, description="Whether a missing result passes")
    advice: str = Field(default="", description="What to do if the gate does not pass")
    advice_on: dict[str, Text] = Field(default={})
    """Other advice for some words of judged_by, by word"""

    def cross_faults(self) -> Iterator[InputError]:
        if self.max is None and self.min is None and not self.judged_by:
            yield InputError("neither 'max' nor 'min'", remedy="give the limit, or 'judged_by'")
        if bool(self.judged_by) != bool(self.passes):
            yield InputError("'judged_by' and 'passes' go together", remedy="give both, or neither")
        if self.advice_on and not self.judged_by:
            yield InputError("'advice_on' without 'judged_by'", remedy="give the path of the word")


class BaseModelTable(Declaration):
    """The base model, if it differs from the bare device of the session."""

    device: str = ""
    """Device of the base model; the session's by default"""
    effects: Distinct[Text] = ()
    """Effects of the base model, name[:target]"""


class Pipeline(Declaration):
    """Work of ``bampipe run``."""

    schema_: Literal["bampipe.pipeline/1"] = Field(alias="schema")
    name: Annotated[str, StringConstraints(pattern="^[A-Za-z0-9_-]+$")]
    """Letters, digits, '_' and '-'"""
    summary: str = Field(default="", description="Purpose of the pipeline, in one sentence")
    stages: Annotated[Several[StageName], AfterValidator(_in_order), Field(min_length=1)]
    """The stages, in order"""
    model: BaseModelTable = BaseModelTable()
    """The base model, if it is not the bare device"""
    settings: dict[StageName, dict[str, Any]] = Field(default={})
    """By stage: fields of its configuration that replace the defaults"""
    gates: Several[Gate] = Field(default=(), description="Limits for the results")
    _where: str = PrivateAttr("")

    @property
    def where(self) -> str:
        """The file of the pipeline, for messages."""
        return self._where or f"pipeline {self.name}"

    @property
    def base_model(self) -> tuple[str, tuple[str, ...]]:
        """Device and effects of the base model."""
        return self.model.device, self.model.effects

    def with_every_stage(self) -> Self:
        """Return the pipeline for single stages: with its settings, but with every stage."""
        return self.model_copy(update={"stages": base.STAGES})
