"""Quality gates: results held against the limits of a pipeline."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bampipe.data.run_folder import RunFolder
from bampipe.files import read_json_table
from bampipe.run import accepted

if TYPE_CHECKING:
    from bampipe.declarations.pipeline import Gate
    from bampipe.results.run import GateState, GateVerdict


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


def _found(
    gate: Gate, key: str, passed: bool, value: float | None, parts: Sequence[str]
) -> GateVerdict:
    """Return what came of ``gate`` for ``key``: ``parts`` in one line, and advice if it fails."""
    from bampipe.results.run import GateVerdict

    state: GateState = "passed" if passed else "failed" if gate.level == "fail" else "warned"
    parts = [*parts, gate.advice] if gate.advice and not passed else parts
    return GateVerdict(gate=gate.name, key=key, state=state, value=value, message="; ".join(parts))


def _missing(gate: Gate, key: str, what: str) -> GateVerdict:
    from bampipe.results.run import GateVerdict

    state: GateState = "absent" if gate.optional else "failed" if gate.level == "fail" else "warned"
    return GateVerdict(gate=gate.name, key=key, state=state, value=None, message=what)


def judge_gates(gate: Gate, root: Path, model: str, baseline: Path) -> list[GateVerdict]:
    """Return the verdicts of ``gate`` on the run folder ``root``.

    Args:
        gate: the gate.
        root: the run folder.
        model: name of the model that is judged.
        baseline: folder of the values last accepted.

    Raises:
        InputError: the result or the file of accepted values is damaged.
    """
    relative = gate.result.replace("{model}", model)
    path = root / relative
    if not path.is_file():
        return [_missing(gate, "", f"there is no {relative}")]
    content = read_json_table(path)
    values = _pick(content, gate.value)
    divisors = _pick(content, gate.divide_by) if gate.divide_by else {}
    words = _pick(content, gate.judged_by) if gate.judged_by else {}
    if not values:
        return [_missing(gate, "", f"{relative} has no {gate.value}")]
    if gate.against == accepted.ACCEPTED:
        return _against_accepted(gate, root, model, baseline, content)
    verdicts = []
    for key, raw in values.items():
        value = _number(raw)
        if value is not None and gate.divide_by:
            divisor = _number(divisors.get(key))
            value = value / divisor if divisor else None
        if gate.judged_by:
            verdicts.append(_judged(gate, key, value, words.get(key)))
            continue
        if value is None:
            verdicts.append(_missing(gate, key, f"{relative} has no number at {gate.value}"))
            continue
        verdicts.append(_hold(gate, key, value, ""))
    return verdicts


def _judged(gate: Gate, key: str, value: float | None, word: object) -> GateVerdict:
    """Return the verdict that a stage stored as a word; ``value`` is shown beside it."""
    number = "no number" if value is None else f"{value:.4g}"
    text = f"{number}, {str(word).replace('_', ' ')}"
    return _found(gate, key, word in gate.passes, value, [text])


def _hold(gate: Gate, key: str, value: float, suffix: str) -> GateVerdict:
    """Return the verdict on ``value``; ``suffix`` follows the number in the message."""
    limits = []
    if gate.max is not None and value > gate.max:
        limits.append(f"{value:.4g}{suffix} is above {gate.max:g}")
    if gate.min is not None and value < gate.min:
        limits.append(f"{value:.4g}{suffix} is below {gate.min:g}")
    return _found(gate, key, not limits, value, limits or [f"{value:.4g}{suffix}"])


def _against_accepted(
    gate: Gate, root: Path, model: str, baseline: Path, content: Mapping[str, Any]
) -> list[GateVerdict]:
    """Hold the change since the accepted values, beyond its uncertainty, against the limit."""
    from bampipe.results.ingest import IngestResult

    reference = accepted.read(baseline, RunFolder(root).read(IngestResult).device)
    if reference is None:
        return [_missing(gate, "", f"nothing accepted yet in {baseline}: run `bampipe accept`")]
    if reference.model != model:
        what = f"the accepted values are those of model {reference.model!r}, not of {model!r}"
        return [_missing(gate, "", what)]
    old = reference.results.get(gate.result, {})
    parent, _, last = gate.value.rpartition(".")
    now, before = _pick(content, gate.value), _pick(old, gate.value)
    sds, old_sds = (_pick(of, f"{parent}.sd") for of in (content, old))
    verdicts = []
    for key in [*now, *(key for key in before if key not in now)]:
        value, accepted_value = _number(now.get(key)), _number(before.get(key))
        if value is None or accepted_value is None:
            where = "this run" if value is None else "the accepted values"
            verdicts.append(_missing(gate, key, f"no {last} in {where}"))
            continue
        sd = math.hypot(_number(sds.get(key)) or 0.0, _number(old_sds.get(key)) or 0.0)
        excess = max(0.0, abs(value - accepted_value) - 2.0 * sd)
        if accepted_value == 0.0:
            verdicts.append(_missing(gate, key, "the accepted value is 0: no change in percent"))
            continue
        change = 100.0 * (value - accepted_value) / abs(accepted_value)
        numbers = f"{accepted_value:.4g} to {value:.4g}, {change:+.3g} %"
        suffix = f" % beyond two standard deviations ({numbers})"
        verdicts.append(_hold(gate, key, 100.0 * excess / abs(accepted_value), suffix))
    return verdicts
