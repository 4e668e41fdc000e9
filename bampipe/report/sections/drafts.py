"""Drafts: formulas for what no effect explains, over the residual, and what chance would give."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from bampipe.lists import join_names
from bampipe.report import style, wording
from bampipe.report.document import Block, Figure, Formulas, Paragraph, Section, Subheading, Table
from bampipe.report.results import Results
from bampipe.results.diagnose import DiagnoseResult, ResidualMap
from bampipe.results.draft import AxisDraft, DraftedEffect, DraftResult

TITLE = "Drafts"
_AS_DRAWN = {
    "force": "",
    "friction": ", in the positive direction of motion",
    "damping": ", at the highest speed",
    "inertia": ", at the highest acceleration",
    "reading": ", as what the reading has too much",
}


def section(results: Results) -> Section | None:
    """Return the section; None where no formula was looked for."""
    blocks: list[Block] = []
    for model in results.models:
        found = results.read(DraftResult, model)
        if found is None:
            continue
        diagnosis = results.read(DiagnoseResult, model)
        for axis, entry in found.axes.items():
            blocks.append(Subheading(f"{axis.capitalize()}, model `{model}`"))
            blocks.append(Paragraph(entry.sentence))
            effects = {name: found.effects[name] for name in entry.effects}
            if effects:
                lines = [f"{name}: {effect.expression}" for name, effect in effects.items()]
                blocks.append(Formulas(tuple(lines)))
            maps = diagnosis.maps.get(axis, {}) if diagnosis else {}
            blocks.append(_pictures(model, axis, entry, effects, maps))
            if entry.nearest:
                blocks.append(_nearest(entry))
        blocks += _next(results, model, found)
    return Section(TITLE, tuple(blocks)) if blocks else None


def _next(results: Results, model: str, found: DraftResult) -> list[Block]:
    """Return what to do about the drafts; nothing where a later model has them."""
    drafted, own = set(found.selected), set(results.effects(model))
    later = (set(results.effects(name)) for name in results.models)
    if drafted and any(drafted <= effects - own for effects in later):
        return []
    what = found.next.replace("RUN", results.root.name)
    return [Paragraph(f"Next: `{what}`" if what.startswith("bampipe ") else f"Next: {what}.")]


def _pictures(
    model: str,
    axis: str,
    entry: AxisDraft,
    effects: dict[str, DraftedEffect],
    maps: dict[str, ResidualMap],
) -> Figure:
    """Draw each formula over the residual, then error against length, then chance."""
    count = len(effects) + 2
    figure, panels = style.panels(1, count, 2.3, width=min(style.WIDTH, 0.6 + 2.2 * count))
    for panel, (name, effect) in zip(panels.flat, effects.items(), strict=False):
        left = None if effect.curve.beside else maps.get(effect.curve.variable)
        _curve(panel, name, effect, left)
    _length(panels.flat[count - 2], entry)
    _chance(panels.flat[count - 1], entry)
    if effects:
        style.legend_below(figure, panels.flat[0])
    drawn = "".join(
        f" `{name}` is drawn{_as_drawn(effect)}."
        for name, effect in effects.items()
        if _as_drawn(effect)
    )
    caption = (
        f"What was drafted for {axis}, with its 95 % band, over what the model leaves (sign turned "
        "round: a missing force and the residual are opposite). Error on held-out trials against "
        "the number of constants; the line is the noise floor. Gain in log likelihood of the best "
        f"formula, on the measured trials and on replays that lack nothing.{drawn}"
        if effects
        else f"What was looked for on {axis}: error on held-out trials against the number of "
        "constants, with the noise floor, and the gain of the best formula on the measured trials "
        "and on replays that lack nothing."
    )
    return Figure(f"draft-{model}-{axis}".replace(":", "."), caption, style.svg(figure))


def _as_drawn(effect: DraftedEffect) -> str:
    """Where on what it depends on a formula is drawn; nothing where it follows one position."""
    others = [f"{words} {value:.3g}" for words, value in effect.curve.beside.items()]
    return _AS_DRAWN[effect.acts_as] + (f", at {join_names(others)}" if others else "")


def _curve(panel: Axes, name: str, effect: DraftedEffect, left: ResidualMap | None) -> None:
    curve = effect.curve
    x, unit = style.scaled(np.array(curve.at), curve.variable_unit)
    if left is not None and effect.acts_as == "force":
        centre, _ = style.scaled(np.array(left.center), left.unit)
        low, high = -np.array(left.high), -np.array(left.low)
        panel.fill_between(centre, low, high, color=style.VERMILLION, alpha=0.2, lw=0)
        mean = -np.array(left.mean)
        panel.plot(
            centre,
            mean,
            color=style.VERMILLION,
            marker=".",
            ms=3.0,
            lw=0.8,
            label="left by the model",
        )
    panel.fill_between(x, curve.low, curve.high, color=style.BLUE, alpha=0.25, lw=0)
    panel.plot(x, curve.mean, color=style.BLUE, label="draft")
    panel.axhline(0.0, color=style.INK, lw=0.5)
    panel.set_title(name.partition(":")[0].replace("_", " "), fontsize="small")
    panel.set_xlabel(style.label(wording.words(curve.variable), unit))
    kind = "torque" if curve.unit.startswith("N.m") else "force"
    panel.set_ylabel(style.label(kind, wording.unit(curve.unit)))


def _length(panel: Axes, entry: AxisDraft) -> None:
    counts = [option.constants for option in entry.options]
    errors = [option.held_out_rmse for option in entry.options]
    panel.plot(counts, errors, color=style.INK, marker="o", ms=3.5, lw=0.8)
    panel.axhline(entry.noise_floor, color=style.BLUE, lw=0.8)
    style.decades(panel, [*errors, entry.noise_floor])
    panel.set_xticks(sorted(set(counts)))
    panel.set_xlabel("constants")
    panel.set_ylabel(style.label("held-out error", wording.unit(entry.unit)))


def _chance(panel: Axes, entry: AxisDraft) -> None:
    for number, chance in enumerate(entry.chance):
        replays = np.full(len(chance.gains), float(number))
        panel.plot(replays, chance.gains, "o", color=style.BLUE, ms=3.0, alpha=0.6)
        panel.plot([number], [chance.gain], "D", color=style.VERMILLION, ms=4.0)
    first = entry.chance[0]
    for words, value in (("measured", first.gain), ("replays", max(first.gains))):
        panel.annotate(words, (0.0, value), (6, 0), textcoords="offset points", va="center")
    panel.set_yscale("symlog", linthresh=10.0)
    names = ["first formula", "second"][: len(entry.chance)]
    panel.set_xticks(range(len(names)), names)
    panel.set_xlim(-0.5, len(names) - 0.2)
    panel.set_ylabel("gain")


def _nearest(entry: AxisDraft) -> Table:
    rows = [
        (f"`{near.effect}`", wording.significant(near.held_out_rmse), wording.unit(entry.unit))
        for near in entry.nearest
    ]
    rows.insert(0, ("the draft", wording.significant(entry.rmse_after), wording.unit(entry.unit)))
    return Table(
        "Effects of the library that come nearest: error on held-out trials",
        ("Effect", "With it", "Unit"),
        tuple(rows),
        "lrl",
    )
