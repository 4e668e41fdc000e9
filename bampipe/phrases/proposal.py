"""Sentences on a proposed trial: the reason for it and the expected gain."""

from collections.abc import Iterable, Mapping, Sequence

from bampipe.lists import join_names
from bampipe.results.next import AS_FORECAST, Detectable, NextResult, Trajectory

_MOST_NAMED = 3
"""Most parameters or effects that a sentence names."""


def say_chance(value: float) -> str:
    """Return a chance in per cent."""
    return "below 1 %" if value < 0.01 else f"{100.0 * value:.0f} %"


def say_sizes(table: Mapping[str, Detectable], names: Iterable[str]) -> str:
    """Return effects with the sizes from which a proposed trial shows them."""
    sizes = (f"{name} from {table[name].with_proposal:.2g} {table[name].unit}" for name in names)
    return f"{join_names((size.rstrip() for size in sizes), _MOST_NAMED)} on"


def say_trajectory(found: Trajectory) -> list[str]:
    """Say how much of each limit a trajectory uses, and which limits were not stated."""
    most = []
    for name in ("speed", "acceleration", "effort"):
        shares = {
            a: getattr(found.used[a], name) / getattr(v, name) for a, v in found.limits.items()
        }
        axis = max(shares, key=lambda a: shares[a])
        most.append(f"{100.0 * shares[axis]:.0f} % of the {name} ({axis})")
    said = [
        f"The trajectory uses at most {join_names(most)} that its limits allow. Check it for"
        " collisions: the model does not know obstacles."
    ]
    if found.assumed:
        said.append(
            f"No acceleration limit is stated for {join_names(found.assumed, _MOST_NAMED)}"
            " ([limits]); the highest in these trials is used."
        )
    return said


def find_shown(table: Mapping[str, Detectable]) -> tuple[str, ...]:
    """Return the effects that only the proposed trial would show, the smallest first."""
    hidden = _find_hidden(table)
    sizes = {
        name: entry.with_proposal / entry.typical
        for name, entry in table.items()
        if name in hidden
        and entry.with_proposal is not None
        and (entry.smallest is None or entry.with_proposal < entry.smallest / AS_FORECAST)
    }
    return tuple(sorted(sizes, key=lambda name: sizes[name]))


def explain_proposal(
    found: NextResult,
    unlimited: Sequence[str],
    lacking: Sequence[str],
    missing: Sequence[str] | None = (),
    unbraked: Sequence[str] = (),
) -> tuple[str, str]:
    """State the reason for a proposed trial and the expected gain, a sentence or two each.

    Args:
        found: the proposal, without these sentences.
        unlimited: axes without a stated range, for which no wider motion was tried.
        lacking: axes whose held-out error is above the noise floor.
        missing: effects that the model lacks by the diagnosis; None without a diagnosis.
        unbraked: effects of brakes, if no present trial uses brakes.
    """
    best = found.proposals[0]
    why, expected = _explain_purpose(found, unlimited, unbraked)
    if best.brakes:
        why += " Add it to session.toml as a viscous trial."
    if best.farther or best.faster:
        expected += (
            " This forecast assumes that the model holds beyond the range of the present trials."
        )
    if best.parts > 1:
        why += (
            " It takes more than one trial: each is judged by parameters fitted to the others, and"
            " no present trial resembles it."
        )
    if best.sd and missing:
        why = (
            f"According to the diagnosis, the model lacks {join_names(missing, _MOST_NAMED)}."
            f" Extend the model first (`bampipe extend`), then ask again. {why}"
        )
        expected += " These are the uncertainties of a model that lacks something."
    elif best.sd and lacking:
        error = f"The error of {join_names(lacking, _MOST_NAMED)} is above the noise floor:"
        if missing is None:
            why = f"{error} find the missing effect first (`bampipe diagnose`). {why}"
        expected += f" {error} the missing effect counts as noise in these uncertainties."
    return why, expected


