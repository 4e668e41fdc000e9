"""Stage diagnose: what the model lacks, axis by axis, and how sure that is."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.run_folder import FILTERED, INGESTED, RunFolder
from bampipe.data.store import write_parquet
from bampipe.declarations.model_file import IDENTIFIED_MODEL, identified, load_model, read_recipe
from bampipe.discover.candidates import list_candidates
from bampipe.discover.diagnosis import diagnose
from bampipe.discover.findings import Diagnosis
from bampipe.discover.settings import Settings
from bampipe.discover.shape import residual_map, variables, worst_windows
from bampipe.errors import InputError, NothingToDoError, did_you_mean
from bampipe.estimate.simulation import Runaway
from bampipe.identification.terms import effect_text
from bampipe.physics import compile_model, registry
from bampipe.physics.effect import effect_from
from bampipe.physics.recipe import Recipe
from bampipe.progress import Progress
from bampipe.results.diagnose import (
    DiagnoseResult,
    RankedEffect,
    ResidualMap,
)
from bampipe.results.identify import IdentifyResult
from bampipe.results.setup import SetupResult
from bampipe.results.standing import FLOOR_WRONG
from bampipe.results.terms import EffectText
from bampipe.schema import STRICT, Count, Distinct
from bampipe.trials.folds import HELD_OUT
from bampipe.trials.measured import MeasuredTrials, read_measured_trials, trial_of_block

_DESCRIBED = 12
"""Effects of the ranking whose formulas are stored with it."""

SUMMARY = "Find which physical effect the model lacks"
INPUTS = (*INGESTED, *FILTERED, "filter/setup.json?", *IDENTIFIED_MODEL)
OUTPUTS = ("models/{model}/diagnose.json", "models/{model}/map_variables.parquet")


@checked_dataclass(frozen=True, config=STRICT)
class Config:
    """Settings of the stage.

    Attributes:
        model: which model version to diagnose.
        replicates: replays of the fitted model for the chance level, and up to three times as many
            where a decision is close; more is slower and sharper.
        significance: chance of a false alarm in a session that is accepted.
        most_effects: the most effects that are tried before the search ends.
        jobs: worker processes; 0 means one for each processor, eight at most.
        seed: of the noise in the replays.
        trust_setup: whether to diagnose in spite of a mistake that was named in the set-up.
        without: effects that are not weighed, such as one that came to nothing when it was added.
    """

    model: str = "base"
    replicates: Annotated[int, Field(ge=4)] = 10
    significance: Annotated[float, Field(gt=0, lt=1)] = 0.01
    most_effects: Annotated[int, Field(ge=1)] = 8
    jobs: Count = 0
    seed: Count = 0
    trust_setup: bool = False
    without: Distinct[str] = ()


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Diagnose one model; write what it lacks, and what its residual was mapped against.

    Raises:
        InputError: fewer than two moving trials, a setting out of range, an axis that no force
            acts on, or a mistake in the set-up.
    """
    if not config.trust_setup:
        _require_sound_setup(run)
    model = load_model(run, config.model)
    system = compile_model(model)
    if system.undriven:
        raise InputError(
            f"no force acts on {system.undriven[0]}: with nothing measured to hold its equation"
            " against, whatever makes all of it smaller would seem to explain it",
            where=f"device {model.device.name!r}",
            remedy="judge its models by validate and compare",
        )
    timing = run.read(IdentifyResult, config.model).input_timing
    trials = read_measured_trials(run, system, every_input=True, timing=timing)
    fitted = sum(group != HELD_OUT for group in trials.folds.groups)
    if fitted < 2:
        raise InputError(
            f"a diagnosis needs at least two moving trials, found {fitted}",
            where=str(run.root),
            remedy="one trial is held out to judge the others; record more free trials",
        )
    trials = replace(trials, motions=tuple(trials.motions))
    recipe = read_recipe(run, config.model, model)
    _require_known(config.without, recipe)
    start = identified(run, config.model, system)
    settings = Settings(
        replicates=config.replicates,
        significance=config.significance,
        most_effects=config.most_effects,
        jobs=config.jobs or min(8, os.cpu_count() or 1),
        seed=config.seed,
    )
    try:
        found = diagnose(trials, recipe, start, settings, progress, config.without)
    except Runaway as error:
        raise NothingToDoError(
            f"model {config.model!r} cannot be diagnosed, for it cannot be replayed and so has no"
            f" chance level: {error.what}",
            where=str(run.root),
            remedy="judge it by validate and compare, and diagnose the model that it came from",
        ) from error
    samples = _map_variables(found)
    write_parquet(out / f"models/{config.model}/map_variables.parquet", samples)
    result = _result(found, trials, recipe, config)
    headline = "; ".join(f"{axis}: {words}" for axis, words in result.verdicts_in_words.items())
    return {"headline": headline, **_summary(result.write(out), result.limits)}


def _require_known(without: Sequence[str], recipe: Recipe) -> None:
    """Refuse a name of no effect, which would leave out nothing."""
    extra = [effect_from(effect) for effect in recipe.extra]
    known = list_candidates(recipe.model().device, (), extra)
    for name in without:
        if name not in known:
            raise InputError(
                f"{name!r} is no effect of this device{did_you_mean(name, known)}",
                where="diagnose.without",
                remedy="`bampipe effects` lists them",
            )


