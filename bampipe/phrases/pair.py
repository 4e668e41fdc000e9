"""Two sessions of one device, in sentences."""

from bampipe.lists import join_names
from bampipe.phrases.diagnosis import probability
from bampipe.results.pair import Journey, PairResult


def describe_pair(pair: PairResult) -> list[str]:
    """Return what changed from the first session to the second, a sentence each."""
    lines = []
    for name, one in pair.parameters.items():
        if one.changed:
            by = one.second - one.first
            share = f" ({100.0 * by / abs(one.first):+.0f} %)" if one.first else ""
            errors = f"{abs(one.standard_errors):.3g} standard errors"
            lines.append(f"{name} changed by {by:+.3g} {one.unit}{share}, {errors}.")
    if not lines:
        lines.append(f"None of {len(pair.parameters)} parameters changed beyond chance.")
    lines += map(describe_journey, pair.journeys)
    bins = sum(len(state.p_values) for state in pair.states)
    found = [f"{s.axis} by {s.variable} ({s.changed})" for s in pair.states if s.changed]
    where = f"in bins of {join_names(found)}" if found else f"in none of {bins} bins"
    lines.append(
        f"The residual of the model of {pair.first.session} changed beyond chance {where}."
    )
    return lines


def describe_journey(one: Journey) -> str:
    """Return whether a model travels and, if not, what would make it."""
    line = f"The model of {one.model_of}"
    if not one.failed:
        return f"{line} travels to {one.trials_of}."
    errors = []
    for axis, e in ((axis, one.axes[axis]) for axis in one.failed):
        floor = f", floor {e.noise_floor:.3g}" if e.noise_floor else ""
        errors.append(f"{axis} ({e.error:.3g} {e.unit}; own model {e.own_error:.3g}{floor})")
    line += f" does not travel to {one.trials_of} on {join_names(errors)}."
    reached = [
        axis
        for axis in one.failed
        if one.together and axis in one.together.travels and axis not in one.lacking
    ]
    if one.together is not None and reached:
        changes = join_names(f"{name} {by:+.3g}" for name, by in one.together.changes.items())
        line += f" Refitted in {changes}, it travels on {join_names(reached)}."
    found = [
        f"{effect} (probability {probability(entry.probabilities[effect])})"
        for entry in one.lacking.values()
        for effect in entry.likely
        if effect not in one.effects
    ]
    unknown = [axis for axis, entry in one.lacking.items() if entry.verdict == "unknown_effect"]
    found += [f"something unknown on {axis}" for axis in unknown]
    if found:
        return f"{line} It lacks {join_names(dict.fromkeys(found))} there."
    if len(reached) < len(one.failed):
        line += f" The missing effect is not known{f': {one.reason}' * bool(one.reason)}."
    return line
