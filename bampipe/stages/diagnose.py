"""Stage diagnose: the effects that the model lacks, by axis, with probabilities."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.refusals import refusal
from bampipe.data.run_folder import FILTERED, INGESTED, RunFolder
from bampipe.data.store import write_parquet
from bampipe.declarations.model_file import IDENTIFIED_MODEL, load_model, read_estimate, read_spec
from bampipe.diagnosis.candidates import list_candidates
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.description import describe
from bampipe.diagnosis.select import Selection, select_effects
from bampipe.diagnosis.session import Session
from bampipe.diagnosis.shape import residual_map, variables, worst_windows
from bampipe.diagnosis.verdict import conclude
from bampipe.errors import NothingToDoError, did_you_mean
from bampipe.estimate.simulation import Runaway
from bampipe.next_trial.suggestion import suggest_trial
from bampipe.phrases import diagnosis as phrases
from bampipe.physics import compile_model, registry
from bampipe.physics.effect import effect_from
from bampipe.physics.model_spec import ModelSpec
from bampipe.progress import Progress
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.setup import SetupResult
from bampipe.results.terms import EffectText
from bampipe.schema import STRICT, Count, Distinct
from bampipe.trials.folds import HELD_OUT
from bampipe.trials.linearisation import Linearisation
from bampipe.trials.measured import read_measured_trials, trial_of_block

_DESCRIBED = 12
"""Effects of the ranking whose formulas are stored with it."""

SUMMARY = "Find which physical effect the model lacks"
INPUTS = (*INGESTED, *FILTERED, "filter/setup.json?", *IDENTIFIED_MODEL)
OUTPUTS = ("models/{model}/diagnose.json", "models/{model}/map_variables.parquet")


@checked_dataclass(frozen=True, config=STRICT)
class Config(Criteria):
    """Settings of the stage; docs/method_selection.md describes each number.

    Attributes:
        model: which model version to diagnose.
        jobs: number of worker processes; 0 means one for each processor, eight at most.
        seed: seed of the noise in the replicates.
        trust_setup: whether to diagnose in spite of a mistake in the set-up.
        without: effects that are not weighed, such as one that was added in vain.
        also: effects that are weighed on request only, such as loose_link:elbow.
    """

    model: str = "base"
    jobs: Count = 0
    seed: Count = 0
    trust_setup: bool = False
    without: Distinct[str] = ()
    also: Distinct[str] = ()


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Diagnose one model; write its missing effects and the variables of the residual maps.

    Raises:
        InputError: fewer than two moving trials, a setting out of range, an axis that no force
            acts on, or a mistake in the set-up.
    """
    setup = None if config.trust_setup else run.find(SetupResult)
    if setup is not None and setup.mistakes:
        raise refusal("wrong_set_up", str(run.path(SetupResult.FILE)), first=setup.mistakes[0])
    model = load_model(run, config.model)
    system = compile_model(model)
    if system.undriven:
        where = f"device {model.device.name!r}"
        raise refusal("no_measured_side", where, axis=system.undriven[0])
    timing = run.read(IdentifyResult, config.model).input_timing
    trials = read_measured_trials(run, system, every_input=True, timing=timing)
    fitted = sum(group != HELD_OUT for group in trials.folds.groups)
    if fitted < 2:
        raise refusal("too_few_moving", str(run.root), found=fitted)
    trials = replace(trials, motions=tuple(trials.motions))
    spec = read_spec(run, config.model, model)
    for setting in ("without", "also"):
        _require_known(getattr(config, setting), spec, setting)
    start = read_estimate(run, config.model, system)
    jobs = config.jobs or min(8, os.cpu_count() or 1)
    session = Session(trials, config, jobs, config.seed, config.also)
    try:
        selection = select_effects(session, spec, start, config.without, progress)
    except Runaway as error:
        raise NothingToDoError(
            f"model {config.model!r} cannot be diagnosed, because it cannot be simulated and so"
            f" has no noise floor: {error.what}",
            where=str(run.root),
            remedy="judge it by validate and compare, and diagnose the model that it came from",
        ) from error
    samples = _map_variables(selection.initial.linearisation)
    write_parquet(out / f"models/{config.model}/map_variables.parquet", samples)
    progress(0.95, "looking for a trial that would decide")
    result = _result(session, selection, spec, config)
    trial = suggest_trial(session, selection.final, result)
    result = result.model_copy(update={"suggested_trial": trial})
    headline = "; ".join(f"{axis}: {phrases.verdict(result, axis)}" for axis in result.axes)
    return {"headline": headline, **_summary(result.write(out), phrases.limits(result))}


