"""The ladder: held-out error of each model version against the floor; what its parameters did."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from bampipe.lists import join_names
from bampipe.report import style, verdicts, wording
from bampipe.report.document import Block, Bullets, Figure, Section, Table
from bampipe.report.results import Results
from bampipe.results.compare import CompareResult, Rung, Value, horizons_of

TITLE = "Model versions"
_MOST_COLUMNS = 3
_MOST_NUMBERS = 4
"""Versions of which each can have its number below a panel."""


def section(results: Results) -> Section | None:
    """Return the section; None where there is one model only."""
    compared = results.read(CompareResult)
    if compared is None or len(compared.ladder) < 2:
        return None
    rungs = compared.ladder
    blocks: list[Block] = [_steps(results, rungs), _picture(results, rungs)]
    if any(rung.free_run for rung in rungs):
        blocks.append(_free_runs(results, rungs))
    if horizons_of(rungs):
        blocks.append(_drift(results, rungs))
    if compared.parameters:
        blocks.append(_parameters(results, rungs, compared.parameters))
    if compared.moved:
        blocks.append(Bullets(tuple(one.sentence for one in compared.moved)))
    return Section(TITLE, tuple(blocks))


def _axes(results: Results, rungs: Sequence[Rung]) -> tuple[str, ...]:
    return verdicts.ordered(results, {axis for rung in rungs for axis in rung.held_out_rmse})


def _steps(results: Results, rungs: Sequence[Rung]) -> Table:
    axes = _axes(results, rungs)
    rows = []
    for rung in rungs:
        cells = []
        for axis in axes:
            error, floor = rung.sound_error(axis), rung.sound_floor(axis)
            text = "refused" if axis in rung.refused else wording.significant(error)
            cells.append(f"{text} ({wording.significant(floor)})" if floor else text)
        rows.append((_version(rungs, rung), f"`{rung.added}`" if rung.added else "", *cells))
    units = (f"{axis} ({wording.unit(results.force_unit(axis))})" for axis in axes)
    return Table(
        "RMSE on the same held-out trials (noise floor)",
        ("Version", "Added", *units),
        tuple(rows),
        "ll" + "r" * len(axes),
    )


def _free_runs(results: Results, rungs: Sequence[Rung]) -> Table:
    """Position error of each version left to itself: mean absolute, and relative to the motion."""
    axes = _axes(results, rungs)
    scales = {
        axis: wording.scale(
            (rung.free_run[axis].mean_absolute for rung in rungs if axis in rung.free_run),
            results.unit(axis),
        )
        for axis in axes
    }
    rows = []
    for rung in rungs:
        cells = []
        for axis in axes:
            entry = rung.free_run.get(axis)
            if entry is None:
                cells += ["–", "–"]
                continue
            cells.append(wording.significant(scales[axis][0] * entry.mean_absolute))
            cells.append(wording.significant(entry.relative_error_percent))
        loop = wording.words(rung.free_run_mode or "–")
        rows.append((_version(rungs, rung), loop, *cells))
    units = [column for axis in axes for column in (f"{axis} ({scales[axis][1]})", "relative (%)")]
    return Table(
        "Free run over held-out trials: mean absolute error of the position, and relative error",
        ("Version", "Loop", *units),
        tuple(rows),
        "ll" + "rr" * len(axes),
        note=" ".join(
            f"{_version(rungs, rung).capitalize()}, –: {rung.free_run_reason}."
            for rung in rungs
            if not rung.free_run and rung.free_run_reason
        ),
    )


def _drift(results: Results, rungs: Sequence[Rung]) -> Table:
    """How far each version drifts within each horizon: the medians."""
    axes = _axes(results, rungs)
    horizons = horizons_of(rungs)
    rows = []
    drifts = {axis: [rung.median_drift(axis) for rung in rungs] for axis in axes}
    scales = {
        axis: wording.scale(
            (x for found in drifts[axis] for x in found.values()), results.unit(axis)
        )
        for axis in axes
    }
    for number, rung in enumerate(rungs):
        cells = []
        for axis, (factor, _) in scales.items():
            found = {h: factor * x for h, x in drifts[axis][number].items()}
            cells.append(" / ".join(wording.significant(found.get(h), 2) for h in horizons))
        rows.append((_version(rungs, rung), *cells))
    units = (f"{axis} ({unit})" for axis, (_, unit) in scales.items())
    within = " / ".join(f"{h:g}" for h in horizons)
    return Table(
        f"Drift of each version left to itself for {within} s under the recorded inputs, median",
        ("Version", *units),
        tuple(rows),
        "l" + "r" * len(axes),
        note="–: runs away, drifts further than the axis itself moves, or the axis hardly moves."
        if any("–" in cell for row in rows for cell in row)
        else "",
    )


def _version(rungs: Sequence[Rung], rung: Rung) -> str:
    """Return a short name: the base model's own, then numbers (names grow with every effect)."""
    number = rungs.index(rung)
    return rung.model if number == 0 else f"version {number}"


