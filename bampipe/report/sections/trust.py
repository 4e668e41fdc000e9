"""What the estimates are worth: weak directions, information by trial, tests of the innovations."""

from __future__ import annotations

from collections.abc import Mapping

from bampipe.report import verdicts, wording
from bampipe.report.document import Block, Bullets, Paragraph, Section, Table
from bampipe.report.results import Results
from bampipe.results.identify import (
    IdentifiabilityReport,
    IdentifyResult,
    InnovationTests,
    TrialGrowth,
)

TITLE = "What the estimates are worth"


def section(results: Results) -> Section | None:
    """Return the section; None where nothing of it is stored."""
    identified = results.read(IdentifyResult)
    if identified is None:
        return None
    known = identified.identifiability
    blocks: list[Block] = []
    if known:
        blocks.append(Paragraph(_words(identified, known)))
        if known.sentences:
            blocks.append(Bullets(known.sentences))
        blocks.append(_parameters(results, identified, known))
        if len(known.trials) > 1:
            blocks.append(_trials(known.trials))
    if identified.innovations:
        blocks.append(_innovations(results, identified.innovations, identified.method == "ukf"))
    return Section(TITLE, tuple(blocks)) if blocks else None


def _words(identified: IdentifyResult, known: IdentifiabilityReport) -> str:
    if known.weak_directions:
        words = "Not everything below is known as well as its interval alone suggests."
    elif identified.base_parameters:
        words = "Of a robot's bodies motion shows combinations only (under Identification)."
    else:
        words = (
            "No two parameters hide each other in these trials. What remains beyond reach follows "
            "from the equations and from the numbers of the device file."
        )
    if identified.inertial:
        words += (
            " A single inertial number leans on the drawing, however small its standard deviation: "
            f"those are left out below, and stand in `models/{identified.model}/identify.json`."
        )
    return words


def _parameters(
    results: Results, identified: IdentifyResult, known: IdentifiabilityReport
) -> Table:
    rows = []
    for name in results.in_order(known.parameters.keys() - identified.inertial):
        entry, found = known.parameters[name], identified.parameters[name]
        partner = (
            "–"
            if entry.correlation is None
            else f"`{entry.partner}` {wording.plain(entry.correlation, 2)}"
        )
        rows.append(
            (
                f"`{name}`",
                wording.significant(found.sd, 2),
                wording.significant(entry.bound_sd, 2),
                wording.significant(entry.alone_sd, 2),
                partner,
                wording.significant(found.least_squares_bias, 2),
                wording.unit(found.unit) or "1",
            )
        )
    return Table(
        "Standard deviation of each estimate beside the least possible",
        ("Parameter", "SD", "Bound", "Alone", "Goes with", "Bias of filtering", "Unit"),
        tuple(rows),
        "lrrrlrl",
        note="Bound: Cramér-Rao, the least that sensor noise allows on these trials; alone, were "
        "all others known. Goes with: the parameter whose error is most correlated with its own. "
        "Bias of filtering: what filtered velocities add to plain least squares, found by "
        "replaying the fit, and taken off; the unscented filter sees positions alone.",
    )


def _trials(trials: Mapping[str, TrialGrowth]) -> Table:
    rows = tuple(
        (name, wording.percent(entry.growth), f"`{entry.parameter}`")
        for name, entry in trials.items()
    )
    return Table(
        "What each trial adds: growth of the bound of the parameter that needs it most, without it",
        ("Trial", "Growth", "Parameter"),
        rows,
        "lrl",
    )


def _innovations(results: Results, tests: Mapping[str, InnovationTests], published: bool) -> Table:
    """Tabulate the tests, in words only where the filter's parameters are those published."""
    rows = []
    for axis in verdicts.ordered(results, tests):
        own, driven = tests[axis].whiteness, tests[axis].inputs
        rows.append(
            (
                axis,
                _outcome(own.white if own else None),
                wording.percent(own.share if own else None),
                _outcome(driven.independent if driven else None),
                wording.percent(driven.share if driven else None),
                tests[axis].sentence if published else "",
            )
        )
    note = (
        "White: Ljung-Box over one second. Inputs: regression on the inputs up to half a second "
        "back. Share: of the variance that is predictable beyond chance."
    )
    if not published:
        note += (
            " The filter's parameters are not those published: a failure may speak of them alone."
        )
    return Table(
        "Innovations of the filter",
        ("Axis", "White", "Share", "Inputs", "Share", "In words"),
        tuple(rows),
        "llrlrl",
        (0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        note,
    ).without_empty_columns()


def _outcome(passed: bool | None) -> str:
    return "–" if passed is None else ("passes" if passed else "**fails**")