def _explain_purpose(
    found: NextResult, unlimited: Sequence[str], unbraked: Sequence[str]
) -> tuple[str, str]:
    """Return the reason, and the gain that the model predicts."""
    if found.purpose == "decision":
        return _explain_decision(found, unlimited)
    about = f"`{found.parameter}`" if found.parameter else "all parameters together"
    most = f"adds most information on {about}"
    if found.purpose == "precision":
        return f"Of all motions tried, this one {most}.", _say_uncertainties(found)
    why = _say_unseen(found, unbraked)
    if shown := find_shown(found.sensitivity):
        sizes = say_sizes(found.sensitivity, shown)
        return why, f"It would show {sizes} with 90 % probability."
    # No trial would show more: the proposal is for the parameters.
    return f"{why} This one {most}.", _say_uncertainties(found)


def _say_unseen(found: NextResult, unbraked: Sequence[str]) -> str:
    """Name the effects that the present trials would not have shown."""
    table, unpromised = found.sensitivity, found.unpromised
    hidden = list(dict.fromkeys([*find_shown(table), *_find_hidden(table)]))
    # Neither the present trials nor the proposed one show these at any size.
    never = [
        name
        for name, entry in table.items()
        if entry.smallest is None and entry.with_proposal is None and name not in unbraked
    ]
    every = "every other effect" if never or unbraked or unpromised else "every effect"
    why = f"These trials would have shown {every} of the library at its typical size."
    if hidden:
        sizes = join_names([_say_size(name, table[name]) for name in hidden], _MOST_NAMED)
        why = f"These trials would not have shown {sizes}."
    if never:
        one = "one effect stays" if len(never) == 1 else f"{len(never)} effects stay"
        names = join_names(never, _MOST_NAMED)
        why += f" In trials like these, {one} invisible at any size ({names})."
    if unbraked:
        names = join_names(unbraked, _MOST_NAMED)
        why += f" Effects of brakes ({names}) show in viscous trials only, and there are none."
    if unpromised:
        names = join_names(unpromised, _MOST_NAMED)
        why += (
            f" No size is given for {names}: an effect large enough to show would change how the"
            " motion reverses."
        )
    return why


def _explain_decision(found: NextResult, unlimited: Sequence[str]) -> tuple[str, str]:
    pair = max(found.proposals[0].confusion, key=lambda pair: pair.weight * pair.before)
    before, after = say_chance(pair.before), say_chance(pair.after)
    why = (
        f"These trials may confuse {pair.between[0]} with {pair.between[1]}: the chance of that is"
        f" {before}."
    )
    if pair.after < pair.before / AS_FORECAST:
        return (why, f"The chance of confusing them is expected to fall from {before} to {after}.")
    remedy = (
        f", as may a wider motion: none was tried, because the device file states no [limits] of"
        f" {join_names(unlimited, _MOST_NAMED)}."
    )
    return why, (
        f"None of the trials that were tried distinguishes them: the chance would be {after} after"
        f" this one. Another load may help{remedy if unlimited else '.'}"
    )


def _say_size(name: str, entry: Detectable) -> str:
    """Return an effect and the size up to which trials do not show it."""
    if entry.smallest is None:
        return f"{name} at any size"
    return f"{name} below {entry.smallest:.2g} {entry.unit}".rstrip()


def _say_uncertainties(found: NextResult) -> str:
    """Return the expected uncertainties of parameters, with the present ones."""
    sds = found.proposals[0].sd
    falls = {name: sd.after / sd.before for name, sd in sds.items() if sd.before > 0.0}
    names = [found.parameter] if found.parameter else sorted(falls, key=lambda name: falls[name])
    shown = {name: sds[name] for name in names[:_MOST_NAMED] if name in sds}
    if not shown:
        return "No uncertainties are forecast, because the model is not fitted to such a trial."
    parts = [
        f"`{name}` ± {sd.number} {sd.unit}".rstrip() + f", now ± {sd.before:.2g}"
        for name, sd in shown.items()
    ]
    wide = any(not sd.is_sharp for sd in shown.values())
    return f"Expected: {'; '.join(parts)}" + (" (eight cases in ten)." if wide else ".")


def _find_hidden(table: Mapping[str, Detectable]) -> list[str]:
    """Return effects that trials can show, but not at their typical size, worst first."""
    factors = {
        name: float("inf") if entry.smallest is None else entry.smallest / entry.typical
        for name, entry in table.items()
        if entry.smallest is not None or entry.with_proposal is not None
    }
    return sorted((n for n in factors if factors[n] > 1.0), key=lambda n: -factors[n])
