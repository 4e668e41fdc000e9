"""The ladder: held-out error of each model version against the floor, and its parameters."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from bampipe.lists import join_names
from bampipe.report import style
from bampipe.report.document import Block, Figure, Table
from bampipe.report.run_results import Results
from bampipe.report.wording import (
    NONE,
    choose_scale,
    format_decimals,
    format_digits,
    format_unit,
    split_name,
)
from bampipe.results.compare import CompareResult, Rung, Value

TITLE = "Model versions"
_MOST_COLUMNS = 3
_MOST_NUMBERS = 4
"""Most versions for which every number fits below a panel."""


def list_blocks(results: Results) -> Iterator[Block]:
    """Yield the comparison of several models."""
    compared = results.read(CompareResult)
    if compared is None or len(compared.ladder) < 2:
        return
    rungs = compared.ladder
    known = {axis for rung in rungs for axis in rung.held_out_rmse}
    axes = [axis for axis in results.axes if axis in known]
    rows = []
    for rung in rungs:
        cells = []
        for axis in axes:
            text, floor = format_digits(rung.held_out_rmse.get(axis)), rung.noise_floor.get(axis)
            cells.append(f"{text} ({format_digits(floor)})" if floor else text)
        rows.append((_name_version(rungs, rung), f"`{rung.added}`" if rung.added else "", *cells))
    heads = (f">{axis} ({format_unit(results.force_unit(axis))})" for axis in axes)
    caption = "RMSE on the same held-out trials (noise floor)"
    yield Table(caption, " | ".join(("Version | Added", *heads)), rows)
    yield _draw(results, rungs, axes)
    yield from tabulate_runs(rungs, axes)
    yield _tabulate_parameters(results, rungs, compared.parameters)
    yield tuple(one.sentence for one in compared.moved)


def tabulate_runs(rungs: Sequence[Rung], axes: Sequence[str]) -> Iterator[Table]:
    """Yield the errors of each version in free runs: whole trials, and short horizons."""
    if any(rung.free_run for rung in rungs):
        yield _tabulate_free_runs(rungs, axes)
    every = {axis: [rung.drift.get(axis) for rung in rungs] for axis in axes}
    drifts = {
        axis: [{h.horizon_s: h.median for h in one.horizons} if one else {} for one in found]
        for axis, found in every.items()
    }
    if any(map(any, drifts.values())):
        yield _tabulate_drift(rungs, drifts)


def _choose_scales(
    sizes: Mapping[str, Sequence[float]], units: Mapping[str, str]
) -> dict[str, tuple[float, str]]:
    """Return, by axis, a scale that suits most of its errors: they differ by powers of ten."""
    return {
        axis: choose_scale(sorted(found)[len(found) // 2 :][:1], units.get(axis, ""))
        for axis, found in sizes.items()
    }


def _tabulate_free_runs(rungs: Sequence[Rung], axes: Sequence[str]) -> Table:
    """Tabulate the position error in free runs: mean absolute, and relative to the motion."""
    runs = {axis: [rung.free_run.get(axis) for rung in rungs] for axis in axes}
    scales = _choose_scales(
        {axis: [one.mean_absolute for one in found if one] for axis, found in runs.items()},
        {axis: one.unit for found in rungs for axis, one in found.free_run.items()},
    )
    rows = []
    for number, rung in enumerate(rungs):
        cells: list[float | None] = []
        for axis, (factor, _) in scales.items():
            one = runs[axis][number]
            cells += [factor * one.mean_absolute, one.relative_error_percent] if one else [None] * 2
        rows.append((_name_version(rungs, rung), split_name(rung.free_run_mode or NONE), *cells))
    heads = (f">{axis} ({unit}) | >relative (%)" for axis, (_, unit) in scales.items())
    reasons = (
        f"{_name_version(rungs, rung).capitalize()}, –: {rung.free_run_reason}"
        for rung in rungs
        if not rung.free_run and rung.free_run_reason
    )
    caption = "Free run over held-out trials: mean absolute and relative error of the position"
    return Table(caption, " | ".join(("Version | Loop", *heads)), rows, " ".join(reasons))


def _tabulate_drift(
    rungs: Sequence[Rung], drifts: Mapping[str, Sequence[Mapping[float, float]]]
) -> Table:
    """Tabulate ``drifts``, by axis and version the median drift within each horizon, s."""
    horizons = sorted({h for found in drifts.values() for one in found for h in one})
    scales = _choose_scales(
        {axis: [x for one in found for x in one.values()] for axis, found in drifts.items()},
        {axis: one.unit for found in rungs for axis, one in found.drift.items()},
    )
    rows = []
    for number, rung in enumerate(rungs):
        cells = []
        for axis, (factor, _) in scales.items():
            found = {h: factor * x for h, x in drifts[axis][number].items()}
            cells.append(" / ".join(format_digits(found.get(h), 2) for h in horizons))
        rows.append((_name_version(rungs, rung), *cells))
    heads = (f">{axis} ({unit})" for axis, (_, unit) in scales.items())
    within = " / ".join(f"{h:g}" for h in horizons)
    note = "–: the model runs away or drifts farther than the axis moves, or the axis hardly moves."
    return Table(
        f"Median drift of each version in free runs of {within} s under the recorded inputs",
        " | ".join(("Version", *heads)),
        rows,
        note if any(NONE in cell for row in rows for cell in row) else "",
    )


def _name_version(rungs: Sequence[Rung], rung: Rung) -> str:
    """Return a short name: the base model's own, then numbers (names grow with every effect)."""
    number = rungs.index(rung)
    return rung.model if number == 0 else f"version {number}"


