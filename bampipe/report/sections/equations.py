"""The model: its equations of motion with the identified numbers in them."""

from __future__ import annotations

from bampipe.report.document import Formulas, Paragraph, Section
from bampipe.report.results import Results
from bampipe.results.terms import TermsResult

TITLE = "Equations of motion"


def section(results: Results) -> Section | None:
    """Return the section; None where no equations are stored."""
    terms = results.read(TermsResult)
    if terms is None or not terms.equations:
        return None
    effects = results.effects(results.model)
    with_effects = f" with {', '.join(f'`{name}`' for name in effects)}" if effects else ""
    words = (
        f"Model `{terms.model}`{with_effects}: M q'' + h = Q, with the identified numbers put in. "
        "Primes are derivatives by time, M is the mass matrix, h holds Coriolis, centrifugal and "
        "gravity terms, Q the generalised forces. Names without a number are inputs, coordinates, "
        "or numbers of the device (under Device)."
    )
    return Section(TITLE, (Paragraph(words), Formulas(terms.equations)))
