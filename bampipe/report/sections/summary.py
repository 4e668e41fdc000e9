"""Summary: the verdict, the trials and the model, the key numbers."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from bampipe.lists import count_noun, join_names
from bampipe.phrases.results import METHODS
from bampipe.report import verdicts
from bampipe.report.document import Block, Callout, Table
from bampipe.report.run_results import Results
from bampipe.report.wording import (
    NONE,
    format_decimals,
    format_digits,
    format_quantity,
    format_scaled,
    format_unit,
    name_parameter,
)
from bampipe.results.compare import Rung
from bampipe.results.identify import IdentifyResult, ParameterEstimate
from bampipe.results.rounding import NORMAL_95
from bampipe.results.setup import SetupResult
from bampipe.results.stiffness import StiffnessResult
from bampipe.results.validate import JudgedError, ValidateResult

TITLE = "Summary"
_MOST_OTHERS = 12
"""Most parameters other than friction that a note names."""
_FRICTION = ("viscous.", "coulomb.")
_TERMS = (
    f"RMSE: root mean square of measured minus predicted force. {verdicts.FLOOR} Fit: 100 (1 − RMSE"
    " / standard deviation of the measured force)."
)


def list_blocks(results: Results) -> Iterator[Block]:
    """Yield the warnings, the verdict unless the set-up is wrong, and the findings."""
    setup = results.read(SetupResult)
    for mistake in setup.mistakes if setup else ():
        text = f"Once this is corrected, {mistake.evidence}."
        if mistake.alternatives:
            others = "; ".join(other.sentence for other in mistake.alternatives)
            text += f" The trials cannot distinguish it from: {others}."
        text += " No result below is valid before the session file is corrected."
        yield Callout("attention", f"Set-up: {mistake.sentence}", text)
    if setup and (doubts := _list_doubts(results, setup)):
        yield Callout("note", "Doubtful set-up", " ".join(f"{line}." for line in doubts))
    if results.outdated:
        steps = ", ".join(f"`{step}`" for step in results.outdated)
        text = f"Run these again before relying on their results: {steps}."
        yield Callout("attention", "Some results are older than their inputs", text)
    if setup is None or not setup.mistakes:
        yield verdicts.judge_session(results)
    yield _describe_session(results)
    yield _describe_ladder(results)
    yield _tabulate_numbers(results)


def _list_doubts(results: Results, setup: SetupResult) -> list[str]:
    """Return the warnings of the set-up, without what the model shown explains by its effects."""
    validated = results.read(ValidateResult)
    judged = validated.axes if validated else {}
    explained = {axis for axis, error in judged.items() if error.standing == "at_floor"}
    doubts = results.order_axes(setup.unexplained)
    return [*setup.warnings, *(said for axis, said in doubts.items() if axis not in explained)]


def _describe_session(results: Results) -> str:
    trials = results.trials
    used = trials[trials["status"] != "set_aside"]
    kinds = [
        count_noun(number, f"{kind} trial")
        for kind in ("free", "viscous", "locked")
        if (number := int((used["kind"] == kind).sum()))
    ]
    seconds = format_decimals(float(used["duration_s"].sum()), 0)
    aside = len(trials) - len(used)
    rest = f"; {count_noun(aside, 'trial')} set aside." if aside else "."
    parts = [f"{join_names(kinds) or 'No trial'} ({seconds} s) could be used{rest}"]
    if identified := results.read(IdentifyResult):
        count = count_noun(len(identified.parameters), "parameter")
        effects = f",{results.list_effects()}," if results.list_effects() else ""
        parts.append(
            f"{count} of model `{results.model}`{effects} were identified by "
            f"{METHODS[identified.method]}."
        )
    if validated := results.read(ValidateResult):
        is_held_out = any(t.held_out for t in validated.trials.values())
        where = "held-out data" if is_held_out else "the same trials"
        parts.append(f"The predicted force was compared with the measured one on {where}.")
    return " ".join(parts)


def _describe_ladder(results: Results) -> str:
    if len(results.ladder) < 2:
        return ""
    first = results.ladder[0]
    number = [rung.model for rung in results.ladder].index(results.model)
    if number == 0:
        return _explain_rejection(results.ladder)
    last, changes = results.ladder[number], []
    for axis, before in results.order_axes(first.held_out_rmse).items():
        after, floor = last.held_out_rmse.get(axis), last.noise_floor.get(axis)
        if after is not None:
            unit = format_unit(results.force_unit(axis))
            text = f"{axis} {format_digits(before)} to {format_digits(after)} {unit}"
            changes.append(text + (f" (floor {format_digits(floor)})" if floor else ""))
    return (
        f"From model `{first.model}` to version {number} (`{last.model}`), the best confirmed one, "
        f"the error on held-out trials changed: {'; '.join(changes)}."
    )


def _explain_rejection(rungs: Sequence[Rung]) -> str:
    """Say why no later version is accepted, although one may have a lower error."""
    first = rungs[0]
    better = [rung for rung in rungs if rung.has_lower_error_than(first)]
    if not better:
        return f"Of {len(rungs)} models none has a lower error than `{first.model}`."
    why = "the version it builds on is not confirmed"
    if better[-1].has_lost_its_floor(first):
        why = "it has no noise floor, or an error far below it, which cannot be judged"
    return (
        f"With `{better[-1].added}` the error would be lower than that of `{first.model}`, but that"
        f" version does not count: {why}."
    )


def _tabulate_numbers(results: Results) -> Table:
    identify, validate = results.read(IdentifyResult), results.read(ValidateResult)
    stiffness = results.read(StiffnessResult)
    identified = identify.parameters if identify else {}
    validated = validate.axes if validate else {}
    stiff = stiffness.axes if stiffness else {}
    rows: dict[str, list[str]] = {}
    for axis in results.axes:
        error, locked = validated.get(axis), stiff.get(axis)
        fit = error.fit_percent if error else None
        cells = {
            "Viscous damping": _format_estimate(identified.get(f"viscous.{axis}")),
            "Coulomb friction": _format_estimate(identified.get(f"coulomb.{axis}")),
            "Error on held-out trials (RMSE)": _format_error(error, "held_out_rmse"),
            "Noise floor": _format_error(error, "noise_floor"),
            "Error without friction terms": _format_error(error, "rmse_without_friction"),
            "Fit": NONE if fit is None else f"{format_decimals(fit, 1)} %",
            "Stiffness, brake locked": NONE,
        }
        if locked:
            shown = format_scaled(locked.stiffness, locked.unit, sd=locked.sd)
            cells["Stiffness, brake locked"] = shown
        for title, cell in cells.items():
            rows.setdefault(title, []).append(cell)
    rows = {title: cells for title, cells in rows.items() if {*cells} != {NONE}}
    held_out = f"Held-out: {verdicts.describe_held_out(validate)}. {_TERMS}" if validate else ""
    notes = (_name_zeros(results, identified), _list_others(results, identified), held_out)
    return Table(
        "Key numbers (± one standard deviation)",
        " | ".join(("", *(f">{axis} ~1" for axis in results.axes))),
        [_share_unit(*row) for row in rows.items()],
        " ".join(filter(None, notes)),
    )


def _share_unit(title: str, cells: list[str]) -> tuple[str, ...]:
    """Return a row; a unit that all of its cells have stands behind its title."""
    units = {cell.rpartition(" ")[2] for cell in cells if cell != NONE}
    if len(cells) < 2 or len(units) != 1:
        return (title, *cells)
    return (f"{title} ({units.pop()})", *(cell.rpartition(" ")[0] or NONE for cell in cells))


def _format_estimate(entry: ParameterEstimate | None) -> str:
    return format_quantity(entry.estimate, entry.sd, entry.unit) if entry else NONE


def _format_error(entry: JudgedError | None, key: str) -> str:
    value: Any = getattr(entry, key, None)
    if entry is None or value is None:
        return NONE
    return f"{format_digits(value)} {format_unit(entry.unit)}"


def _name_zeros(results: Results, parameters: Mapping[str, ParameterEstimate]) -> str:
    """Name the friction parameters that do not differ from zero by more than chance."""
    names = [
        f"`{name}`"
        for name in results.order_parameters(parameters)
        if name.startswith(_FRICTION)
        and abs(parameters[name].estimate) < NORMAL_95 * parameters[name].sd
    ]
    verb = "does" if len(names) == 1 else "do"
    return f"{join_names(names)} {verb} not differ from zero by more than chance." if names else ""


def _list_others(results: Results, parameters: Mapping[str, ParameterEstimate]) -> str:
    named = results.order_parameters(parameters)
    others = [name for name in named if not name.startswith(_FRICTION)]
    if len(others) > _MOST_OTHERS:  # a robot's bodies
        return f"{count_noun(len(others), 'other parameter')} under Identification."
    shown = (f"{name_parameter(name)}: {_format_estimate(parameters[name])}" for name in others)
    return "; ".join(shown) + "." * bool(others)
