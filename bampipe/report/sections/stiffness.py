"""Stiffness: Table I, the hysteresis loops of Fig. 3, bandwidth in both units."""

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from bampipe.report import style
from bampipe.report.document import Block, Figure, Table
from bampipe.report.run_results import Results
from bampipe.report.wording import choose_scale, format_scaled, format_with_sd, split_name
from bampipe.results.stiffness import AxisStiffness, StiffnessResult

TITLE = "Stiffness"


def list_blocks(results: Results) -> Iterator[Block]:
    """Yield the stiffness of axes and gears; nothing for a session without locked trials."""
    found = results.read(StiffnessResult)
    is_locked = bool((results.trials["kind"] == "locked").any())
    if found is None and is_locked:
        yield results.state_undone("The locked trials have not been used", "stiffness")
    if found is None or not (found.axes or found.gears or is_locked):
        return
    axes, notes = found.axes, found.notes
    rows = []
    poses: dict[str, str] = {}
    for axis, one in results.order_axes(axes).items():
        stiffness = format_scaled(one.stiffness, one.unit, sd=one.sd)
        width = format_scaled(one.loop_width, one.loop_width_unit, 3)
        loss = format_scaled(one.energy_per_cycle, one.energy_unit, 3)
        bandwidth = (one.bandwidth_rad_s, one.bandwidth_hz)
        rows.append((axis, stiffness, str(one.n_cycles), width, loss, *bandwidth))
        pose = results.order_axes(one.poses.get(one.bandwidth_pose, {}))
        parts = ", ".join(f"{name} {x:.3g} {results.unit(name)}" for name, x in pose.items())
        words = split_name(one.bandwidth_pose) + (f" ({parts})" if parts else "")
        poses.setdefault(words, axis)
    note = (
        "± standard uncertainty: the scatter of the cycles, and the remaining curvature of the loop"
        " after a reversal. Loop width at constant deflection."
    )
    if poses:
        note += f" Bandwidth √(K/M) at {'; '.join(poses)}."
    yield Table(
        f"Stiffness of the locked axes{results.cite_paper('Table I')}",
        "Axis | >Stiffness ~1.3 | >Cycles | >Loop width ~1 | >Loss per cycle ~1"
        " | >Bandwidth (rad/s) ~1 | >(Hz) ~0.5",
        rows,
        note,
    )
    gears = []
    for axis, gear in results.order_axes(found.gears).items():
        stiffness, play = "not seen", "not crossed"
        if gear.stiffness is not None and gear.sd is not None:
            stiffness = format_scaled(gear.stiffness, gear.unit, sd=gear.sd)
        if gear.play is not None and gear.play_sd is not None:
            play = format_scaled(gear.play, gear.play_unit, sd=gear.play_sd)
        late = f"{format_with_sd(1e3 * gear.late_s, 1e3 * gear.late_sd)} ms"
        gears.append((axis, stiffness, play, gear.explained, late, gear.side))
    yield Table(
        "Gears with an encoder on either side",
        "Axis | >Stiffness ~1.3 | >Play ~1.3 | >Explained :% ~0.8 | >Read late by ~1"
        " | Second encoder ~1",
        gears,
        "From the difference of the encoders against the load of the drive, less the drive's own"
        " friction and inertia. Explained: share of the variance of the difference that stiffness"
        " and play explain, after timing and the losses of the drive.",
    )
    loops = results.table("stiffness/loops.parquet")
    if loops is not None and len(loops):
        yield _draw_loops(results, axes, loops)
    yield notes


def _draw_loops(results: Results, axes: Mapping[str, AxisStiffness], loops: pd.DataFrame) -> Figure:
    names = [axis for axis in results.order_axes(axes) if (loops["axis"] == axis).any()]
    figure, panels = style.make_grid(len(names), len(names), 2.35, extra=0.0, column_width=2.0)
    for panel, axis in zip(panels, names, strict=True):
        rows = loops[loops["axis"] == axis]
        rows = rows.iloc[style.thin(len(rows), 6000)]
        deflection, torque = rows["deflection"].to_numpy(), rows["torque"].to_numpy()
        deflection = deflection - 0.5 * (deflection.min() + deflection.max())
        factor, unit = choose_scale([float(np.max(np.abs(deflection)))], results.unit(axis))
        panel.plot(
            factor * deflection, torque, color=style.FAINT, lw=0.6, label="around a reversal"
        )
        away = np.where(rows["post_yield"].to_numpy(dtype=bool), torque, np.nan)
        panel.plot(factor * deflection, away, color=style.BLUE, lw=0.8, label="away from reversals")
        middle, reach = 0.5 * (torque.max() + torque.min()), 0.5 * (torque.max() - torque.min())
        line = np.array([-reach, reach])
        panel.plot(
            factor * line / axes[axis].stiffness, middle + line,
            color=style.VERMILLION, ls=(0, (4, 2)), lw=1.2, label="stiffness",
        )  # fmt: skip
        panel.set(title=axis, xlabel=style.label_axis("deflection", unit))
        panel.set_ylabel(style.label_axis(results.name_force(axis), results.force_unit(axis)))
    caption = (
        f"Hysteresis loops of the locked axes{results.cite_paper('Fig. 3')}: generalised force of "
        "the hand against deflection. The slope of the parts away from reversals (blue) is the "
        "stiffness (dashed)."
    )
    return style.finish(figure, "stiffness-loops", caption, panels[:1])
