"""The outcome of a run for a CI job: the gates as JUnit XML, and a summary in Markdown."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Sequence

from bampipe.data.run_folder import RunFolder
from bampipe.errors import InputError, printable
from bampipe.results.validate import ValidateResult
from bampipe.run.request import Outcome

_TAGS = {"failed": "failure", "absent": "skipped"}
STATES = {0: "passed", 1: "**gate failed**", 2: "**bad input**", 3: "**crashed**"}
MOST = 30
"""Largest number of rows in a table, so that a summary is short enough to be read."""


def junit(outcomes: Iterable[Outcome]) -> bytes:
    """Return the verdicts as JUnit XML: a session is a test suite, a gate on an axis a test."""
    top = ElementTree.Element("testsuites", name="bampipe")
    for outcome in outcomes:
        states = [verdict.state for verdict in outcome.verdicts]
        suite = ElementTree.SubElement(
            top,
            "testsuite",
            name=outcome.root.name,
            tests=str(len(states) + bool(outcome.error)),
            failures=str(states.count("failed")),
            errors=str(int(bool(outcome.error))),
            skipped=str(states.count("absent")),
        )
        models = sorted({verdict.model for verdict in outcome.verdicts if verdict.model})
        if models:
            properties = ElementTree.SubElement(suite, "properties")
            for model in models:
                ElementTree.SubElement(properties, "property", name="model", value=model)
        of_suite = {"classname": outcome.root.name}
        if outcome.error:
            case = ElementTree.SubElement(suite, "testcase", of_suite, name="the pipeline finishes")
            ElementTree.SubElement(case, "error", message=outcome.error)
        for verdict in outcome.verdicts:
            name = f"{verdict.gate}: {verdict.key}" if verdict.key else verdict.gate
            case = ElementTree.SubElement(suite, "testcase", of_suite, name=name)
            if tag := _TAGS.get(verdict.state):
                ElementTree.SubElement(case, tag, message=verdict.message)
            elif verdict.state == "warned":
                ElementTree.SubElement(case, "system-out").text = verdict.message
    ElementTree.indent(top)
    text = ElementTree.tostring(top, encoding="unicode")
    return f"<?xml version='1.0' encoding='utf-8'?>\n{printable(text)}\n".encode()


def markdown(outcomes: Sequence[Outcome]) -> str:
    """Return the summary of a run as GitHub-flavoured Markdown."""
    codes = [outcome.exit_code for outcome in outcomes]
    lines = [f"## bampipe: {_headline(codes)}", ""]
    head = ("session", "result", "model", "error / floor", "what")
    lines += _table(head, list(map(_session, outcomes)))
    marked = [
        (outcome.root.name, one.gate, one.key, one.state, one.message)
        for outcome in outcomes
        for one in outcome.verdicts
        if one.state in ("failed", "warned")
    ]
    if marked:
        lines += ["", "### Gates that did not pass", ""]
        head = ("session", "gate", "", "verdict", "")
        lines += _table(head, sorted(marked, key=lambda row: row[3]))
    return "\n".join(lines) + "\n"


def _headline(codes: Sequence[int]) -> str:
    total = f"{len(codes)} session" + ("s" if len(codes) != 1 else "")
    parts = [
        f"{codes.count(code)} {word}"
        for code, word in ((1, "failed a gate"), (2, "could not be read"), (3, "crashed"))
        if code in codes
    ]
    return f"{total}, " + (", ".join(parts) if parts else "all gates passed")


def _session(outcome: Outcome) -> tuple[str, ...]:
    if outcome.error:
        return outcome.root.name, STATES[outcome.exit_code], "", "", outcome.error
    states = [verdict.state for verdict in outcome.verdicts]
    counts = [f"{states.count(one)} {one}" for one in ("failed", "warned") if one in states]
    gates = f"gates: {', '.join(counts)}" if counts else ""
    errors = _errors(RunFolder(outcome.root), outcome.model)
    return outcome.root.name, STATES[outcome.exit_code], outcome.model, errors, gates


def _errors(run: RunFolder, model: str) -> str:
    """Return the ratio of held-out error to noise floor of each axis."""
    try:
        found = run.find(ValidateResult, model) if model else None
    except InputError:
        return "not readable"
    axes = found.axes if found else {}
    return ", ".join(
        f"{axis} {error.held_out_rmse / error.noise_floor:.2f}"
        for axis, error in axes.items()
        if error.noise_floor
    )


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = [f"| {' | '.join(map(_cell, cells))} |" for cells in (head, *rows[:MOST])]
    lines.insert(1, "|" + "---|" * len(head))
    if len(rows) > MOST:
        lines += ["", f"and {len(rows) - MOST} more"]
    return lines


def _cell(text: str) -> str:
    """Escape ``text`` so that it can neither break the table nor become markup."""
    if text in STATES.values():
        return text
    for mark in "\\|`*_<>[]&~":
        text = text.replace(mark, f"\\{mark}")
    return printable(" ".join(text.split()))
