"""Quality gates: results compared with the limits of a pipeline."""

import math
from collections.abc import Sequence
from pathlib import Path

from bampipe.data.run_folder import RunFolder
from bampipe.declarations.pipeline import Gate
from bampipe.files import pick_values, read_json_table
from bampipe.results.ingest import IngestResult
from bampipe.results.run import GateState, GateVerdict
from bampipe.run import accepted


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) else None


def _found(
    gate: Gate, key: str, passed: bool, value: float | None, parts: Sequence[str], word: str = ""
) -> GateVerdict:
    """Return the verdict of ``gate`` for ``key``: ``parts`` in one line, and advice if it fails.

    The advice is that for ``word``, if the gate has one.
    """
    state: GateState = "passed" if passed else "failed" if gate.level == "fail" else "warned"
    advice = gate.advice_on.get(word, gate.advice)
    parts = [*parts, advice] if advice and not passed else parts
    return GateVerdict(gate=gate.name, key=key, state=state, value=value, message="; ".join(parts))


def _missing(gate: Gate, key: str, what: str) -> GateVerdict:
    state: GateState = "absent" if gate.optional else "failed" if gate.level == "fail" else "warned"
    return GateVerdict(gate=gate.name, key=key, state=state, value=None, message=what)


def judge_gates(gate: Gate, root: Path, model: str, baseline: Path) -> list[GateVerdict]:
    """Return the verdicts of ``gate`` on the run folder ``root``.

    Args:
        gate: against accepted values it judges the model that was accepted, not ``model``.
        baseline: folder of the values last accepted.
    """
    if gate.against == accepted.ACCEPTED:
        model, found = _judge_change(gate, root, model, baseline)
    else:
        found = _judge_result(gate, root, model)
    of_model = model if "{model}" in gate.result else ""
    return [verdict.model_copy(update={"model": of_model}) for verdict in found]


def _judge_result(gate: Gate, root: Path, model: str) -> list[GateVerdict]:
    relative = gate.result.replace("{model}", model)
    if not (root / relative).is_file():
        return [_missing(gate, "", f"there is no {relative}")]
    content = read_json_table(root / relative)
    values = pick_values(content, gate.value)
    divisors = pick_values(content, gate.divide_by) if gate.divide_by else {}
    words = pick_values(content, gate.judged_by) if gate.judged_by else {}
    if not values:
        return [_missing(gate, "", f"{relative} has no {gate.value}")]
    verdicts = []
    for key, raw in values.items():
        if isinstance(raw, list):
            passed = len(raw) <= (gate.max or 0.0)
            parts = [str(item) for item in raw] or ["none"]
            verdicts.append(_found(gate, key, passed, float(len(raw)), parts))
            continue
        value = _number(raw)
        if value is not None and gate.divide_by:
            divisor = _number(divisors.get(key))
            value = value / divisor if divisor else None
        if gate.judged_by:  # the verdict is stored as a word
            word = str(words.get(key))
            number = "no number" if value is None else f"{value:.4g}"
            parts = [f"{number}, {word.replace('_', ' ')}"]
            verdicts.append(_found(gate, key, word in gate.passes, value, parts, word))
        elif value is None:
            verdicts.append(_missing(gate, key, f"{relative} has no number at {gate.value}"))
        else:
            limits = []
            if gate.max is not None and value > gate.max:
                limits.append(f"{value:.4g} is above {gate.max:g}")
            if gate.min is not None and value < gate.min:
                limits.append(f"{value:.4g} is below {gate.min:g}")
            parts = limits or [f"{value:.4g}"]
            verdicts.append(_found(gate, key, not limits, value, parts))
    return verdicts


def _judge_change(
    gate: Gate, root: Path, model: str, baseline: Path
) -> tuple[str, list[GateVerdict]]:
    """Compare changes since the accepted values, in percent, with the limit.

    A change beyond the limit but within two standard deviations neither passes nor fails: it warns.
    """
    reference = accepted.read(baseline, RunFolder(root).read(IngestResult).device)
    if reference is None:
        what = f"nothing accepted yet in {baseline}: run `bampipe accept`"
        return model, [_missing(gate, "", what)]
    model = reference.model
    path = root / gate.result.replace("{model}", model)
    content = read_json_table(path) if path.is_file() else None
    if content is None and "{model}" in gate.result:
        what = f"the accepted values are those of model {model!r}, which this run does not have"
        found = _missing(gate, "", what)
        return model, [found.model_copy(update={"state": "warned"}) if gate.optional else found]
    old = reference.results.get(gate.result, {})
    parent, _, last = gate.value.rpartition(".")
    now, before = pick_values(content, gate.value), pick_values(old, gate.value)
    sds, old_sds = (pick_values(of, f"{parent}.sd") for of in (content, old))
    verdicts = []
    for key in now | before:
        value, accepted_value = _number(now.get(key)), _number(before.get(key))
        if value is None or not accepted_value:
            what = f"no {last} in {'this run' if value is None else 'the accepted values'}"
            if value is not None and accepted_value == 0.0:
                what = "the accepted value is 0: no change in percent"
            verdicts.append(_missing(gate, key, what))
            continue
        scale = 100.0 / abs(accepted_value)
        change = scale * (value - accepted_value)
        scatter = scale * math.hypot(_number(sds.get(key)) or 0.0, _number(old_sds.get(key)) or 0.0)
        text = f"{accepted_value:.4g} to {value:.4g}, {change:+.3g} % ± {scatter:.2g} %"
        passed = abs(change) <= (math.inf if gate.max is None else gate.max)
        if not passed:
            text += f", is beyond {gate.max:g} %"
        verdict = _found(gate, key, passed, change, [text])
        if verdict.state == "failed" and abs(change) <= 2.0 * scatter:
            doubt = f"{text}, but within two standard deviations: too uncertain to say"
            verdict = verdict.model_copy(update={"state": "warned", "message": doubt})
        verdicts.append(verdict)
    return model, verdicts
