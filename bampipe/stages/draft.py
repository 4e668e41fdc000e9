"""Stage draft: a formula for an unexplained residual, as an effect file, with its p-value."""

import os
from dataclasses import replace
from pathlib import Path

from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.run_folder import FILTERED, INGESTED, RunFolder
from bampipe.declarations.model_file import IDENTIFIED_MODEL, load_model, read_estimate, read_spec
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.drafts import symbolic
from bampipe.diagnosis.drafts.search import FoundDraft, draft_formulas
from bampipe.diagnosis.drafts.terms import Term
from bampipe.diagnosis.session import Session
from bampipe.errors import NothingToDoError
from bampipe.files import toml_text, write_text
from bampipe.physics import compile_model
from bampipe.progress import Progress
from bampipe.results.diagnose import AxisVerdict, DiagnoseResult, RankedEffect
from bampipe.results.draft import (
    AxisDraft,
    DraftCurve,
    DraftedEffect,
    DraftOption,
    DraftResult,
    DraftVerdict,
    FittedConstant,
    NearestEffect,
)
from bampipe.results.identify import IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.rounding import NORMAL_95, round_with_sd, significant
from bampipe.schema import STRICT, Count
from bampipe.trials.measured import read_measured_trials

SUMMARY = "Draft a formula for a residual that no effect of the library explains"
INPUTS = (*INGESTED, *FILTERED, *IDENTIFIED_MODEL, "models/{model}/diagnose.json")
OUTPUTS = ("models/{model}/draft.json", "models/{model}/drafts/*.toml")

_NEAREST = 3
"""Effects of the library that are compared with a draft."""
_MORE_TRIALS = (
    "record more trials like these: the residual follows none of the quantities that formulas use"
)
_MORE_FORMULAS = (
    f" Formulas in several quantities were not searched: pip install 'bampipe[{symbolic.EXTRA}]'"
    " brings pyoperon."
)


