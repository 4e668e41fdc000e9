"""The verdict on a session, from what the stages stored, worst axis first."""

from collections.abc import Sequence

from bampipe.lists import count_noun, join_names
from bampipe.phrases import diagnosis as phrases
from bampipe.phrases.results import STANDINGS
from bampipe.report.document import Callout, Tone
from bampipe.report.run_results import Results
from bampipe.report.wording import format_digits
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.validate import ValidateResult

FLOOR = "Noise floor: the error that sensor noise, quantisation and filtering alone would leave."
_MOST_NAMED = 3
"""Held-out trials that a note can name."""


def describe_held_out(validated: ValidateResult) -> str:
    """Return the trials that were held out of the fit, in words."""
    names = [name for name, trial in validated.trials.items() if trial.held_out]
    if not names:
        return "nothing could be held out, so the error is that of the fit"
    if len(names) == len(validated.trials):
        if len({name.partition("@")[0] for name in names}) == 1:
            return "each part of the trial predicted with the estimate from its other parts"
        return "each trial predicted with the estimate from the others"
    word = "trials" if len(names) > 1 else "trial"
    return f"{word} {join_names(names, _MOST_NAMED)}, which no parameter has seen"


def judge_session(results: Results) -> Callout:
    """Return the verdict on the session: good if no check failed and nothing is outdated."""
    validated = results.read(ValidateResult, results.model)
    failed = validated.failed_checks if validated else ()
    found = _judge_model(results, validated)
    if found.tone == "good" and failed:
        title = f"{found.title}, but {count_noun(len(failed), 'check')} failed"
        return Callout("attention", title, _list_failures(failed))
    if found.tone == "good" and results.outdated:
        return Callout("attention", f"{found.title}, but some results are outdated", found.text)
    return Callout(found.tone, found.title, f"{found.text}\n{_list_failures(failed)}".rstrip())


def _list_failures(failed: Sequence[str]) -> str:
    """Return the checks that failed, one per line."""
    return "\n".join(f"{one[:1].upper()}{one[1:]}".rstrip(".") + "." for one in failed)


def _judge_model(results: Results, validated: ValidateResult | None) -> Callout:
    axes = results.order_axes(validated.axes) if validated else {}
    if wrong := [a for a, error in axes.items() if error.standing == "floor_implausible"]:
        return Callout(
            "attention",
            f"No verdict on {join_names(wrong)}: the noise floor is wrong",
            f"The held-out error is {STANDINGS['floor_implausible']}."
            " Check the noise and resolution of the sensors, under Data.",
        )
    diagnosis = results.read(DiagnoseResult)
    if diagnosis is not None:
        return _judge_diagnosis(results, diagnosis)
    if validated is None:
        done = "identified" if results.models else "read"
        return Callout(
            "note",
            f"The session has been {done}, not validated",
            f"`bampipe validate {results.root.name}` compares measured and predicted force.",
        )
    ratios = {a: e.held_out_rmse / e.noise_floor for a, e in axes.items() if e.noise_floor}
    if not ratios:
        return Callout(
            "note",
            "No held-out error",
            "The parameters have seen every trial, or no noise floor could be computed, so the"
            " error of the model on a new trial is not known.",
        )
    high = {a: r for a, r in ratios.items() if axes[a].standing == "above_floor"}
    parts = join_names(f"{a} {format_digits(r)} ×" for a, r in (high or ratios).items())
    if not high:
        return Callout(
            "good",
            "The model explains this session down to its noise floor",
            "On held-out trials, the error is that of sensor noise, quantisation and filtering"
            f" alone ({parts} the noise floor). `{results.diagnose_command}` tests whether a"
            " smaller effect hides below it.",
        )
    return Callout(
        "attention",
        f"The model leaves something unexplained on {join_names(high)}",
        f"Error on held-out trials: {parts} the noise floor. `{results.diagnose_command}` finds"
        " which effect is missing.",
    )


def _judge_diagnosis(results: Results, diagnosis: DiagnoseResult) -> Callout:
    axes = results.order_axes(diagnosis.axes)
    sentence = "\n".join(entry.sentence for entry in axes.values())
    model = f"The model{results.list_effects()}"

    def find(verdict: str) -> dict[str, str]:
        found = [axis for axis, entry in axes.items() if entry.verdict == verdict]
        return {axis: phrases.missing_effects(diagnosis, axis, "`") for axis in found}

    tone: Tone = "attention"
    if lacking := find("missing"):
        title = f"{model} lacks {'; '.join(f'{what} on {axis}' for axis, what in lacking.items())}"
    elif unknown := find("unknown_effect"):
        tone, title = "unknown", "Something that no known effect explains acts on "
        title += join_names(unknown)
    elif unjudged := find("no_verdict"):
        title = f"No verdict on {join_names(unjudged)}"
    elif undecided := find("undecided"):
        title = f"Undecided on {'; '.join(map(': '.join, undecided.items()))}"
    else:
        tone, title = "good", f"{model} explains this session: nothing is missing"
    return Callout(tone, title, sentence)
