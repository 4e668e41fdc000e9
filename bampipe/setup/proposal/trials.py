"""The tables ``[[trials]]``: one for every log, or for every part of the only one."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

from bampipe.data import guesses
from bampipe.data.survey import SurveyedColumn, words
from bampipe.physics.device import Device
from bampipe.setup.proposal.matching import Matcher
from bampipe.setup.proposal.notes import Notes, quoted


def trials_tables(
    device: Device, axes: Mapping[str, SurveyedColumn], match: Matcher, notes: Notes
) -> list[str]:
    """Propose the trials and their kinds; a single long record is cut at rests of its first axis.

    Args:
        device: whose axes a locked trial may name.
        axes: columns of the positions.
        match: the logs and their time.
        notes: where guesses and what is left open are noted.
    """
    trials = match.found.trials
    cuts: list[float] = []
    if len(trials) == 1 and axes:
        cuts = guesses.stretches(match.t, next(iter(axes.values())).values)
    lines = []
    if cuts:
        note = notes.guess("one record, cut at rests, so that each part can be held out")
        lines.append(note.strip())
    for trial in trials:
        for start_s, end_s in pairwise([None, *cuts, None]):
            lines += ["[[trials]]", f"file = {quoted(trial.file)}"]
            lines += _kind(trial.file, device, notes)
            lines += [f"recording = {trial.recording}"] if trial.recording else []
            lines += [f"start_s = {start_s}"] if start_s is not None else []
            lines += [f"end_s = {end_s}"] if end_s is not None else []
            lines += [f"part = {quoted(trial.part)}"] if trial.part else []
            for part in trial.parts:
                if not any(name.startswith(f"{part.name}:") for name in match.used):
                    continue
                lines += ["", "[[trials.parts]]"]
                given = ("file", "name", "join", "time", "time_unit")
                told = {key: getattr(part, key) for key in given}
                lines += [f"{key} = {quoted(value)}" for key, value in told.items() if value]
            lines.append("")
    return lines


def _kind(file: str, device: Device, notes: Notes) -> list[str]:
    said = set(words(Path(file).stem))
    axis = next((c.name for c in device.coordinates if c.name in said), "")
    if "locked" in said and axis:
        note = notes.guess(f"{file} is a locked trial, by its name")
        return [f'kind = "locked"{note}', f'locked_axis = "{axis}"']
    if "viscous" in said:
        return [
            'kind = "viscous"' + notes.guess(f"{file} is a viscous trial, by its name"),
            "viscous_n_s_per_m = 0.0"
            + notes.ask("viscous_n_s_per_m, the damping", "the commands of the brakes' controller"),
        ]
    return ['kind = "free"']
