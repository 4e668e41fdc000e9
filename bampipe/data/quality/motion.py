"""What a trial of each kind must do: move, hold still, be free of brakes."""

from __future__ import annotations

import numpy as np

from bampipe.data.quality.table import TrialTable, counted


def refuse_wrong_motion(table: TrialTable, columns: dict[str, np.ndarray]) -> None:
    """A free trial moves; a locked axis winds up, but stays."""
    session, limits, entry = table.session, table.limits, table.entry
    travel = {e.axis: float(np.ptp(columns[f"q_{e.axis}"])) for e in session.encoders}
    still = {"rad": limits.still_rad, "m": limits.still_m}
    if entry.kind != "locked":
        if all(travel[e.axis] < still[e.unit] for e in session.encoders):
            shown = ", ".join(f"{e.axis} {travel[e.axis]:.2g} {e.unit}" for e in session.encoders)
            raise table.fault(
                f"declared {entry.kind}, but never moves ({shown})",
                remedy="were the encoders on, and is their unit right? or is it a locked trial?",
            )
        for encoder in session.encoders:
            if travel[encoder.axis] == 0.0:
                raise table.fault(
                    "never changes while other axes move: frozen",
                    column=encoder.column,
                    remedy="check the encoder's cable; an axis held in all trials is none of the"
                    " device: make a robot's joint fixed in its file",
                )
        return
    encoder = next(e for e in session.encoders if e.axis == entry.locked_axis)
    most = {"rad": limits.locked_rad, "m": limits.locked_m}[encoder.unit]
    moved = travel[encoder.axis]
    if moved > most:
        raise table.fault(
            f"{encoder.axis} is declared locked, but moves by {moved:.3g} {encoder.unit},"
            f" more than {most:g} {encoder.unit}",
            column=encoder.column,
            remedy="did the brake slip? or is it a free trial?",
        )
    if encoder.resolution is not None and moved < (limits.locked_steps - 0.5) * encoder.resolution:
        steps = counted(round(moved / encoder.resolution), "encoder step")
        raise table.fault(
            f"locked {encoder.axis} deflects by {steps} only, too little for a stiffness",
            column=encoder.column,
            remedy="was another axis loaded? are the columns right?",
        )


def refuse_wrong_brakes(table: TrialTable, columns: dict[str, np.ndarray]) -> None:
    """A free trial has its brakes off, a viscous one has them on, and recorded."""
    entry, brakes = table.entry, table.session.brakes
    highest = {b.axis: float(np.abs(columns[f"brake_{b.axis}"]).max()) for b in brakes}
    for brake in brakes:
        if entry.kind == "free" and highest[brake.axis] > table.limits.brake_on:
            raise table.fault(
                f"declared free, but the brake is commanded up to {highest[brake.axis]:.3g}"
                f" {brake.unit}",
                column=brake.column,
                remedy='is its kind "locked" or "viscous"?',
            )
        if brake.axis == entry.locked_axis and highest[brake.axis] == 0.0:
            table.notes.append(f"brake of the locked axis {brake.axis} is never commanded")
    if entry.kind == "viscous" and not brakes:
        raise table.fault(
            "declared viscous, but no brake command is recorded",
            remedy="name the columns of the commands under [brakes] in session.toml",
        )
    if entry.kind == "viscous" and not any(highest.values()):
        raise table.fault("declared viscous, but no brake is ever commanded")
