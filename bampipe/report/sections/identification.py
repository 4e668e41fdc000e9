"""Identification: Table VII, Table VI, convergence (Fig. 7), torques and motion (Fig. 6)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from bampipe.lists import join_names
from bampipe.report import style, verdicts, wording
from bampipe.report.document import Block, Bullets, Figure, Paragraph, Section, Table
from bampipe.report.results import Results
from bampipe.results.identify import (
    METHODS_IN_WORDS,
    BaseEstimate,
    IdentifyResult,
    InputTiming,
    ParameterEstimate,
    StateBound,
)
from bampipe.results.intervals import NORMAL_95
from bampipe.results.validate import ValidateResult

TITLE = "Identification"
_WORTH_A_COLUMN = 0.1
"""Share of an SD from which on a table gives the part that calibration has in it."""
_COLUMNS, _MOST_ROWS = (2, 3, 4), 7
"""Of panels: those that leave the fewest places empty, and of these the least."""
_DASHES = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)), (0, (5, 1.5, 1, 1.5)))


def section(results: Results) -> Section:
    """Return the section."""
    identified = results.read(IdentifyResult)
    if identified is None:
        return results.not_done(TITLE, "No parameters have been identified", "identify")
    blocks: list[Block] = [_parameters(results, identified)]
    if identified.base_parameters:
        blocks.append(_base_parameters(identified.base_parameters))
    known = identified.identifiability.sentences if identified.identifiability else ()
    notes = [note for note in identified.notes if note not in known]
    if notes:
        blocks.append(Bullets(tuple(notes)))
    checks = _checks(identified)
    if checks:
        blocks.append(Paragraph(checks))
    if identified.state_3sigma:
        blocks.append(_bounds(results, identified.state_3sigma))
    trace = results.table(results.model_file("trace.parquet"))
    # Least squares leaves a row a trial at most: nothing converges along the data.
    if trace is not None and len(trace) > trace["trial_id"].nunique():
        blocks.append(_convergence(results, identified, trace))
    motion = _motion(results)
    if motion is not None:
        blocks.append(motion)
    return Section(TITLE, tuple(blocks))


def _parameters(results: Results, identified: IdentifyResult) -> Table:
    parameters = _without_inertial(identified)
    names = results.in_order(parameters)
    others = [
        method
        for method, tried in identified.methods.items()
        if method != identified.method and tried.parameters
    ]
    bounded = any(parameters[name].bound_sd is not None for name in names)
    calibrated = any(
        (entry.calibration_sd or 0.0) > _WORTH_A_COLUMN * (entry.sd or math.inf)
        for entry in parameters.values()
    )
    rows = []
    for name in names:
        entry = parameters[name]
        value, sd = entry.estimate, entry.sd
        digits = wording.digits_of(value, sd)
        half = NORMAL_95 * sd if sd else 0.0
        rows.append(
            (
                wording.parameter(name),
                f"`{name}`",
                wording.plain(value, *digits) + (" *" if entry.at_bound else ""),
                wording.significant(sd, 2) if sd else "fixed",
                *((wording.significant(entry.calibration_sd or 0.0, 2),) if calibrated else ()),
                *((wording.significant(entry.bound_sd, 2),) if bounded else ()),
                wording.interval(value - half, value + half, sd) if sd else "–",
                *(
                    wording.plain(identified.methods[method].parameters[name].estimate, *digits)
                    for method in others
                ),
                wording.unit(entry.unit),
            )
        )
    note = f"Interval: estimate ± 1.96 standard deviations{_caveat(results)}."
    if calibrated:
        note += (
            " Calibration: the part of SD that comes from what is stated of sensors and constants,"
            " and from the zeros of encoders, known to a step."
        )
    if bounded:
        note += " Bound: the least SD that these sensors allow on these trials (Cramér-Rao)."
    if others:
        tried = join_names(METHODS_IN_WORDS[method] for method in others)
        note += f" For comparison, {tried}."
    if any(parameters[name].at_bound for name in names):
        note += " * At the limit of its range: the data ask for a value beyond it."
    return Table(
        f"Parameters of model `{identified.model}`{_method(identified)}"
        f"{results.in_paper('Table VII')}",
        (
            "Parameter",
            "Name",
            "Estimate",
            "SD",
            *(("Calibration",) if calibrated else ()),
            *(("Bound",) if bounded else ()),
            "95 % interval",
            *(METHODS_IN_WORDS[method].removeprefix("the ").capitalize() for method in others),
            "Unit",
        ),
        tuple(rows),
        "llrrr" + "r" * (len(others) + bounded + calibrated) + "l",
        (1.1, 1.0) + (0.0,) * (4 + len(others) + bounded + calibrated),
        note,
    )


def _caveat(results: Results) -> str:
    """Return what an interval is worth where the model lacks something; "" where it does not."""
    validated = results.read(ValidateResult)
    ratios = verdicts.error_over_floor(results, results.model) or {}
    lacking = [
        ratio
        for axis, ratio in ratios.items()
        if validated is not None and validated.axes[axis].standing == "above_floor"
    ]
    if not lacking:
        return ""
    return (
        ", as if the model lacked nothing; its held-out error is up to "
        f"{wording.significant(max(lacking))} times the noise floor, and what it lacks may have "
        "moved the estimates out of them"
    )


def _without_inertial(identified: IdentifyResult) -> Mapping[str, ParameterEstimate]:
    """The parameters without a robot's inertial numbers: motion shows combinations of them only."""
    inertial, found = identified.inertial, identified.parameters
    return {name: entry for name, entry in found.items() if name not in inertial}


