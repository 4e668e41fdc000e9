"""Identification: Table VII, Table VI, convergence (Fig. 7), torques and motion (Fig. 6)."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from bampipe.lists import join_names
from bampipe.phrases.results import METHODS
from bampipe.report import style
from bampipe.report.document import Block, Figure, Table
from bampipe.report.run_results import Results
from bampipe.report.wording import (
    format_decimals,
    format_digits,
    format_interval,
    format_scaled,
    format_unit,
    format_with_sd,
    name_parameter,
)
from bampipe.results.identify import IdentifyResult, ParameterEstimate
from bampipe.results.rounding import NORMAL_95, find_digits
from bampipe.results.validate import ValidateResult

TITLE = "Identification"
_LEAST_CALIBRATION = 0.1
"""The table gives calibration from this share of an SD on."""
_PANEL_COLUMNS, _MOST_PANEL_ROWS = (2, 3, 4), 7
"""Columns and rows of panels: the fewest columns that leave the fewest places empty."""
_DASHES = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)), (0, (5, 1.5, 1, 1.5)))


def list_blocks(results: Results) -> Iterator[Block | None]:
    """Yield the parameters, how they converged, and the motion."""
    identified = results.read(IdentifyResult)
    if identified is None:
        yield results.state_undone("No parameters have been identified", "identify")
        return
    yield _tabulate_parameters(results, identified)
    found = identified.base_parameters or ()
    texts = [format_decimals(one.estimate, *find_digits(one.estimate, one.sd)) for one in found]
    yield Table(
        "Combinations of inertial numbers that motion determines",
        "Combination :code ~3 | >Estimate | >SD :2 | >Drawing | From trials | Unit :unit",
        [
            (one.combination, text, one.sd, (one.drawn, one.drawn_sd), one.shown, one.unit)
            for one, text in zip(found, texts, strict=True)
        ],
        "From trials: whether its SD is less than half of that of the drawing.",
    )
    known = identified.identifiability.sentences if identified.identifiability else ()
    yield tuple(note for note in identified.notes if note not in known)
    yield _list_checks(identified)
    rows = []
    for axis, one in results.order_axes(identified.state_3sigma or {}).items():
        # The smoother before least squares gives no bound of position: no column of dashes.
        place = "" if one.position is None else format_scaled(one.position, results.unit(axis))
        rows.append((axis, place, format_scaled(one.velocity, f"{results.unit(axis)}/s")))
    caption = f"Error of the filtered state, 3σ bounds{results.cite_paper('Table VI')}"
    yield Table(caption, "Axis | >Position | >Velocity", rows).drop_empty_columns()
    trace = results.table(results.model_file("trace.parquet"))
    # Least squares stores at most one row per trial: nothing converges along the data.
    if trace is not None and len(trace) > trace["trial_id"].nunique():
        yield _draw_convergence(results, identified, trace)
    yield _draw_motion(results)


def _tabulate_parameters(results: Results, identified: IdentifyResult) -> Table:
    parameters = _select_parameters(identified)
    others = {
        method: tried.parameters
        for method, tried in identified.methods.items()
        if method != identified.method and tried.parameters
    }
    shares = ((p.calibration_sd or 0.0) / (p.sd or math.inf) for p in parameters.values())
    calibrated = any(share > _LEAST_CALIBRATION for share in shares)
    rows = []
    for name in results.order_parameters(parameters):
        one = parameters[name]
        value, sd = one.estimate, one.sd
        digits = find_digits(value, sd)
        half = NORMAL_95 * sd
        rows.append(
            (
                *(name, name, format_decimals(value, *digits) + (" *" if one.at_bound else "")),
                sd or "fixed",
                (one.calibration_sd or 0.0) if calibrated else "",
                "" if one.bound_sd is None else one.bound_sd,
                format_interval(value - half, value + half, sd) if sd else None,
                *(format_decimals(found[name].estimate, *digits) for found in others.values()),
                one.unit,
            )
        )
    note = f"Interval: estimate ± 1.96 standard deviations{_qualify_intervals(results)}."
    if calibrated:
        note += (
            " Calibration: the part of SD that comes from the stated uncertainties of sensors and"
            " constants, and from the zeros of encoders, which are known to a step."
        )
    if any(one.bound_sd is not None for one in parameters.values()):
        note += " Bound: the least SD that these sensors allow on these trials (Cramér-Rao)."
    if others:
        note += f" For comparison, {join_names(METHODS[method] for method in others)}."
    if any(one.at_bound for one in parameters.values()):
        note += " * At the limit of its range: the data may ask for a value beyond it."
    heads = (f" | >{METHODS[m].removeprefix('the ').capitalize()}" for m in others)
    return Table(
        f"Parameters of model `{identified.model}`, {METHODS[identified.method]}"
        f"{results.cite_paper('Table VII')}",
        "Parameter :name ~1.1 | Name :code ~1 | >Estimate | >SD :2 | >Calibration :2 | >Bound :2"
        f" | >95 % interval{''.join(heads)} | Unit :unit",
        rows,
        note,
    ).drop_empty_columns()


def _qualify_intervals(results: Results) -> str:
    """Return a clause on intervals if the model lacks something, else ""."""
    validated = results.read(ValidateResult)
    lacking = [
        error.held_out_rmse / error.noise_floor
        for error in (validated.axes.values() if validated else ())
        if error.noise_floor and error.standing == "above_floor"
    ]
    most = format_digits(max(lacking, default=0.0))
    said = (
        f", as if the model lacked nothing; its held-out error is up to {most} times the noise"
        " floor, and the missing effect may bias the estimates by more than these intervals"
    )
    return said if lacking else ""


def _select_parameters(identified: IdentifyResult) -> Mapping[str, ParameterEstimate]:
    """Return all but a robot's inertial numbers, of which motion determines only combinations."""
    return {n: one for n, one in identified.parameters.items() if n not in identified.inertial}


