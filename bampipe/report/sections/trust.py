"""What the estimates are worth: weak directions, information by trial, tests of the innovations."""

from __future__ import annotations

from typing import Any

from bampipe.report import verdicts, wording
from bampipe.report.document import Block, Bullets, Section, Table, Text
from bampipe.report.results import Results

TITLE = "What the estimates are worth"


def section(results: Results) -> Section | None:
    """Return the section; None where nothing of it is stored."""
    content = results.json(results.of_model("identify.json")) or {}
    known = content.get("identifiability")
    blocks: list[Block] = []
    if known:
        blocks.append(Text(_words(known)))
        said = tuple(str(line) for line in known.get("sentences", ()))
        if said:
            blocks.append(Bullets(said))
        blocks.append(_parameters(results, content, known))
        if len(known.get("trials", {})) > 1:
            blocks.append(_trials(known["trials"]))
    tests = content.get("innovations")
    if tests:
        blocks.append(_innovations(results, tests))
    return Section(TITLE, tuple(blocks)) if blocks else None


def _words(known: dict[str, Any]) -> str:
    if known.get("weak_directions"):
        return "Not everything below is known as well as its interval alone suggests."
    return (
        "Each parameter is determined on its own: no two hide each other in these trials. What "
        "remains beyond reach follows from the equations and from the numbers of the device file."
    )


def _parameters(results: Results, content: dict[str, Any], known: dict[str, Any]) -> Table:
    parameters = content.get("parameters", {})
    rows = []
    for name in results.in_order(known["parameters"]):
        entry, found = known["parameters"][name], parameters.get(name, {})
        partner = entry.get("partner")
        bias = found.get("least_squares_bias")
        rows.append(
            (
                f"`{name}`",
                wording.significant(found.get("sd"), 2),
                wording.significant(entry.get("bound_sd"), 2),
                wording.significant(entry.get("alone_sd"), 2),
                "–" if partner is None else f"`{partner}` {wording.plain(entry['correlation'], 2)}",
                wording.significant(bias, 2),
                wording.unit(str(found.get("unit", ""))) or "1",
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


def _trials(trials: dict[str, Any]) -> Table:
    rows = tuple(
        (name, wording.percent(entry["growth"]), f"`{entry['parameter']}`")
        for name, entry in trials.items()
    )
    return Table(
        "What each trial adds: growth of the bound of the parameter that needs it most, without it",
        ("Trial", "Growth", "Parameter"),
        rows,
        "lrl",
    )


def _innovations(results: Results, tests: dict[str, Any]) -> Table:
    rows = []
    for axis in verdicts.ordered(results, tests):
        entry = tests[axis]
        own, driven = entry.get("whiteness") or {}, entry.get("inputs") or {}
        rows.append(
            (
                axis,
                _outcome(own, "white"),
                wording.percent(own.get("share")),
                _outcome(driven, "independent"),
                wording.percent(driven.get("share")),
                str(entry["sentence"]),
            )
        )
    return Table(
        "Innovations of the filter",
        ("Axis", "White", "Share", "Inputs", "Share", "In words"),
        tuple(rows),
        "llrlrl",
        (0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        "White: Ljung-Box over one second. Inputs: regression on the inputs up to half a second "
        "back. Share: of the variance that is predictable beyond chance.",
    )


def _outcome(entry: dict[str, Any], key: str) -> str:
    return "–" if key not in entry else ("passes" if entry[key] else "**fails**")
