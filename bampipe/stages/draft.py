"""Stage draft: a formula for what no effect explains, as an effect file, with its chance level."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.run_folder import FILTERED, INGESTED, RunFolder
from bampipe.declarations.model_file import IDENTIFIED_MODEL, identified, load_model, read_recipe
from bampipe.discover.drafts import symbolic
from bampipe.discover.drafts.effect_file import declare, write_toml
from bampipe.discover.drafts.search import FoundDraft, Term, draft
from bampipe.discover.settings import Settings
from bampipe.errors import NothingToDoError
from bampipe.files import write_text
from bampipe.physics import compile_model
from bampipe.physics.system import System
from bampipe.progress import Progress
from bampipe.results.diagnose import AxisVerdict, DiagnoseResult
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
from bampipe.results.rounding import round_with_sd, significant
from bampipe.schema import STRICT, Count
from bampipe.trials.measured import read_measured_trials

SUMMARY = "Draft a formula for what no effect of the library explains"
INPUTS = (*INGESTED, *FILTERED, *IDENTIFIED_MODEL, "models/{model}/diagnose.json")
OUTPUTS = ("models/{model}/draft.json", "models/{model}/drafts/*.toml")

_NEAREST = 3
"""Effects of the library that are held against a draft."""
_MORE_FORMULAS = (
    f" Formulas in several quantities were not searched: pip install 'bampipe[{symbolic.EXTRA}]'"
    " brings pyoperon."
)


@checked_dataclass(frozen=True, config=STRICT)
class Config:
    """Settings of the stage.

    Attributes:
        model: which model version to draft for.
        replicates: replays on which a formula is searched as on the measurement.
        significance: chance of a formula where nothing is missing.
        jobs: worker processes; 0 means one for each processor, eight at most.
        seed: of the noise in the replays.
        curve: whether to draft a curve through points, where prediction is all that is wanted.
    """

    model: str = "base"
    replicates: Annotated[int, Field(ge=4)] = 6
    significance: Annotated[float, Field(gt=0, lt=1)] = 0.01
    jobs: Count = 0
    seed: Count = 0
    curve: bool = False


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Draft formulas for one model; write them and what they rest on.

    Raises:
        InputError: there is no diagnosis of the model, or nothing is left by it without a name.
    """
    diagnosis = run.read(DiagnoseResult, config.model)
    model = load_model(run, config.model)
    system = compile_model(model)
    axes = _axes_to_draft(diagnosis, system, run)
    timing = run.read(IdentifyResult, config.model).input_timing
    trials = read_measured_trials(run, system, every_input=True, timing=timing)
    trials = replace(trials, motions=tuple(trials.motions))
    settings = Settings(
        draft_replicates=config.replicates,
        draft_significance=config.significance,
        jobs=config.jobs or min(8, os.cpu_count() or 1),
        seed=config.seed,
    )
    source = _source(run.read(IngestResult))
    recipe = read_recipe(run, config.model, model)
    start = identified(run, config.model, system)
    found = draft(trials, recipe, start, axes, settings, source, config.curve, progress)
    effects: dict[str, DraftedEffect] = {}
    for axis in found:
        if not _beats_named_effects(axis, diagnosis, system, settings):
            continue
        for term in axis.terms:
            file = f"models/{config.model}/drafts/{term.name}.toml"
            write_text(out / file, write_toml(declare(term, source)))
            effects[term.canonical] = _effect(term, file, system)
    result = _result(found, effects, diagnosis, system)
    content = result.write(out)
    return {
        "axes": {
            axis: {
                "verdict": entry.verdict,
                "rmse_before": entry.rmse_before,
                "rmse_after": entry.rmse_after,
                "noise_floor": entry.noise_floor,
                "unit": entry.unit,
                "p_value": entry.chance[0].p_value,
                "sentence": entry.sentence,
            }
            for axis, entry in result.axes.items()
        },
        "selected": content["selected"],
    }


def _axes_to_draft(diagnosis: DiagnoseResult, system: System, run: RunFolder) -> list[int]:
    """Numbers of the axes that lack something without a name.

    Raises:
        NothingToDoError: there are none.
    """
    found = [system.coordinates.index(axis) for axis in diagnosis.unnamed_axes]
    if not found:
        raise NothingToDoError(
            f"nothing to draft: the diagnosis of model {diagnosis.model!r} leaves nothing unnamed",
            where=str(run.root),
            remedy="a formula is drafted where `remains` is true: something is left without a name",
        )
    return found


def _beats_named_effects(
    found: FoundDraft, diagnosis: DiagnoseResult, system: System, settings: Settings
) -> bool:
    """Whether the terms found leave less than the effects that the diagnosis names there."""
    entry = diagnosis.axes[system.coordinates[found.axis]]
    return not entry.effects or found.after < entry.rmse_after * np.exp(-settings.draft_worth)


def _source(session: IngestResult) -> str:
    """Where a draft comes from: dated by the recording, so that it is the same whenever made."""
    on = f", recorded on {session.recorded_at[:10]}" if session.recorded_at else ""
    return f"drafted by bampipe from {session.session_id}{on}"


