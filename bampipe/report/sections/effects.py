"""Effects: a description of each one found, its curve, errors before and after, alternatives."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from bampipe.lists import join_names
from bampipe.phrases import diagnosis as phrases
from bampipe.report import style
from bampipe.report.document import Block, Figure, Formulas, Subheading, Table
from bampipe.report.run_results import Results
from bampipe.report.wording import format_digits, format_quantity, format_unit, split_name
from bampipe.results.diagnose import DiagnoseResult, WorstWindow
from bampipe.results.identify import IdentifyResult
from bampipe.results.terms import ModelTerm, TermCurve, TermsResult

TITLE = "Effects"
_MOST_CANDIDATES = 8
_ALTERNATIVES = 3
_LEAST_CURVE_SHARE = 0.2
"""Share of a term's variance that its curve has to carry to be drawn."""


def list_blocks(results: Results) -> Iterator[Block]:
    """Yield friction and effects of the model in detail, if it was validated."""
    terms = results.read(TermsResult)
    if terms is None:
        return
    friction = [term for term in terms.terms if term.name.startswith("friction:")]
    effects = [term for term in terms.terms if term not in friction]
    if not effects:
        yield f"Model `{results.model}` is the device without effects."
    if curves := [term.curves[0] for term in friction if term.curves]:
        caption = (
            "Identified friction of each axis with its 95 % band, over the motion of the trials."
        )
        yield _draw_curves("friction", curves, caption)
    shown: set[str] = set()
    for term in effects:
        about = term.text
        yield Subheading(f"`{term.name}`")
        yield f"{about.summary}. {_list_estimates(results, term)}".rstrip()
        yield Formulas(about.formulas)
        yield from _draw_effect(results, term, shown)
        yield f"**On the machine.** {about.on_the_machine}." if about.on_the_machine else ""
        yield f"**Diagnosis.** {_tell_alternatives(results, term.name)}"
        yield f"**Source.** {about.source}." if about.source else ""
    # The candidates that the latest diagnosis weighed and that were not added.
    added = {term.name for term in effects}
    diagnosis = next((found for found in _read_diagnoses(results) if found.descriptions), None)
    texts = diagnosis.descriptions if diagnosis else {}
    rows = [
        (one.effect, f"{text.summary}. " + "; ".join(f"`{line}`" for line in text.formulas[:2]))
        for one in (diagnosis.ranking if diagnosis else ())
        if one.effect not in added and (text := texts.get(one.effect.partition(":")[0]))
    ][:_MOST_CANDIDATES]
    yield Table("Candidates in words, best first", "Effect :code | Meaning and formula ~1", rows)


def _list_estimates(results: Results, term: ModelTerm) -> str:
    identified = results.read(IdentifyResult)
    known = identified.parameters if identified else {}
    shown = []
    for name, one in ((name, known[name]) for name in term.parameters if name in known):
        value = format_quantity(one.estimate, one.sd, one.unit)
        shown.append(f"{split_name(name.rpartition('.')[2])} {value}")
    return f"Found: {'; '.join(shown)}." if shown else ""


def _draw_curves(name: str, curves: Sequence[TermCurve], caption: str) -> Figure:
    figure, panels = style.make_grid(len(curves), 3, 1.85, extra=0.0, column_width=2.1)
    for panel, curve in zip(panels, curves, strict=True):
        _draw_curve(panel, curve)
    return style.finish(figure, name, caption)


def _draw_curve(panel: Axes, curve: TermCurve) -> None:
    style.draw_curve(panel, curve, curve.center, " taken", marker=".", ms=3.0)
    panel.set_title(curve.axis)


def _draw_effect(results: Results, term: ModelTerm, shown: set[str]) -> Iterator[Block]:
    """Draw the curves of an effect and, once per version, its worst window without and with it."""
    name = f"effect-{term.name.replace(':', '-')}"
    curves = [curve for curve in term.curves if curve.variance_share >= _LEAST_CURVE_SHARE]
    if term.curves and not curves:
        yield "No curve is drawn: no single variable accounts for a fifth of its force."
    found = _find_window(results, term)
    if found is None or found[1] in shown:
        yield from _draw_contribution(name, term, curves)
        return
    window, added, stretches = found
    shown.add(added)
    first = next((curve for curve in curves if curve.axis == window.axis), None)
    if first is None:
        figure, (top, bottom) = style.make_grid(2, 1, 1.35, extra=0.0)
    else:
        figure, (left, top, bottom) = style.split_figure(2.7)
        _draw_curve(left, first)
    unit = format_unit(results.force_unit(window.axis))
    errors = _draw_window(top, bottom, window, stretches, unit)
    before, after = (format_digits(error, 2) for error in errors)
    change = f"the residual does not fall ({before} and {after} {unit} RMSE)"
    if errors[1] < errors[0]:
        change = f"the residual falls from {before} to {after} {unit} (RMSE)"
    beside = f"Left: {_describe_curves(term, [first])} Right: the" if first else "The"
    caption = (
        f"{beside} worst window of {window.axis} without {added} ({window.doing}), where {change}."
    )
    yield style.finish(figure, name, caption, [top])
    others = [curve for curve in curves if curve is not first]
    yield from _draw_contribution(f"{name}-more", term, others)


