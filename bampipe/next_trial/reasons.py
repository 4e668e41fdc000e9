"""Why a trial is proposed, and what it is expected to give, in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from bampipe.results.next import Detectable, ExpectedConfusion, Proposal, Purpose

_SHOWN = 3
"""Parameters or effects that a sentence names."""
_SURE = 0.01
"""Chance below which its exact size means nothing."""


def say_why(
    purpose: Purpose, parameter: str, best: Proposal, table: Mapping[str, Detectable]
) -> str:
    """Say why a trial is proposed."""
    if purpose == "decision":
        pair = _hardest(best)
        return (
            f"These trials do not tell {pair.between[0]} from {pair.between[1]}: the chance of"
            f" confusing them is {_chance(pair.before)}."
        )
    if purpose == "sensitivity":
        hidden, never = _hidden(table), _never(table)
        if hidden:
            why = f"These trials would not have shown {_listed(hidden, table)}."
        else:
            every = "every other effect" if never else "every effect"
            why = f"These trials would have shown {every} of the library at its typical size."
        if never:
            one = "one effect stays" if len(never) == 1 else f"{len(never)} effects stay"
            why += f" In trials like these {one} out of sight at any size ({_some(never)})."
        return why
    if parameter:
        return f"Of the motions tried, this one says most of `{parameter}`."
    return "Of the motions tried, this one adds most to what is known of all parameters together."


def say_expected(
    purpose: Purpose, parameter: str, best: Proposal, table: Mapping[str, Detectable]
) -> str:
    """Say what a trial is expected to give."""
    if purpose == "decision":
        pair = _hardest(best)
        return (
            f"The chance of confusing them is expected to fall from {_chance(pair.before)} to"
            f" {_chance(pair.after)}."
        )
    if purpose == "sensitivity":
        shown = [
            f"{name} from {entry.with_proposal:.2g} {entry.unit} on".replace("  ", " ")
            for name, entry in table.items()
            if name in _hidden(table)
            and entry.with_proposal is not None
            and (entry.smallest is None or entry.with_proposal < 0.8 * entry.smallest)
        ]
        if shown:
            return f"It would show {_joined(shown[:_SHOWN])} with 90 % probability."
    falls = {name: sd.after / sd.before for name, sd in best.sd.items() if sd.before > 0.0}
    names = [parameter] if parameter else sorted(falls, key=lambda name: falls[name])[:_SHOWN]
    return (
        "Expected: "
        + "; ".join(
            f"`{name}` from ± {best.sd[name].before:.2g} to ± {best.sd[name].after:.2g}"
            f" {best.sd[name].unit}".rstrip()
            for name in names
        )
        + "."
    )


def _hardest(best: Proposal) -> ExpectedConfusion:
    return max(best.confusion, key=lambda pair: pair.weight * pair.before)


def _chance(value: float) -> str:
    return "below 1 %" if value < _SURE else f"{100.0 * value:.0f} %"


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


def _listed(names: list[str], table: Mapping[str, Detectable]) -> str:
    parts = []
    for name in names[:_SHOWN]:
        entry = table[name]
        size = "at any size" if entry.smallest is None else f"below {entry.smallest:.2g}"
        parts.append(f"{name} {size} {entry.unit if entry.smallest else ''}".rstrip())
    return _some(parts, len(names) - len(parts))


def _some(names: Sequence[str], more: int = 0) -> str:
    more += max(len(names) - _SHOWN, 0)
    shown = list(names[:_SHOWN])
    return f"{', '.join(shown)} and {more} more" if more else _joined(shown)


def _joined(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
