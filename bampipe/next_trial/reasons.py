"""Why a trial is proposed, and what it is expected to give, in words."""

from __future__ import annotations

from collections.abc import Mapping

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
        hidden = _hidden(table)
        if hidden:
            return f"These trials would not have shown {_listed(hidden, table)}."
        return (
            "These trials would have shown every effect of the library at its typical size, so the"
            " next one is for the parameters."
        )
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
    """Effects that would go unnoticed at their typical size, those never excited first."""

    def factor(name: str) -> float:
        smallest = table[name].smallest
        return float("inf") if smallest is None else smallest / table[name].typical

    return sorted((name for name in table if factor(name) > 1.0), key=lambda n: -factor(n))


def _listed(names: list[str], table: Mapping[str, Detectable]) -> str:
    parts = []
    for name in names[:_SHOWN]:
        entry = table[name]
        if entry.smallest is None:
            parts.append(f"{name} of any size")
        else:
            parts.append(f"{name} below {entry.smallest:.2g} {entry.unit}".rstrip())
    more = len(names) - len(parts)
    return _joined(parts) + (f", and {more} more" if more else "")


def _joined(parts: list[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
