"""A forecast compared with its outcome, once the proposed trial has been recorded."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from bampipe.errors import InputError
from bampipe.lists import join_names
from bampipe.phrases.proposal import say_chance, say_sizes
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.next import AS_FORECAST, NOTHING, ExpectedSd, NextResult, split_effects

_MOST_NAMED = 3
"""Parameters that are compared: those with the largest predicted improvement."""


def read_forecasts(root: Path, model: str) -> tuple[NextResult, ...]:
    """Return the forecasts of a model's trials: that of the last proposal first, then earlier ones.

    A forecast that another version of bampipe stored in another form is left out: a new proposal
    replaces it.
    """
    last, folder = root / NextResult.file(model), root / NextResult.EARLIER.format(model=model)
    paths = [*([last] if last.is_file() else []), *sorted(folder.glob("*.json"))]
    found = []
    for path in paths:
        with suppress(InputError):
            found.append(NextResult.read(path))
    return tuple(found)


def find_open(forecasts: Sequence[NextResult], proposed: NextResult) -> tuple[NextResult, ...]:
    """Return those of ``forecasts`` that are still open, without the one now ``proposed``.

    A forecast is open until a trial is recorded that it did not know; `bampipe run` and `bampipe
    next` compare the two before a new proposal closes it.
    """

    def purpose(one: NextResult) -> tuple[str, str, str]:
        return one.purpose, one.parameter, one.sentence

    asked, found = {purpose(proposed)}, []
    for one in forecasts:
        if purpose(one) not in asked and set(proposed.trials) <= set(one.trials):
            asked.add(purpose(one))
            found.append(one)
    return tuple(found)


def compare_forecasts(
    forecasts: Sequence[NextResult], identified: IdentifyResult, diagnosed: DiagnoseResult | None
) -> tuple[str, ...]:
    """Compare each forecast that a new trial has followed with its outcome."""
    said: list[str] = []
    for one in forecasts:
        about = f"{one.parameter or one.purpose}, {one.proposals[0].seconds:g} s: "
        lines = compare_forecast(one, identified, diagnosed)
        said += [about + line if len(forecasts) > 1 else line for line in lines]
    return tuple(said)


def compare_forecast(
    proposed: NextResult, identified: IdentifyResult, diagnosed: DiagnoseResult | None
) -> tuple[str, ...]:
    """Compare the forecast of the best proposal with its outcome, a sentence each.

    Args:
        proposed: made before the new trials; identified: with them.
        diagnosed: the last diagnosis, None without one; used if it includes the new trials.

    Returns:
        Nothing without a new trial.
    """
    new = [trial for trial in identified.trials if trial not in proposed.trials]
    if not new:
        return ()
    if diagnosed is not None and not set(new) <= set(diagnosed.trials):
        diagnosed = None
    best, said = proposed.proposals[0], []
    trials = f"{'trial' if len(new) == 1 else 'trials'} {join_names(new, _MOST_NAMED)}"
    falls = sorted(best.sd, key=lambda name: best.sd[name].after / (best.sd[name].before or 1.0))
    for name in [proposed.parameter] if proposed.parameter in best.sd else falls[:_MOST_NAMED]:
        if name in identified.parameters:
            forecast, outcome = best.sd[name], identified.parameters[name].sd
            said.append(
                f"`{name}`: ± {forecast.number} {forecast.unit} was forecast with {trials},"
                f" ± {outcome:.2g} resulted (± {forecast.before:.2g} before)"
                f"{_judge_forecast(forecast, outcome)}"
            )
    for pair in best.confusion[:_MOST_NAMED]:
        first, second = pair.between
        text = f"{first} or {second}: the forecast chance of confusion was {say_chance(pair.after)}"
        tells = "`bampipe diagnose RUN` tells the outcome"
        if diagnosed is not None:
            tells = _name_alternative(first, second, diagnosed)
        said.append(f"{text}; {tells}.")
    return (*said, *_compare_revealed(proposed, diagnosed))


def _name_alternative(first: str, second: str, diagnosed: DiagnoseResult) -> str:
    """Say which of two alternatives a diagnosis found, as a clause."""
    one, other = split_effects(first), split_effects(second)
    undecided = (axis for axis in diagnosed.axes.values() if axis.verdict == "undecided")
    if {name for axis in undecided for name in axis.probabilities} & (one ^ other):
        return "the trials still do not distinguish them"
    there = [name for name in (first, second) if split_effects(name) <= {*diagnosed.selected}]
    named = max(there, key=lambda name: len(split_effects(name)), default=NOTHING)
    if split_effects(named):
        return f"it is {named}"
    return "neither is found" if one and other else f"{first if one else second} is not found"


def _compare_revealed(proposed: NextResult, diagnosed: DiagnoseResult | None) -> Iterator[str]:
    """Say whether the effects that a trial was to reveal are present."""
    if not proposed.shows:
        return

    def compare(names: Sequence[str], outcome: str) -> str:
        return f"it was to reveal {say_sizes(proposed.sensitivity, names)}; {outcome}."

    if diagnosed is None:
        they = "they are" if proposed.shows[1:] else "it is"
        yield compare(proposed.shows, f"`bampipe diagnose RUN` tells whether {they} there")
        return
    there = [name for name in proposed.shows if name in diagnosed.selected]
    absent = [name for name in proposed.shows if name not in there]
    if there:
        yield compare(there, "they are there" if there[1:] else "it is there")
    if absent:
        they = "them, so that they are" if absent[1:] else "it, so that it is"
        yield compare(absent, f"the diagnosis does not find {they} hardly larger")


def _judge_forecast(forecast: ExpectedSd, outcome: float) -> str:
    """Compare an uncertainty with its forecast, as the end of a sentence."""
    if forecast.is_sharp:
        ratio = outcome / forecast.after if forecast.after > 0.0 else 1.0
        kept = 1.0 / AS_FORECAST <= ratio <= AS_FORECAST
        return "." if kept else f": {ratio:.2g} times the forecast."
    if outcome < forecast.low:
        return ": less than forecast."
    return ": more than forecast." if outcome > forecast.high else ": within the forecast range."
