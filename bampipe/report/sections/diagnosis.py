"""Diagnosis: verdict by axis, candidate effects, where the residual is, the trial to add."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from bampipe.lists import count_noun, join_names
from bampipe.phrases import diagnosis as phrases
from bampipe.report import style
from bampipe.report.document import Block, Callout, Figure, Subheading, Table
from bampipe.report.run_results import Results
from bampipe.report.sections import next_trial
from bampipe.report.wording import format_decimals, format_digits, format_unit, split_name
from bampipe.results.diagnose import AxisVerdict, DiagnoseResult, RankedEffect, ResidualMap
from bampipe.results.draft import DraftResult
from bampipe.results.next import NextResult

Maps = Mapping[str, ResidualMap]
TITLE = "Diagnosis"
_MOST_RANKED = 8
_MOST_WINDOWS = 6
_MOST_MAPS = 6
"""Most maps shown of one axis: those that explain most, best first."""


def list_blocks(results: Results) -> Iterator[Block]:
    """Yield the findings of each diagnosis."""
    every = (results.read(DiagnoseResult, model) for model in results.models)
    found = [content for content in every if content is not None]
    if not found:
        yield f"No model has been diagnosed yet: run `{results.diagnose_command}`."
    for content in found:
        if len(found) > 1:
            yield Subheading(f"Model `{content.model}`")
        yield from _show_model(results, content, {} if content is found[-1] else found[-1].maps)


def _show_model(
    results: Results, found: DiagnoseResult, later: Mapping[str, Maps]
) -> Iterator[Block]:
    model, axes = found.model, results.order_axes(found.axes)
    yield tuple(entry.sentence for entry in axes.values())
    yield _tabulate_verdicts(found, axes)
    yield phrases.limits(found)
    lacking = [axis for axis in axes if axis in found.lacking]
    if found.ranking and lacking:
        yield _tabulate_candidates(found.ranking)
        shown = [one for one in found.sets if phrases.probability(one.probability) != "< 0.01"]
        if len(shown) > 1:
            first = shown[0].log_evidence
            sets = ((phrases.name_set(one), one) for one in shown[:_MOST_RANKED])
            yield Table(
                "Sets of effects, the most probable first",
                "Effects | >Probability | >Log evidence over the first (nats)",
                [(n, phrases.probability(s.probability), s.log_evidence - first) for n, s in sets],
                "Probabilities are means over resampled blocks of time, so that no single event "
                "decides: they differ less than the evidence of all blocks.",
            )
        yield phrases.null_distribution(found.chance)
    yield _advise(results, found) if lacking else _tell_sensitivity(results, model)
    if found.suggested_trial is not None and results.read(NextResult, model) is None:
        yield Callout("note", "A trial that would tell more", found.suggested_trial.sentence)
    for axis in lacking:
        if maps := found.maps.get(axis):
            yield _draw_maps(model, axis, axes[axis].unit, maps, later.get(axis, {}))
    windows = [one for one in found.worst_windows if one.axis in lacking][:_MOST_WINDOWS]
    yield Table(
        "Worst windows: where the prediction fails most, and how the machine moved there",
        "Axis | Trial | Time (s) | >RMSE | Motion ~1",
        [
            (
                *(one.axis, one.trial_id),
                f"{format_decimals(one.t_start, 1)} to {format_decimals(one.t_end, 1)}",
                *(f"{format_digits(one.rmse)} {format_unit(one.unit)}", one.doing or None),
            )
            for one in windows
        ],
    )


def _tell_sensitivity(results: Results, model: str) -> str:
    """Name the effects that these trials would not have revealed, if nothing is missing."""
    proposed = results.read(NextResult, model)
    if proposed is not None and proposed.sensitivity:
        return f"{proposed.why} The table under {next_trial.TITLE} lists every effect."
    option = f" --model {model}" if len(results.models) > 1 else ""
    return (
        f"`bampipe next {results.root.name}{option}` computes the size up to which an effect would"
        " go unnoticed in these trials, and the trial that would reveal it."
    )


def _advise(results: Results, found: DiagnoseResult) -> str:
    """Return the next command, or its result if it has been run."""
    wanted = {*found.selected}
    for rung in results.ladder:
        if wanted and rung.parent == found.model and wanted == {*(rung.added or "").split(", ")}:
            return f"Added since, as model `{rung.model}`."
    if found.next.startswith("bampipe draft ") and results.read(DraftResult, found.model):
        return "Drafted since (under Drafts)."
    if found.next.startswith("bampipe next ") and results.read(NextResult, found.model):
        return f"The trial to record is under {next_trial.TITLE}."
    return results.state_next(found.next)


def _tabulate_verdicts(found: DiagnoseResult, axes: Mapping[str, AxisVerdict]) -> Table:
    rows = []
    for axis, one in axes.items():
        errors = (one.rmse_before, one.rmse_after, one.rmse_beyond_bias, one.noise_floor)
        words, share = phrases.verdict(found, axis), phrases.percent_of_force(one.explained)
        rows.append((axis, words, share, *errors, one.unit, one.explainable_share))
    return Table(
        "Verdict by axis",
        "Axis | Verdict ~1 | >Explained | >Error now | >with the set | >beyond bias | >Floor"
        " | Unit :unit | >Explainable :%",
        rows,
        "Probabilities are in brackets. Explained: share of the mean square of the applied force "
        "that the model with the most probable set of effects explains. Errors are RMSE on "
        "held-out trials. Beyond bias: with the set, without the bias that filters leave where "
        "friction changes its sign. Floor: of replicates of the model with the set. Explainable: "
        "share of the present residual that a smooth function of motion and load predicts on "
        "unseen trials. Errors and floors are of fits of the diagnosis, within the trials that it "
        f"used ({join_names(found.trials, 4)}), not those of Validation.",
    )


def _tabulate_candidates(ranking: Sequence[RankedEffect]) -> Table:
    more = len(ranking) - _MOST_RANKED
    note = f"{count_noun(more, 'candidate')} further down not shown. " if more > 0 else ""
    return Table(
        "Candidate effects, best first",
        "Effect :code | Axis | Indistinguishable from | >Without | >With | Unit :unit"
        " | >Probability | >p :p",
        [
            (
                *(one.effect, one.axis, join_names(f"`{n}`" for n in one.indistinguishable_from)),
                *(one.held_out_rmse_before, one.held_out_rmse_after, one.unit),
                *(phrases.probability(one.probability), one.p_value),
            )
            for one in ranking[:_MOST_RANKED]
        ],
        f"{note}Without and with: RMSE on held-out trials, one of them scaled by the weighted "
        "misfit. p: probability that replicates give any candidate such a gain.",
    ).drop_empty_columns()


def _draw_maps(model: str, axis: str, unit: str, maps: Maps, later: Maps) -> Figure:
    names = sorted(maps, key=lambda name: -maps[name].variance_share)[:_MOST_MAPS]
    figure, panels = style.make_grid(len(names), 3, 1.65, column_width=1.9)
    for number, (panel, name) in enumerate(zip(panels, names, strict=True)):
        shown = [(maps[name], style.VERMILLION, "the model")]
        if name in later:
            shown.append((later[name], style.BLUE, "with the effects found"))
        draw_maps(panel, name, shown)
        if number % 3 == 0:
            panel.set_ylabel(style.label_axis("mean residual", unit))
    caption = (
        f"Where the force prediction of {axis} fails: mean residual (measured minus predicted)"
        " with its confidence band against its possible causes. Where the band excludes zero,"
        " the model lacks something."
    )
    name = f"residual-maps-{model}-{axis}"
    return style.finish(figure, name, caption, panels[:1] if later else ())


def draw_maps(panel: Any, name: str, shown: Sequence[tuple[ResidualMap, str, str]]) -> None:
    """Draw maps of one variable into a panel, each with its colour and its title."""
    bands = []
    for one, colour, title in shown:
        mean, low, high = (np.array(values) for values in (one.mean, one.low, one.high))
        bands += [low, high]
        if one.unit or not all(value.is_integer() for value in one.center):
            x, unit = style.scale_values(np.array(one.center), one.unit)
            panel.fill_between(x, low, high, color=colour, alpha=0.2, lw=0)
            panel.plot(x, mean, color=colour, lw=1.1, label=title)
            panel.set_xlabel(style.label_axis(split_name(name), unit))
        else:  # a discrete variable
            signs = {-1: "−", 0: "0", 1: "+"} if name == "direction" else {}
            numbers = [int(value) for value in one.center]
            names = [signs.get(n, str(n + (name == "trial"))) for n in numbers]
            places = np.arange(len(names), dtype=float)
            spread = np.abs(np.vstack([mean - low, high - mean]))
            panel.errorbar(places, mean, spread, color=colour, fmt="o", ms=3, lw=1.0, label=title)
            panel.set_xticks(places, names)
            panel.set(xlim=(-0.5, max(len(names), 1) - 0.5), xlabel=split_name(name))
    panel.axhline(0.0, color=style.INK, lw=0.6, zorder=1)
    style.set_limits(panel, bands, zero=True)