@checked_dataclass(frozen=True, config=STRICT)
class Config(Criteria):
    """Settings of the stage, with the criteria of a diagnosis.

    Attributes:
        model: which model version to draft for.
        jobs: number of worker processes; 0 means one for each processor, eight at most.
        seed: seed of the noise in the replicates.
        curve: whether to draft a curve through points instead, for prediction only.
    """

    model: str = "base"
    jobs: Count = 0
    seed: Count = 0
    curve: bool = False


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Draft formulas for one model; write them with their evidence."""
    diagnosis = run.read(DiagnoseResult, config.model)
    if not diagnosis.unnamed_axes:
        raise NothingToDoError(
            f"nothing to draft: by the diagnosis, model {diagnosis.model!r} and the effects that it"
            " names explain all of the residual",
            where=str(run.root),
            remedy="a formula is drafted only if something `remains` that no named effect explains",
        )
    model = load_model(run, config.model)
    system = compile_model(model)
    timing = run.read(IdentifyResult, config.model).input_timing
    trials = read_measured_trials(run, system, every_input=True, timing=timing)
    session = Session(
        replace(trials, motions=tuple(trials.motions)),
        config,
        config.jobs or min(8, os.cpu_count() or 1),
        config.seed,
    )
    # Dated by the recording, so that a file is the same whenever it is made.
    ingested = run.read(IngestResult)
    on = f", recorded on {ingested.recorded_at[:10]}" if ingested.recorded_at else ""
    source = f"drafted by bampipe from {ingested.session_id}{on}"
    axes = [system.coordinates.index(axis) for axis in diagnosis.unnamed_axes]
    spec, start = read_spec(run, config.model, model), read_estimate(run, config.model, system)
    effects: dict[str, DraftedEffect] = {}
    entries: dict[str, AxisDraft] = {}
    for one in draft_formulas(session, spec, start, axes, source, config.curve, progress):
        axis = system.coordinates[one.axis]
        drafted: dict[str, DraftedEffect] = {}
        named = diagnosis.axes[axis]
        if not named.effects or one.chosen.held_out_rmse < named.rmse_after:
            for term in one.terms:
                file = f"models/{config.model}/drafts/{term.form.name}.toml"
                write_text(out / file, toml_text(term.declaration(source)))
                drafted[term.form.canonical_name] = _effect(term, file)
        rows = [row for row in diagnosis.ranking if row.axis == axis]
        entries[axis] = _axis(axis, one, drafted, named, rows)
        effects |= drafted
    selected = tuple(effects)
    added = selected or diagnosis.selected
    advice = f"bampipe extend RUN {' '.join(added)} --model {diagnosis.model}"
    DraftResult(
        model=diagnosis.model,
        sentence=" ".join(entry.sentence for entry in entries.values()),
        next=advice if added else _MORE_TRIALS,
        axes=entries,
        effects=effects,
        selected=selected,
    ).write(out)
    told = {"verdict", "rmse_before", "rmse_after", "noise_floor", "unit", "sentence"}
    return {
        "axes": {
            axis: entry.model_dump(include=told) | {"p_value": entry.chance[0].p_value}
            for axis, entry in entries.items()
        },
        "selected": selected,
    }


def _effect(term: Term, file: str) -> DraftedEffect:
    form, unit = term.form, term.form.unit
    units = dict.fromkeys(form.shape.strengths, unit)
    units |= {name: of for name, (_, _, of) in form.limits().items()}
    at, mean, sd = term.curve()
    constants = {}
    for name, value in term.values.items():
        half = NORMAL_95 * term.sd[name]
        ends = {"low": value - half, "high": value + half}
        constants[name] = FittedConstant(value=value, unit=units[name], **ends)
    numbers = ", ".join(
        f"{name} {round_with_sd(c.value, 0.5 * (c.high - c.low))} {c.unit}".rstrip()
        for name, c in constants.items()
    )
    is_curve = form.shape.name == "curve"
    return DraftedEffect.of(
        form,
        file=file,
        axis=form.axis.name,
        acts_as=form.factor,
        constants=constants,
        sentence=f"{form.summary}." if is_curve else f"{form.summary}: {numbers}.",
        curve=DraftCurve.of(
            variable=form.coordinate.words,
            variable_unit=form.coordinate.unit,
            unit=unit,
            at=at,
            mean=mean,
            low=mean - NORMAL_95 * sd,
            high=mean + NORMAL_95 * sd,
            beside={quantity.words: span.high for quantity, span in form.other_quantities},
        ),
    )


def _axis(
    axis: str,
    found: FoundDraft,
    effects: dict[str, DraftedEffect],
    diagnosed: AxisVerdict,
    ranked: list[RankedEffect],
) -> AxisDraft:
    """Return the result of an axis: ``effects`` drafted, ``ranked`` those of the library."""
    fitted = len(found.options) > 1
    verdict: DraftVerdict = "drafted" if effects else "nothing_beyond_chance"
    if fitted and not effects:
        verdict = "no_lower_error"
    before, after = found.options[0].held_out_rmse, found.chosen.held_out_rmse
    ranked = sorted(ranked, key=lambda row: row.held_out_rmse_after)[: _NEAREST if effects else 0]
    return AxisDraft(
        verdict=verdict,
        effects=tuple(effects),
        chance=found.chance,
        options=tuple(
            DraftOption.of(option, effects=tuple(form.name for form in option.terms))
            for option in found.options
        ),
        rmse_before=before,
        rmse_after=after if effects else before,
        noise_floor=found.noise_floor,
        unit=diagnosed.unit,
        nearest=tuple(
            NearestEffect(
                effect=row.effect,
                held_out_rmse=row.held_out_rmse_after,
                sentence=f"{row.effect} leaves an error of {significant(row.held_out_rmse_after)}"
                f" {diagnosed.unit}, {row.held_out_rmse_after / max(after, 1e-30):.2g} times that"
                " with the draft",
            )
            for row in ranked
        ),
        sentence=f"{axis.capitalize()}: {_say(found, [*effects.values()], diagnosed)}"
        + _MORE_FORMULAS * found.wants_formulas,
    )


def _say(found: FoundDraft, effects: list[DraftedEffect], diagnosed: AxisVerdict) -> str:
    chance, unit = found.chance[0], diagnosed.unit
    before, after = found.options[0].held_out_rmse, found.chosen.held_out_rmse
    most = max(0.0, *chance.gains)
    by_chance = (
        f"the best formula gains {chance.gain:.3g} nats of log evidence; on {len(chance.gains)}"
        f" replicates, which lack nothing, the same search gains {most:.2g} at most (p ="
        f" {chance.p_value:.2g})"
    )
    if effects:
        ratio = after / max(found.noise_floor, 1e-30)
        return (
            f"{' '.join(effect.sentence for effect in effects)} The held-out error falls from "
            f"{significant(before)} to {significant(after)} {unit}, {ratio:.2f} times the noise "
            f"floor; {by_chance}."
        )
    if found.terms:
        return (
            f"no draft, because the error with {', '.join(diagnosed.effects)}"
            f" ({significant(diagnosed.rmse_after)} {unit}) is no larger than with the best"
            f" formula ({significant(after)} {unit})."
        )
    if len(found.options) > 1:
        return f"no draft, because no formula lowers the held-out error; {by_chance}."
    return f"no draft, because chance would give as good a formula; {by_chance}."
