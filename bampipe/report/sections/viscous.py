"""Viscous field: the damping that the brakes rendered, against the command (Fig. 8)."""

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from bampipe.lists import join_names
from bampipe.report import style
from bampipe.report.document import Block, Figure, Table
from bampipe.report.run_results import Results
from bampipe.results.rounding import NORMAL_95
from bampipe.results.viscous import Damping, ViscousResult

TITLE = "Viscous field"


def list_blocks(results: Results) -> Iterator[Block]:
    """Yield the rendered damping; nothing for a session without trials in a viscous field."""
    found = results.read(ViscousResult)
    if found is None and (results.trials["kind"] == "viscous").any():
        yield results.state_undone("The viscous trials have not been used", "viscous")
    if found is None or not found.directions:
        return
    yield _compare(found.directions)
    yield Table(
        "Damping at the handle (N·s/m), along the components of its force",
        "Direction | >Commanded | >Rendered by the brakes | >p :p | >Own friction"
        " | >Felt by a hand",
        [
            (name, d.commanded, (d.estimate, d.sd), d.p_value, d.own_friction, d.felt)
            for name, d in found.directions.items()
        ],
        "± one standard deviation over blocks of time. p: probability of so large a difference "
        "from the command if there were none (two-sided, Student's t). Friction and inertia as "
        "identified; the filter does not use the commands of the brakes.",
    )
    trace = results.table(results.model_file("viscous.parquet"))
    if trace is not None and len(trace):
        yield _draw(results, found.directions, trace)


def _compare(directions: Mapping[str, Damping]) -> str:
    """Say along which directions the brakes rendered the command."""
    tested = {name: one for name, one in directions.items() if one.differs is not None}
    if not tested:
        return "The command is not recorded, so that the estimates cannot be compared with it."
    parts = []
    if right := [name for name, one in tested.items() if not one.differs]:
        parts.append(
            f"Along {join_names(right)} the rendered damping does not differ from the command by "
            "more than chance."
        )
    if wrong := [name for name, one in tested.items() if one.differs]:
        parts.append(f"Along {join_names(wrong)} it does differ (p < 0.05).")
    if any(one.felt_differs for one in tested.values()):
        parts.append("A hand feels more: the device's own viscous friction adds to the field.")
    return " ".join(parts)


def _draw(results: Results, directions: Mapping[str, Damping], trace: pd.DataFrame) -> Figure:
    names = [name for name in directions if f"damping_{name}" in trace]
    figure, panels = style.make_grid(len(names), len(names), 2.1, extra=0.0, column_width=1.9)
    late = trace.iloc[len(trace) // 20 :]
    for number, (panel, name) in enumerate(zip(panels, names, strict=True)):
        column, colour = f"damping_{name}", style.SERIES[number % len(style.SERIES)]
        style.draw_estimate(panel, trace, column, colour, "estimate")
        half = NORMAL_95 * late[f"{column}_sd"].to_numpy()
        extent = [late[column].to_numpy() - half, late[column].to_numpy() + half]
        if (command := directions[name].commanded) is not None:
            panel.axhline(command, color=style.INK, lw=0.8, ls="--", label="commanded")
            extent.append(np.array([command]))
        style.mark_trials(panel, trace)
        style.set_limits(panel, extent)
        panel.set(title=name, xlabel="time in the filter (s)")
    panels[0].set_ylabel(style.label_axis("damping", "N.s/m"))
    caption = (
        f"Damping of the viscous field by the filter{results.cite_paper('Fig. 8')}, with 95 % "
        "bounds and the command. Dotted verticals: a new trial starts; the first is filtered twice."
    )
    return style.finish(figure, "viscous-field", caption, panels[:1])