def _draw_contribution(name: str, term: ModelTerm, curves: Sequence[TermCurve]) -> Iterator[Figure]:
    if curves:
        words = _describe_curves(term, curves)
        yield _draw_curves(name, curves, words[:1].upper() + words[1:])


def _describe_curves(term: ModelTerm, curves: Sequence[TermCurve]) -> str:
    variables = join_names(dict.fromkeys(curve.variable for curve in curves))
    return (
        f"the force of `{term.name}`, with its 95 % band, against its main variable ({variables}),"
        " over the motion of the trials."
    )


def _find_window(
    results: Results, term: ModelTerm
) -> tuple[WorstWindow, str, list[pd.DataFrame]] | None:
    """Return the worst window of the version before the one that added the effect.

    With it, the effects that were added, and the residuals without and with them.
    """
    adding = (one for one in results.ladder if term.name in (one.added or "").split(", "))
    rung = next(adding, None)
    diagnosis = results.read(DiagnoseResult, rung.parent) if rung and rung.parent else None
    if rung is None or rung.parent is None or diagnosis is None:
        return None
    axes = [curve.axis for curve in term.curves]
    windows = (w for axis in axes for w in diagnosis.worst_windows if w.axis == axis)
    if (window := next(windows, None)) is None:
        return None
    every = (_read_stretch(results, name, window) for name in (rung.parent, rung.model))
    found = [stretch for stretch in every if stretch is not None]
    added = join_names(f"`{name}`" for name in (rung.added or "").split(", "))
    return (window, added, found) if len(found) == 2 else None


def _draw_window(
    top: Axes, bottom: Axes, window: WorstWindow, stretches: Sequence[pd.DataFrame], unit: str
) -> list[float]:
    """Draw forces above residuals; return the RMS residuals in the window, without and with."""
    axis, times = window.axis, stretches[0]["t"]
    measured = stretches[0][f"torque_measured_{axis}"]
    top.plot(times, measured, color=style.FAINT, lw=2.6, label="measured")
    errors, looks = [], (("without", style.VERMILLION, (0, (4, 1.5))), ("with", style.BLUE, "-"))
    for frame, (title, colour, look) in zip(stretches, looks, strict=True):
        top.plot(frame["t"], frame[f"torque_predicted_{axis}"], color=colour, ls=look, label=title)
        residual = frame[f"residual_{axis}"]
        bottom.plot(frame["t"], residual, color=colour, ls=look)
        inside = residual[frame["t"].between(window.t_start, window.t_end)]
        errors.append(float(np.sqrt(np.mean(inside.to_numpy() ** 2))))
    bottom.axhline(0.0, color=style.INK, lw=0.5)
    for panel in (top, bottom):
        panel.axvspan(window.t_start, window.t_end, color=style.SKY, alpha=0.2, lw=0)
    top.tick_params(labelbottom=False)
    top.set_ylabel(style.label_axis(axis, unit))
    bottom.set(ylabel=style.label_axis("residual", unit), xlabel=f"time in {window.trial_id} (s)")
    return errors


def _read_stretch(results: Results, model: str, window: WorstWindow) -> pd.DataFrame | None:
    """Return the residuals of ``model`` in the window, with 1.5 times its length on either side."""
    frame = results.table(results.model_file("residuals.parquet", model), trial=window.trial_id)
    if frame is None or f"residual_{window.axis}" not in frame:
        return None
    margin = 1.5 * (window.t_end - window.t_start)
    part = frame[frame["t"].between(window.t_start - margin, window.t_end + margin)]
    return part if len(part) > 3 else None


def _read_diagnoses(results: Results) -> Iterable[DiagnoseResult]:
    """Yield the diagnoses of all versions, the latest first."""
    for model in reversed(results.models):
        if found := results.read(DiagnoseResult, model):
            yield found


def _tell_alternatives(results: Results, effect: str) -> str:
    """Return the probability of ``effect``, and its alternatives."""
    for diagnosis in _read_diagnoses(results):
        if effect not in diagnosis.selected:
            continue
        known = {n: p for one in diagnosis.axes.values() for n, p in one.probabilities.items()}
        row = next(row for row in diagnosis.ranking if row.effect == effect)
        others = row.indistinguishable_from[:_ALTERNATIVES]
        named = (f"`{n}` ({phrases.probability(known.get(n, 0.0))})" for n in others)
        place = f"Alternatives: {join_names(named)}" if others else "No other effect replaces it"
        return f"Its probability is {phrases.probability(known[effect])}. {place}."
    return "No diagnosis of this run has compared it with other effects."
