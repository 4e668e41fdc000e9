"""Phrases on a session, its set-up, its identified and its validated models."""

from collections.abc import Iterator, Mapping

from bampipe.results.floor import FLOOR_WRONG, FloorStatus
from bampipe.results.identify import EffectEstimate, IdentifyResult, Method
from bampipe.results.ingest import DeadStretch, IngestResult, MainsHum
from bampipe.results.rounding import NORMAL_95, round_with_sd
from bampipe.results.setup import SetupResult
from bampipe.results.validate import JudgedError

METHODS: Mapping[Method, str] = {"ukf": "the unscented filter", "least-squares": "least squares"}
FILTERS = {"kalman": "a Kalman smoother", "butterworth": "a zero-phase Butterworth filter"}
STANDINGS: Mapping[FloorStatus, str] = {
    "at_floor": "at the noise floor",
    "above_floor": "above the noise floor",
    "floor_implausible": "far below its noise floor, which is therefore wrong",
    "floor_missing": "without a noise floor for comparison",
}
TIMING_AT_LIMIT = (
    "the model lacks something that shifts the force in time, such as a delay, a lag, a command"
    " held from sample to sample or friction that builds up"
)
"""The likely cause of a timing at its limit."""


def describe_hum(hum: MainsHum) -> str:
    """Return channel, amplitude and frequency of a mains hum."""
    return (
        f"{hum.channel}: mains hum of {hum.amplitude:.2g} {hum.unit} at {hum.hz:g} Hz subtracted"
        f" (trials with it: {hum.trials})"
    )


def describe_placeholder(place: str) -> str:
    """Return that a number of the device file still has to be filled in."""
    return f"{place}: still a placeholder, with `fill in` as its source"


def describe_dead_stretch(stretch: DeadStretch) -> str:
    """Return why the readings of a column are not used."""
    if stretch.missing:
        return f"'{stretch.column}' has no readings"
    if stretch.rail is not None:
        return f"'{stretch.column}' is at the end of its range"
    return f"'{stretch.column}' is stuck at one value while the machine moves"


def describe_unidentified(name: str, effect: EffectEstimate) -> str:
    """Return that an effect does not count as identified, and why; "" if it does."""
    if effect.identified:
        return ""
    return f"`{name}` does not count as identified: {'; '.join(effect.reasons)}."


def list_setup_faults(setup: SetupResult) -> list[str]:
    """Return the mistakes of the set-up, then the warnings, a line each."""
    found = []
    for mistake in setup.mistakes:
        either = "".join(f"; or {other.sentence}" for other in mistake.alternatives)
        found.append(f"{mistake.sentence}{either} ({mistake.evidence})")
    return [*found, *setup.warnings, *setup.unexplained.values()]


def find_failed_checks(
    session: IngestResult, identified: IdentifyResult, errors: Mapping[str, JudgedError]
) -> Iterator[str]:
    """Yield a sentence on every check that a model fails, whose ``errors`` are by axis."""
    yield from map(describe_placeholder, session.placeholders)
    for axis, channel in session.axes.items():
        if channel.resolution == 0.0:
            yield f"{axis}: resolution and noise of the encoder are not known"
    for name, sd in session.force.noise_sd.items():
        if sd == 0.0:
            yield f"{name}: the noise of its samples is not known"
    for name in session.force.look_like_counts:
        yield (
            f"{name}: its readings look like raw counts of a converter, not like"
            f" {session.force.unit}"
        )
    published = identified.methods.get(identified.method)
    doubts = published.doubts if published else ()
    yield from (f"estimate by {METHODS[identified.method]}: {doubt}" for doubt in doubts)
    if not (identified.convergence.converged or doubts):
        yield "the estimates have not converged"
    timing = identified.input_timing
    # If the trials do not determine the timing, it indicates nothing about the clocks.
    if timing.is_at_limit and abs(timing.estimate) >= NORMAL_95 * timing.sd:
        yield (
            f"input timing: {round_with_sd(1e3 * timing.estimate, 1e3 * timing.sd)} ms, at its"
            f" limit of half a sample: {TIMING_AT_LIMIT}, or the clocks disagree"
        )
    # The innovations of a filter whose parameters are not published concern those parameters.
    tested = identified.innovations if identified.method == "ukf" else None
    for axis, tests in (tested or {}).items():
        white, independent = tests.whiteness, tests.inputs
        if (white and not white.white) or (independent and not independent.independent):
            yield f"{axis}, innovations: {tests.sentence[:1].lower()}{tests.sentence[1:]}"
    for axis, error in errors.items():
        if error.standing in FLOOR_WRONG:
            yield f"{axis}: the error is {STANDINGS[error.standing]}"
