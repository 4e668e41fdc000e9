"""Stiffness: Table I, the hysteresis loops of Fig. 3, bandwidth in both units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from bampipe.report import style, verdicts, wording
from bampipe.report.document import Block, Bullets, Figure, Paragraph, Section, Table
from bampipe.report.results import Results
from bampipe.results.stiffness import AxisStiffness, GearStiffness, StiffnessResult

TITLE = "Stiffness"


def section(results: Results) -> Section | None:
    """Return the section; None for a session without locked trials."""
    found = results.read(StiffnessResult)
    if found is None:
        if not (results.trials["kind"] == "locked").any():
            return None
        return results.not_done(TITLE, "The locked trials have not been used", "stiffness")
    axes, notes = found.axes, found.notes
    if not axes and not found.gears:
        return Section(TITLE, (Paragraph(" ".join(notes) or "There are no locked trials."),))
    blocks: list[Block] = [_table(results, axes)] if axes else []
    blocks += [_gears(results, found.gears)] if found.gears else []
    loops = results.table("stiffness/loops.parquet")
    if loops is not None and len(loops):
        blocks.append(_loops(results, axes, loops))
    if notes:
        blocks.append(Bullets(notes))
    return Section(TITLE, tuple(blocks))


def _table(results: Results, axes: Mapping[str, AxisStiffness]) -> Table:
    rows = []
    poses: dict[str, str] = {}
    for axis in verdicts.ordered(results, axes):
        entry = axes[axis]
        rows.append(
            (
                axis,
                wording.scaled(entry.stiffness, entry.unit, sd=entry.sd),
                str(entry.n_cycles),
                wording.scaled(entry.loop_width, entry.loop_width_unit, 3),
                wording.scaled(entry.energy_per_cycle, entry.energy_unit, 3),
                wording.significant(entry.bandwidth_rad_s),
                wording.significant(entry.bandwidth_hz),
            )
        )
        pose = _pose(results, entry)
        if pose:
            poses.setdefault(pose, axis)
    note = (
        "± standard uncertainty: scatter of the cycles, and what is left of the turn of the loop."
        " Loop width at constant deflection."
    )
    if poses:
        note += f" Bandwidth √(K/M) at {'; '.join(poses)}."
    return Table(
        f"Stiffness of the locked axes{results.in_paper('Table I')}",
        (
            "Axis",
            "Stiffness",
            "Cycles",
            "Loop width",
            "Loss per cycle",
            "Bandwidth (rad/s)",
            "(Hz)",
        ),
        tuple(rows),
        "lrrrrrr",
        (0.0, 1.3, 0.0, 1.0, 1.0, 1.0, 0.5),
        note,
    )


def _gears(results: Results, gears: Mapping[str, GearStiffness]) -> Table:
    rows = []
    for axis in verdicts.ordered(results, gears):
        gear = gears[axis]
        stiffness, play = "not seen", "not crossed"
        if gear.stiffness is not None and gear.sd is not None:
            stiffness = wording.scaled(gear.stiffness, gear.unit, sd=gear.sd)
        if gear.play is not None and gear.play_sd is not None:
            play = wording.scaled(gear.play, gear.play_unit, sd=gear.play_sd)
        late = wording.with_sd(1e3 * gear.late_s, 1e3 * gear.late_sd)
        explained = f"{100.0 * gear.explained:.0f} %"
        rows.append((axis, stiffness, play, explained, f"{late} ms", gear.side))
    return Table(
        "Gears with an encoder on either side",
        ("Axis", "Stiffness", "Play", "Explained", "Read late by", "Second encoder"),
        tuple(rows),
        "lrrrrl",
        (0.0, 1.3, 1.3, 0.8, 1.0, 1.0),
        "By how far the encoders move apart with the load of the drive, its own friction and"
        " inertia taken off. Explained: share of what these and timing leave of the difference's"
        " variance.",
    )


def _pose(results: Results, entry: AxisStiffness) -> str:
    name = entry.bandwidth_pose
    pose = entry.poses.get(name, {})
    parts = [
        f"{axis} {pose[axis]:.3g} {results.unit(axis)}" for axis in verdicts.ordered(results, pose)
    ]
    return f"{wording.words(name)} ({', '.join(parts)})" if parts else wording.words(name)


def _loops(results: Results, axes: Mapping[str, AxisStiffness], loops: pd.DataFrame) -> Figure:
    names = [axis for axis in verdicts.ordered(results, axes) if (loops["axis"] == axis).any()]
    figure, panels = style.panels(
        1, len(names), 2.35, width=min(style.WIDTH, 1.6 + 1.9 * len(names))
    )
    for panel, axis in zip(panels[0], names, strict=True):
        _loop(results, panel, axis, axes[axis], loops[loops["axis"] == axis])
    style.legend_below(figure, panels[0][0])
    caption = (
        f"Hysteresis loops of the locked axes{results.in_paper('Fig. 3')}: generalised force of "
        "the hand against deflection. The slope of the parts away from reversals (blue) is the "
        "stiffness (dashed)."
    )
    return Figure("stiffness-loops", caption, style.svg(figure))


def _loop(
    results: Results, panel: Any, axis: str, entry: AxisStiffness, rows: pd.DataFrame
) -> None:
    rows = rows.iloc[style.pick(len(rows), 6000)]
    deflection = rows["deflection"].to_numpy()
    torque = rows["torque"].to_numpy()
    centre = 0.5 * (deflection.min() + deflection.max())
    level = 0.5 * (torque.min() + torque.max())
    shown, unit = style.scaled(deflection - centre, results.unit(axis))
    factor = wording.scale([float(np.max(np.abs(deflection - centre)))], results.unit(axis))[0]
    panel.plot(shown, torque, color=style.FAINT, lw=0.6, label="around a reversal")
    if "post_yield" in rows:
        away = np.where(rows["post_yield"].to_numpy(dtype=bool), torque, np.nan)
        panel.plot(shown, away, color=style.BLUE, lw=0.8, label="away from reversals")
    reach = 0.5 * (torque.max() - torque.min())
    line = np.array([-reach, reach])
    panel.plot(
        factor * line / entry.stiffness, level + line,
        color=style.VERMILLION, ls=(0, (4, 2)), lw=1.2, label="stiffness",
    )  # fmt: skip
    panel.set_title(axis)
    panel.set_xlabel(style.label("deflection", unit))
    force = wording.unit(results.force_unit(axis))
    panel.set_ylabel(style.label("torque" if results.is_rotary(axis) else "force", force))
