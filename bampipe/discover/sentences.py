"""What a diagnosis says of each axis: sentences made from its numbers, and from nothing else."""

from __future__ import annotations

from collections.abc import Sequence

from bampipe.discover.description import describe
from bampipe.discover.findings import Diagnosis
from bampipe.discover.settings import Settings
from bampipe.lists import join_names
from bampipe.results.diagnose import AxisVerdict, Contender, RefusedEffect, Stretch, in_words
from bampipe.results.identify import NEAR_LIMIT
from bampipe.results.rounding import significant as three
from bampipe.results.standing import FLOOR_WRONG, STANDINGS_IN_WORDS, standing


def axis_sentences(found: Diagnosis, s: Settings) -> list[str]:
    """One or more sentences for each axis."""
    system = found.evidence.system
    return [
        " ".join(_parts(axis, i, found, system.torque_units[i], s))
        for i, axis in enumerate(system.coordinates)
    ]


def _parts(axis: str, i: int, found: Diagnosis, unit: str, s: Settings) -> list[str]:
    a = found.axes[i]
    name = axis.capitalize() if axis.isalpha() else axis  # joint_1 is a name, not a word
    if a.standing in FLOOR_WRONG:
        parts = [
            f"{name}: no verdict can be trusted, for its held-out error of {three(a.rmse_after)} "
            f"{unit} is {STANDINGS_IN_WORDS[a.standing]} ({three(a.noise_floor)} {unit})."
        ]
        return parts + ([f"Weighed: {join_names(a.effects)}."] if a.effects else [])
    parts = [f"{name}: {_verdict(a, found, unit)}."]
    parts += _rivals(axis, a, found, unit, s)
    parts += _transients(axis, found)
    parts += _refused(axis, found, unit, a.remains)
    if a.remains:
        left = f"{_no_effect(found)} explains what is left; its shape" if a.effects else "Its shape"
        judged = found.evidence if a.effects else found.initial
        parts.append(f"{left}: {describe(judged, i, s)}.")
    elif a.standing == "above_floor":
        parts.append(_excused(a, unit))
    return parts + _timing(found) + _creeping(a, found, unit) + _other_band(a)


def _timing(found: Diagnosis) -> list[str]:
    """Where the inputs are taken to act half a sample before or after the log, that they are."""
    earliest, latest = found.evidence.timing
    limit_s, late_s = 0.5 * (latest - earliest), -0.5 * (latest + earliest)
    if not 0.0 < NEAR_LIMIT * limit_s <= abs(late_s):
        return []
    way = "after" if late_s > 0.0 else "before"
    also = ", or as of what is still missing" if any(a.remains for a in found.axes) else ""
    return [
        f"The inputs are taken to act {three(1e3 * abs(late_s))} ms {way} they were logged, half a"
        f" sample, as of a command that is held until the next one{also}: a delay or a lag of no"
        " more than that would not show as an effect."
    ]


_MORE = " With a smaller sign_width more would show."


def _creeping(a: AxisVerdict, found: Diagnosis, unit: str) -> list[str]:
    """Where the floor is that of replays that stand still, what those that creep leave."""
    if a.creeping_floor is None:
        return []
    # On a test bench the trials have chosen the width.
    chosen = found.evidence.system.model.device.prescribed
    whose, more = ("model's", "") if chosen else ("device's", _MORE)
    return [
        "The floor is that of a machine that stands still where it turns round; replays that creep"
        f" there, as the {whose} sign_width says, leave {three(a.creeping_floor)} {unit}.{more}"
    ]


def _other_band(a: AxisVerdict) -> list[str]:
    """Where another reasonable band gives another standing, that it does."""
    other = a.other_band
    if other is None or other.standing == a.standing:
        return []
    ratio = other.rmse / max(other.noise_floor, 1e-30)
    return [
        f"In another band, up to {other.cutoff_hz:.3g} Hz, the error is {ratio:.2f} times the noise"
        f" floor there: look at it with `bampipe filter --set band_hz={other.cutoff_hz:.3g}` and "
        "diagnose again."
    ]


