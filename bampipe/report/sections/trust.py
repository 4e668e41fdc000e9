"""Trust in the estimates: weak directions, trials, tests of the innovations."""

from collections.abc import Iterator

from bampipe.report.document import Block, Table
from bampipe.report.run_results import Results
from bampipe.report.wording import format_decimals
from bampipe.results.identify import IdentifiabilityReport, IdentifyResult

TITLE = "Trust in the estimates"
_BIAS_NOTE = (
    " Bias of filtering: the bias that filtered velocities give plain least squares, found from"
    " replicates of the fit, and subtracted."
)


def list_blocks(results: Results) -> Iterator[Block]:
    """Yield the limits of the estimates and the tests of the filter, if they are stored."""
    identified = results.read(IdentifyResult)
    if identified is None:
        return
    if known := identified.identifiability:
        yield _summarise(identified, known)
        yield known.sentences
        rows = []
        for name in results.order_parameters(known.parameters.keys() - identified.inertial):
            bound, found = known.parameters[name], identified.parameters[name]
            partner = None
            if bound.correlation is not None:
                partner = f"`{bound.partner}` {format_decimals(bound.correlation, 2)}"
            bias = found.least_squares_bias and round(found.least_squares_bias, 12)  # no 1e-19
            sds = (found.sd, bound.bound_sd, bound.alone_sd)
            rows.append((name, *sds, partner, bias, found.unit or "1"))
        yield Table(
            "Standard deviation of each estimate beside the least possible",
            "Parameter :code | >SD :2 | >Bound :2 | >Alone :2 | Correlated with"
            " | >Bias of filtering :2 | Unit :unit",
            rows,
            "Bound: Cramér-Rao, the least that sensor noise allows on these trials. Alone: the same"
            " if all others were known. Correlated with: the parameter whose error is most"
            " correlated with this one." + _BIAS_NOTE * any(row[5] is not None for row in rows),
        ).drop_empty_columns()
        if len(known.trials) > 1:
            growth = [(name, one.growth, one.parameter) for name, one in known.trials.items()]
            caption = "Growth of a bound without each trial, for the parameter that needs it most"
            yield Table(caption, "Trial | >Growth :% | Parameter :code", growth)
    is_published = identified.method == "ukf"
    rows, outcome = [], {True: "passes", False: "**fails**"}
    for axis, entry in results.order_axes(identified.innovations or {}).items():
        own, inputs = entry.whiteness, entry.inputs
        white = (outcome[own.white], own.share) if own else (None, None)
        driven = (outcome[inputs.independent], inputs.share) if inputs else (None, None)
        rows.append((axis, *white, *driven, entry.sentence if is_published else ""))
    note = (
        "White: Ljung-Box over one second. Inputs: regression on the inputs up to half a second "
        "back. Share: of the variance that is predictable beyond chance."
    )
    if not is_published:
        note += (
            " The parameters of the filter are not those published: a failure may be due to them."
        )
    yield Table(
        "Innovations of the filter",
        "Axis | White | >Share :% | Inputs | >Share :% | In words ~1",
        rows,
        note,
    ).drop_empty_columns()


def _summarise(identified: IdentifyResult, known: IdentifiabilityReport) -> str:
    words = (
        "No two parameters are confounded in these trials. The remaining limits follow from the "
        "equations and from the numbers of the device file."
    )
    if identified.base_parameters:
        words = "The motion of a robot determines only combinations of its inertial numbers."
    if known.weak_directions:
        words = "Some parameters are known less well than their intervals suggest."
    if identified.inertial:
        words += (
            " A single inertial number depends on the drawing, however small its standard "
            "deviation: the table below leaves them out, and "
            f"`models/{identified.model}/identify.json` lists them."
        )
    return words
