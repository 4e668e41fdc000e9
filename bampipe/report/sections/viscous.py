"""Viscous field: the damping that the brakes rendered, against the command (Fig. 8)."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

from bampipe.lists import join_names
from bampipe.report import style, wording
from bampipe.report.document import Block, Figure, Paragraph, Section, Table
from bampipe.report.results import Results
from bampipe.results.intervals import NORMAL_95
from bampipe.results.viscous import Damping, ViscousResult

TITLE = "Viscous field"


def section(results: Results) -> Section | None:
    """Return the section; None for a session without trials in a viscous field."""
    found = results.read(ViscousResult)
    if found is None:
        if not (results.trials["kind"] == "viscous").any():
            return None
        return results.not_done(TITLE, "The viscous trials have not been used", "viscous")
    directions = found.directions
    if not directions:
        return None
    blocks: list[Block] = [Paragraph(_words(directions)), _table(directions)]
    trace = results.table(results.model_file("viscous.parquet"))
    if trace is not None and len(trace):
        blocks.append(_figure(results, directions, trace))
    return Section(TITLE, tuple(blocks))


def _words(directions: Mapping[str, Damping]) -> str:
    """Say along which directions the brakes rendered what was commanded."""
    tested = [name for name, entry in directions.items() if entry.differs is not None]
    if not tested:
        return "What was commanded is not recorded, so the estimates cannot be compared with it."
    wrong = [name for name in tested if directions[name].differs]
    right = [name for name in tested if name not in wrong]
    parts = []
    if right:
        parts.append(
            f"Along {join_names(right)} what the brakes rendered does not differ from the "
            "command by more than chance."
        )
    if wrong:
        parts.append(f"Along {join_names(wrong)} it does differ (p < 0.05).")
    if any(directions[name].felt_differs for name in tested):
        parts.append(
            "A hand feels more: the device's own viscous friction comes on top of the field."
        )
    return " ".join(parts)


def _table(directions: Mapping[str, Damping]) -> Table:
    rows = []
    for name, entry in directions.items():
        rows.append(
            (
                name,
                wording.significant(entry.commanded),
                wording.with_sd(entry.estimate, entry.sd),
                wording.probability(entry.p_value),
                wording.significant(entry.own_friction),
                wording.significant(entry.felt),
            )
        )
    return Table(
        "Damping at the handle (N·s/m), along the components of its force",
        ("Direction", "Commanded", "Rendered by the brakes", "p", "Own friction", "Felt by a hand"),
        tuple(rows),
        "lrrrrr",
        note="± one standard deviation over blocks of time. p: chance of so large a difference "
        "from the command if there were none (two-sided, Student's t). Friction and inertia as "
        "identified; the filter does not know the brakes' commands, only what they did.",
    )


def _figure(results: Results, directions: Mapping[str, Damping], trace: pd.DataFrame) -> Figure:
    names = [name for name in directions if f"damping_{name}" in trace]
    figure, panels = style.panels(
        1, len(names), 2.1, width=min(style.WIDTH, 1.2 + 1.9 * len(names))
    )
    shown = trace.iloc[style.pick(len(trace), 1500)]
    t = shown["t_total"].to_numpy()
    starts = trace.loc[trace["trial_id"].ne(trace["trial_id"].shift()), "t_total"].to_numpy()
    for number, (panel, name) in enumerate(zip(panels[0], names, strict=True)):
        value = shown[f"damping_{name}"].to_numpy()
        half = NORMAL_95 * shown[f"damping_{name}_sd"].to_numpy()
        colour = style.SERIES[number % len(style.SERIES)]
        panel.fill_between(t, value - half, value + half, color=colour, alpha=0.18, lw=0)
        panel.plot(t, value, color=colour, label="estimate")
        command = directions[name].commanded
        if command is not None:
            panel.axhline(command, color=style.INK, lw=0.8, ls="--", label="commanded")
        for start in starts[1:]:
            panel.axvline(start, color=style.FAINT, lw=0.6, ls=(0, (1, 2)), zorder=0)
        late = slice(len(t) // 20, None)
        held = [value[late] - half[late], value[late] + half[late]]
        style.limits(panel, [*held, value[:0] if command is None else value[:1] * 0.0 + command])
        panel.set_title(name)
        panel.set_xlabel("time in the filter (s)")
    panels[0][0].set_ylabel(style.label("damping", wording.unit("N.s/m")))
    style.legend_below(figure, panels[0][0])
    caption = (
        f"Damping of the viscous field as the filter finds it{results.in_paper('Fig. 8')}, with "
        "95 % bounds and the command. Dotted verticals: a new trial starts; the first is filtered "
        "twice."
    )
    return Figure("viscous-field", caption, style.svg(figure))