def _verdict(a: AxisVerdict, found: Diagnosis, unit: str) -> str:
    ratio = a.rmse_after / max(a.noise_floor, 1e-30)
    falls = (
        f"takes the held-out error from {three(a.rmse_before)} to {three(a.rmse_after)} {unit}, "
        f"{ratio:.2f} times the noise floor"
    )
    share = f"{100 * a.explained_by_effects:.0f} %"
    explained = f"{share} of what exceeds the noise floor in the mean square"
    stands = f"held-out error {three(a.rmse_after)} {unit}, {ratio:.1f} times the noise floor"
    if a.verdict == "missing":
        it = "it" if len(a.effects) == 1 else "them"
        if any(c.beside for name in a.effects for c in found.contests.get(name, ())):
            it = join_names(a.effects)
        return f"{_missing(a.effects, found)}; adding {it} {falls}"
    if a.verdict == "undecided" and a.effects:
        sure = [n for n in a.effects if n not in a.likely]
        also = f"{_missing(sure, found)}, and " if sure else ""
        adding = f"adding {join_names(a.effects)} {falls}"
        return f"{also}these trials cannot tell {_odds(a, ' from ')}; {adding}"
    if a.verdict == "undecided" and a.explained_by_effects > 0.0:
        return (
            f"{join_names(a.likely)} would take the held-out error from {three(a.rmse_before)} to "
            f"{three(a.rmse_after)} {unit} only, {explained}: likely, but not the effect that is "
            "missing"
        )
    if a.verdict == "undecided":
        return f"{stands}; likely, but not beyond chance: {_odds(a, ', ')}"
    if a.verdict == "unknown_effect":
        error = a.rmse_before
        near = (
            f"; {join_names(a.likely)} would take {explained}, and leave "
            f"{three(a.rmse_after)} {unit}"
            if a.likely
            else ""
        )
        return (
            f"something is missing that {_no_effect(found).lower()} explains (held-out error "
            f"{three(error)} {unit}, {error / max(a.noise_floor, 1e-30):.1f} times the noise floor)"
            + near
        )
    if a.standing == "above_floor":
        return f"nothing is missing that these trials could show, at a {stands}"
    return (
        f"nothing is missing that these trials could show (held-out error {three(a.rmse_after)} "
        f"{unit}, noise floor {three(a.noise_floor)} {unit})"
    )


def _no_effect(found: Diagnosis) -> str:
    """What does not explain the rest."""
    return (
        "No effect tried before the search ended" if found.cut_short else "No effect in the library"
    )


def _missing(names: Sequence[str], found: Diagnosis) -> str:
    named = [in_words(name, found.contests.get(name, ())) for name in names]
    return f"{join_names(named)} {'is' if len(names) == 1 else 'are'} missing"


def _rivals(axis: str, a: AxisVerdict, found: Diagnosis, unit: str, s: Settings) -> list[str]:
    """The effects that come close to one found on this axis, with what they would leave."""
    said = []
    for name in a.effects:
        mine, *others = found.contests.get(name, ()) or (None,)
        wider = found.wider.get(name, frozenset())
        said += [
            f"{c.effect} is {name} and a part more, for which nothing speaks."
            for c in others
            if c.effect in wider
        ]
        rivals = [c for c in others if c.effect not in {*a.likely, *wider}]
        if mine is None or not rivals:
            continue
        doubted = [c for c in (mine, *rivals) if c.odds >= s.least_odds]
        if mine.odds < s.decided and len(doubted) > 1 and not found.groups.get(name):
            names, every = (
                join_names(c.effect for c in doubted),
                "both" if len(doubted) == 2 else "all",
            )
            odds = join_names(
                f"{100 * c.odds:.0f} % for {c.effect} ({_left(c, unit)})" for c in doubted
            )
            said.append(
                f"Replays of {names} {every} differ from the measurement by more than chance: by"
                f" their scores alone the odds are {odds}."
            )
            continue
        listed = join_names(f"{c.effect} ({_left(c, unit)})" for c in rivals)
        where = f" on {mine.axis}" if mine.axis != axis else ""
        verb = "comes" if len(rivals) == 1 else "come"
        better = [c for c in rivals if c.held_out_rmse < mine.held_out_rmse]
        better = better if all(c.score < mine.score for c in better) else []
        over_all = "; over all axes together it explains most" if better else ""
        # Scores take a shape at the best of a few values: a full fit may leave far less.
        fitted = three(mine.held_out_rmse) == three(a.rmse_after)
        when = "" if fitted or where else ", before any is fitted in full"
        said.append(
            f"Close to {name} ({_left(mine, unit)}{where}{over_all}) {verb} {listed}{when}."
        )
    return said


