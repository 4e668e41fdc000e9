"""Why a trial is proposed, and what it is expected to give, in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from bampipe.lists import join_names
from bampipe.results.next import Detectable, Proposal, Purpose

_SHOWN = 3
"""Parameters or effects that a sentence names."""
LOWERED = 0.8
"""Of a number, above which a trial is not said to lower it: forecasts are a fifth off."""
_UNTRIED = " This forecast takes the model to hold beyond what the trials at hand have shown."


@dataclass(frozen=True)
class Reasons:
    """Why a trial is proposed, and what it is expected to give, a sentence or two each."""

    why: str
    expected: str


def explain_proposal(
    purpose: Purpose,
    parameter: str,
    best: Proposal,
    table: Mapping[str, Detectable],
    unlimited: Sequence[str],
    lacking: Sequence[str],
    missing: Sequence[str] | None = (),
    unbraked: Sequence[str] = (),
    unpromised: Sequence[str] = (),
) -> Reasons:
    """Say why a trial is proposed and what it is expected to give.

    Args:
        purpose: of the trial; parameter: the one that it is for, "" for all.
        best: the proposal; table: by effect, from which size on trials show it.
        unlimited: axes of which the device states no range, so that nothing wider was tried.
        lacking: axes whose held-out error is above the noise floor.
        missing: effects that the diagnosis found and the model does not have; None without one.
        unbraked: effects of brakes that no trial at hand has on.
        unpromised: effects whose smallest strength is not known; see `Visibility.is_promised`.
    """
    why, expected = _explain(purpose, parameter, best, unlimited, table, unbraked, unpromised)
    if best.brakes:
        why += " Add it to session.toml as a viscous trial."
    if best.farther or best.faster:
        expected += _UNTRIED
    if best.parts > 1:
        why += (
            " It takes more than one trial, because each is judged by what the others say and none"
            " at hand is like it."
        )
    if best.sd and missing:
        why = (
            f"By the diagnosis the model lacks {join_names(missing, _SHOWN)}: add that first"
            f" (`bampipe extend`), and ask again. {why}"
        )
        expected += " These are the uncertainties of a model that lacks something."
    elif best.sd and lacking:
        if missing is None:
            why = (
                f"The error of {join_names(lacking, _SHOWN)} is above the noise floor: ask first"
                f" what the model lacks (`bampipe diagnose`). {why}"
            )
        expected += (
            f" The error of {join_names(lacking, _SHOWN)} is above the noise floor: what the model"
            " lacks there counts as noise in these uncertainties."
        )
    return Reasons(why, expected)


def _explain(
    purpose: Purpose,
    parameter: str,
    best: Proposal,
    unlimited: Sequence[str],
    table: Mapping[str, Detectable],
    unbraked: Sequence[str],
    unpromised: Sequence[str],
) -> tuple[str, str]:
    """Why, and what is expected as far as the model goes."""
    if purpose == "decision":
        return _decision(best, unlimited)
    most = (
        f"says most of `{parameter}`"
        if parameter
        else "adds most to what is known of all parameters together"
    )
    narrowed = _narrowed(parameter, best)
    if purpose == "sensitivity":
        shown, unseen = _detected(table), _unseen(table, unbraked, unpromised)
        # Nothing tried shows more: then it is for the parameters.
        return unseen + ("" if shown else f" This one {most}."), shown or narrowed
    return f"Of the motions tried, this one {most}.", narrowed


def _unseen(
    table: Mapping[str, Detectable], unbraked: Sequence[str], unpromised: Sequence[str]
) -> str:
    """Which effects the trials at hand would not have shown."""
    shown = find_shown(table)
    hidden = [*shown, *(name for name in _hidden(table) if name not in shown)]
    never = [name for name in _never(table) if name not in unbraked]
    if hidden:
        sizes = [_size(name, table[name]) for name in hidden]
        why = f"These trials would not have shown {join_names(sizes, _SHOWN)}."
    else:
        every = "every other effect" if never or unbraked or unpromised else "every effect"
        why = f"These trials would have shown {every} of the library at its typical size."
    if never:
        one = "one effect stays" if len(never) == 1 else f"{len(never)} effects stay"
        names = join_names(never, _SHOWN)
        why += f" In trials like these {one} out of sight at any size ({names})."
    if unbraked:
        names = join_names(unbraked, _SHOWN)
        why += f" What brakes do ({names}) shows in viscous trials, of which there are none."
    if unpromised:
        names = join_names(unpromised, _SHOWN)
        why += (
            f" Of {names} no size is promised: large enough to show, it changes how the motion"
            " turns round."
        )
    return why


def _decision(best: Proposal, unlimited: Sequence[str]) -> tuple[str, str]:
    pair = max(best.confusion, key=lambda pair: pair.weight * pair.before)
    before, after = say_chance(pair.before), say_chance(pair.after)
    expected = (
        f"The chance of confusing them is expected to fall from {before} to {after}."
        if pair.after < LOWERED * pair.before
        else f"No trial tried tells them apart: the chance would be {after} after this one."
        f" {_remedy(unlimited)}"
    )
    why = (
        f"These trials may confuse {pair.between[0]} with {pair.between[1]}: the chance of that is"
        f" {before}."
    )
    return why, expected


def _remedy(unlimited: Sequence[str]) -> str:
    """What may tell apart what no design does."""
    if not unlimited:
        return "Another load may."
    return (
        f"Another load may, or a wider motion: the device file states no [limits] of"
        f" {join_names(unlimited, _SHOWN)}, so that none was tried."
    )


def _size(name: str, entry: Detectable) -> str:
    """An effect, and the size at which trials do not show it."""
    if entry.smallest is None:
        return f"{name} at any size"
    return f"{name} below {entry.smallest:.2g} {entry.unit}".rstrip()


def find_shown(table: Mapping[str, Detectable]) -> tuple[str, ...]:
    """What trials at hand do not show and the proposed one would, the smallest first."""
    hidden = _hidden(table)
    sizes = {
        name: entry.with_proposal / entry.typical
        for name, entry in table.items()
        if name in hidden
        and entry.with_proposal is not None
        and (entry.smallest is None or entry.with_proposal < LOWERED * entry.smallest)
    }
    return tuple(sorted(sizes, key=lambda name: sizes[name]))


def _detected(table: Mapping[str, Detectable]) -> str:
    """From which sizes on the proposed trial would show effects; "" where it shows none."""
    shown = [
        f"{name} from {table[name].with_proposal:.2g} {table[name].unit} on".replace("  ", " ")
        for name in find_shown(table)
    ]
    text = f"It would show {join_names(shown, _SHOWN)} with 90 % probability."
    return text if shown else ""


def _narrowed(parameter: str, best: Proposal) -> str:
    """By how much the uncertainty of parameters falls."""
    falls = {name: sd.after / sd.before for name, sd in best.sd.items() if sd.before > 0.0}
    names = [parameter] if parameter else sorted(falls, key=lambda name: falls[name])[:_SHOWN]
    parts = [
        f"`{name}` ± {entry.number} {entry.unit}".rstrip() + f", now ± {entry.before:.2g}"
        for name in names
        for entry in (best.sd[name],)
    ]
    wide = any(not best.sd[name].is_sharp for name in names)
    return f"Expected: {'; '.join(parts)}" + (" (eight cases in ten)." if wide else ".")


def say_chance(value: float) -> str:
    """A chance in per cent."""
    return "below 1 %" if value < 0.01 else f"{100.0 * value:.0f} %"


def _hidden(table: Mapping[str, Detectable]) -> list[str]:
    """Effects that go unnoticed at their typical size though trials can show them, worst first."""
    factors = {
        name: float("inf") if entry.smallest is None else entry.smallest / entry.typical
        for name, entry in table.items()
        if entry.smallest is not None or entry.with_proposal is not None
    }
    return sorted((n for n in factors if factors[n] > 1.0), key=lambda n: -factors[n])


def _never(table: Mapping[str, Detectable]) -> list[str]:
    """Effects that neither the trials at hand nor the one proposed show, whatever their size."""
    return [
        name
        for name, entry in table.items()
        if entry.smallest is None and entry.with_proposal is None
    ]
