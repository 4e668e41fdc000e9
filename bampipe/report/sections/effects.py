"""Effects: what each one found is, the curve identified, before and after, what to do, rivals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from bampipe.lists import join_names
from bampipe.report import style, wording
from bampipe.report.document import (
    Block,
    Figure,
    Formulas,
    Paragraph,
    Section,
    Subheading,
)
from bampipe.report.results import Results
from bampipe.report.sections.diagnosis import LONG, ranking_table
from bampipe.results import phrases
from bampipe.results.compare import CompareResult
from bampipe.results.diagnose import DiagnoseResult, WorstWindow
from bampipe.results.identify import IdentifyResult
from bampipe.results.terms import ModelTerm, TermCurve, TermsResult

TITLE = "Effects"
_COLUMNS = 3
_WEIGHED = 8
_RIVALS = 3
_LEAST_FOLLOWED = 0.2
"""Share of a term's variance that its curve has to carry to be drawn."""


def section(results: Results) -> Section | None:
    """Return the section; None where no model was validated."""
    terms = results.read(TermsResult)
    if terms is None:
        return None
    friction = [term for term in terms.terms if term.name.startswith("friction:") and term.curves]
    effects = [term for term in terms.terms if not term.name.startswith("friction:")]
    blocks: list[Block] = []
    if not effects:
        blocks.append(Paragraph(f"Model `{results.model}` is the device alone, without effects."))
    if friction:
        curves = [curve for term in friction for curve in term.curves[:1]]
        caption = (
            "Friction as identified: the force that it takes, with its 95 % band, over the motion "
            "that it was learned from."
        )
        blocks.append(_curves("friction", curves, caption))
    shown: set[str] = set()
    for term in effects:
        blocks += _effect(results, term, shown)
    blocks += _weighed(results, {term.name for term in effects})
    return Section(TITLE, tuple(blocks))


def _effect(results: Results, term: ModelTerm, shown: set[str]) -> list[Block]:
    """Return what is said of an effect; ``shown``: versions whose worst window is drawn already."""
    text = term.text
    name = term.name.replace(":", "-")
    blocks: list[Block] = [
        Subheading(f"`{term.name}`"),
        Paragraph(f"{text.summary}. {_found(results, term)}".rstrip()),
        Formulas(text.formulas),
    ]
    blocks += _pictures(results, term, name, shown)
    words = []
    if text.on_the_machine:
        words.append(f"**On the machine.** {text.on_the_machine}.")
    words.append(f"**Rivals.** {_rivals(results, term.name)}")
    if text.source:
        words.append(f"**Source.** {text.source}.")
    return [*blocks, *map(Paragraph, words)]


def _found(results: Results, term: ModelTerm) -> str:
    """Return its estimates in a sentence."""
    identified = results.read(IdentifyResult)
    known = identified.parameters if identified else {}
    shown = []
    for name in term.parameters:
        if name in known:
            entry = known[name]
            value = wording.with_sd(entry.estimate, entry.sd)
            unit = wording.unit(entry.unit)
            short = wording.words(name.rpartition(".")[2])
            shown.append(f"{short} {value} {unit}".rstrip())
    return f"Found: {'; '.join(shown)}." if shown else ""


def _variables(curves: Sequence[TermCurve]) -> str:
    return join_names(dict.fromkeys(curve.variable for curve in curves))


