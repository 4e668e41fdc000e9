"""Every check that a model fails, in words: what report, lab, gates and command line read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from bampipe.results.identify import LACKS_TIMING, METHODS_IN_WORDS, IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.intervals import NORMAL_95
from bampipe.results.rounding import round_with_sd, significant
from bampipe.results.standing import FLOOR_WRONG, STANDINGS_IN_WORDS
from bampipe.results.validate import JudgedError

_TIMING_LIMIT = 0.95
"""Share of half a sample beyond which the timing of the inputs counts as at its limit."""


def find_failed_checks(
    session: IngestResult, identified: IdentifyResult, errors: Mapping[str, JudgedError]
) -> Iterator[str]:
    """Yield a sentence on every check that fails.

    Args:
        session: what ingest says; identified: the model; errors: its errors by axis.
    """
    for place in session.placeholders:
        yield f"{place}: a placeholder, its source still says `fill in`"
    for axis, channel in session.axes.items():
        if channel.resolution == 0.0:
            yield f"{axis}: resolution and noise of the encoder are not known"
    for name, sd in session.force.noise_sd.items():
        if sd == 0.0:
            yield f"{name}: the noise of its samples is not known"
    for name in session.force.look_like_counts:
        yield f"{name}: its readings look like counts of a converter, not like {session.force.unit}"
    published = identified.methods.get(identified.method)
    doubts = published.doubts if published else ()
    yield from (f"estimate by {METHODS_IN_WORDS[identified.method]}: {doubt}" for doubt in doubts)
    if not (identified.convergence.converged or doubts):
        yield "the estimates have not converged"
    timing, half = identified.input_timing, 0.5 / session.sample_rate_hz
    # What the trials do not determine, as under an effect that is missing, says nothing of clocks.
    least = max(_TIMING_LIMIT * half, NORMAL_95 * timing.sd)
    if timing.sd > 0.0 and abs(timing.estimate) >= least:
        yield (
            f"input timing: {round_with_sd(1e3 * timing.estimate, 1e3 * timing.sd)} ms, at its"
            f" limit of half a sample: {LACKS_TIMING}, or the clocks disagree"
        )
    # The innovations of a filter that is not published speak of its own parameters.
    tested = identified.innovations if identified.method == "ukf" else None
    for axis, tests in (tested or {}).items():
        white, independent = tests.whiteness, tests.inputs
        if (white and not white.white) or (independent and not independent.independent):
            yield f"{axis}, innovations: {tests.sentence}"
    for axis, error in errors.items():
        if error.estimate == "refused":
            yield (
                f"{axis}: the published parameters are refused, they err by"
                f" {significant(error.published_rmse)} {error.unit} where parameters refitted"
                f" without each trial err by {significant(error.held_out_rmse)}"
            )
        if error.standing in FLOOR_WRONG:
            yield f"{axis}: the error is {STANDINGS_IN_WORDS[error.standing]}"
