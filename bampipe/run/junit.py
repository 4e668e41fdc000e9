"""The verdicts of the gates as JUnit XML, which every continuous integration reads."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bampipe.errors import printable

if TYPE_CHECKING:
    from bampipe.results.run import GateVerdict


@dataclass(frozen=True)
class Suite:
    """The verdicts on one session.

    Attributes:
        name: the session.
        verdicts: of all gates.
        error: why the session has no result, or "".
    """

    name: str
    verdicts: tuple[GateVerdict, ...]
    error: str = ""


def junit(suites: Iterable[Suite]) -> bytes:
    """Return the verdicts as JUnit XML: a session is a test suite, a gate on an axis a test."""
    top = ElementTree.Element("testsuites", name="bampipe")
    for suite in suites:
        tests = len(suite.verdicts) + bool(suite.error)
        element = ElementTree.SubElement(
            top,
            "testsuite",
            name=printable(suite.name),
            tests=str(tests),
            failures=str(sum(v.state == "failed" for v in suite.verdicts)),
            errors=str(int(bool(suite.error))),
            skipped=str(sum(v.state == "absent" for v in suite.verdicts)),
        )
        models = sorted({verdict.model for verdict in suite.verdicts if verdict.model})
        if models:
            properties = ElementTree.SubElement(element, "properties")
            for model in models:
                ElementTree.SubElement(properties, "property", name="model", value=printable(model))
        if suite.error:
            case = ElementTree.SubElement(
                element, "testcase", classname=printable(suite.name), name="the pipeline finishes"
            )
            ElementTree.SubElement(case, "error", message=printable(suite.error))
        for verdict in suite.verdicts:
            name = f"{verdict.gate}: {verdict.key}" if verdict.key else verdict.gate
            case = ElementTree.SubElement(
                element, "testcase", classname=printable(suite.name), name=printable(name)
            )
            if verdict.state == "failed":
                ElementTree.SubElement(case, "failure", message=printable(verdict.message))
            elif verdict.state == "absent":
                ElementTree.SubElement(case, "skipped", message=printable(verdict.message))
            elif verdict.state == "warned":
                ElementTree.SubElement(case, "system-out").text = printable(verdict.message)
    ElementTree.indent(top)
    text: bytes = ElementTree.tostring(top, encoding="utf-8", xml_declaration=True)
    return text + b"\n"