def _draw(results: Results, rungs: Sequence[Rung], axes: Sequence[str]) -> Figure:
    figure, panels = style.make_grid(len(axes), len(axes), 2.3, extra=0.0, column_width=1.95)
    x = np.arange(len(rungs))
    for panel, axis in zip(panels, axes, strict=True):
        error = np.array([rung.held_out_rmse.get(axis) for rung in rungs], dtype=float)
        floor = np.array([rung.noise_floor.get(axis) for rung in rungs], dtype=float)
        panel.plot(x, error, "o-", color=style.BLUE, ms=4.5, lw=1.3, label="held-out error")
        panel.plot(x, floor, "s--", color=style.VERMILLION, ms=3.0, lw=1.0, label="noise floor")
        both = np.concatenate([error, floor])
        both = both[np.isfinite(both) & (both > 0.0)]
        if both.size and both.max() > 10.0 * both.min():
            style.use_decades(panel, both)
        else:
            panel.set_ylim(0.0, 1.1 * both.max(initial=0.0) or 1.0)
        panel.set_xticks(x, _name_ticks(rungs[0].model, error))
        below = style.break_heading("version, and its error", len(axes))
        panel.set(xlim=(-0.4, len(rungs) - 0.6), xlabel=below)
        panel.set(title=axis, ylabel=style.label_axis("RMSE", results.force_unit(axis)))
    parts = []
    for axis in axes:
        before, after = (rung.held_out_rmse.get(axis) for rung in (rungs[0], rungs[-1]))
        if before and after:
            change = 100.0 * (after / before - 1.0)
            # A fall by 100 % would leave nothing.
            decimals = max(0, int(np.ceil(-np.log10(100.0 * after / before))))
            size = f"{format_decimals(abs(change), decimals)} %"
            verb = f"{'falls' if change < 0.0 else 'rises'} by {size}"
            parts.append(f"{axis} {verb if abs(change) >= 1.0 else 'does not change'}")
    changes = f": {join_names(parts)}" if parts else ""
    caption = f"Error on held-out trials by version, against the noise floor{changes}."
    return style.finish(figure, "ladder", caption, panels[:1])


def _name_ticks(first: str, error: np.ndarray) -> list[str]:
    """Return each version with its error below; of many versions only the first and the last."""
    names = [first, *(str(number) for number in range(1, len(error)))]
    shown = range(len(error)) if len(error) <= _MOST_NUMBERS else (0, len(error) - 1)
    return [
        f"{name}\n{format_digits(float(value))}" if number in shown else name
        for number, (name, value) in enumerate(zip(names, error, strict=True))
    ]


def _tabulate_parameters(
    results: Results, rungs: Sequence[Rung], parameters: Mapping[str, Mapping[str, Value]]
) -> Table:
    shown = rungs if len(rungs) <= _MOST_COLUMNS else [rungs[0], *rungs[-(_MOST_COLUMNS - 1) :]]
    rows = []
    for name in results.order_parameters(parameters):
        values = [parameters[name].get(rung.model) for rung in shown]
        unit = next((one.unit for one in values if one), "")
        rows.append((name, *((one.estimate, one.sd) if one else None for one in values), unit))
    heads = (f">{_name_version(rungs, rung)}" for rung in shown)
    return Table(
        "Parameters of each version (± one standard deviation): a missing effect biases the others",
        " | ".join(("Parameter :name", *heads, "Unit :unit")),
        rows,
        "–: not in that version." if any(None in row for row in rows) else "",
    )
