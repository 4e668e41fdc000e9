"""Quality gates: results held against the limits of a pipeline, and their JUnit form."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from bampipe.run.pipeline import Gate


@dataclass(frozen=True)
class Verdict:
    """What came of one gate for one axis (or for the one number it guards).

    Attributes:
        gate: name of the gate.
        key: what ``*`` stood for, or "".
        state: "passed", "failed", "warned" or "absent" (no such result, and none was demanded).
        value: the number, None where there is none.
        message: one line that says what was found.
    """

    gate: str
    key: str
    state: str
    value: float | None
    message: str

    def content(self) -> dict[str, object]:
        """Return the verdict as a table that JSON can hold."""
        return asdict(self)


def _pick(content: object, dotted: str) -> dict[str, object]:
    """Return the values at ``dotted``, by what its ``*`` stands for ("" without one)."""
    found: dict[str, object] = {"": content}
    for part in dotted.split("."):
        step: dict[str, object] = {}
        for key, value in found.items():
            if not isinstance(value, Mapping):
                continue
            if part == "*":
                step.update({str(name): value[name] for name in sorted(value)})
            elif part in value:
                step[key] = value[part]
        found = step
    return found


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) else None


def _missing(gate: Gate, key: str, what: str) -> Verdict:
    if gate.optional:
        return Verdict(gate.name, key, "absent", None, what)
    return Verdict(gate.name, key, "failed" if gate.level == "fail" else "warned", None, what)


def judge(gate: Gate, root: Path, model: str) -> list[Verdict]:
    """Return the verdicts of ``gate`` on the run folder ``root``.

    Args:
        gate: the gate.
        root: the run folder.
        model: name of the model that is judged.
    """
    relative = gate.result.replace("{model}", model)
    path = root / relative
    if not path.is_file():
        return [_missing(gate, "", f"there is no {relative}")]
    content = json.loads(path.read_text(encoding="utf-8"))
    values = _pick(content, gate.value)
    divisors = _pick(content, gate.divide_by) if gate.divide_by else {}
    if not values:
        return [_missing(gate, "", f"{relative} has no {gate.value}")]
    verdicts = []
    for key, raw in values.items():
        value = _number(raw)
        if value is not None and gate.divide_by:
            divisor = _number(divisors.get(key))
            value = value / divisor if divisor else None
        if value is None:
            verdicts.append(_missing(gate, key, f"{relative} has no number at {gate.value}"))
            continue
        limits = []
        if gate.max is not None and value > gate.max:
            limits.append(f"{value:.4g} is above {gate.max:g}")
        if gate.min is not None and value < gate.min:
            limits.append(f"{value:.4g} is below {gate.min:g}")
        if limits:
            state = "failed" if gate.level == "fail" else "warned"
            text = "; ".join([*limits, gate.advice] if gate.advice else limits)
            verdicts.append(Verdict(gate.name, key, state, value, text))
        else:
            verdicts.append(Verdict(gate.name, key, "passed", value, f"{value:.4g}"))
    return verdicts


@dataclass(frozen=True)
class Suite:
    """The verdicts on one session.

    Attributes:
        name: the session.
        verdicts: of all gates.
        error: why the session has no result, or "".
    """

    name: str
    verdicts: tuple[Verdict, ...]
    error: str = ""


def _printable(text: str) -> str:
    return "".join(c for c in text if c in "\t\n\r" or ord(c) >= 0x20)


def junit(suites: Iterable[Suite]) -> bytes:
    """Return the verdicts as JUnit XML: a session is a test suite, a gate on an axis a test."""
    top = ElementTree.Element("testsuites", name="bampipe")
    for suite in suites:
        tests = len(suite.verdicts) + bool(suite.error)
        element = ElementTree.SubElement(
            top,
            "testsuite",
            name=suite.name,
            tests=str(tests),
            failures=str(sum(v.state == "failed" for v in suite.verdicts)),
            errors=str(int(bool(suite.error))),
            skipped=str(sum(v.state == "absent" for v in suite.verdicts)),
        )
        if suite.error:
            case = ElementTree.SubElement(
                element, "testcase", classname=suite.name, name="the pipeline finishes"
            )
            ElementTree.SubElement(case, "error", message=_printable(suite.error))
        for verdict in suite.verdicts:
            name = f"{verdict.gate}: {verdict.key}" if verdict.key else verdict.gate
            case = ElementTree.SubElement(element, "testcase", classname=suite.name, name=name)
            if verdict.state == "failed":
                ElementTree.SubElement(case, "failure", message=_printable(verdict.message))
            elif verdict.state == "absent":
                ElementTree.SubElement(case, "skipped", message=_printable(verdict.message))
            elif verdict.state == "warned":
                ElementTree.SubElement(case, "system-out").text = _printable(verdict.message)
    ElementTree.indent(top)
    text: bytes = ElementTree.tostring(top, encoding="utf-8", xml_declaration=True)
    return text + b"\n"