def _require_known(names: Sequence[str], spec: ModelSpec, setting: str) -> None:
    """Refuse an unknown effect, which would change nothing."""
    extra = [effect_from(effect) for effect in spec.extra]
    known = list_candidates(spec.model().device, (), extra, on_request=True)
    for name in names:
        if name not in known:
            near = did_you_mean(name, known)
            raise refusal("no_such_effect", f"diagnose.{setting}", name=name, near=near)


def _summary(result: dict[str, Any], limits: str) -> dict[str, object]:
    """Return the summary for a person: verdicts, the head of the ranking, the next step."""
    trial = result["suggested_trial"] or {"sentence": ""}
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
        "notes": [*filter(None, (limits, trial["sentence"]))],
    }


def _result(
    session: Session, selection: Selection, spec: ModelSpec, config: Config
) -> DiagnoseResult:
    found, given = conclude(session, selection), selection.initial.linearisation
    names = given.system.coordinates
    own = {effect.name: effect for effect in map(effect_from, spec.extra)}
    known = sorted({entry.effect.partition(":")[0] for entry in found.ranking[:_DESCRIBED]})
    maps = {}
    for i, axis in enumerate(names):
        known_here = variables(given.fitted, given.band, i)
        maps[axis] = {one.name: residual_map(given, i, one) for one in known_here}
    result = DiagnoseResult.of(
        found,
        selection,
        model=config.model,
        trials=tuple(dict.fromkeys(trial_of_block(m.trial_id) for m in session.trials.weighed)),
        axes=dict(zip(names, found.axes, strict=True)),
        descriptions={
            name: EffectText.of(own.get(name) or registry.effect(name)) for name in known
        },
        fitted=selection.final.effect_parameters,
        suggested_trial=None,
        maps=maps,
        worst_windows=tuple(worst_windows(given)),
        not_weighed=config.without,
        sentence="",
        next="",
    )
    result = result.model_copy(update={"next": _next(result, bool(spec.effects))})
    shapes = {}
    for i, (axis, entry) in enumerate(result.axes.items()):
        if entry.remains:
            fit = selection.final if entry.effects else selection.initial
            shapes[axis] = describe(fit.linearisation, i)
    said = phrases.describe_axes(result, shapes)
    axes = {
        axis: entry.model_copy(update={"sentence": said[axis]})
        for axis, entry in result.axes.items()
    }
    return result.model_copy(update={"axes": axes, "sentence": " ".join(said.values())})


def _map_variables(linearisation: Linearisation) -> pd.DataFrame:
    """Return map_variables.parquet: the variables of every axis' maps, sample by sample."""
    motions, band = linearisation.motions, linearisation.band
    rows = [band.thinned_rows(len(motion.t)) for motion in motions]
    trials = [trial_of_block(motion.trial_id) for motion in motions]
    columns: dict[str, object] = {
        "trial_id": np.repeat(trials, [len(k) for k in rows]),
        "t": np.concatenate([motion.t[k] for motion, k in zip(motions, rows, strict=True)]),
    }
    for i, axis in enumerate(linearisation.system.coordinates):
        for variable in variables(linearisation.fitted, band, i):
            columns[f"{axis}.{variable.name}"] = np.concatenate(variable.values)
    return pd.DataFrame(columns)


def _next(result: DiagnoseResult, extended: bool) -> str:
    """Return the next step; an ``extended`` model gets no effect that would imitate an unknown."""
    verdicts = {axis: entry.verdict for axis, entry in result.axes.items()}
    if "undecided" in verdicts.values():
        return f"bampipe next RUN --model {result.model}"
    if result.selected and not (extended and result.remainder_unknown):
        return f"bampipe extend RUN {' '.join(result.selected)} --model {result.model}"
    if wrong := [axis for axis, verdict in verdicts.items() if verdict == "no_verdict"]:
        return (
            f"{', '.join(wrong)} cannot be judged: compare the noise and resolution in"
            " session.toml with those that `bampipe ingest` measured"
        )
    if "unknown_effect" in verdicts.values():
        return f"bampipe draft RUN --model {result.model}"
    return "nothing to add; `bampipe report RUN` writes the report"
