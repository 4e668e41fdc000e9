"""The verdicts of the gates as JUnit XML, which every continuous integration reads."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable

from bampipe.errors import printable
from bampipe.run.request import Outcome

_TAGS = {"failed": "failure", "absent": "skipped"}


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