def _list_checks(identified: IdentifyResult) -> str:
    """Say when the filter settled, and whether its noise levels fit."""
    parts = []
    convergence, timing = identified.convergence, identified.input_timing
    settled = convergence.settled_s
    if settled and convergence.total_s:
        last = max(settled, key=lambda name: (settled[name], name))
        parts.append(
            f"All estimates had settled after {format_decimals(settled[last], 1)} s of "
            f"{format_decimals(convergence.total_s, 1)} s in the filter (`{last}` last)."
        )
    if not convergence.converged:
        parts.append("**The estimates have not converged.**")
    if identified.nis is not None:
        mean = format_digits(identified.nis.mean, 2)
        parts.append(
            f"The mean normalised innovation squared is {mean}; it would be 1 with the right noise "
            "levels."
        )
    lag, sd = 1e3 * timing.estimate, 1e3 * timing.sd  # ms; 0 where it was not estimated
    verb = "lags" if lag > 0.0 else "leads"
    text = f"The force {verb} the encoders by {format_with_sd(abs(lag), sd)} ms."
    if abs(lag) < NORMAL_95 * sd:
        text = f"The force shows no delay against the encoders ({format_with_sd(lag, sd)} ms)."
    return " ".join([*parts, *([text] if sd > 0.0 else [])])


def _draw_convergence(results: Results, identified: IdentifyResult, trace: pd.DataFrame) -> Figure:
    parameters = _select_parameters(identified)
    by_kind: dict[tuple[str, str], list[str]] = {}
    for name in results.order_parameters(parameters):
        if name in trace.columns:
            is_base = name.startswith(("viscous.", "coulomb."))
            kind = name_parameter(name.split(".")[0] if is_base else name)
            by_kind.setdefault((kind, parameters[name].unit), []).append(name)
    groups = [(kind, unit, names) for (kind, unit), names in by_kind.items()]
    few = [n for n in _PANEL_COLUMNS if len(groups) <= n * _MOST_PANEL_ROWS] or _PANEL_COLUMNS[-1:]
    columns = min(few, key=lambda columns: (-len(groups) % columns, columns))
    figure, panels = style.make_grid(len(groups), columns, 1.35)
    again = trace.loc[trace["run"] > 0, "t_total"].to_numpy() if "run" in trace else np.array([])
    for number, (panel, (kind, unit, names)) in enumerate(zip(panels, groups, strict=True)):
        _draw_traces(results, panel, trace, names)
        style.mark_trials(panel, trace)
        if again.size:
            panel.axvline(again[0], color=style.INK, lw=0.6, zorder=0)
        _limit_panel(panel, trace, names)
        panel.set_title(style.break_heading(kind, columns + 1))
        panel.set_ylabel(format_unit(unit) or "1")
        if len(panel.get_legend_handles_labels()[1]) > 1:
            panel.legend(loc="best", ncols=2 if columns == 2 else 1)
        if number < len(panels) - columns:
            panel.tick_params(labelbottom=False)
        else:
            panel.set_xlabel("time in the filter (s)")
    caption = (
        f"Convergence of the parameters{results.cite_paper('Fig. 7')}, with the filter's own 95 % "
        "bounds. Dotted verticals: a new trial starts."
    )
    if again.size:
        caption += " Solid vertical: the last run begins, around the answer of the one before."
    return style.finish(figure, "convergence", caption)