def _left(c: Contender, unit: str) -> str:
    return f"leaves {three(c.held_out_rmse)} {unit}"


def _transients(axis: str, found: Diagnosis) -> list[str]:
    by_second: dict[Stretch, list[str]] = {}
    for one in found.transients:
        if one.axis == axis:
            by_second.setdefault(one.second, []).append(one.effect)
    return [
        f"Only {_when(second)} speaks for {join_names(effects)}: "
        f"{'it counts' if len(effects) == 1 else 'they count'} once another trial shows it."
        for second, effects in by_second.items()
    ]


def _refused(axis: str, found: Diagnosis, unit: str, remains: bool) -> list[str]:
    """The candidates that beat chance by their score and are not kept, and why.

    Where nothing ``remains`` only those for stops: at their floor others need no reason.
    """
    said = []
    for one in found.refused:
        if one.axis != axis or not remains or one.why == "stops":
            continue
        before, after = one.held_out_rmse_before, one.held_out_rmse_after
        rest, left = one.without_worst_second_before, one.without_worst_second_after
        aside = ""
        if one.why == "held_out" and after and rest and left and left * before > after * rest:
            before, after, aside = rest, left, " but for the worst second"
        numbers = f"{three(before)} to {three(after)} {unit}{aside}" if after is not None else ""
        if one.why == "scale":
            why = "fits best where next to nothing is left of what the applied force does, which"
            why += " makes every error small"
        elif after is None:
            why = "beats chance by its score, but, fitted without one of the trials, runs away on"
            why += " it: another trial like that could decide"
        elif one.why == "replays":
            why = f"would take the held-out error from {numbers}, but replays with it give no floor"
            why += " that this could be judged by"
        elif after < before:
            why = f"beats chance by its score, but takes the held-out error only from {numbers}"
        else:
            why = f"beats chance by its score, but does not lower the held-out error ({numbers})"
        said.append(f"{one.effect} {why}: it is not named.")
    return said + _imitated([r for r in found.refused if r.axis == axis and r.why == "stops"], unit)


def _imitated(refused: Sequence[RefusedEffect], unit: str) -> list[str]:
    """What replays imitate that stand still at reversals, in one sentence."""
    if not refused:
        return []
    said = [
        f"{one.effect} would take the held-out error from {three(one.held_out_rmse_before)} to"
        f" {three(after)} {unit}"
        for one in refused
        if (after := one.held_out_rmse_after) is not None
    ]
    said[1:] = [each.replace(" would take the held-out error", "", 1) for each in said[1:]]
    it, none = ("them", "none of them is") if len(said) > 1 else ("it", "it is not")
    return [
        f"{join_names(said)}, but replays without {it} that truly stand still at"
        f" reversals give {it} most of that gain as well: {none} named."
    ]


def _excused(a: AxisVerdict, unit: str) -> str:
    """Why an error above its floor does not mean that something is missing."""
    rest = standing(a.rmse_without_worst_second, a.noise_floor, a.noise_floor_sd)
    if rest == "at_floor":
        return (
            f"It is at the floor without {_when(a.worst_second)}, the worst second: "
            f"{three(a.rmse_without_worst_second)} {unit}."
        )
    return "What exceeds the noise floor follows nothing that the machine does."


def _when(second: Stretch) -> str:
    return f"{second.t_start:.1f} to {second.t_end:.1f} s of trial {second.trial_id}"


def _odds(a: AxisVerdict, between: str) -> str:
    return between.join(f"{name} (odds {100 * share:.0f} %)" for name, share in a.likely.items())
