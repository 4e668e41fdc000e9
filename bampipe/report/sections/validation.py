"""Validation: force measured and predicted (Fig. 9), error without friction (Fig. 4), tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from bampipe.lists import join_names
from bampipe.report import style, verdicts, wording
from bampipe.report.document import Block, Bullets, Figure, Paragraph, Section, Table
from bampipe.report.results import Results
from bampipe.results.validate import AxisDrift, ValidateResult

TITLE = "Validation"
_WINDOW_S = 12.0
_SETTLE_S = 1.0


def section(results: Results) -> Section:
    """Return the section."""
    validated = results.read(ValidateResult)
    if validated is None:
        said = "Predicted and measured force have not been compared"
        return results.not_done(TITLE, said, "validate")
    blocks: list[Block] = [_by_axis(results, validated)]
    if validated.trials:
        blocks.append(_by_trial(results, validated))
    if validated.forces:
        blocks.append(Paragraph(_at_the_handle(validated, results.pusher)))
    if validated.free_run is not None and validated.free_run.drift:
        blocks += _drift(results, validated, validated.free_run.drift)
    if validated.notes:
        blocks.append(Bullets(validated.notes))
    residuals = _shown_trial(results)
    if residuals is not None:
        blocks.append(_forces(results, residuals))
        velocity = _velocity(results, residuals)
        if velocity:
            blocks.append(_friction(results, residuals, velocity))
    return Section(TITLE, tuple(blocks))


def _by_axis(results: Results, validated: ValidateResult) -> Table:
    rows = []
    for axis in verdicts.ordered(results, validated.axes):
        entry = validated.axes[axis]
        fit = entry.fit_percent
        rows.append(
            (
                axis,
                wording.significant(entry.held_out_rmse),
                wording.significant(entry.noise_floor),
                wording.significant(entry.rmse),
                wording.significant(entry.rmse_without_friction),
                "–" if fit is None else wording.plain(fit, 1),
                wording.unit(entry.unit),
            )
        )
    bands = {
        axis: f"at {wording.significant(hz, 2)} Hz" for axis, hz in validated.cutoff_hz.items()
    }
    each = join_names(f"{axis} {band}" for axis, band in bands.items())
    if len(set(bands.values())) == 1:
        each = next(iter(bands.values()))
    return Table(
        f"Error of the predicted force, model `{validated.model}`",
        (
            "Axis",
            "Held-out RMSE",
            "Noise floor",
            "RMSE, all trials",
            "RMSE without friction",
            "Fit (%)",
            "Unit",
        ),
        tuple(rows),
        "lrrrrrl",
        (0.0, 1.0, 1.0, 1.0, 1.2, 0.6, 0.0),
        f"Held out: {verdicts.held_out_in_words(validated)}. Noise floor: what sensor noise, "
        "quantisation and filtering alone would leave. Fit: share of the measured "
        "force that is explained, as 100 (1 − held-out RMSE / standard deviation)."
        f" Measured and predicted force are low-passed {each}.",
    )


def _by_trial(results: Results, validated: ValidateResult) -> Table:
    rows = []
    for name, trial in validated.trials.items():
        key = "held_out_rmse" if trial.held_out else "rmse"
        # Zero: the axis rested, no sample counts.
        cells = (
            wording.significant(getattr(trial.axes.get(axis), key, None) or None)
            for axis in results.axes
        )
        rows.append((name, "yes" if trial.held_out else "no", *cells))
    units = (f"{axis} ({wording.unit(results.force_unit(axis))})" for axis in results.axes)
    return Table(
        "RMSE by trial",
        ("Trial", "Held out", *units),
        tuple(rows),
        "ll" + "r" * len(results.axes),
        note="–: the axis rested." if any("–" in row for row in rows) else "",
    )


def _at_the_handle(validated: ValidateResult, pusher: str) -> str:
    """Return the error of the measured force in words."""
    shown = (
        f"{wording.words(name)} {wording.significant(entry.rmse)} {wording.unit(entry.unit)}"
        for name, entry in validated.forces.items()
    )
    place = " at the handle" if pusher == "hand" else ""
    return f"Error of the predicted force{place} (RMSE): {join_names(shown)}."


def _drift(
    results: Results, validated: ValidateResult, drift: Mapping[str, AxisDrift]
) -> list[Block]:
    """Return how far the model drifts in short free runs, and where it is not said why."""
    axes = verdicts.ordered(results, drift)
    horizons = sorted({h.horizon_s for axis in axes for h in drift[axis].horizons})
    reasons = tuple(
        f"{axis}: {reason[:1].lower()}{reason[1:]}"
        for axis in axes
        if (reason := drift[axis].reason)
    )
    everywhere = {drift[axis].reason for axis in axes}
    if not horizons and len(everywhere) == 1 and reasons:
        return [Paragraph(f"No short free runs of this model. {everywhere.pop()}")]
    blocks: list[Block] = []
    rows = []
    for axis in axes:
        found = {h.horizon_s: h for h in drift[axis].horizons}
        largest = [h.quantile_90 for h in found.values()]
        factor, unit = wording.scale(largest, results.unit(axis))
        cells = []
        for horizon in horizons:
            h = found.get(horizon)
            shown = (h.median, h.quantile_90, h.displacement) if h else ()
            cells += [wording.significant(factor * value, 2) for value in shown] or ["–"] * 3
        rows.append((axis, *cells, unit))
    if horizons:
        head = ((f"in {h:g} s", "90 %", "moved") for h in horizons)
        blocks.append(
            Table(
                "Drift of the model left to itself",
                ("Axis", *(name for names in head for name in names), "Unit"),
                tuple(rows),
                "l" + "rrr" * len(horizons) + "l",
                (),
                f"From many moments of {_where_it_ran(validated)} the model runs freely under the "
                "recorded inputs: distance from the measured position, median and 90 % quantile, "
                "beside how far the axis itself has moved by then.",
            )
        )
    if reasons:
        blocks.append(Bullets(reasons))
    return blocks


def _where_it_ran(validated: ValidateResult) -> str:
    """Return the trials of the free runs, and with what parameters."""
    held_out = sum(trial.held_out for trial in validated.trials.values())
    if not held_out or len(validated.trials) == 1:
        return "each trial"
    which = "each trial," if held_out == len(validated.trials) else "each held-out trial,"
    return f"{which} with parameters that never saw it,"


def _shown_trial(results: Results) -> pd.DataFrame | None:
    """Return the residuals of the first held-out trial, else of the first."""
    path = results.model_file("residuals.parquet")
    columns = results.columns(path)
    if not columns:
        return None
    names = ["trial_id", "held_out"] if "held_out" in columns else ["trial_id"]
    ids = results.table(path, names)
    if ids is None or ids.empty:
        return None
    held = ids[ids["held_out"].astype(bool)] if "held_out" in ids else ids
    trial = str((held if len(held) else ids)["trial_id"].iloc[0])
    return results.table(path, trial=trial)


def _forces(results: Results, frame: pd.DataFrame) -> Figure:
    """Fig. 9: forces at the handle where they are stored with and without friction, else joints."""
    components = [
        name.removeprefix("force_predicted_without_friction_")
        for name in frame.columns
        if str(name).startswith("force_predicted_without_friction_")
    ]
    at_handle = bool(components)
    names = components or [a for a in results.axes if f"torque_measured_{a}" in frame]
    kind = "force" if at_handle else "torque"
    figure, panels = style.panels(len(names), 1, 0.45 + 1.2 * len(names), sharex=True)
    t = frame["t"].to_numpy()
    window = (t >= t[0] + _SETTLE_S) & (t <= t[0] + _SETTLE_S + _WINDOW_S)
    part = frame[window] if window.sum() > 10 else frame
    t = part["t"].to_numpy()
    for panel, name in zip(panels[:, 0], names, strict=True):
        for column, title, colour, look in (
            (f"{kind}_predicted_without_friction_{name}", "predicted without friction",
             style.ORANGE, {"ls": (0, (4, 1.5)), "lw": 0.9}),
            (f"{kind}_measured_{name}", "measured", style.FAINT, {"lw": 2.6}),
            (f"{kind}_predicted_{name}", "predicted", style.BLUE, {"lw": 0.9}),
        ):  # fmt: skip
            if column in part:
                style.series(panel, t, part[column].to_numpy(), colour, title, **look)
        unit = "N" if at_handle else wording.unit(results.force_unit(name))
        what = f"force {name}" if at_handle else f"{name}, {_noun(results, name)}"
        panel.set_ylabel(style.label(what, unit, 20))
    panels[-1, 0].set_xlabel("time (s)")
    style.legend_below(figure, panels[0, 0])
    trial = str(frame["trial_id"].iloc[0])
    whose = f"the {results.pusher}'s"
    where = f"{whose} force" if at_handle else f"{whose} generalised force at each joint"
    caption = (
        f"Trial {trial}{results.in_paper('Fig. 9')}: {where}, measured and predicted by the "
        "inverse dynamics, with and without its friction terms."
    )
    return Figure("force-prediction", caption, style.svg(figure))


def _noun(results: Results, axis: str) -> str:
    return "torque" if results.is_rotary(axis) else "force"


def _velocity(results: Results, residuals: pd.DataFrame) -> dict[str, np.ndarray]:
    """Return the velocity of each axis at the times of the residuals, where it is stored."""
    axes = [
        axis
        for axis in results.axes
        if f"torque_predicted_without_friction_{axis}" in residuals
        and f"qd_{axis}" in results.columns("filter/kinematics.parquet")
    ]
    trial = str(residuals["trial_id"].iloc[0])
    frame = results.table(
        "filter/kinematics.parquet",
        ["t", *(f"qd_{axis}" for axis in axes)],
        trial=trial,
    )
    if not axes or frame is None or frame.empty:
        return {}
    t = residuals["t"].to_numpy()
    known = frame["t"].to_numpy()
    return {axis: np.interp(t, known, frame[f"qd_{axis}"].to_numpy()) for axis in axes}


def _one_movement(speed: np.ndarray) -> slice:
    """Return the stretch around the fastest moment, from rest to rest."""
    peak = int(np.argmax(np.abs(speed)))
    sign = np.sign(speed[peak])
    still = np.flatnonzero(sign * speed <= 0.01 * abs(speed[peak]))
    before, after = still[still < peak], still[still > peak]
    start = int(before[-1]) if len(before) else 0
    stop = int(after[0]) + 1 if len(after) else len(speed)
    margin = (stop - start) // 8
    return slice(max(0, start - margin), min(len(speed), stop + margin))


def _friction(results: Results, frame: pd.DataFrame, velocity: dict[str, np.ndarray]) -> Figure:
    axes = list(velocity)
    alone = len(axes) == 1
    figure, panels = style.panels(1, 2, 2.2) if alone else style.panels(2, len(axes), 3.9)
    if alone:
        panels = panels.T
    t = frame["t"].to_numpy()
    for column, axis in enumerate(axes):
        measured = frame[f"torque_measured_{axis}"].to_numpy()
        without = frame[f"torque_predicted_without_friction_{axis}"].to_numpy()
        error = measured - without
        one = _one_movement(velocity[axis])
        keep = style.pick(len(error), 2500)
        speed, unit = velocity[axis], wording.unit(results.rate_unit(axis))
        top, bottom = panels[0, column], panels[1, column]
        top.plot(speed[keep], error[keep], ".", ms=2.2, mew=0, color=style.BLUE, alpha=0.5)
        top.plot(speed[one], error[one], color=style.VERMILLION, lw=1.2, label="one movement")
        _arrow(top, speed[one], error[one])
        force = wording.unit(results.force_unit(axis))
        top.set_title(style.heading(axis, len(axes)))
        top.set_xlabel(style.label("velocity", unit))
        quantity = style.label(f"{_noun(results, axis)} error", force)
        new = column == 0 or quantity != panels[0, 0].get_ylabel()
        top.set_ylabel(quantity if new else "")
        style.limits(top, [np.quantile(error, [0.001, 0.999]), error[one]])
        shown = t[one] - t[one][0]
        bottom.plot(shown, measured[one], color=style.INK, lw=1.4, label="measured")
        bottom.plot(shown, without[one], color=style.ORANGE, ls=(0, (4, 1.5)), lw=1.1,
                    label="predicted without friction")  # fmt: skip
        bottom.axhline(0.0, color=style.INK, lw=0.5)
        bottom.set_xlabel("time (s)")
        bottom.set_ylabel(style.label(_noun(results, axis), force) if new else "")
    panels[0, 0].plot([], [], "o", ms=3.5, color=style.BLUE, label="whole trial")
    top_handles, top_names = panels[0, 0].get_legend_handles_labels()
    more_handles, more_names = panels[1, 0].get_legend_handles_labels()
    style.legend_of(figure, top_handles + more_handles, top_names + more_names)
    places = ("Left", "Right") if alone else ("Top", "Bottom")
    caption = (
        f"The friction that a model without it leaves{results.in_paper('Fig. 4')}. {places[0]}: "
        "measured minus predicted generalised force against velocity; the arrow shows the start "
        f"of one movement. {places[1]}: that movement."
    )
    return Figure("error-without-friction", caption, style.svg(figure))


def _arrow(panel: Any, x: np.ndarray, y: np.ndarray) -> None:
    if len(x) < 12:
        return
    start = len(x) // 5
    ahead = start + max(2, len(x) // 25)
    panel.annotate(
        "", xy=(x[ahead], y[ahead]), xytext=(x[start], y[start]),
        arrowprops={"arrowstyle": "-|>", "color": style.VERMILLION, "mutation_scale": 13},
    )  # fmt: skip
