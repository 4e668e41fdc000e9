"""The model: its equations of motion with the identified numbers in them."""

from bampipe.report.document import Formulas, Paragraph, Section
from bampipe.report.run_results import Results
from bampipe.results.terms import TermsResult


def section(results: Results) -> Section | None:
    """Return the section; None where no equations are stored."""
    terms = results.read(TermsResult)
    if terms is None or not terms.equations:
        return None
    words = (
        f"Model `{terms.model}`{results.list_effects()}: M q'' + h = Q, with the identified "
        "numbers put in. Primes are derivatives with respect to time. M is the mass matrix, h "
        "holds Coriolis, centrifugal and gravity terms, Q the generalised forces. Names without a "
        "number are inputs, coordinates, or numbers of the device (under Device)."
    )
    return Section("Equations of motion", (Paragraph(words), Formulas(terms.equations)))
