"""What a session's results amount to, in words: as stored by the stages, worst axis first."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from bampipe.lists import join_names
from bampipe.report import wording
from bampipe.report.document import Callout
from bampipe.report.results import Results
from bampipe.results import phrases
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.standing import STANDINGS_IN_WORDS
from bampipe.results.validate import ValidateResult

_MOST_NAMED = 3
"""Held-out trials that a note can name."""


def error_over_floor(results: Results, model: str) -> dict[str, float] | None:
    """Return, by axis, held-out error over noise floor; None where it was not validated."""
    validated = results.read(ValidateResult, model)
    if validated is None:
        return None
    axes = validated.axes
    return {
        axis: axes[axis].held_out_rmse / floor
        for axis in ordered(results, axes)
        if (floor := axes[axis].noise_floor)
    }


def held_out_in_words(validated: ValidateResult) -> str:
    """Return which trials were held out, and from what."""
    names = [name for name, trial in validated.trials.items() if trial.held_out]
    if not names:
        return "nothing could be held out, so that the error is that of the fit"
    if len(validated.trials) == 1:
        return "each part of the trial predicted with parameters fitted to its other parts"
    if len(names) == len(validated.trials):
        return "each trial predicted with parameters fitted to others"
    if len(names) > _MOST_NAMED:
        return f"{len(names)} of the {len(validated.trials)} trials, which no parameter has seen"
    trials = "trial" if len(names) == 1 else "trials"
    return f"{trials} {join_names(names)}, which no parameter has seen"


def ordered(results: Results, by_axis: Collection[str]) -> tuple[str, ...]:
    """Return the axes in ``by_axis`` in the order of the session."""
    return tuple(axis for axis in results.axes if axis in by_axis)


def overall(results: Results) -> Callout:
    """Return the verdict on the session: good where no check failed and nothing is outdated."""
    validated = results.read(ValidateResult, results.model)
    if validated is not None and validated.is_refused:
        return Callout(
            "attention",
            "The published parameters are refused",
            f"`bampipe identify {results.root.name} --method least-squares` takes another "
            f"estimator.\n{_failures(validated.failed_checks)}",
        )
    found = _explained(results, validated)
    failed = validated.failed_checks if validated else ()
    if found.tone == "good" and failed:
        count = wording.count(len(failed), "check")
        return Callout("attention", f"{found.title}, but {count} failed", _failures(failed))
    if found.tone == "good" and results.outdated:
        return Callout("attention", f"{found.title}, but some results are outdated", found.text)
    return Callout(found.tone, found.title, f"{found.text}\n{_failures(failed)}".rstrip())


def _failures(failed: Sequence[str]) -> str:
    """Return the checks that failed, a line each."""
    sentences = (f"{one[:1].upper()}{one[1:]}".rstrip(".") for one in failed)
    return "\n".join(f"{one}." for one in sentences)


def _explained(results: Results, validated: ValidateResult | None) -> Callout:
    if validated is not None and (wrong := _wrong_floors(results, validated)):
        return Callout(
            "attention",
            f"No verdict on {join_names(wrong)}: the noise floor is wrong",
            f"The held-out error is {join_names(f'{a}: {w}' for a, w in wrong.items())}. "
            "Look at the noise and resolution of the sensors, under Data.",
        )
    diagnosis = results.read(DiagnoseResult)
    if diagnosis is not None:
        return _diagnosed(results, diagnosis)
    if validated is None:
        done = "identified" if results.models else "read"
        return Callout(
            "note",
            f"The session has been {done}, not validated",
            f"`bampipe validate {results.root.name}` compares measured and predicted force.",
        )
    ratios = error_over_floor(results, results.model)
    if not ratios:
        return Callout(
            "note",
            "No held-out error",
            "The parameters have seen every trial, or no noise floor could be found, so nothing "
            "can be said about what the model would do on a new trial.",
        )
    high = {a: r for a, r in ratios.items() if validated.axes[a].standing == "above_floor"}
    if not high:
        return Callout(
            "good",
            "The model explains this session down to its noise floor",
            "On trials that the parameters never saw, the error is what sensor noise, quantisation "
            f"and filtering alone would leave ({_ratios(ratios)}).",
        )
    return Callout(
        "attention",
        f"The model leaves something unexplained on {join_names(high)}",
        f"Error on trials that the parameters never saw: {_ratios(high)}. "
        f"`{results.diagnose}` says which effect is missing.",
    )


def _wrong_floors(results: Results, validated: ValidateResult) -> dict[str, str]:
    """Axes whose noise floor is implausible, in words."""
    return {
        axis: STANDINGS_IN_WORDS[validated.axes[axis].standing]
        for axis in ordered(results, validated.axes)
        if validated.axes[axis].standing == "floor_implausible"
    }


def _ratios(ratios: dict[str, float]) -> str:
    parts = (f"{axis} {wording.significant(ratio)} ×" for axis, ratio in ratios.items())
    return f"{join_names(parts)} the noise floor"


def _diagnosed(results: Results, diagnosis: DiagnoseResult) -> Callout:
    axes = {axis: diagnosis.axes[axis] for axis in ordered(results, diagnosis.axes)}
    effects = results.effects(results.model)
    with_effects = f" with {join_names(f'`{name}`' for name in effects)}" if effects else ""
    sentence = "\n".join(entry.sentence for entry in axes.values())

    def found(verdict: str) -> list[str]:
        return [axis for axis, entry in axes.items() if entry.verdict == verdict]

    if lacking := found("missing"):
        what = (f"{phrases.missing(diagnosis, axis, '`')} on {axis}" for axis in lacking)
        title = f"The model{with_effects} lacks {'; '.join(what)}"
        return Callout("attention", title, sentence)
    if unknown := found("unknown_effect"):
        title = f"Something that no known effect explains acts on {join_names(unknown)}"
        return Callout("unknown", title, sentence)
    if unjudged := found("no_verdict"):
        return Callout("attention", f"No verdict on {join_names(unjudged)}", sentence)
    if undecided := found("undecided"):
        which = (f"{axis}: {phrases.missing(diagnosis, axis, '`')}" for axis in undecided)
        return Callout("attention", f"Undecided on {'; '.join(which)}", sentence)
    title = f"The model{with_effects} explains this session: nothing is missing"
    return Callout("good", title, sentence)
