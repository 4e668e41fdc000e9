"""Two sessions of one device: tables for page and terminal, and the residual by state."""

from bampipe.lists import count_noun
from bampipe.report import style
from bampipe.report.document import Block, Callout, Document, Figure, Section, Table, Tone
from bampipe.report.page import render_page
from bampipe.report.sections.diagnosis import draw_maps
from bampipe.results.pair import PairResult


def tabulate_pair(pair: PairResult) -> list[Table]:
    """Return parameters, verdicts, predictions and refits; empty tables are left out."""
    sides, axes = (pair.first, pair.second), list(pair.journeys[0].axes)
    parameters = [
        (
            *(name, one.first, one.first_sd, one.second, one.second_sd, one.unit),
            *(one.standard_errors, one.p_value, "yes" if one.changed else ""),
        )
        for name, one in pair.parameters.items()
    ]
    verdicts = [("model", *(f"`{side.model}`" for side in sides))]
    verdicts += [(x, *(side.verdicts.get(x, "not diagnosed") for side in sides)) for x in axes]
    travels = [
        (
            *(one.model_of, one.trials_of, axis),
            *(e.error, e.own_error, e.noise_floor, e.limit, e.unit, e.travels),
        )
        for one in pair.journeys
        for axis, e in one.axes.items()
    ]
    refits = [
        (
            one.model_of, ", ".join(f"{name} {by:+.3g}" for name, by in refit.changes.items()),
            *(refit.errors[axis] for axis in axes), ", ".join(refit.travels),
        )
        for one in pair.journeys
        for refit in (*one.alone, one.together)
        if refit is not None and (refit is not one.together or len(refit.changes) > 1)
    ]  # fmt: skip
    a, b = (side.session for side in sides)
    columns = f"Parameter | >{a} | >sd | >{b} | >sd | Unit :unit | >Change/se | >p (Holm) :p"
    columns += " | Changed"
    found = [
        Table("Parameters", columns, parameters, "Change/se: difference over its standard error."),
        Table("Verdicts", f"Axis | {a} ~1 | {b} ~1", verdicts),
        Table(
            "Prediction of the other session's trials, RMSE",
            "Model of | Trials of | Axis | >Error | >Own model | >Floor | >Limit | Unit :unit"
            " | Travels",
            travels,
            "Own model: its held-out error at home. Travels: error within the limit.",
        ),
        Table(
            "Some parameters refitted to the other session",
            f"Model of | Refitted, others held ~1 | {''.join(f'>Error {x} | ' for x in axes)}"
            "Travels on",
            refits,
        ).drop_empty_columns(),
    ]
    return [table for table in found if table.rows]


def build_page(pair: PairResult) -> str:
    """Return the page as HTML."""
    changed = any(one.changed for one in pair.parameters.values())
    changed |= any(one.failed for one in pair.journeys) or any(one.changed for one in pair.states)
    tone: Tone = "attention" if changed else "good"
    verdict = "The sessions differ" if changed else "Nothing changed beyond chance"
    blocks: list[Block] = [Callout(tone, verdict, "\n".join(pair.sentences)), pair.notes]
    with style.use_style():
        blocks += [*tabulate_pair(pair), *(_draw_states(pair, a) for a in pair.journeys[0].axes)]
    title = f"{pair.first.session} and {pair.second.session}"
    section = Section.gather("What changed", blocks)
    return render_page(Document(title, f"device {pair.device}", (section,)))


def _draw_states(pair: PairResult, axis: str) -> Figure:
    states = [one for one in pair.states if one.axis == axis and one.p_values]
    figure, panels = style.make_grid(max(len(states), 1), 3, 1.8)
    for panel, one in zip(panels, states, strict=False):
        first = (one.first, style.BLUE, pair.first.session)
        draw_maps(panel, one.variable, [first, (one.second, style.VERMILLION, pair.second.session)])
        panel.set_title(f"{count_noun(one.changed, 'bin')} of {len(one.p_values)} changed")
    panels[0].set_ylabel(style.label_axis("mean residual", pair.journeys[0].axes[axis].unit))
    caption = f"Residual of the model of {pair.first.session} on {axis}, trials of both sessions."
    return style.finish(figure, f"states-{axis}", caption, panels[:1])