def _curves(name: str, curves: Sequence[TermCurve], caption: str) -> Figure:
    """Draw each curve with its band in a panel."""
    columns = min(_COLUMNS, len(curves))
    rows = -(-len(curves) // columns)
    width = min(style.WIDTH, 0.4 + 2.1 * columns)
    figure, panels = style.panels(rows, columns, 1.85 * rows, width=width)
    for panel, curve in zip(panels.flat, curves, strict=False):
        _curve(panel, curve)
    for panel in panels.flat[len(curves) :]:
        panel.set_axis_off()
    return Figure(name, caption, style.svg(figure))


def _curve(panel: Axes, curve: TermCurve) -> None:
    x, unit = style.scaled(np.array(curve.center), curve.variable_unit)
    panel.fill_between(x, curve.low, curve.high, color=style.BLUE, alpha=0.25, lw=0)
    panel.plot(x, curve.mean, color=style.BLUE, marker=".", ms=3.0)
    panel.axhline(0.0, color=style.INK, lw=0.5)
    panel.set_title(curve.axis)
    panel.set_xlabel(style.label(wording.words(curve.variable), unit))
    kind = "torque" if curve.unit.startswith("N.m") else "force"
    panel.set_ylabel(style.label(f"{kind} it takes", wording.unit(curve.unit)))


def _pictures(results: Results, term: ModelTerm, name: str, shown: set[str]) -> list[Block]:
    """Draw the curves of an effect and, once a version, its worst window without and with it."""
    curves = [curve for curve in term.curves if curve.variance_share >= _LEAST_FOLLOWED]
    blocks: list[Block] = []
    if term.curves and not curves:
        blocks.append(
            Paragraph("No single variable carries a fifth of its force: no curve is drawn.")
        )
    found = _window(results, term)
    if found is None or found.added in shown:
        if curves:
            words = _contribution(term, curves)
            blocks.append(_curves(f"effect-{name}", curves, f"What {words}"))
        return blocks
    shown.add(found.added)
    first = next((curve for curve in curves if curve.axis == found.window.axis), None)
    if first is None:
        figure, panels = style.panels(2, 1, 2.7)
        top, bottom = panels.flat
    else:
        figure, (left, top, bottom) = style.beside(2, 2.7)
        _curve(left, first)
    unit = wording.unit(results.force_unit(found.window.axis))
    errors = _draw_window(top, bottom, found, unit)
    style.legend_below(figure, top)
    size = [wording.significant(error, 2) for error in errors]
    change = (
        f"the residual falls from {size[0]} to {size[1]} {unit} (RMSE)"
        if errors[1] < errors[0]
        else f"the residual does not fall ({size[0]} and {size[1]} {unit} RMSE)"
    )
    window = (
        f"worst window of {found.window.axis} without {found.added} "
        f"({found.window.doing}), where {change}."
    )
    beside = f"Left: what {_contribution(term, [first])} Right: the {window}" if first else ""
    blocks.append(Figure(f"effect-{name}", beside or f"The {window}", style.svg(figure)))
    others = [curve for curve in curves if curve is not first]
    if others:
        axes = join_names(curve.axis for curve in others)
        more = f"What {_contribution(term, others).rstrip('.')}, on {axes}."
        blocks.append(_curves(f"effect-{name}-more", others, more))
    return blocks


def _contribution(term: ModelTerm, curves: Sequence[TermCurve]) -> str:
    return (
        f"`{term.name}` contributes: the force that it takes, with its 95 % band, against "
        f"{_variables(curves)}, which it follows most, over the trials that it was learned from."
    )


@dataclass(frozen=True)
class _Window:
    """A window that was worst before effects were ``added``: residuals without and with them."""

    window: WorstWindow
    added: str
    before: pd.DataFrame
    after: pd.DataFrame


def _window(results: Results, term: ModelTerm) -> _Window | None:
    """Return the worst window of the version before the one that added the effect."""
    compared = results.read(CompareResult)
    rungs = compared.ladder if compared else ()
    rung = next((one for one in rungs if _adds(one.added, term.name)), None)
    diagnosis = results.read(DiagnoseResult, rung.parent) if rung and rung.parent else None
    axes = [curve.axis for curve in term.curves]
    if rung is None or rung.parent is None or diagnosis is None:
        return None
    windows = (w for axis in axes for w in diagnosis.worst_windows if w.axis == axis)
    window = next(windows, None)
    if window is None:
        return None
    before, after = (_stretch(results, model, window) for model in (rung.parent, rung.model))
    if before is None or after is None:
        return None
    added = join_names(f"`{name}`" for name in _names(rung.added))
    return _Window(window, added, before, after)


def _draw_window(top: Axes, bottom: Axes, found: _Window, unit: str) -> list[float]:
    """Draw forces above residuals; return the errors in the window, without and with."""
    window, axis = found.window, found.window.axis
    measured = found.before[f"torque_measured_{axis}"]
    top.plot(found.before["t"], measured, color=style.FAINT, lw=2.6, label="measured")
    for frame, title, colour, look in (
        (found.before, "without", style.VERMILLION, (0, (4, 1.5))),
        (found.after, "with", style.BLUE, "-"),
    ):
        top.plot(frame["t"], frame[f"torque_predicted_{axis}"], color=colour, ls=look, label=title)
        bottom.plot(frame["t"], frame[f"residual_{axis}"], color=colour, ls=look)
    bottom.axhline(0.0, color=style.INK, lw=0.5)
    for panel in (top, bottom):
        panel.axvspan(window.t_start, window.t_end, color=style.SKY, alpha=0.2, lw=0)
    top.tick_params(labelbottom=False)
    top.set_ylabel(style.label(axis, unit))
    bottom.set_ylabel(style.label("residual", unit))
    bottom.set_xlabel(f"time in {window.trial_id} (s)")
    return [_rms(frame, axis, window) for frame in (found.before, found.after)]


def _names(added: str | None) -> list[str]:
    return (added or "").replace(",", " ").split()


def _adds(added: str | None, effect: str) -> bool:
    return effect in _names(added)


def _stretch(results: Results, model: str, window: WorstWindow) -> pd.DataFrame | None:
    """Return the residuals of ``model`` in the window, with as much again to either side."""
    frame = results.table(results.model_file("residuals.parquet", model), trial=window.trial_id)
    if frame is None or frame.empty or f"residual_{window.axis}" not in frame:
        return None
    margin = 1.5 * (window.t_end - window.t_start)
    part = frame[frame["t"].between(window.t_start - margin, window.t_end + margin)]
    return part if len(part) > 3 else None


def _rms(frame: pd.DataFrame, axis: str, window: WorstWindow) -> float:
    inside = frame.loc[frame["t"].between(window.t_start, window.t_end), f"residual_{axis}"]
    return float(np.sqrt(np.mean(inside.to_numpy() ** 2)))


def _diagnoses(results: Results) -> Iterable[DiagnoseResult]:
    """Yield the diagnoses of all versions, the latest first."""
    for model in reversed(results.models):
        found = results.read(DiagnoseResult, model)
        if found is not None:
            yield found


def _rivals(results: Results, effect: str) -> str:
    """Say how probable ``effect`` is, and what else could stand in its place."""
    for diagnosis in _diagnoses(results):
        if effect not in diagnosis.selected:
            continue
        chance = {n: p for e in diagnosis.axes.values() for n, p in e.probabilities.items()}
        others = diagnosis.alternatives[effect][:_RIVALS]
        named = (f"`{n}` ({phrases.probability(chance.get(n, 0.0))})" for n in others)
        place = f"In its place: {join_names(named)}" if others else "Nothing else takes its place"
        return f"Its probability is {phrases.probability(chance[effect])}. {place}."
    return "It was not found by a diagnosis of this run: none has weighed it against others."


def _weighed(results: Results, added: set[str]) -> list[Block]:
    """Return what the latest diagnosis weighed and did not add: best first."""
    diagnosis = next((found for found in _diagnoses(results) if found.descriptions), None)
    if diagnosis is None:
        return []
    texts = diagnosis.descriptions
    shown = [
        (entry, text)
        for entry in diagnosis.ranking
        if entry.effect not in added and (text := texts.get(entry.effect.partition(":")[0]))
    ][:_WEIGHED]
    rows = [
        (entry, [f"{text.summary}. " + "; ".join(f"`{line}`" for line in text.formulas[:2])])
        for entry, text in shown
    ]
    title = f"Weighed on model `{diagnosis.model}`, best first"
    return [ranking_table(title, rows, (LONG,), "")] if rows else []
