"""Summary: what was done, the verdict, the key numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bampipe.lists import join_names
from bampipe.report import verdicts, wording
from bampipe.report.document import Block, Paragraph, Section, Table
from bampipe.report.results import Results
from bampipe.results.compare import CompareResult
from bampipe.results.identify import METHODS_IN_WORDS, IdentifyResult, ParameterEstimate
from bampipe.results.intervals import NORMAL_95
from bampipe.results.setup import SetupResult
from bampipe.results.stiffness import AxisStiffness, StiffnessResult
from bampipe.results.validate import AxisError, ValidateResult

_MOST_OTHERS = 12
"""Parameters of no axis that a note can name."""
_TERMS = (
    "RMSE: root mean square of measured minus predicted force. Noise floor: the error that sensor "
    "noise, quantisation and filtering alone would leave. Fit: share of the measured force that is "
    "explained."
)


def section(results: Results) -> Section:
    """Return the section."""
    setup = results.read(SetupResult)
    blocks: list[Block] = [Paragraph(_done(results))]
    if setup is None or not setup.mistakes:  # else no verdict on the model counts
        blocks.insert(0, verdicts.overall(results))
    ladder = _ladder(results)
    if ladder:
        blocks.append(Paragraph(ladder))
    numbers = _numbers(results)
    if numbers is not None:
        blocks.append(numbers)
    return Section("Summary", tuple(blocks))


def _done(results: Results) -> str:
    trials = results.trials
    used = trials[trials["status"] != "set_aside"]
    kinds = [
        wording.count(int((used["kind"] == kind).sum()), f"{kind} trial")
        for kind in ("free", "viscous", "locked")
        if (used["kind"] == kind).any()
    ]
    seconds = float(used["duration_s"].sum())
    parts = [f"{join_names(kinds) or 'No trial'} ({wording.plain(seconds, 0)} s) could be used"]
    aside = len(trials) - len(used)
    parts[0] += f"; {wording.count(aside, 'trial')} set aside." if aside else "."
    identified = results.read(IdentifyResult)
    if identified is not None:
        names = len(identified.parameters)
        effects = results.effects(results.model)
        added = f", with {join_names(f'`{name}`' for name in effects)}," if effects else ""
        parts.append(
            f"{wording.count(names, 'parameter')} of model `{results.model}`{added} were identified"
            f" by {METHODS_IN_WORDS[identified.method]}."
        )
    validated = results.read(ValidateResult)
    if validated is not None:
        where = "held-out" if any(t.held_out for t in validated.trials.values()) else "the same"
        parts.append(
            f"The force that the model predicts was compared with the measured one on {where} "
            "trials."
        )
    return " ".join(parts)


def _ladder(results: Results) -> str:
    compared = results.read(CompareResult)
    if compared is None or len(compared.ladder) < 2:
        return ""
    first = compared.ladder[0]
    number = [rung.model for rung in compared.ladder].index(results.model)
    last = compared.ladder[number]
    if last is first:
        return _unconfirmed(results, compared)
    changes = []
    for axis in verdicts.ordered(results, first.held_out_rmse):
        before, after = first.held_out_rmse[axis], last.held_out_rmse.get(axis)
        floor = last.noise_floor.get(axis)
        if after is None:
            continue
        unit = wording.unit(results.force_unit(axis))
        text = f"{axis} {wording.significant(before)} to {wording.significant(after)} {unit}"
        changes.append(text + (f" (floor {wording.significant(floor)})" if floor else ""))
    return (
        f"From model `{first.model}` to version {number} (`{last.model}`), the best confirmed one, "
        f"the error on held-out trials went: {'; '.join(changes)}."
    )


def _unconfirmed(results: Results, compared: CompareResult) -> str:
    """Say why no later version counts, which may have a lower error all the same."""
    first = compared.ladder[0]
    better = [rung for rung in compared.ladder if rung.has_lower_error_than(first)]
    if not better:
        return f"Of {len(compared.ladder)} models none has a lower error than `{first.model}`."
    validated = results.read(ValidateResult, better[-1].model)
    refused = validated is not None and validated.is_refused
    why = "its parameters are refused" if refused else "the version it builds on is not confirmed"
    if better[-1].has_lost_its_floor(first):
        why = "no noise floor could be computed for it, so that its error cannot be judged"
    return (
        f"With `{better[-1].added}` the error would be lower than that of `{first.model}`, but that"
        f" version does not count: {why}."
    )


def _numbers(results: Results) -> Table | None:
    identify, validate = results.read(IdentifyResult), results.read(ValidateResult)
    stiffness = results.read(StiffnessResult)
    identified = identify.parameters if identify else {}
    validated = validate.axes if validate else {}
    stiff = stiffness.axes if stiffness else {}
    axes = results.axes
    rows = [
        _row(
            f"{title}",
            axes,
            lambda axis, key=key: _estimate(identified.get(f"{key}.{axis}")),
        )
        for title, key in (
            ("Viscous damping", "viscous"),
            ("Coulomb friction", "coulomb"),
        )
    ]
    rows += [
        _row(
            title,
            axes,
            lambda axis, key=key: _error(validated.get(axis), key),
        )
        for title, key in (
            ("Error on held-out trials (RMSE)", "held_out_rmse"),
            ("Noise floor", "noise_floor"),
            ("Error without friction terms", "rmse_without_friction"),
        )
    ]
    rows.append(_row("Fit", axes, lambda axis: _percent(validated.get(axis))))
    rows.append(_row("Stiffness, brake locked", axes, lambda axis: _stiffness(stiff.get(axis))))
    rows = [row for row in rows if any(cell != "–" for cell in row[1:])]
    if not rows:
        return None
    return Table(
        "Key numbers (± one standard deviation)",
        ("", *axes),
        tuple(rows),
        "l" + "r" * len(axes),
        (0.0, *(1.0 for _ in axes)),
        " ".join(
            part
            for part in (
                _near_zero(results, identified),
                _others(results, identified),
                f"Held-out: {verdicts.held_out_in_words(validate)}. {_TERMS}" if validate else "",
            )
            if part
        ),
    )


def _row(title: str, axes: tuple[str, ...], cell: Any) -> tuple[str, ...]:
    return (title, *(cell(axis) for axis in axes))


def _estimate(entry: ParameterEstimate | None) -> str:
    if entry is None:
        return "–"
    return f"{wording.with_sd(entry.estimate, entry.sd)} {wording.unit(entry.unit)}".rstrip()


def _error(entry: AxisError | None, key: str) -> str:
    value = None if entry is None else getattr(entry, key)
    if entry is None or value is None:
        return "–"
    return f"{wording.significant(value)} {wording.unit(entry.unit)}"


def _percent(entry: AxisError | None) -> str:
    value = None if entry is None else entry.fit_percent
    return "–" if value is None else f"{wording.plain(value, 1)} %"


def _stiffness(entry: AxisStiffness | None) -> str:
    return "–" if entry is None else wording.scaled(entry.stiffness, entry.unit, sd=entry.sd)


def _near_zero(results: Results, parameters: Mapping[str, ParameterEstimate]) -> str:
    """Name the strengths that these trials do not show to differ from zero."""
    names = [
        f"`{name}`"
        for name in results.in_order(parameters)
        if name.startswith(("viscous.", "coulomb."))
        and abs(parameters[name].estimate) < NORMAL_95 * parameters[name].sd
    ]
    verb = "is" if len(names) == 1 else "are"
    return f"{join_names(names)} {verb} not shown to differ from zero." if names else ""


def _others(results: Results, parameters: Mapping[str, ParameterEstimate]) -> str:
    named = results.in_order(parameters)
    others = [name for name in named if not name.startswith(("viscous.", "coulomb."))]
    if len(others) > _MOST_OTHERS:  # a robot's bodies
        return f"{wording.count(len(others), 'other parameter')} under Identification."
    shown = [f"{wording.parameter(name)}: {_estimate(parameters[name])}" for name in others]
    return "; ".join(shown) + "." if shown else ""
