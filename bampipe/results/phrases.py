"""Short phrases on a diagnosis, for its sentences, the report, the lab and the command line."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from bampipe.lists import join_names

if TYPE_CHECKING:
    from bampipe.results.diagnose import AxisVerdict, DiagnoseResult, NullDistribution

_MOST_ALTERNATIVES = 3
"""Sets of effects that a phrase names."""


def probability(value: float) -> str:
    """Return a probability with two decimals, none of which says that something is certain."""
    shown = f"{value:.2f}"
    return {"1.00": "> 0.99", "0.00": "< 0.01"}.get(shown, shown)


def percent_of_force(share: float) -> str:
    """Return a share of the force in per cent, with the decimals that tell it from all of it."""
    left = 100.0 * abs(1.0 - share)
    decimals = 1 if left == 0.0 else max(1, math.ceil(-math.log10(left)))
    return f"{100.0 * share:.{min(decimals, 6)}f} %"


def share_of_force(entry: AxisVerdict) -> str:
    """Return what the final model explains of an axis."""
    return f"{percent_of_force(entry.explained)} of the mean square of the applied force"


def times_floor(error: float, floor: float) -> str:
    """Return how many noise floors an error is."""
    return f"{error / floor:.3g} times the noise floor" if floor > 0.0 else "without a noise floor"


def weighed(entry: AxisVerdict, effects: Iterable[str], mark: str = "") -> str:
    """Return ``a:yaw (0.98) and b:yaw (0.95)``: effects of an axis with their probabilities.

    Args:
        entry: the axis; effects: some of its probable ones; mark: what a name stands between.
    """
    chance = entry.probabilities
    return join_names(f"{mark}{name}{mark} ({probability(chance[name])})" for name in effects)


def split_sets(
    found: DiagnoseResult, axis: str
) -> tuple[list[str], list[tuple[tuple[str, ...], float]]]:
    """Return the effects that all probable sets of an axis hold, and the sets to be named."""
    sets = found.sets_on(axis)[:_MOST_ALTERNATIVES]
    sets = [one for one in sets if probability(one[1]) != "< 0.01"] or sets[:1]
    if len(sets) < 2:
        return [], sets
    return [name for name in sets[0][0] if all(name in names for names, _ in sets[1:])], sets


def undecided(
    found: DiagnoseResult, axis: str, mark: str = "", first: str = ""
) -> tuple[str, list[str]]:
    """Return the effects that all probable sets of an axis hold, and what they differ in.

    Args:
        found: the diagnosis; axis: of it; mark: what a name stands between.
        first: a word before the first probability of each part.

    Returns:
        ``a:yaw (0.99)``, or "" where there is none; ``b:yaw (0.60)``, ``nothing more (0.40)``.
    """
    common, sets = split_sets(found, axis)
    parts: list[str] = []
    for names, chance in sets:
        rest = [f"{mark}{name}{mark}" for name in names if name not in common]
        what = " with ".join(rest) or ("nothing more" if common else "nothing")
        parts.append(f"{what} ({'' if parts else first}{probability(chance)})")
    known = weighed(found.axes[axis], common, mark).replace(" (", f" ({first}", 1)
    return known, parts


def open_question(parts: Sequence[str]) -> str:
    """Return what trials leave open between parts of `undecided`."""
    return f"these trials do not decide {'between' if parts[1:] else 'on'} {join_names(parts)}"


def missing(found: DiagnoseResult, axis: str, mark: str = "") -> str:
    """Return what an axis lacks: its effects, or those between which is not decided."""
    if found.axes[axis].verdict == "undecided":
        known, parts = undecided(found, axis, mark)
        either = f"either {' or '.join(parts)}" if parts[1:] else f"perhaps {join_names(parts)}"
        return ", and ".join(filter(None, (known, either)))
    return weighed(found.axes[axis], found.axes[axis].effects, mark)


def verdict(found: DiagnoseResult, axis: str) -> str:
    """Return the verdict on an axis in a few words, with what may be missing there."""
    kind = found.axes[axis].verdict
    words = kind.replace("_", " ")
    if kind == "missing":
        return f"missing {missing(found, axis)}"
    return f"undecided: {missing(found, axis)}" if kind == "undecided" else words


def chance(null: NullDistribution | None) -> str:
    """Return what chance gives to candidates where nothing is missing, in a sentence."""
    if null is None:
        return (
            "Replays of the model are not like the measurement, so that what chance gives to a"
            " candidate is not known."
        )
    return (
        f"On {null.replicates} replays of the final model, which lack nothing, the largest gain of"
        f" any candidate is {min(null.largest):.3g} to {max(null.largest):.3g} nats; beside the"
        f" final model it is {null.measured:.3g} nats on the measured trials, of {null.effect}"
        f" (p = {null.p_value:.2g})."
    )
