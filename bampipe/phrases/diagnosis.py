"""Phrases and sentences on a diagnosis, made from its record alone."""

import math
from collections.abc import Iterable, Mapping, Sequence

from bampipe.lists import join_names
from bampipe.phrases.results import STANDINGS
from bampipe.results.diagnose import (
    UNKNOWN,
    AxisVerdict,
    DiagnoseResult,
    NullDistribution,
    WeighedSet,
)
from bampipe.results.floor import FLOOR_WRONG
from bampipe.results.rounding import significant

_MOST_ALTERNATIVES = 3
"""Most sets of effects that a phrase names."""
_NO_SHAPES: Mapping[str, str] = {}
_PROBABILITY = "probability "
_SURE = 0.9  # as the diagnosis's own default


def probability(value: float) -> str:
    """Return a probability with two decimals; none is called certain."""
    shown = f"{value:.2f}"
    return {"1.00": "> 0.99", "0.00": "< 0.01"}.get(shown, shown)


def percent_of_force(share: float) -> str:
    """Return a share of the force in per cent, with enough decimals to differ from 100."""
    left = 100.0 * abs(1.0 - share)
    decimals = 1 if left == 0.0 else max(1, math.ceil(-math.log10(left)))
    return f"{100.0 * share:.{min(decimals, 6)}f} %"


def share_of_force(entry: AxisVerdict) -> str:
    """Return the share of the force of an axis that the final model explains."""
    return f"{percent_of_force(entry.explained)} of the mean square of the applied force"


def list_effects(entry: AxisVerdict, effects: Iterable[str], mark: str = "") -> str:
    """Return ``a:yaw (0.98) and b:yaw (0.95)``: effects of an axis with their probabilities.

    ``mark`` stands on either side of a name.
    """
    known = entry.probabilities
    return join_names(f"{mark}{name}{mark} ({probability(known[name])})" for name in effects)


def split_sets(
    found: DiagnoseResult, axis: str
) -> tuple[list[str], list[tuple[tuple[str, ...], float]]]:
    """Return the effects common to all probable sets of an axis, and the sets to be named.

    Of a single set, those that are certain: beside something unknown, others are in doubt.
    """
    sets, known = found.sets_on(axis)[:_MOST_ALTERNATIVES], found.axes[axis].probabilities
    sets = [one for one in sets if probability(one[1]) != "< 0.01"] or sets[:1]
    if len(sets) < 2:
        return [n for names, _ in sets for n in names if known.get(n, 0.0) >= _SURE], sets
    return [n for n in sets[0][0] if n in known and all(n in names for names, _ in sets)], sets


def name_set(one: WeighedSet) -> str:
    """Return the effects of a set, each in backticks, and what is unknown beside them."""
    names = [f"`{name}`" for name in one.effects]
    beside = [f"{UNKNOWN} on {one.unknown}"] if one.unknown else []
    return join_names(names + beside) or "none"


def find_open_effects(found: DiagnoseResult) -> frozenset[str]:
    """Return the effects that these trials leave open: not all probable sets hold them."""
    axes = [axis for axis, entry in found.axes.items() if entry.verdict == "undecided"]
    known = {name for axis in axes for name in split_sets(found, axis)[0]}
    return frozenset(name for axis in axes for name in found.axes[axis].probabilities) - known


def split_alternatives(
    found: DiagnoseResult, axis: str, mark: str = "", first: str = ""
) -> tuple[str, list[str]]:
    """Return the effects common to all probable sets of an axis, and their differences.

    Args:
        found: the diagnosis; axis: of it; mark: put on either side of a name.
        first: a word before the first probability of each part.

    Returns:
        ``a:yaw (0.99)``, or "" if there is none; ``b:yaw (0.60)``, ``nothing more (0.40)``.
    """
    common, sets = split_sets(found, axis)
    entry, parts = found.axes[axis], list[str]()
    for names, chance in sets if len(sets) > 1 else ():
        marks = {name: mark * (name != UNKNOWN) for name in names if name not in common}
        rest = [f"{around}{name}{around}" for name, around in marks.items()]
        shown = " with ".join(filter(None, (*rest[:1], join_names(rest[1:]))))
        shown = shown or ("nothing more" if common else "nothing")
        parts.append(f"{shown} ({probability(chance)})")
    if not parts:
        # In doubt together, since something unknown may resemble them: no alternatives.
        doubtful = [n for names, _ in sets for n in names if n not in (*common, UNKNOWN)]
        parts = [list_effects(entry, doubtful, mark) or f"{UNKNOWN} ({probability(entry.unknown)})"]
    parts[0] = parts[0].replace(" (", f" ({first}", 1)
    known = list_effects(entry, common, mark).replace(" (", f" ({first}", 1)
    return known, parts


