"""Validation: measured and predicted force (Fig. 9), error without friction (Fig. 4), tables."""

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from bampipe.lists import join_names
from bampipe.report import style, verdicts
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
from bampipe.results.validate import AxisDrift, ValidateResult

TITLE = "Validation"
_SHOWN_S = 12.0
_SETTLE_S = 1.0


def list_blocks(results: Results) -> Iterator[Block]:
    """Yield the errors of the predicted force, and its course over one trial."""
    validated = results.read(ValidateResult)
    if validated is None:
        said = "The predicted force has not been compared with the measured one"
        yield results.state_undone(said, "validate")
        return
    rows = []
    for axis, one in results.order_axes(validated.axes).items():
        fit = None if one.fit_percent is None else format_decimals(one.fit_percent, 1)
        errors = (one.held_out_rmse, one.noise_floor, one.rmse, one.rmse_without_friction)
        rows.append((axis, *errors, fit, one.unit))
    bands = {axis: f"at {format_digits(hz, 2)} Hz" for axis, hz in validated.cutoff_hz.items()}
    different = {*bands.values()}
    each = join_names(map(" ".join, bands.items())) if len(different) != 1 else different.pop()
    yield Table(
        f"Error of the predicted force, model `{validated.model}`",
        "Axis | >Held-out RMSE ~1 | >Noise floor ~1 | >RMSE, all trials ~1"
        " | >RMSE without friction ~1.2 | >Fit (%) ~0.6 | Unit :unit",
        rows,
        f"Held out: {verdicts.describe_held_out(validated)}. {verdicts.FLOOR} Fit: share of the "
        "measured force that is explained, as 100 (1 − held-out RMSE / standard deviation). Both "
        f"forces are low-passed {each}.",
    )
    trials = []
    for name in sorted(validated.trials, key=lambda n: (n.partition("@")[0], len(n), n)):
        trial = validated.trials[name]  # a part has its start in its name, as in log@10.0s
        key = "held_out_rmse" if trial.held_out else "rmse"
        # Zero: the axis rested, no sample counts.
        by_axis = (getattr(trial.axes.get(axis), key, None) or None for axis in results.axes)
        trials.append((name, trial.held_out, *by_axis))
    heads = (f">{axis} ({format_unit(results.force_unit(axis))})" for axis in results.axes)
    note = "–: the axis rested." if any(None in row for row in trials) else ""
    yield Table("RMSE by trial", " | ".join(("Trial | Held out", *heads)), trials, note)
    if validated.forces:
        shown = join_names(
            f"{split_name(name)} {format_digits(one.rmse)} {format_unit(one.unit)}"
            for name, one in validated.forces.items()
        )
        place = " at the handle" if results.pusher == "hand" else ""
        yield f"Error of the predicted force{place} (RMSE while all axes move): {shown}."
    if validated.free_run is not None and validated.free_run.drift:
        yield from _tabulate_drift(results, validated, validated.free_run.drift)
    yield validated.notes
    residuals = _read_trial(results)
    if residuals is not None:
        yield _draw_forces(results, residuals)
        if velocity := _read_velocity(results, residuals):
            yield _draw_friction(results, residuals, velocity)


def _tabulate_drift(
    results: Results, validated: ValidateResult, drift: Mapping[str, AxisDrift]
) -> Iterator[Block]:
    """Yield the drift of the model in short free runs, or the reasons why it is unknown."""
    axes = results.order_axes(drift)
    horizons = sorted({h.horizon_s for one in axes.values() for h in one.horizons})
    reasons = {axis: one.reason for axis, one in axes.items() if one.reason}
    if not horizons and len(reasons) == len(axes) and len(set(reasons.values())) == 1:
        yield f"No short free runs of this model. {next(iter(reasons.values()))}"
        return
    if horizons:
        rows = []
        for axis, one in axes.items():
            found = {h.horizon_s: h for h in one.horizons}
            factor, unit = choose_scale((h.quantile_90 for h in found.values()), results.unit(axis))
            cells: list[str] = []
            for horizon in horizons:
                h = found.get(horizon)
                shown = (h.median, h.quantile_90, h.displacement) if h else ()
                cells += [format_digits(factor * x, 2) for x in shown] or [NONE] * 3
            rows.append((axis, *cells, unit))
        heads = (f">in {h:g} s | >90 % | >moved" for h in horizons)
        held_out, count = sum(t.held_out for t in validated.trials.values()), len(validated.trials)
        which = "each trial" if held_out in (0, count) else "each held-out trial"
        which += ", with parameters fitted to other trials" if held_out and count > 1 else ""
        note = (
            f"The model runs freely under the recorded inputs from many moments of "
            f"{which}. Distance from the measured position, median and 90 % "
            "quantile, and the distance that the axis itself has moved by then."
        )
        columns = " | ".join(("Axis", *heads, "Unit"))
        yield Table("Drift of the model in free runs", columns, rows, note)
    yield tuple(f"{axis}: {why[:1].lower()}{why[1:]}" for axis, why in reasons.items())


def _read_trial(results: Results) -> pd.DataFrame | None:
    """Return the residuals of the first held-out trial, else of the first."""
    path = results.model_file("residuals.parquet")
    ids = results.table(path, ["trial_id", "held_out"])
    if ids is None or ids.empty:
        return None
    held = ids[ids["held_out"]]
    return results.table(path, trial=str((held if len(held) else ids)["trial_id"].iloc[0]))


