"""A proposed trial held against what came of it, once it has been recorded."""

from __future__ import annotations

from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.next import NextResult

_SHOWN = 3
"""Parameters that are compared: those for which the forecast promised most."""
_AS_FORECAST = 1.3
"""Factor within which an uncertainty came as forecast."""


def compare_forecast(
    proposed: NextResult, identified: IdentifyResult, diagnosed: DiagnoseResult | None
) -> tuple[str, ...]:
    """Say what was forecast of the best proposal and what came, a sentence each.

    Args:
        proposed: made before the new trials; identified: with them.
        diagnosed: with them; None where no diagnosis has been made since.

    Returns:
        Nothing where there is no new trial.
    """
    new = [trial for trial in identified.trials if trial not in proposed.trials]
    if not new:
        return ()
    best, said = proposed.proposals[0], []
    falls = sorted(best.sd, key=lambda name: best.sd[name].after / (best.sd[name].before or 1.0))
    names = [proposed.parameter] if proposed.parameter in best.sd else falls[:_SHOWN]
    for name in names:
        if name in identified.parameters:
            forecast, came = best.sd[name], identified.parameters[name].sd
            ratio = came / forecast.after if forecast.after > 0.0 else 1.0
            kept = 1.0 / _AS_FORECAST <= ratio <= _AS_FORECAST
            said.append(
                f"`{name}`: ± {forecast.after:.2g} {forecast.unit} was forecast with trial"
                f" {', '.join(new)}, ± {came:.2g} came (± {forecast.before:.2g} before)"
                + ("." if kept else f": {ratio:.2g} times the forecast.")
            )
    for pair in best.confusion[:_SHOWN]:
        first, second = pair.between
        forecast_text = (
            f"{first} or {second}: a chance of {100.0 * pair.after:.0f} % was forecast of"
            " confusing them"
        )
        if diagnosed is None:
            said.append(f"{forecast_text}; `bampipe diagnose RUN` says what came.")
            continue
        found = {name for name in pair.between if name in diagnosed.selected}
        alike = {other for name in found for other in diagnosed.groups.get(name, ())}
        if len(found) == 1 and not alike & set(pair.between):
            said.append(f"{forecast_text}; it is {next(iter(found))}.")
        else:
            said.append(f"{forecast_text}; the trials still do not distinguish them.")
    return tuple(said)
