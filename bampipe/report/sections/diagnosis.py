"""Diagnosis: verdict per axis, candidate effects, where the residual is, the trial to add."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bampipe.lists import join_names
from bampipe.report import style, verdicts, wording
from bampipe.report.document import (
    Block,
    Bullets,
    Callout,
    Figure,
    Paragraph,
    Section,
    Subheading,
    Table,
)
from bampipe.report.results import Results
from bampipe.report.sections import next_trial
from bampipe.results import phrases
from bampipe.results.compare import CompareResult
from bampipe.results.diagnose import (
    AxisVerdict,
    DiagnoseResult,
    RankedEffect,
    ResidualMap,
    WorstWindow,
)
from bampipe.results.draft import DraftResult
from bampipe.results.next import NextResult

Maps = Mapping[str, ResidualMap]
TITLE = "Diagnosis"
_RANKED = 8
_WINDOWS = 6
LONG = "What it is, and its formula"
"""A column of text, wider than others."""
_MAPS = 6
"""Most maps of one axis: those that tell most, best first."""


def section(results: Results) -> Section:
    """Return the section."""
    found = [
        (model, content)
        for model in results.models
        if (content := results.read(DiagnoseResult, model)) is not None
    ]
    if not found:
        text = "Whether an effect is missing, and which, has not been asked: "
        text += f"`{results.diagnose}` does it."
        return Section(TITLE, (Paragraph(text),))
    blocks: list[Block] = []
    last, after = found[-1]
    for model, content in found:
        if len(found) > 1:
            blocks.append(Subheading(f"Model `{model}`"))
        later = None if model == last else after.maps
        blocks += _model(results, model, content, later)
    return Section(TITLE, tuple(blocks))


def _model(
    results: Results, model: str, found: DiagnoseResult, later: Mapping[str, Maps] | None
) -> list[Block]:
    axes = found.axes
    names = verdicts.ordered(results, axes)
    sentences = tuple(axes[axis].sentence for axis in names)
    blocks: list[Block] = [Bullets(sentences), _verdicts(found, names)]
    if found.limits:
        blocks.append(Paragraph(found.limits))
    lacking = [axis for axis in names if axis in found.lacking]
    if found.ranking and lacking:
        blocks += [_ranking(found.ranking), *_sets(found)]
    if lacking:
        blocks += _next(results, model, found)
    else:
        blocks.append(Paragraph(_unseen(results, model)))
    if found.suggested_trial is not None:
        words = found.suggested_trial.sentence
        blocks.append(Callout("note", "A trial that would tell more", words))
    blocks += [
        _maps(model, axis, axes[axis], found.maps[axis], (later or {}).get(axis))
        for axis in lacking
        if found.maps.get(axis)
    ]
    windows = [window for window in found.worst_windows if window.axis in lacking]
    if windows:
        blocks.append(_windows(results, windows))
    return blocks


def _unseen(results: Results, model: str) -> str:
    """What these trials would not have shown, beside that nothing is missing."""
    proposed = results.read(NextResult, model)
    if proposed is not None and proposed.sensitivity:
        return f"{proposed.why} The table under {next_trial.TITLE} has every effect."
    option = f" --model {model}" if len(results.models) > 1 else ""
    return (
        "How large an effect could be and go unnoticed in these trials, and which trial would show"
        f" it: `bampipe next {results.root.name}{option}` says."
    )


def _next(results: Results, model: str, found: DiagnoseResult) -> list[Block]:
    """Return the command that follows; where it has been run, the model that came of it."""
    compared = results.read(CompareResult)
    rungs = compared.ladder if compared else ()
    wanted = set(found.selected)
    for rung in rungs:
        if wanted and rung.parent == model and wanted == set((rung.added or "").split(", ")):
            return [Paragraph(f"Added since, as model `{rung.model}`.")]
    if found.next.startswith("bampipe draft ") and results.read(DraftResult, model):
        return [Paragraph("Drafted since (under Drafts).")]
    what = found.next.replace("RUN", results.root.name)
    return [Paragraph(f"Next: `{what}`" if what.startswith("bampipe ") else f"Next: {what}.")]


def _verdicts(found: DiagnoseResult, names: Sequence[str]) -> Table:
    rows = [
        (
            axis,
            phrases.verdict(found, axis),
            phrases.percent_of_force(entry.explained),
            wording.significant(entry.rmse_before),
            wording.significant(entry.rmse_after),
            wording.significant(entry.rmse_beyond_bias),
            wording.significant(entry.noise_floor),
            wording.unit(entry.unit),
            wording.percent(entry.explainable_share),
        )
        for axis in names
        for entry in (found.axes[axis],)
    ]
    return Table(
        "Verdict by axis",
        (
            *("Axis", "Verdict", "Explained", "Error now", "with the set", "beyond bias", "Floor"),
            *("Unit", "Explainable"),
        ),
        tuple(rows),
        "llrrrrrlr",
        (0.0, 1.0, *7 * (0.0,)),
        note="In brackets: probabilities. Explained: share of the mean square of the applied "
        "force, with the most probable set of effects. Errors are RMSE on held-out trials; beyond "
        "bias: with the set, but for what filters leave where friction turns; floor: of replays of "
        "the model with the set. Explainable: share of the residual now that any smooth function "
        "of motion and load predicts on unseen trials.",
    )


def _sets(found: DiagnoseResult) -> list[Block]:
    """Return the sets of effects that are probable, where there are several, and chance beside."""
    shown = [one for one in found.sets if phrases.probability(one.probability) != "< 0.01"]
    chance = Paragraph(phrases.chance(found.chance))
    if len(shown) < 2:
        return [chance]
    rows = [
        (
            join_names(f"`{name}`" for name in one.effects) or "none",
            phrases.probability(one.probability),
            wording.significant(one.log_evidence),
        )
        for one in shown[:_RANKED]
    ]
    heads = ("Effects", "Probability", "Log evidence over the first (nats)")
    return [Table("Sets of effects, the most probable first", heads, tuple(rows), "lrr"), chance]


def ranking_table(
    title: str, rows: Sequence[tuple[RankedEffect, Sequence[str]]], about: Sequence[str], note: str
) -> Table:
    """Return candidate effects with the error without and with each, and how probable it is.

    Args:
        title: of the table; note: below it.
        rows: candidates, each with the cells of the columns ``about``, which may be long.
    """
    return Table(
        title,
        ("Effect", *about, "Without", "With", "Unit", "Probability", "p"),
        tuple(
            (
                f"`{entry.effect}`",
                *more,
                wording.significant(entry.held_out_rmse_before),
                wording.significant(entry.held_out_rmse_after),
                wording.unit(entry.unit),
                phrases.probability(entry.probability),
                wording.probability(entry.p_value),
            )
            for entry, more in rows
        ),
        "l" + "l" * len(about) + "rrlrr",
        (0.0, *(2.6 if name == LONG else 0.0 for name in about), *5 * (0.0,)),
        f"{note} Without and with: RMSE on held-out trials; p: chance that replays give any "
        "candidate as large a gain.",
    )


def _ranking(ranking: Sequence[RankedEffect]) -> Table:
    shown = ranking[:_RANKED]
    imitated = any(entry.indistinguishable_from for entry in shown)
    more = len(ranking) - len(shown)
    return ranking_table(
        "Candidate effects, best first",
        [
            (
                entry,
                (
                    entry.axis,
                    *([join_names(f"`{n}`" for n in entry.indistinguishable_from)] * imitated),
                ),
            )
            for entry in shown
        ],
        ("Axis", *(["Indistinguishable from"] * imitated)),
        f"{wording.count(more, 'candidate')} further down not shown." if more else "",
    )


def _maps(
    model: str,
    axis: str,
    entry: AxisVerdict,
    maps: Maps,
    later: Maps | None,
) -> Figure:
    names = sorted(maps, key=lambda name: -maps[name].variance_share)
    names = names[:_MAPS]
    columns = min(3, len(names))
    rows = math.ceil(len(names) / columns)
    figure, panels = style.panels(
        rows, columns, 0.35 + 1.65 * rows, width=min(style.WIDTH, 1.0 + 1.9 * columns)
    )
    unit = wording.unit(entry.unit)
    for number, (panel, name) in enumerate(zip(panels.flat, names, strict=False)):
        extents = [_map(panel, name, maps[name], style.VERMILLION, "the model")]
        if later and name in later:
            extents.append(_map(panel, name, later[name], style.BLUE, "with the effects found"))
        panel.axhline(0.0, color=style.INK, lw=0.6, zorder=1)
        style.limits(panel, [item for pair in extents for item in pair], zero=True)
        if number % columns == 0:
            panel.set_ylabel(style.label("mean residual", unit))
    for panel in panels.flat[len(names) :]:
        panel.set_axis_off()
    style.legend_below(figure, panels.flat[0])
    caption = (
        f"Where the force prediction of {axis} fails: mean residual (measured minus predicted) "
        "with its confidence band against what might cause it. A band that leaves zero is "
        "structure that the model lacks."
    )
    return Figure(f"residual-maps-{model}-{axis}".replace(":", "."), caption, style.svg(figure))


def _map(
    panel: Any, name: str, drawn: ResidualMap, colour: str, title: str
) -> tuple[np.ndarray, np.ndarray]:
    """Draw one map; return its lower and upper band."""
    centre = drawn.center
    mean, low, high = (np.array(values) for values in (drawn.mean, drawn.low, drawn.high))
    levels = _levels(name, centre) if not drawn.unit else None
    if levels is None:
        x, shown = style.scaled(np.array(centre), drawn.unit)
        panel.fill_between(x, low, high, color=colour, alpha=0.2, lw=0)
        panel.plot(x, mean, color=colour, lw=1.1, label=title)
        panel.set_xlabel(style.label(wording.words(name), shown))
    else:
        x = np.arange(len(centre), dtype=float)
        spread = np.abs(np.vstack([mean - low, high - mean]))
        panel.errorbar(x, mean, spread, color=colour, fmt="o", ms=3, lw=1.0, label=title)
        panel.set_xticks(x, levels)
        panel.set_xlim(-0.5, len(centre) - 0.5)
        panel.set_xlabel(wording.words(name))
    return low, high


def _levels(name: str, centre: Sequence[float]) -> list[str] | None:
    """Return the names of the levels of a variable that counts or sorts, else None."""
    if not all(value.is_integer() for value in centre):
        return None
    first = 1 if name == "trial" else 0
    signed = {-1: "−", 0: "0", 1: "+"} if name == "direction" else {}
    return [signed.get(int(value), str(int(value) + first)) for value in centre]


def _windows(results: Results, windows: Sequence[WorstWindow]) -> Table:
    rows = []
    for entry in windows[:_WINDOWS]:
        unit = wording.unit(results.force_unit(entry.axis)) if entry.axis in results.axes else ""
        rows.append(
            (
                entry.axis,
                entry.trial_id,
                f"{wording.plain(entry.t_start, 1)} to {wording.plain(entry.t_end, 1)}",
                f"{wording.significant(entry.rmse)} {unit}",
                entry.doing or "–",
            )
        )
    return Table(
        "Worst windows: where the prediction fails most, and what the machine was doing",
        ("Axis", "Trial", "Time (s)", "RMSE", "Doing"),
        tuple(rows),
        "lllrl",
        (0.0, 0.0, 0.0, 0.0, 1.0),
    )
