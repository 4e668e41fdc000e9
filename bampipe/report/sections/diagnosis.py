"""Diagnosis: verdict per axis, candidate effects, where the residual is, the trial to add."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bampipe.report import style, verdicts, wording
from bampipe.report.document import (
    Block,
    Bullets,
    Callout,
    Figure,
    Section,
    Subheading,
    Table,
    Text,
)
from bampipe.report.results import Results

TITLE = "Diagnosis"
_RANKED = 8
_WINDOWS = 6
_MAPS = 6
"""Most maps of one axis: those that tell most, best first."""


def section(results: Results) -> Section:
    """Return the section."""
    found = [
        (model, content)
        for model in results.models
        if (content := results.json(results.of_model("diagnose.json", model))) is not None
    ]
    if not found:
        command = f"`bampipe diagnose {results.root.name}`"
        text = f"Whether an effect is missing, and which, has not been asked: {command} does it."
        return Section(TITLE, (Text(text),))
    blocks: list[Block] = []
    last, after = found[-1]
    for model, content in found:
        if len(found) > 1:
            blocks.append(Subheading(f"Model `{model}`"))
        later = None if model == last else after.get("maps")
        blocks += _model(results, model, content, later)
    return Section(TITLE, tuple(blocks), new_page=True)


def _model(
    results: Results, model: str, content: dict[str, Any], later: dict[str, Any] | None
) -> list[Block]:
    axes = content.get("axes", {})
    names = verdicts.ordered(results, axes)
    blocks: list[Block] = []
    sentences = tuple(
        wording.sentence(axes[axis]["sentence"]) for axis in names if axes[axis].get("sentence")
    )
    if sentences:
        blocks.append(Bullets(sentences))
    elif content.get("sentence"):
        blocks.append(Text(wording.sentence(content["sentence"])))
    blocks.append(_verdicts(results, names, axes))
    lacking = any(axes[axis].get("verdict") != "nothing_missing" for axis in names)
    ranking = content.get("ranking") or []
    if ranking and lacking:
        blocks.append(_ranking(results, ranking))
    following = str(content.get("next") or "")
    if following:
        command = following.startswith("bampipe ")
        blocks.append(Text(f"Next: `{following}`" if command else f"Next: {following}."))
    suggestion = content.get("suggested_trial")
    if isinstance(suggestion, dict) and suggestion.get("sentence"):
        blocks.append(
            Callout(
                "note", "A trial that would tell more", wording.sentence(suggestion["sentence"])
            )
        )
    maps = content.get("maps") or {}
    blocks += [
        _maps(results, model, axis, axes[axis], maps[axis], (later or {}).get(axis))
        for axis in names
        if maps.get(axis) and axes[axis].get("verdict") != "nothing_missing"
    ]
    windows = content.get("worst_windows") or []
    if windows and lacking:
        blocks.append(_windows(results, windows))
    return blocks


def _verdicts(results: Results, names: tuple[str, ...], axes: dict[str, Any]) -> Table:
    rows = []
    for axis in names:
        entry = axes[axis]
        verdict = str(entry.get("verdict", ""))
        rows.append(
            (
                axis,
                verdicts.IN_WORDS.get(verdict, wording.words(verdict)),
                wording.percent(entry.get("explainable_share")),
                wording.percent(entry.get("explainable_chance")),
                wording.significant(entry.get("rmse_before")),
                wording.significant(entry.get("rmse_after")),
                wording.significant(entry.get("noise_floor")),
                wording.unit(str(entry.get("unit", results.force_unit(axis)))),
            )
        )
    return Table(
        "Verdict by axis",
        (
            "Axis",
            "Verdict",
            "Explainable",
            "by chance",
            "Error now",
            "with effects",
            "Floor",
            "Unit",
        ),
        tuple(rows),
        "llrrrrrl",
        note="Explainable: share of the residual that any function of motion and load could "
        "predict on unseen trials; by chance: the same where nothing is missing. Errors are RMSE "
        "on held-out trials.",
    )


def _ranking(results: Results, ranking: list[dict[str, Any]]) -> Table:
    rows = []
    for entry in ranking[:_RANKED]:
        axis = str(entry.get("axis") or "")
        unit = wording.unit(results.force_unit(axis)) if axis in results.axes else ""
        alike = [f"`{name}`" for name in entry.get("indistinguishable_from") or ()]
        rows.append(
            (
                f"`{entry['effect']}`",
                axis or "–",
                wording.significant(entry.get("held_out_rmse_before")),
                wording.significant(entry.get("held_out_rmse_after")),
                unit,
                wording.probability(entry.get("p_value")),
                ", ".join(alike) or "–",
            )
        )
    more = len(ranking) - len(rows)
    note = "p: chance of such a fall in error where the effect is absent."
    if more:
        note += f" {wording.count(more, 'candidate')} further down not shown."
    return Table(
        "Candidate effects, best first: error on held-out trials without and with each",
        ("Effect", "Axis", "Without", "With", "Unit", "p", "Not told apart from"),
        tuple(rows),
        "llrrlrl",
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        note,
    )


def _maps(
    results: Results,
    model: str,
    axis: str,
    entry: dict[str, Any],
    maps: dict[str, Any],
    later: dict[str, Any] | None,
) -> Figure:
    names = sorted(maps, key=lambda name: -float(maps[name].get("variance_share") or 0.0))
    names = names[:_MAPS]
    columns = min(3, len(names))
    rows = math.ceil(len(names) / columns)
    figure, panels = style.panels(
        rows, columns, 0.35 + 1.65 * rows, width=min(style.WIDTH, 1.0 + 1.9 * columns)
    )
    unit = wording.unit(str(entry.get("unit", results.force_unit(axis))))
    for number, (panel, name) in enumerate(zip(panels.flat, names, strict=False)):
        extents = [_map(panel, name, maps[name], style.VERMILLION, f"model {model}")]
        if later and later.get(name):
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
    panel: Any, name: str, content: dict[str, Any], colour: str, title: str
) -> tuple[np.ndarray, np.ndarray]:
    """Draw one map; return its lower and upper band."""
    centre = content["center"]
    mean = _numbers(content["mean"])
    low = _numbers(content.get("low") or content["mean"])
    high = _numbers(content.get("high") or content["mean"])
    unit = str(content.get("unit") or "")
    levels = _levels(name, centre) if not unit else None
    if levels is None:
        x, shown = style.scaled(_numbers(centre), unit)
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


def _levels(name: str, centre: list[Any]) -> list[str] | None:
    """Return the names of the levels of a variable that counts or sorts, else None."""
    if not all(isinstance(value, int | float) and float(value).is_integer() for value in centre):
        return None
    first = 1 if name == "trial" else 0
    signed = {-1: "−", 0: "0", 1: "+"} if name == "direction" else {}
    return [signed.get(int(value), str(int(value) + first)) for value in centre]


def _numbers(values: list[float | None]) -> np.ndarray:
    return np.array([math.nan if value is None else float(value) for value in values])


def _windows(results: Results, windows: list[dict[str, Any]]) -> Table:
    rows = []
    for entry in windows[:_WINDOWS]:
        axis = str(entry.get("axis", ""))
        start, stop = float(entry["t_start"]), float(entry["t_end"])
        unit = wording.unit(results.force_unit(axis)) if axis in results.axes else ""
        rows.append(
            (
                axis,
                str(entry.get("trial_id", "")),
                f"{wording.plain(start, 1)} to {wording.plain(stop, 1)}",
                f"{wording.significant(entry.get('rmse'))} {unit}",
                str(entry.get("doing") or "–"),
            )
        )
    return Table(
        "Worst windows: where the prediction fails most, and what the arm was doing",
        ("Axis", "Trial", "Time (s)", "RMSE", "Doing"),
        tuple(rows),
        "lllrl",
        (0.0, 0.0, 0.0, 0.0, 1.0),
    )