def _base_parameters(bases: Sequence[BaseEstimate]) -> Table:
    rows = []
    for base in bases:
        rows.append(
            (
                base.combination,
                wording.plain(base.estimate, *wording.digits_of(base.estimate, base.sd)),
                wording.significant(base.sd, 2),
                wording.with_sd(base.drawn, base.drawn_sd),
                "yes" if base.shown else "no",
                wording.unit(base.unit),
            )
        )
    return Table(
        "Combinations of inertial numbers that motion shows",
        ("Combination", "Estimate", "SD", "Drawing", "Shown", "Unit"),
        tuple(rows),
        "lrrrll",
        (3.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        "Shown: whether the trials say more of it than the drawing does.",
    )


def _checks(identified: IdentifyResult) -> str:
    """Return what the filter says of itself: when it settled, whether its noise levels fit."""
    parts = []
    convergence, timing = identified.convergence, identified.input_timing
    settled = convergence.settled_s
    if settled and convergence.total_s:
        last = max(settled, key=lambda name: (settled[name], name))
        parts.append(
            f"All estimates had settled after {wording.plain(settled[last], 1)} s of the "
            f"{wording.plain(convergence.total_s, 1)} s of the filter's first run and last (the "
            f"last to settle was `{last}`)."
        )
    if not convergence.converged:
        parts.append("**The estimates have not converged.**")
    if identified.nis is not None:
        mean = wording.significant(identified.nis.mean, 2)
        parts.append(
            f"The mean normalised innovation squared is {mean}; it is 1 where the noise levels "
            "are right."
        )
    if timing.sd > 0.0:  # else it was not estimated
        parts.append(_timing(timing))
    return " ".join(parts)


def _timing(timing: InputTiming) -> str:
    """Return by how much the force lags the encoders, where the trials show that it does."""
    lag = 1e3 * timing.estimate
    if abs(timing.estimate) < NORMAL_95 * timing.sd:
        shown = wording.with_sd(lag, 1e3 * timing.sd)
        return f"No delay between force and encoders is shown (the force lags by {shown} ms)."
    verb = "lags" if lag > 0.0 else "leads"
    return f"The force {verb} the encoders by {wording.with_sd(abs(lag), 1e3 * timing.sd)} ms."


def _method(identified: IdentifyResult) -> str:
    return f", {METHODS_IN_WORDS[identified.method]}"


def _bounds(results: Results, bounds: Mapping[str, StateBound]) -> Table:
    # A smoother before least squares bounds no position: no column of dashes for it.
    positions = any(bound.position is not None for bound in bounds.values())
    rows = [
        (
            axis,
            *((wording.scaled(bounds[axis].position, results.unit(axis)),) if positions else ()),
            wording.scaled(bounds[axis].velocity, results.rate_unit(axis)),
        )
        for axis in verdicts.ordered(results, bounds)
    ]
    return Table(
        f"Error of the filtered state, 3σ bounds{results.in_paper('Table VI')}",
        ("Axis", *(("Position",) if positions else ()), "Velocity"),
        tuple(rows),
        "lrr" if positions else "lr",
    )


def _groups(
    results: Results, parameters: Mapping[str, ParameterEstimate], trace: pd.DataFrame
) -> list[tuple[str, str, list[str]]]:
    """Return title, unit and parameters of each panel: those of one kind and unit together."""
    groups: dict[tuple[str, str], list[str]] = {}
    for name in results.in_order(parameters):
        if name in trace.columns:
            kind = wording.parameter(name)
            if name.startswith(("viscous.", "coulomb.")):
                kind = wording.parameter(name.split(".")[0])
            groups.setdefault((kind, parameters[name].unit), []).append(name)
    return [(kind, unit, names) for (kind, unit), names in groups.items()]


def _convergence(results: Results, identified: IdentifyResult, trace: pd.DataFrame) -> Figure:
    groups = _groups(results, _without_inertial(identified), trace)
    few = [n for n in _COLUMNS if len(groups) <= n * _MOST_ROWS] or _COLUMNS[-1:]
    columns = min(few, key=lambda columns: (-len(groups) % columns, columns))
    rows = math.ceil(len(groups) / columns)
    figure, panels = style.panels(rows, columns, 0.35 + 1.35 * rows, sharex=True)
    time_column = "t_total" if "t_total" in trace else "t"
    keep = style.pick(len(trace), 1500)
    shown = trace.iloc[keep]
    t = shown[time_column].to_numpy()
    starts = trace.loc[trace["trial_id"].ne(trace["trial_id"].shift()), time_column].to_numpy()
    again = trace.loc[trace["run"] > 0, time_column].to_numpy() if "run" in trace else np.array([])
    for panel, (kind, unit, names) in zip(panels.flat, groups, strict=False):
        for number, name in enumerate(names):
            _trace(panel, t, shown, name, number, results)
        _design(results, panel, names)
        for start in starts[1:]:
            panel.axvline(start, color=style.FAINT, lw=0.6, ls=(0, (1, 2)), zorder=0)
        if again.size:
            panel.axvline(again[0], color=style.INK, lw=0.6, zorder=0)
        _settled(panel, trace, names)
        panel.set_title(style.heading(kind, columns + 1))
        panel.set_ylabel(wording.unit(unit) or "1")
        if len(panel.get_legend_handles_labels()[1]) > 1:
            panel.legend(loc="best", ncols=2 if columns == 2 else 1)
    for panel in panels.flat[len(groups) :]:
        panel.set_axis_off()
    for column in range(min(columns, len(groups))):
        last = (len(groups) - 1 - column) // columns
        panels[last, column].tick_params(labelbottom=True)
        panels[last, column].set_xlabel("time in the filter (s)")
    caption = (
        f"Convergence of the parameters{results.in_paper('Fig. 7')}, with the filter's own 95 % "
        "bounds. Dotted verticals: a new trial starts."
    )
    if again.size:
        caption += " Solid vertical: the last run begins, around the answer of the one before."
    return Figure("convergence", caption, style.svg(figure))


def _trace(
    panel: Any,
    t: np.ndarray,
    shown: pd.DataFrame,
    name: str,
    number: int,
    results: Results,
) -> None:
    axis = name.split(".")[-1]
    place = results.axes.index(axis) if axis in results.axes else number
    colour = style.SERIES[place % len(style.SERIES)]
    value = shown[name].to_numpy()
    title = axis if axis in results.axes else "estimate"
    panel.plot(t, value, color=colour, ls=_DASHES[place % len(_DASHES)], label=title)
    if f"{name}_sd" in shown:
        half = NORMAL_95 * shown[f"{name}_sd"].to_numpy()
        panel.fill_between(t, value - half, value + half, color=colour, alpha=0.18, lw=0)


def _design(results: Results, panel: Any, names: list[str]) -> None:
    design = (results.paper or {}).get("design", {})
    for name in names:
        if name in design:
            entry = design[name]
            panel.axhline(entry["value"], color=style.INK, lw=0.8, ls="--", label=entry["label"])


def _settled(panel: Any, trace: pd.DataFrame, names: list[str]) -> None:
    """Set the range to every estimate from its start on, and to the bounds past the first trial."""
    later = np.flatnonzero(trace["trial_id"].ne(trace["trial_id"].iloc[0]).to_numpy())
    start = int(later[0]) + len(trace) // 100 if len(later) else len(trace) // 10
    tail = trace.iloc[start:]
    values = []
    for name in names:
        centre = tail[name].to_numpy()
        half = 2.5 * tail[f"{name}_sd"].to_numpy() if f"{name}_sd" in tail else 0.0
        values += [centre - half, centre + half, trace[name].to_numpy()]
    style.limits(panel, values)


def _motion(results: Results) -> Figure | None:
    path = results.model_file("states.parquet")
    columns = results.columns(path)
    torques = [axis for axis in results.axes if f"torque_user_{axis}" in columns]
    axes = [axis for axis in results.axes if f"q_{axis}" in columns]
    if not axes:
        return None
    ids = results.table(path, ["trial_id"])
    if ids is None or ids.empty:
        return None
    trial = str(ids["trial_id"].iloc[0])
    frame = results.table(path, trial=trial)
    assert frame is not None
    kinds = [
        kind for kind in (True, False) if any(results.is_rotary(axis) == kind for axis in axes)
    ]
    rows = 2 if torques else 1
    figure, panels = style.panels(rows, len(kinds), 1.9 * rows + 0.3, sharex=True)
    t = frame["t"].to_numpy()
    for column, rotary in enumerate(kinds):
        members = [axis for axis in axes if results.is_rotary(axis) == rotary]
        for axis in members:
            place = results.axes.index(axis)
            look: dict[str, Any] = {"lw": 0.9}
            colour = style.SERIES[place % len(style.SERIES)]
            if axis in torques:
                user = frame[f"torque_user_{axis}"].to_numpy()
                style.series(
                    panels[0, column], t, user, colour, f"{axis}, {results.pusher}", **look
                )
            if f"torque_gravity_{axis}" in columns:
                gravity = frame[f"torque_gravity_{axis}"].to_numpy()
                dashed = {**look, "ls": (0, (3, 1.5))}
                title = f"{axis}, gravity compensation"
                style.series(panels[0, column], t, gravity, colour, title, **dashed)
            position = frame[f"q_{axis}"].to_numpy()
            style.series(panels[-1, column], t, position, colour, axis, **look)
        first = members[0]
        force = "torque" if rotary else "force"
        panels[0, column].set_ylabel(style.label(force, wording.unit(results.force_unit(first))))
        panels[-1, column].set_ylabel(style.label("position", wording.unit(results.unit(first))))
        panels[-1, column].set_xlabel("time (s)")
        for row in range(rows):
            panels[row, column].legend(loc="upper right", ncols=2)
            low, high = panels[row, column].get_ylim()
            panels[row, column].set_ylim(low, high + 0.22 * (high - low))
    forces = f"generalised forces of the {results.pusher}"
    if any(f"torque_gravity_{axis}" in columns for axis in axes):
        forces += " and of the gravity compensator"
    caption = f"Trial {trial}{results.in_paper('Fig. 6')}: {forces} (top) and the motion (bottom)."
    return Figure("torques-and-motion", caption, style.svg(figure))
