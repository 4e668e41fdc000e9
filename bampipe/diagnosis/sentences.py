"""What a diagnosis says of each axis: sentences made from its record, and from nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from bampipe.lists import join_names
from bampipe.results import phrases
from bampipe.results.diagnose import AxisVerdict, DiagnoseResult
from bampipe.results.rounding import significant as three
from bampipe.results.standing import FLOOR_WRONG, STANDINGS_IN_WORDS

_NO_SHAPES: Mapping[str, str] = MappingProxyType({})
_PROBABILITY = "probability "


def axis_sentences(
    result: DiagnoseResult, shapes: Mapping[str, str] = _NO_SHAPES
) -> dict[str, str]:
    """One or more sentences for each axis.

    Args:
        result: the diagnosis.
        shapes: by axis, the shape of what the final model leaves, as `describe` says it.
    """
    said = {}
    for axis, entry in result.axes.items():
        name = axis.capitalize() if axis.isalpha() else axis  # joint_1 is a name, not a word
        if entry.verdict == "no_verdict":
            said[axis] = f"{name}: no verdict, for {_why_none(axis, entry, result)}"
            continue
        parts = [f"{name}: {_verdict(axis, entry, result)}."]
        if entry.remains:
            parts += _rest(entry, result, shapes.get(axis, ""))
        elif entry.standing == "above_floor":
            parts.append(
                "Without the bias that filters leave where friction turns, the error is"
                f" {three(entry.rmse_beyond_bias)} {entry.unit}."
            )
        said[axis] = " ".join(parts)
    return said


def _verdict(axis: str, entry: AxisVerdict, result: DiagnoseResult) -> str:
    """What is missing, the error with it, and how much of the force is then explained."""
    before, error = three(entry.rmse_before), three(entry.rmse_after)
    stands = f"{error} {entry.unit}, {phrases.times_floor(entry.rmse_after, entry.noise_floor)}"
    share = f"explains {phrases.share_of_force(entry)}"
    whole = f"the held-out error is {stands}, and the model {share}"
    if result.selected and (entry.effects or before != error):
        adding = f"{_adding(entry, result)} takes the held-out error from {before}"
        whole = f"{adding} to {stands}; the model then {share}"
    if entry.verdict == "nothing_missing":
        return f"nothing of a size that matters is missing, as far as these trials show; {whole}"
    if entry.verdict == "unknown_effect":
        return f"something is missing that {_no_effect(entry, result)}; {whole}"
    if entry.verdict == "missing":
        return f"{_are_missing(entry)}; {whole}"
    known, parts = phrases.undecided(result, axis, first=_PROBABILITY)
    sure = f"{known} {'are' if ' and ' in known else 'is'} missing, and " if known else ""
    return f"{sure}{phrases.open_question(parts)}; {whole}"


def _are_missing(entry: AxisVerdict) -> str:
    """``a:yaw and b:yaw are missing (probability 0.99 and 0.97)``."""
    verb = "is" if len(entry.effects) == 1 else "are"
    chances = join_names(phrases.probability(entry.probabilities[n]) for n in entry.effects)
    return f"{join_names(entry.effects)} {verb} missing ({_PROBABILITY}{chances})"


def _adding(entry: AxisVerdict, result: DiagnoseResult) -> str:
    """What the errors of an axis come from: its own effects, or those of several axes."""
    if set(entry.effects) != set(result.selected):
        return f"adding all that is selected ({join_names(result.selected)})"
    if entry.verdict == "missing":
        return "adding it" if len(entry.effects) == 1 else "adding them"
    return f"adding {join_names(entry.effects)}"


def _no_effect(entry: AxisVerdict, result: DiagnoseResult) -> str:
    """What does not explain the rest, with the probability that something is left."""
    none = (
        "no set of as many effects as may be added explains"
        if result.cut_short
        else "no effect of the library explains"
    )
    return f"{none} ({_PROBABILITY}{phrases.probability(entry.unknown)})"


def _rest(entry: AxisVerdict, result: DiagnoseResult, shape: str) -> list[str]:
    """That something is left beside what is named, and its shape."""
    said = []
    if entry.verdict in ("missing", "undecided"):
        said.append(f"Beside that, something is missing that {_no_effect(entry, result)}.")
    return [*said, *([f"Its shape: {shape}."] if shape else [])]


def _why_none(axis: str, entry: AxisVerdict, result: DiagnoseResult) -> str:
    """Why an axis has no verdict, which effects fit all the same, and what to do."""
    error, floor = (f"{three(x)} {entry.unit}" for x in (entry.rmse_after, entry.noise_floor))
    do = "Compare the noise and resolution in session.toml with what `bampipe ingest` measured."
    if entry.standing in FLOOR_WRONG:
        of = f" ({floor})" if entry.standing == "floor_implausible" else ""
        why = f"its held-out error of {error} is {STANDINGS_IN_WORDS[entry.standing]}{of}."
    else:
        why = (
            "replays of the model are not like the measurement, so that what chance gives to a"
            f" candidate is not known; the held-out error is {error}, that of replays {floor}, and"
            f" the model explains {phrases.share_of_force(entry)}."
        )
        windows = [w for w in result.worst_windows if w.axis == axis]
        if windows:
            w = max(windows, key=lambda w: w.rmse)
            do += (
                f" The error is largest, {three(w.rmse)} {w.unit}, from {w.t_start:.1f} to"
                f" {w.t_end:.1f} s of trial {w.trial_id} ({w.doing}): look there first."
            )
    fit = f"By their fit alone: {phrases.weighed(entry, entry.likely)}." if entry.likely else ""
    return " ".join(filter(None, (why, fit, do)))
