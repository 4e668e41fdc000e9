"""Drafts: formulas over residuals that no effect explains, and over the null distribution."""

from collections.abc import Iterator

import numpy as np

from bampipe.lists import join_names
from bampipe.report import style
from bampipe.report.document import Block, Figure, Formulas, Subheading, Table
from bampipe.report.run_results import Results
from bampipe.report.wording import split_name
from bampipe.results.diagnose import DiagnoseResult, ResidualMap
from bampipe.results.draft import AxisDraft, DraftedEffect, DraftResult

TITLE = "Drafts"
_DRAWN_AT = {
    "force": "",
    "friction": ", in the positive direction of motion",
    "damping": ", at the highest speed",
    "inertia": ", at the highest acceleration",
    "reading": ", as the error of the reading",
}


def list_blocks(results: Results) -> Iterator[Block]:
    """Yield the searches for formulas, model by model."""
    for model in results.models:
        found = results.read(DraftResult, model)
        if found is None:
            continue
        diagnosis = results.read(DiagnoseResult, model)
        for axis, one in found.axes.items():
            yield Subheading(f"{axis.capitalize()}, model `{model}`")
            yield one.sentence
            effects = {name: found.effects[name] for name in one.effects}
            if effects:
                yield Formulas(tuple(f"{n}: {e.expression}" for n, e in effects.items()))
            maps = diagnosis.maps.get(axis, {}) if diagnosis else {}
            yield _draw(f"draft-{model}-{axis}", axis, one, effects, maps)
            errors = {f"`{near.effect}`": near.held_out_rmse for near in one.nearest}
            errors = {"the draft": one.rmse_after} | errors if errors else {}
            title = "Most similar effects of the library: error on held-out trials"
            rows = [(name, error, one.unit) for name, error in errors.items()]
            yield Table(title, "Effect | >With it | Unit :unit", rows)
        drafted, own = set(found.selected), set(results.effects(model))
        later = (set(results.effects(name)) for name in results.models)
        if not drafted or not any(drafted <= effects - own for effects in later):
            yield results.state_next(found.next)


def _draw(
    name: str,
    axis: str,
    entry: AxisDraft,
    effects: dict[str, DraftedEffect],
    maps: dict[str, ResidualMap],
) -> Figure:
    """Draw each formula over the residual, then error against length, then the gains."""
    count = len(effects) + 2
    figure, panels = style.make_grid(count, count, 2.3, extra=0.0, column_width=2.1)
    for panel, (effect_name, effect) in zip(panels, effects.items(), strict=False):
        residual = None if effect.curve.beside else maps.get(effect.curve.variable)
        curve = effect.curve
        if residual is not None and effect.acts_as == "force":
            centre, _ = style.scale_values(np.array(residual.center), residual.unit)
            low, high, mean = (-np.array(v) for v in (residual.high, residual.low, residual.mean))
            panel.fill_between(centre, low, high, color=style.VERMILLION, alpha=0.2, lw=0)
            panel.plot(centre, mean, ".-", color=style.VERMILLION, ms=3.0, lw=0.8, label="residual")
        style.draw_curve(panel, curve, curve.at, label="draft")
        panel.set_title(split_name(effect_name.partition(":")[0]), fontsize="small")
    panel = panels[-2]
    counts = [option.constants for option in entry.options]
    errors = [option.held_out_rmse for option in entry.options]
    panel.plot(counts, errors, "o", color=style.INK, ms=3.5)
    panel.axhline(entry.noise_floor, color=style.BLUE, lw=0.8)
    style.use_decades(panel, [*errors, entry.noise_floor])
    panel.set(xticks=sorted(set(counts)), xlabel="constants")
    panel.set_ylabel(style.label_axis("held-out error", entry.unit))
    panel = panels[-1]
    for number, one in enumerate(entry.chance):
        replicates = np.full(len(one.gains), float(number))
        panel.plot(replicates, one.gains, "o", color=style.BLUE, ms=3.0, alpha=0.6)
        panel.plot([number], [one.gain], "D", color=style.VERMILLION, ms=4.0)
    first = entry.chance[0]
    for words, value in (("measured", first.gain), ("replicates", max(first.gains))):
        panel.annotate(words, (0.0, value), (6, 0), textcoords="offset points", va="center")
    panel.set_yscale("symlog", linthresh=10.0)
    names = ["first formula", "second"][: len(entry.chance)]
    panel.set_xticks(range(len(names)), names)
    panel.set(xlim=(-0.5, len(names) - 0.2), ylabel="gain (nats)")
    if not effects:
        caption = (
            f"The search on {axis}: error on held-out trials against the number of constants, with "
            "the noise floor, and the gain of the best formula on the measured trials and on "
            "replicates that lack nothing."
        )
        return style.finish(figure, name, caption)
    drawn = ""
    for n, effect in effects.items():
        others = join_names(f"{words} {x:.3g}" for words, x in effect.curve.beside.items())
        place = _DRAWN_AT[effect.acts_as] + (f", at {others}" if others else "")
        drawn += f" `{n}` is drawn{place}." if place else ""
    caption = (
        f"The draft for {axis} with its 95 % band over the residual of the model (with the sign "
        "of a force: the residual has the opposite one). Error on held-out trials against the "
        "number of constants; the line is the noise floor. Gain in log likelihood of the best "
        f"formula on the measured trials and on replicates that lack nothing.{drawn}"
    )
    return style.finish(figure, name, caption, panels[:1])