def _picture(results: Results, rungs: Sequence[Rung]) -> Figure:
    axes = _axes(results, rungs)
    figure, panels = style.panels(1, len(axes), 2.3, width=min(style.WIDTH, 1.2 + 1.9 * len(axes)))
    x = np.arange(len(rungs))
    for panel, axis in zip(panels[0], axes, strict=True):
        error = _values(rung.sound_error(axis) for rung in rungs)
        floor = _values(rung.sound_floor(axis) for rung in rungs)
        panel.plot(x, error, "o-", color=style.BLUE, ms=4.5, lw=1.3, label="held-out error")
        panel.plot(x, floor, "s--", color=style.VERMILLION, ms=3.0, lw=1.0, label="noise floor")
        _scale(panel, np.concatenate([error, floor]))
        panel.set_xlim(-0.4, len(rungs) - 0.6)
        panel.set_xticks(x, _ticks(rungs[0].model, error))
        panel.set_xlabel("version, and its error")
        panel.set_title(axis)
        panel.set_ylabel(style.label("RMSE", wording.unit(results.force_unit(axis))))
    style.legend_below(figure, panels[0][0])
    return Figure("ladder", _caption(rungs, axes), style.svg(figure))


def _ticks(first: str, error: np.ndarray) -> list[str]:
    """Return each version with its error below, of many versions the first and last alone."""
    names = [first, *(str(number) for number in range(1, len(error)))]
    shown = range(len(error)) if len(error) <= _MOST_NUMBERS else (0, len(error) - 1)
    return [
        f"{name}\n{wording.significant(float(value))}" if number in shown else name
        for number, (name, value) in enumerate(zip(names, error, strict=True))
    ]


def _scale(panel: Any, values: np.ndarray) -> None:
    """Set the vertical range; logarithmic where the values span more than a decade."""
    known = values[np.isfinite(values) & (values > 0.0)]
    if known.size and known.max() > 10.0 * known.min():
        style.decades(panel, known)
    else:
        panel.set_ylim(0.0, 1.1 * known.max(initial=0.0) or 1.0)


def _caption(rungs: Sequence[Rung], axes: Sequence[str]) -> str:
    """Say by how much each axis' error changed from the first version to the last not refused."""
    parts = []
    for axis in axes:
        sound = [rung for rung in rungs if axis not in rung.refused] or rungs
        before, after = (rung.sound_error(axis) for rung in (rungs[0], sound[-1]))
        if before and after:
            change = 100.0 * (after / before - 1.0)
            verb = "falls" if change <= -1.0 else "rises" if change >= 1.0 else ""
            # A fall by 100 % would leave nothing.
            left = 100.0 * after / before
            size = wording.plain(abs(change), max(0, int(np.ceil(-np.log10(left)))))
            parts.append(f"{axis} {verb} by {size} %" if verb else f"{axis} stays as it is")
    said = f": {join_names(parts)}" if parts else ""
    return f"Error on held-out trials by version, against the noise floor{said}."


def _values(found: Iterable[float | None]) -> np.ndarray:
    return np.array([np.nan if value is None else value for value in found])


def _parameters(
    results: Results, rungs: Sequence[Rung], parameters: Mapping[str, Mapping[str, Value]]
) -> Table:
    shown = rungs if len(rungs) <= _MOST_COLUMNS else [rungs[0], *rungs[-(_MOST_COLUMNS - 1) :]]
    rows = []
    for name in results.in_order(parameters):
        by_model = parameters[name]
        entries = [by_model.get(rung.model) for rung in shown]
        unit = next((entry.unit for entry in entries if entry), "")
        cells = [wording.with_sd(entry.estimate, entry.sd) if entry else "–" for entry in entries]
        rows.append((wording.parameter(name), *cells, wording.unit(unit)))
    return Table(
        "Parameters of each version (± one standard deviation): a missing effect biases the others",
        ("Parameter", *(_version(rungs, rung) for rung in shown), "Unit"),
        tuple(rows),
        "l" + "r" * len(shown) + "l",
        note="–: not in that version." if any("–" in row for row in rows) else "",
    )
