"""``models/<model>/terms.json``: the equations of a model and the force of each term."""

from pydantic import Field

from bampipe.results.record import Names, Record, Result, Share


class EffectText(Record):
    """The text of an effect file."""

    summary: str
    formulas: Names
    looks_like: str
    on_the_machine: str = Field(description="Remedy on the machine; may be empty")
    source: str


class TermCurve(Record):
    """Force that a term takes on one axis, against the variable that it follows most."""

    axis: str
    unit: str = Field(description="Of the force")
    variable: str
    variable_unit: str
    center: tuple[float, ...] = Field(description="One value per bin of the trials' samples")
    mean: tuple[float, ...]
    low: tuple[float, ...] = Field(description="95 % band by the parameters' covariance")
    high: tuple[float, ...]
    variance_share: Share = Field(description="Share of the term's variance that the bins carry")


class ModelTerm(Record):
    """Friction of an axis, or an effect."""

    name: str
    text: EffectText
    parameters: Names
    curves: tuple[TermCurve, ...]


class TermsResult(Result, file="models/{model}/terms.json", stage="validate"):
    """The equations of a model, and the force of each of its terms."""

    model: str
    equations: Names
    """Lines of M q'' + h = Q with identified numbers; may be empty"""
    terms: tuple[ModelTerm, ...]