def _draw_traces(results: Results, panel: Any, trace: pd.DataFrame, names: Sequence[str]) -> None:
    """Draw the estimates of one panel with their bounds and design values."""
    for number, name in enumerate(names):
        axis = name.split(".")[-1]
        place = results.axes.index(axis) if axis in results.axes else number
        colour = style.SERIES[place % len(style.SERIES)]
        title = axis if axis in results.axes else "estimate"
        style.draw_estimate(panel, trace, name, colour, title, _DASHES[place % len(_DASHES)])
    design = (results.paper or {}).get("design", {})
    for one in (design[name] for name in names if name in design):
        panel.axhline(one["value"], color=style.INK, lw=0.8, ls="--", label=one["label"])


def _limit_panel(panel: Any, trace: pd.DataFrame, names: Sequence[str]) -> None:
    """Set the range to every estimate from its start on, and to the bounds past the first trial."""
    later = np.flatnonzero(trace["trial_id"].ne(trace["trial_id"].iloc[0]).to_numpy())
    start = int(later[0]) + len(trace) // 100 if len(later) else len(trace) // 10
    tail = trace.iloc[start:]
    values = []
    for name in names:
        centre = tail[name].to_numpy()
        half = 2.5 * tail[f"{name}_sd"].to_numpy()
        values += [centre - half, centre + half, trace[name].to_numpy()]
    style.set_limits(panel, values)


def _draw_motion(results: Results) -> Figure | None:
    """Draw forces and positions of the first trial, rotary axes beside sliding ones."""
    path = results.model_file("states.parquet")
    columns = results.columns(path)
    axes = [axis for axis in results.axes if f"q_{axis}" in columns]
    ids = results.table(path, ["trial_id"]) if axes else None
    if ids is None or ids.empty:
        return None
    trial = str(ids["trial_id"].iloc[0])
    frame = results.table(path, trial=trial)
    assert frame is not None
    kinds = [[a for a in axes if results.is_rotary(a) == kind] for kind in (True, False)]
    kinds = [members for members in kinds if members]
    rows = 2 if any(f"torque_user_{axis}" in columns for axis in results.axes) else 1
    figure, panels = style.make_panels(rows, len(kinds), 1.9 * rows + 0.3, sharex=True)
    t = frame["t"].to_numpy()
    for column, members in enumerate(kinds):
        top, bottom = panels[0, column], panels[-1, column]
        for axis in members:
            colour = style.SERIES[results.axes.index(axis) % len(style.SERIES)]
            for name, title, panel, dashes in (
                (f"torque_user_{axis}", f"{axis}, {results.pusher}", top, "-"),
                (f"torque_gravity_{axis}", f"{axis}, gravity compensation", top, (0, (3, 1.5))),
                (f"q_{axis}", axis, bottom, "-"),
            ):
                if name in frame:
                    look: dict[str, Any] = {"lw": 0.9, "ls": dashes}
                    style.draw_series(panel, t, frame[name].to_numpy(), colour, title, **look)
        first = members[0]
        top.set_ylabel(style.label_axis(results.name_force(first), results.force_unit(first)))
        bottom.set_ylabel(style.label_axis("position", results.unit(first)))
        bottom.set_xlabel("time (s)")
        for panel in panels[:, column]:
            panel.legend(loc="upper right", ncols=2)
            low, high = panel.get_ylim()
            panel.set_ylim(low, high + 0.22 * (high - low))
    forces = f"generalised forces of the {results.pusher}"
    if any(f"torque_gravity_{axis}" in columns for axis in axes):
        forces += " and of the gravity compensator"
    caption = f"Trial {trial}{results.cite_paper('Fig. 6')}: {forces} (top) and motion (bottom)."
    return style.finish(figure, "torques-and-motion", caption)