def _effect(term: Term, file: str, system: System) -> DraftedEffect:
    form, unit = term.form, term.form.unit
    units = {name: unit for name in form.shape.strengths}
    units |= {name: of for name, (_, _, of) in form.limits().items()}
    at, mean, sd = term.curve()
    constants = {
        name: FittedConstant(
            value=value,
            low=value - 1.96 * term.sd[name],
            high=value + 1.96 * term.sd[name],
            unit=units[name],
        )
        for name, value in term.values.items()
    }
    is_curve = form.shape.name == "curve"
    numbers = ", ".join(
        f"{name} {round_with_sd(c.value, 0.5 * (c.high - c.low))} {c.unit}"
        for name, c in constants.items()
    )
    return DraftedEffect(
        file=file,
        axis=form.axis.name,
        expression=form.expression,
        acts_as=form.factor,
        constants=constants,
        summary=form.summary,
        looks_like=form.looks_like,
        sentence=f"{form.summary}." if is_curve else f"{form.summary}: {numbers}.",
        curve=DraftCurve(
            variable=form.coordinate.words,
            variable_unit=form.coordinate.unit,
            unit=unit,
            at=tuple(at),
            mean=tuple(mean),
            low=tuple(mean - 1.96 * sd),
            high=tuple(mean + 1.96 * sd),
            beside={quantity.words: span.high for quantity, span in form.beside},
        ),
    )


def _result(
    found: Sequence[FoundDraft],
    effects: dict[str, DraftedEffect],
    diagnosis: DiagnoseResult,
    system: System,
) -> DraftResult:
    axes = {
        system.coordinates[axis.axis]: _axis(axis, effects, diagnosis, system) for axis in found
    }
    selected = tuple(effects)
    if not selected and diagnosis.selected:
        named = " ".join(diagnosis.selected)
        advice = f"bampipe extend RUN {named} --model {diagnosis.model}"
    elif selected:
        advice = f"bampipe extend RUN {' '.join(selected)} --model {diagnosis.model}"
    else:
        advice = (
            "record more trials like these: what is missing follows nothing that a formula could "
            "be held against"
        )
    return DraftResult(
        model=diagnosis.model,
        sentence=" ".join(entry.sentence for entry in axes.values()),
        next=advice,
        axes=axes,
        effects=effects,
        selected=selected,
    )


def _axis(
    found: FoundDraft,
    effects: dict[str, DraftedEffect],
    diagnosis: DiagnoseResult,
    system: System,
) -> AxisDraft:
    axis, unit = system.coordinates[found.axis], system.torque_units[found.axis]
    names = tuple(term.canonical for term in found.terms if term.canonical in effects)
    beats_chance = len(found.options) > 1
    verdict: DraftVerdict = "drafted" if names else "nothing_beyond_chance"
    if beats_chance and not names:
        verdict = "no_lower_error"
    options = tuple(
        DraftOption(
            effects=tuple(name for _, name in option.terms),
            constants=option.constants,
            held_out_rmse=option.held_out_rmse[found.axis],
        )
        for option in found.options
    )
    return AxisDraft(
        verdict=verdict,
        effects=names,
        chance=found.chance,
        options=options,
        rmse_before=found.before,
        rmse_after=found.after if names else found.before,
        noise_floor=found.noise_floor,
        unit=unit,
        bound=found.bound,
        nearest=_nearest(axis, found, diagnosis, unit) if names else (),
        sentence=_sentence(found, [effects[name] for name in names], diagnosis.axes[axis], axis)
        + (_MORE_FORMULAS if found.wants_formulas else ""),
    )


def _nearest(
    axis: str, found: FoundDraft, diagnosis: DiagnoseResult, unit: str
) -> tuple[NearestEffect, ...]:
    """Effects of the library that come closest, and by how much the draft does better."""
    rows = [row for row in diagnosis.ranking if row.axis == axis]
    rows.sort(key=lambda row: row.held_out_rmse_after)
    return tuple(
        NearestEffect(
            effect=row.effect,
            held_out_rmse=row.held_out_rmse_after,
            sentence=(
                f"{row.effect} leaves {significant(row.held_out_rmse_after)} {unit}, "
                f"{row.held_out_rmse_after / max(found.after, 1e-30):.2g} times what the draft "
                "leaves"
            ),
        )
        for row in rows[:_NEAREST]
    )


def _sentence(
    found: FoundDraft, effects: Sequence[DraftedEffect], diagnosed: AxisVerdict, axis: str
) -> str:
    name, chance, unit = axis.capitalize(), found.chance[0], diagnosed.unit
    by_chance = (
        f"the best formula gains {chance.gain:.3g} in log likelihood on trials left out; on "
        f"{len(chance.gains)} replays, where nothing is missing, the same search gains "
        f"{np.mean(chance.gains):.2g} (p = {chance.p_value:.2g})"
    )
    if not effects and found.terms:
        return (
            f"{name}: no draft, for {', '.join(diagnosed.effects)} leaves no more "
            f"({significant(diagnosed.rmse_after)} {unit}) than the best formula "
            f"({significant(found.after)} {unit})."
        )
    if not effects and len(found.options) > 1:
        return f"{name}: no draft, for no formula lowers the held-out error enough; {by_chance}."
    if not effects:
        return f"{name}: no draft, for chance would have given as good a formula; {by_chance}."
    ratio = found.after / max(found.noise_floor, 1e-30)
    return (
        f"{name}: {' '.join(effect.sentence for effect in effects)} The held-out error falls from "
        f"{significant(found.before)} to {significant(found.after)} {unit}, {ratio:.2f} "
        f"times the noise floor{_beside_curve(found, unit)}; {by_chance}."
    )


def _beside_curve(found: FoundDraft, unit: str) -> str:
    """What a free curve would leave, where that is less."""
    if found.bound is None or found.bound.held_out_rmse > found.after:
        return ""
    return (
        f" (a free curve along {found.bound.variable} leaves "
        f"{significant(found.bound.held_out_rmse)} {unit})"
    )
