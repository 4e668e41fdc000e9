"""A proposed trial held against what came of it, once it has been recorded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from bampipe.errors import InputError
from bampipe.lists import join_names
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.next import AS_FORECAST, NOTHING, ExpectedSd, NextResult, split_rival

_SHOWN = 3
"""Parameters that are compared: those for which the forecast promised most."""


def read_forecasts(root: Path, model: str) -> tuple[NextResult, ...]:
    """Return the forecasts of a model's trials: that of the last proposal first, then earlier ones.

    What another version of bampipe forecast in other terms cannot be held against what came, and is
    left out: a new proposal takes its place.

    Args:
        root: the run folder; model: what was proposed for.
    """
    last, folder = root / NextResult.file(model), root / NextResult.EARLIER.format(model=model)
    paths = [*([last] if last.is_file() else []), *sorted(folder.glob("*.json"))]
    found = []
    for path in paths:
        with suppress(InputError):
            found.append(NextResult.read(path))
    return tuple(found)


def find_open(forecasts: Sequence[NextResult], proposed: NextResult) -> tuple[NextResult, ...]:
    """Return those of ``forecasts`` whose trial may still come, without the one now ``proposed``.

    A forecast is open until a trial is at hand that it did not know; `bampipe run` and `bampipe
    next` hold the two against each other before a new proposal closes it.
    """
    asked, found = {_proposal(proposed)}, []
    for one in forecasts:
        if _proposal(one) not in asked and set(proposed.trials) <= set(one.trials):
            asked.add(_proposal(one))
            found.append(one)
    return tuple(found)


def _proposal(one: NextResult) -> tuple[str, str, str]:
    """What tells one proposal from another: what it is for, and what is to be recorded."""
    return one.purpose, one.parameter, one.sentence


def compare_forecasts(
    forecasts: Sequence[NextResult], identified: IdentifyResult, diagnosed: DiagnoseResult | None
) -> tuple[str, ...]:
    """Say what was forecast and what came, of every forecast that a new trial has followed.

    Args:
        forecasts: as of `read_forecasts`; the others as of `compare_forecast`.
    """
    said: list[str] = []
    for one in forecasts:
        about = f"{one.parameter or one.purpose}, {one.proposals[0].seconds:g} s: "
        lines = compare_forecast(one, identified, diagnosed)
        said += [about + line if len(forecasts) > 1 else line for line in lines]
    return tuple(said)


def compare_forecast(
    proposed: NextResult, identified: IdentifyResult, diagnosed: DiagnoseResult | None
) -> tuple[str, ...]:
    """Say what was forecast of the best proposal and what came, a sentence each.

    Args:
        proposed: made before the new trials; identified: with them.
        diagnosed: the last diagnosis, None without one; heard where it knows the new trials.

    Returns:
        Nothing where there is no new trial.
    """
    new = [trial for trial in identified.trials if trial not in proposed.trials]
    if not new:
        return ()
    if diagnosed is not None and not set(new) <= set(diagnosed.trials):
        diagnosed = None
    best, said = proposed.proposals[0], []
    trials = f"{'trial' if len(new) == 1 else 'trials'} {join_names(new, _SHOWN)}"
    falls = sorted(best.sd, key=lambda name: best.sd[name].after / (best.sd[name].before or 1.0))
    names = [proposed.parameter] if proposed.parameter in best.sd else falls[:_SHOWN]
    for name in names:
        if name in identified.parameters:
            forecast, came = best.sd[name], identified.parameters[name].sd
            said.append(
                f"`{name}`: ± {forecast.number} {forecast.unit} was forecast with {trials},"
                f" ± {came:.2g} came (± {forecast.before:.2g} before)" + _verdict(forecast, came)
            )
    for pair in best.confusion[:_SHOWN]:
        first, second = pair.between
        chance = f"of {100.0 * pair.after:.0f} %" if pair.after >= 0.01 else "below 1 %"
        forecast_text = f"{first} or {second}: a chance {chance} was forecast of confusing them"
        if diagnosed is None:
            said.append(f"{forecast_text}; `bampipe diagnose RUN` says what came.")
            continue
        said.append(f"{forecast_text}; {_decided(first, second, diagnosed)}.")
    return (*said, *_shown(proposed, diagnosed))


def _decided(first: str, second: str, diagnosed: DiagnoseResult) -> str:
    """Which of two rivals a diagnosis found, as a clause."""
    one, other = split_rival(first), split_rival(second)
    doubted = {
        name
        for axis in diagnosed.axes.values()
        if axis.verdict == "undecided"
        for name in axis.probabilities
    }
    if doubted & (one ^ other):
        return "the trials still do not distinguish them"
    there = [name for name in (first, second) if split_rival(name) <= {*diagnosed.selected}]
    named = max(there, key=lambda name: len(split_rival(name)), default=NOTHING)
    if split_rival(named):
        return f"it is {named}"
    return "neither is found" if one and other else f"{first if one else second} is not found"


def _shown(proposed: NextResult, diagnosed: DiagnoseResult | None) -> Iterator[str]:
    """Say of the effects that a trial was to show whether they are there."""
    if not proposed.shows:
        return

    def promised(names: Sequence[str], one: str, more: str) -> str:
        table = proposed.sensitivity
        sizes = [f"{n} from {table[n].with_proposal:.2g} {table[n].unit}".rstrip() for n in names]
        end = more if len(names) > 1 else one
        return f"it was to show {join_names(sizes, _SHOWN)} on; {end}"

    if diagnosed is None:
        ask = "`bampipe diagnose RUN` says whether"
        yield promised(proposed.shows, f"{ask} it is there.", f"{ask} they are there.")
        return
    there = [name for name in proposed.shows if name in diagnosed.selected]
    absent = [name for name in proposed.shows if name not in there]
    if there:
        yield promised(there, "it is there.", "they are there.")
    if absent:
        yield promised(
            absent,
            "the diagnosis does not find it, so that it is hardly larger.",
            "the diagnosis does not find them, so that they are hardly larger.",
        )


def _verdict(forecast: ExpectedSd, came: float) -> str:
    """How an uncertainty that came stands to what was forecast, as the end of a sentence."""
    if forecast.is_sharp:
        ratio = came / forecast.after if forecast.after > 0.0 else 1.0
        kept = 1.0 / AS_FORECAST <= ratio <= AS_FORECAST
        return "." if kept else f": {ratio:.2g} times the forecast."
    if came < forecast.low:
        return ": less than forecast."
    return ": more than forecast." if came > forecast.high else ": within what was forecast."
