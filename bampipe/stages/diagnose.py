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
from bampipe.discover.advice import advise
from bampipe.discover.diagnosis import diagnose
from bampipe.discover.findings import Diagnosis
from bampipe.discover.influence import Stretch as FoundStretch
from bampipe.discover.sentences import axis_sentences
from bampipe.discover.settings import Settings
from bampipe.discover.shape import residual_map, variables, worst_windows
from bampipe.errors import InputError
from bampipe.identification.terms import effect_text
from bampipe.physics import compile_model, registry
from bampipe.physics.effect import effect_from
from bampipe.physics.recipe import Recipe
from bampipe.progress import Progress
from bampipe.results.diagnose import (
    AxisVerdict,
    Contender,
    DiagnoseResult,
    OtherBand,
    RankedEffect,
    ResidualMap,
    Step,
    Stretch,
    SuggestedTrial,
    TransientCandidate,
    WorstWindow,
)
from bampipe.results.identify import IdentifyResult
from bampipe.results.setup import SetupResult
from bampipe.results.standing import FLOOR_WRONG
from bampipe.results.terms import EffectText
from bampipe.schema import STRICT, Count
from bampipe.trials.folds import HELD_OUT
from bampipe.trials.measured import MeasuredTrials, read_measured_trials

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
        replicates: replays of the fitted model for the chance level; more is slower and sharper.
        significance: chance of a false alarm in a session that is accepted.
        most_effects: the most effects that are tried before the search ends.
        jobs: worker processes; 0 means one for each processor, eight at most.
        seed: of the noise in the replays.
        trust_setup: whether to diagnose in spite of a mistake that was named in the set-up.
    """

    model: str = "base"
    replicates: Annotated[int, Field(ge=4)] = 10
    significance: Annotated[float, Field(gt=0, lt=1)] = 0.01
    most_effects: Annotated[int, Field(ge=1)] = 8
    jobs: Count = 0
    seed: Count = 0
    trust_setup: bool = False


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
    start = identified(run, config.model, system)
    settings = Settings(
        replicates=config.replicates,
        significance=config.significance,
        most_effects=config.most_effects,
        jobs=config.jobs or min(8, os.cpu_count() or 1),
        seed=config.seed,
    )
    found = diagnose(trials, recipe, start, settings, progress)
    samples = _map_variables(found)
    write_parquet(out / f"models/{config.model}/map_variables.parquet", samples)
    return _summary(_result(found, trials, recipe, config.model).write(out))


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


def _summary(result: dict[str, Any]) -> dict[str, object]:
    """What a person needs first: verdicts, the head of the ranking, what to record or do next."""
    notes = [result["suggested_trial"]["sentence"]] if result["suggested_trial"] else []
    shown = ("verdict", "rmse_before", "rmse_after", "noise_floor", "unit", "explainable_share")
    return {
        "axes": {
            axis: {k: entry[k] for k in (*shown, "sentence")}
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


def _result(found: Diagnosis, trials: MeasuredTrials, recipe: Recipe, model: str) -> DiagnoseResult:
    names = found.evidence.system.coordinates
    units = found.evidence.system.torque_units
    sentences = axis_sentences(found)
    axes = {
        axis: AxisVerdict(
            verdict=a.verdict,
            explainable_share=a.explainable_share,
            explainable_after=a.explainable_after,
            explainable_chance=a.explainable_chance,
            rmse_before=a.rmse_before,
            rmse_after=a.rmse_after,
            noise_floor=a.noise_floor,
            noise_floor_sd=a.floor_sd,
            standing=a.standing,
            worst_second=_stretch(a.worst_second),
            rmse_without_worst_second=a.rmse_without_second,
            other_band=OtherBand(**vars(found.other_band[i])) if found.other_band[i] else None,
            unit=units[i],
            effects=a.effects,
            likely=dict(a.odds),
            remains=a.remains,
            explained_by_effects=a.explained,
            sentence=sentences[axis],
        )
        for i, (axis, a) in enumerate(zip(names, found.axes, strict=True))
    }
    ranking = tuple(
        RankedEffect(
            effect=r.effect,
            axis=names[r.axis],
            held_out_rmse_before=r.held_out_rmse_before,
            held_out_rmse_after=r.held_out_rmse_after,
            unit=units[r.axis],
            p_value=r.p_value,
            score=r.score,
            parameters=dict(r.values),
            indistinguishable_from=r.indistinguishable_from,
        )
        for r in found.ranking
    )
    contests = {
        effect: tuple(Contender(**vars(c) | {"axis": names[c.axis]}) for c in contest)
        for effect, contest in found.contests.items()
    }
    return DiagnoseResult(
        model=model,
        axes=axes,
        ranking=ranking,
        descriptions=_descriptions(ranking[:_DESCRIBED], recipe),
        selected=found.selected,
        groups=dict(found.groups),
        contests=contests,
        steps=tuple(
            Step(
                effects=step.effects,
                held_out_rmse=dict(zip(names, step.held_out_rmse, strict=True)),
            )
            for step in found.steps
        ),
        transients=tuple(
            TransientCandidate(effect=effect, axis=names[axis], second=_stretch(second))
            for effect, (axis, second) in found.transient.items()
        ),
        suggested_trial=_suggestion(found, trials, recipe),
        maps=_maps(found),
        worst_windows=tuple(
            WorstWindow(**vars(w), unit=units[names.index(w.axis)])
            for w in worst_windows(found.initial)
        ),
        sentence=" ".join(sentences.values()),
        next=_next(found, model),
    )


def _descriptions(ranking: Sequence[RankedEffect], recipe: Recipe) -> dict[str, EffectText]:
    own = {effect.name: effect for effect in map(effect_from, recipe.extra)}
    names = {entry.effect.partition(":")[0] for entry in ranking}
    return {name: effect_text(own.get(name) or registry.effect(name)) for name in sorted(names)}


def _stretch(found: FoundStretch) -> Stretch:
    return Stretch(trial_id=found.trial_id, t_start=found.t_start, t_end=found.t_end)


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
    rows = [band.kept(len(motion.t)) for motion in motions]
    columns: dict[str, object] = {
        "trial_id": np.repeat([motion.trial_id for motion in motions], [len(k) for k in rows]),
        "t": np.concatenate([motion.t[k] for motion, k in zip(motions, rows, strict=True)]),
    }
    for i, axis in enumerate(evidence.system.coordinates):
        for variable in variables(evidence, i):
            columns[f"{axis}.{variable.name}"] = np.concatenate(variable.values)
    return pd.DataFrame(columns)


def _suggestion(found: Diagnosis, trials: MeasuredTrials, recipe: Recipe) -> SuggestedTrial | None:
    """The trial that would tell apart two effects that these trials do not."""
    pairs = [(name, group[0]) for name, group in found.groups.items() if group]
    pairs += [
        (first, second)
        for a in found.axes
        if len(a.odds) > 1 and not a.effects
        for first, second in [list(a.odds)[:2]]
    ]
    ranked = {r.effect: r for r in found.ranking}
    for first, second in pairs:
        if first not in ranked or second not in ranked:
            continue
        axis = ranked[first].axis
        values = {n: np.array(list(ranked[n].values.values())) for n in (first, second)}
        floor = found.axes[axis].noise_floor
        advice = advise(trials, recipe, found.initial, axis, first, second, values, floor)
        if advice is None:
            continue
        return SuggestedTrial(
            between=(first, second),
            axis=found.initial.system.coordinates[axis],
            design=advice.design,
            separation=advice.separation,
            separation_now=advice.separation_now,
            sentence=(
                f"To tell {first} from {second}, record {advice.design}: taking one for the "
                f"other would there leave {advice.separation:.1f} noise floors, against "
                f"{advice.separation_now:.1f} in these trials."
            ),
        )
    return None


def _next(found: Diagnosis, model: str) -> str:
    if found.selected:
        return f"bampipe extend RUN {' '.join(found.selected)} --model {model}"
    by_axis = dict(zip(found.evidence.system.coordinates, found.axes, strict=True))
    wrong = [axis for axis, a in by_axis.items() if a.standing in FLOOR_WRONG]
    if wrong:
        return (
            f"the noise floor of {', '.join(wrong)} is wrong: hold the noise and resolution in "
            "session.toml against what `bampipe ingest` measured"
        )
    unknown = [axis for axis, a in by_axis.items() if a.verdict == "unknown_effect"]
    if unknown:
        return f"bampipe draft RUN --model {model}"
    undecided = [axis for axis, a in by_axis.items() if a.verdict == "undecided" and a.odds]
    if undecided:
        return (
            f"record more trials like these that move {', '.join(undecided)}, or try the likeliest "
            f"with `bampipe extend RUN {next(iter(by_axis[undecided[0]].odds))} --model {model}`"
        )
    return "nothing to add; `bampipe report RUN` writes it up"