def open_question(parts: Sequence[str]) -> str:
    """Return that trials do not decide between parts of `split_alternatives`."""
    return f"these trials do not decide {'between' if parts[1:] else 'on'} {join_names(parts)}"


def advise_trial(entry: AxisVerdict) -> str:
    """Return the trial to record if none was found that would distinguish effects of an axis."""
    if all(any(kind in name for name in entry.likely) for kind in ("delay", "lag")):
        return (
            "A lag weakens fast changes, a delay does not: log at a higher rate, and record trials"
            " in which the force changes faster."
        )
    look = "`bampipe next --for decision` looks for one."
    return f"No trial was found that would distinguish them; {look}"


def missing_effects(found: DiagnoseResult, axis: str, mark: str = "") -> str:
    """Return the effects that an axis lacks, or the alternatives among them."""
    if found.axes[axis].verdict == "undecided":
        known, parts = split_alternatives(found, axis, mark)
        either = f"either {' or '.join(parts)}" if parts[1:] else f"perhaps {join_names(parts)}"
        return ", and ".join(filter(None, (known, either)))
    return list_effects(found.axes[axis], found.axes[axis].effects, mark)


def verdict(found: DiagnoseResult, axis: str) -> str:
    """Return the verdict on an axis in a few words, with the effects that may be missing."""
    kind = found.axes[axis].verdict
    if kind in ("missing", "undecided"):
        return f"{kind}{':' * (kind == 'undecided')} {missing_effects(found, axis)}"
    return kind.replace("_", " ")


def limits(found: DiagnoseResult) -> str:
    """Return the effects that the search left out, in a sentence, or ""."""
    names = ", ".join(found.not_weighed)
    return f"Not weighed (setting `without`): {names}." if names else ""


def null_distribution(null: NullDistribution | None) -> str:
    """Return the gains of candidates on replicates that lack nothing, in a sentence."""
    if null is None:
        return (
            "Replicates of the model do not resemble the measurement, so that the gain of a"
            " candidate by chance is not known."
        )
    return (
        f"On {null.replicates} replicates of the final model, which lack nothing, the largest gain"
        f" of any candidate is {min(null.largest):.3g} to {max(null.largest):.3g} nats; on"
        f" the measured trials it is {null.measured:.3g} nats, of {null.effect}"
        f" (p = {null.p_value:.2g})."
    )


def describe_axes(result: DiagnoseResult, shapes: Mapping[str, str] = _NO_SHAPES) -> dict[str, str]:
    """Return one or more sentences for each axis.

    ``shapes``: by axis, the shape of the residual of the final model, in words.
    """
    said = {}
    for axis, entry in result.axes.items():
        name = axis.capitalize() if axis.isalpha() else axis  # joint_1 is a name, not a word
        if entry.verdict == "no_verdict":
            said[axis] = f"{name}: no verdict, because {_explain_refusal(axis, entry, result)}"
            continue
        parts = [f"{name}: {_describe_verdict(axis, entry, result)}."]
        if entry.remains and entry.verdict in ("missing", "undecided"):
            rest = _describe_unknown(entry, result)
            parts.append(f"In addition, something is missing that {rest}.")
        if entry.remains and shapes.get(axis):
            parts.append(f"Its shape: {shapes[axis]}.")
        if not entry.remains and entry.standing == "above_floor":
            parts.append(
                "Without the bias that filters leave where friction changes sign, the error is"
                f" {significant(entry.rmse_beyond_bias)} {entry.unit}."
            )
        said[axis] = " ".join(parts)
    return said