def _require_sound_setup(run: RunFolder) -> None:
    """Refuse to look for physics where the signals do not mean what is stated."""
    if not run.exists(SetupResult.FILE):
        return
    mistakes = run.read(SetupResult).mistakes
    if mistakes:
        raise InputError(
            f"no effect is looked for, since the set-up is wrong: {mistakes[0].sentence}"
            f" ({mistakes[0].evidence})",
            where=str(run.path(SetupResult.FILE)),
            remedy="correct the session file and run it again, or --set trust_setup=true",
        )


def _summary(result: dict[str, Any], limits: str) -> dict[str, object]:
    """What a person needs first: verdicts, the head of the ranking, what to record or do next."""
    notes = [limits] if limits else []
    if result["suggested_trial"]:
        notes.append(result["suggested_trial"]["sentence"])
    shown = ("verdict", "rmse_before", "rmse_after", "unit", "sentence")
    return {
        "axes": {
            axis: {**{k: entry[k] for k in shown}, "noise_floor_after": entry["noise_floor"]}
            for axis, entry in result["axes"].items()
        },
        "ranking": [
            {k: v for k, v in row.items() if k not in ("parameters", "score")}
            for row in result["ranking"][:5]
        ],
        "selected": result["selected"],
        "suggested_trial": result["suggested_trial"],
        "notes": notes,
    }


def _result(
    found: Diagnosis, trials: MeasuredTrials, recipe: Recipe, config: Config
) -> DiagnoseResult:
    names = found.evidence.system.coordinates
    return DiagnoseResult(
        model=config.model,
        trials=tuple(dict.fromkeys(trial_of_block(m.trial_id) for m in trials.weighed)),
        axes=dict(zip(names, found.axes, strict=True)),
        ranking=found.ranking,
        descriptions=_descriptions(found.ranking[:_DESCRIBED], recipe),
        selected=found.selected,
        groups=dict(found.groups),
        contests=dict(found.contests),
        steps=found.steps,
        transients=found.transients,
        refused=found.refused,
        suggested_trial=None,
        maps=_maps(found),
        worst_windows=tuple(worst_windows(found.initial)),
        not_weighed=config.without,
        sentence=" ".join(a.sentence for a in found.axes),
        next=_next(found, config.model),
    )


def _descriptions(ranking: Sequence[RankedEffect], recipe: Recipe) -> dict[str, EffectText]:
    own = {effect.name: effect for effect in map(effect_from, recipe.extra)}
    names = {entry.effect.partition(":")[0] for entry in ranking}
    return {name: effect_text(own.get(name) or registry.effect(name)) for name in sorted(names)}


def _maps(found: Diagnosis) -> dict[str, dict[str, ResidualMap]]:
    maps: dict[str, dict[str, ResidualMap]] = {}
    for i, axis in enumerate(found.initial.system.coordinates):
        drawn = [residual_map(found.initial, i, v) for v in variables(found.initial, i)]
        maps[axis] = {
            m.variable: ResidualMap(
                unit=m.unit,
                center=tuple(m.center),
                mean=tuple(m.mean),
                low=tuple(m.low),
                high=tuple(m.high),
                count=tuple(m.count),
                variance_share=m.share,
            )
            for m in drawn
        }
    return maps


def _map_variables(found: Diagnosis) -> pd.DataFrame:
    """Return map_variables.parquet: the variables of every axis' maps, sample by sample."""
    evidence = found.initial
    motions, band = evidence.motions, evidence.band
    rows = [band.thinned_rows(len(motion.t)) for motion in motions]
    trials = [trial_of_block(motion.trial_id) for motion in motions]
    columns: dict[str, object] = {
        "trial_id": np.repeat(trials, [len(k) for k in rows]),
        "t": np.concatenate([motion.t[k] for motion, k in zip(motions, rows, strict=True)]),
    }
    for i, axis in enumerate(evidence.system.coordinates):
        for variable in variables(evidence, i):
            columns[f"{axis}.{variable.name}"] = np.concatenate(variable.values)
    return pd.DataFrame(columns)


def _next(found: Diagnosis, model: str) -> str:
    by_axis = dict(zip(found.evidence.system.coordinates, found.axes, strict=True))
    undecided = [axis for axis, a in by_axis.items() if a.verdict == "undecided" and a.likely]
    if undecided:
        return f"bampipe next RUN --model {model}"
    if found.selected:
        return f"bampipe extend RUN {' '.join(found.selected)} --model {model}"
    wrong = [axis for axis, a in by_axis.items() if a.standing in FLOOR_WRONG]
    if wrong:
        return (
            f"the noise floor of {', '.join(wrong)} is wrong: hold the noise and resolution in "
            "session.toml against what `bampipe ingest` measured"
        )
    unknown = [axis for axis, a in by_axis.items() if a.verdict == "unknown_effect"]
    if unknown:
        return f"bampipe draft RUN --model {model}"
    return "nothing to add; `bampipe report RUN` writes it up"