def _draw_forces(results: Results, frame: pd.DataFrame) -> Figure:
    """Draw Fig. 9, at the joints."""
    names = [axis for axis in results.axes if f"torque_measured_{axis}" in frame]
    figure, panels = style.make_panels(len(names), 1, 0.45 + 1.2 * len(names), sharex=True)
    t = frame["t"].to_numpy()
    window = (t >= t[0] + _SETTLE_S) & (t <= t[0] + _SETTLE_S + _SHOWN_S)
    part = frame[window] if window.sum() > 10 else frame
    t = part["t"].to_numpy()
    for panel, name in zip(panels[:, 0], names, strict=True):
        for column, title, colour, look in (
            (f"torque_predicted_without_friction_{name}", "predicted without friction",
             style.ORANGE, {"ls": (0, (4, 1.5)), "lw": 0.9}),
            (f"torque_measured_{name}", "measured", style.FAINT, {"lw": 2.6}),
            (f"torque_predicted_{name}", "predicted", style.BLUE, {"lw": 0.9}),
        ):  # fmt: skip
            if column in part:
                style.draw_series(panel, t, part[column].to_numpy(), colour, title, **look)
        quantity = f"{name}, {results.name_force(name)}"
        panel.set_ylabel(style.label_axis(quantity, results.force_unit(name), 20))
    panels[-1, 0].set_xlabel("time (s)")
    caption = (
        f"Trial {frame['trial_id'].iloc[0]}{results.cite_paper('Fig. 9')}: the {results.pusher}'s "
        "generalised force on each axis, measured and predicted by inverse dynamics, with and "
        "without friction."
    )
    return style.finish(figure, "force-prediction", caption, [panels[0, 0]])


def _read_velocity(results: Results, residuals: pd.DataFrame) -> dict[str, np.ndarray]:
    """Return the velocity of each axis at the times of the residuals, where it is stored."""
    path = "filter/kinematics.parquet"
    stored = results.columns(path)
    axes = [
        axis
        for axis in results.axes
        if f"torque_predicted_without_friction_{axis}" in residuals and f"qd_{axis}" in stored
    ]
    trial = str(residuals["trial_id"].iloc[0])
    frame = results.table(path, ["t", *(f"qd_{axis}" for axis in axes)], trial=trial)
    if not axes or frame is None:
        return {}
    t, known = residuals["t"].to_numpy(), frame["t"].to_numpy()
    return {axis: np.interp(t, known, frame[f"qd_{axis}"].to_numpy()) for axis in axes}


def _find_movement(speed: np.ndarray) -> slice:
    """Return the stretch around the fastest moment, from rest to rest."""
    peak = int(np.argmax(np.abs(speed)))
    sign = np.sign(speed[peak])
    still = np.flatnonzero(sign * speed <= 0.01 * abs(speed[peak]))
    before, after = still[still < peak], still[still > peak]
    start = int(before[-1]) if len(before) else 0
    stop = int(after[0]) + 1 if len(after) else len(speed)
    margin = (stop - start) // 8
    return slice(max(0, start - margin), min(len(speed), stop + margin))


def _draw_friction(
    results: Results, frame: pd.DataFrame, velocity: dict[str, np.ndarray]
) -> Figure:
    axes = list(velocity)
    alone = len(axes) == 1
    if alone:
        figure, panels = style.make_panels(1, 2, 2.2)
        panels = panels.T
    else:
        figure, panels = style.make_panels(2, len(axes), 3.9)
    for column, axis in enumerate(axes):
        top, bottom = panels[0, column], panels[1, column]
        kind, unit = results.name_force(axis), results.force_unit(axis)
        t, measured = frame["t"].to_numpy(), frame[f"torque_measured_{axis}"].to_numpy()
        without = frame[f"torque_predicted_without_friction_{axis}"].to_numpy()
        error = measured - without
        one, keep = _find_movement(velocity[axis]), style.thin(len(error), 2500)
        speed = velocity[axis]
        top.plot(speed[keep], error[keep], ".", ms=2.2, mew=0, color=style.BLUE, alpha=0.5)
        top.plot(speed[one], error[one], color=style.VERMILLION, lw=1.2, label="one movement")
        count = len(speed[one])
        if count >= 12:
            start, ahead = count // 5, count // 5 + max(2, count // 25)
            tail, head = ((speed[one][k], error[one][k]) for k in (start, ahead))
            look = {"arrowstyle": "-|>", "color": style.VERMILLION, "mutation_scale": 13}
            top.annotate("", xy=head, xytext=tail, arrowprops=look)
        style.set_limits(top, [np.quantile(error, [0.001, 0.999]), error[one]])
        shown = t[one] - t[one][0]
        bottom.plot(shown, measured[one], color=style.INK, lw=1.4, label="measured")
        bottom.plot(shown, without[one], color=style.ORANGE, ls=(0, (4, 1.5)), lw=1.1,
                    label="predicted without friction")  # fmt: skip
        bottom.axhline(0.0, color=style.INK, lw=0.5)
        top.set_title(style.break_heading(axis, len(axes)))
        top.set_xlabel(style.label_axis("velocity", f"{results.unit(axis)}/s"))
        bottom.set_xlabel("time (s)")
        quantity = style.label_axis(f"{kind} error", unit)
        if column == 0 or quantity != panels[0, 0].get_ylabel():
            top.set_ylabel(quantity)
            bottom.set_ylabel(style.label_axis(kind, unit))
    panels[0, 0].plot([], [], "o", ms=3.5, color=style.BLUE, label="whole trial")
    places = ("Left", "Right") if alone else ("Top", "Bottom")
    caption = (
        f"The error of the model without its friction{results.cite_paper('Fig. 4')}. {places[0]}: "
        "measured minus predicted generalised force against velocity; the arrow marks the start "
        f"of one movement. {places[1]}: that movement."
    )
    return style.finish(figure, "error-without-friction", caption, [panels[0, 0], panels[1, 0]])