def _describe_verdict(axis: str, entry: AxisVerdict, result: DiagnoseResult) -> str:
    """Return the missing effects, the error with them, and the explained share of the force."""
    if not result.selected and entry.rmse_after > 0.0:  # the model stays as it is
        left = (1.0 - entry.explained) * (entry.rmse_before / entry.rmse_after) ** 2
        kept = {"rmse_after": entry.rmse_before, "explained": max(0.0, 1.0 - left)}
        entry = entry.model_copy(update=kept)
    before, error = significant(entry.rmse_before), significant(entry.rmse_after)
    ratio = "without a noise floor"
    if entry.noise_floor > 0.0:
        ratio = f"{significant(entry.rmse_after / entry.noise_floor)} times the noise floor"
    after = f"{error} {entry.unit}, {ratio}"
    share = f"explains {share_of_force(entry)}"
    errors = f"the held-out error is {after}, and the model {share}"
    if result.selected and (entry.effects or before != error):
        adding = f"{_describe_addition(entry, result)} takes the held-out error from {before}"
        errors = f"{adding} to {after}; the model then {share}"
    if entry.verdict == "nothing_missing":
        return f"nothing of a size that matters is missing, as far as these trials show; {errors}"
    if entry.verdict == "unknown_effect":
        listed = list_effects(entry, entry.likely)
        doubt = f"; in doubt beside it: {listed}" if listed else ""
        return f"something is missing that {_describe_unknown(entry, result)}{doubt}; {errors}"
    if entry.verdict == "missing":
        verb = "is" if len(entry.effects) == 1 else "are"
        each = [probability(entry.probabilities[name]) for name in entry.effects]
        values = f"{each[0]} each" if each[1:] and len({*each}) == 1 else join_names(each)
        return f"{join_names(entry.effects)} {verb} missing ({_PROBABILITY}{values}); {errors}"
    known, parts = split_alternatives(result, axis, first=_PROBABILITY)
    verb = "are" if " and " in known else "is"
    if any(entry.probabilities[name] < _SURE for name in split_sets(result, axis)[0]):
        verb = "may be"
    sure = f"{known} {verb} missing, and " if known else ""
    return f"{sure}{open_question(parts)}; {errors}"


def _describe_addition(entry: AxisVerdict, result: DiagnoseResult) -> str:
    """Return which effects give the errors of an axis: its own, or those of several axes."""
    is_own, count = set(entry.effects) == set(result.selected), len(result.selected)
    if is_own and entry.verdict == "missing":
        return "adding it" if count == 1 else "adding them"
    if count > _MOST_ALTERNATIVES:
        return f"adding all {count} selected effects"
    names = join_names(result.selected)
    return f"adding {names}" if is_own else f"adding all selected effects ({names})"


def _describe_unknown(entry: AxisVerdict, result: DiagnoseResult) -> str:
    """Return that no effect explains the rest, with the probability that something is left."""
    most = "no set of as many effects as may be added explains"
    none = most if result.cut_short else "no effect of the library explains"
    return f"{none} ({_PROBABILITY}{probability(entry.unknown)})"


def _explain_refusal(axis: str, entry: AxisVerdict, result: DiagnoseResult) -> str:
    """Return why an axis has no verdict, which effects fit nevertheless, and the remedy."""
    error, floor = (f"{significant(x)} {entry.unit}" for x in (entry.rmse_after, entry.noise_floor))
    do = "Compare the noise and resolution in session.toml with what `bampipe ingest` measured."
    if entry.standing in FLOOR_WRONG:
        of = f" ({floor})" if entry.standing == "floor_implausible" else ""
        why = f"its held-out error of {error} is {STANDINGS[entry.standing]}{of}."
    else:
        why = (
            "replicates of the model do not resemble the measurement, so that the gain of a"
            f" candidate by chance is not known; the held-out error is {error}, that of replicates"
            f" {floor}, and the model explains {share_of_force(entry)}."
        )
        windows = [one for one in result.worst_windows if one.axis == axis]
        if windows:
            worst = max(windows, key=lambda one: one.rmse)
            do += (
                f" The error is largest, {significant(worst.rmse)} {worst.unit}, from"
                f" {worst.t_start:.1f} to {worst.t_end:.1f} s of trial {worst.trial_id}"
                f" ({worst.doing}): look there first."
            )
    fit = f"Judged by fit alone: {list_effects(entry, entry.likely)}." if entry.likely else ""
    return " ".join(filter(None, (why, fit, do)))
