"""The model: its equations of motion with the identified numbers in them."""

from collections.abc import Iterator

from bampipe.report.document import Block, Formulas
from bampipe.report.run_results import Results
from bampipe.results.terms import TermsResult

TITLE = "Equations of motion"


def list_blocks(results: Results) -> Iterator[Block]:
    """Yield the equations, if they are stored."""
    terms = results.read(TermsResult)
    if terms is None or not terms.equations:
        return
    yield (
        f"Model `{terms.model}`{results.list_effects()}: M q'' + h = Q, with the identified "
        "numbers put in. Primes are derivatives with respect to time. M is the mass matrix, h "
        "holds Coriolis, centrifugal and gravity terms, Q the generalised forces. Names without a "
        "number are inputs, coordinates, or numbers of the device (under Device)."
    )
    yield Formulas(terms.equations)
