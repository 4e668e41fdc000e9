"""Stage next: the trial to record next, in one sentence, and what it is expected to give."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.run_folder import FILTERED, INGESTED, RunFolder
from bampipe.declarations.model_file import IDENTIFIED_MODEL, identified, load_model, read_recipe
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.session import Session, system_of, without_members
from bampipe.errors import InputError, NothingToDoError, choose_from
from bampipe.estimate.simulation import Runaway
from bampipe.files import digest_content, write_json
from bampipe.identification.filter_choice import FilterChoice
from bampipe.identification.sensor_noise import sensor_noise
from bampipe.next_trial.choice import Tried, Worth, find_best_of_each, rank_designs
from bampipe.next_trial.discrimination import Contest
from bampipe.next_trial.forecast import Forecast
from bampipe.next_trial.motion import TRAJECTORY_HZ, Rehearsal
from bampipe.next_trial.plan import Goal, plan_trials, record_plan
from bampipe.next_trial.precision import Precision
from bampipe.next_trial.primitives import Envelope, imitate_trials
from bampipe.next_trial.reasons import explain_proposal, find_shown
from bampipe.next_trial.sensitivity import HOPELESS, Blindness, find_blindness
from bampipe.next_trial.suggestion import find_ambiguity, make_contest
from bampipe.phrases.forecast import find_open, read_forecasts
from bampipe.physics import System, compile_model
from bampipe.physics.recipe import Recipe
from bampipe.progress import Progress
from bampipe.results.diagnose import AxisVerdict, DiagnoseResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.next import Detectable, NextResult, Plan, Purpose
from bampipe.results.validate import JudgedError, ValidateResult
from bampipe.schema import STRICT, Count
from bampipe.trials.measured import read_measured_trials, trial_of_block
from bampipe.trials.motion import Motion

SUMMARY = "The trial to record next, and what it is expected to give"
INPUTS = (
    *INGESTED,
    *FILTERED,
    *IDENTIFIED_MODEL,
    "models/{model}/validate.json?",
    "models/{model}/diagnose.json?",
)
OUTPUTS = (
    "models/{model}/next.json",
    "models/{model}/forecasts/*.json",
    "models/{model}/protocol*.pdf",
    "models/{model}/trajectory*.csv",
)

Array = NDArray[np.float64]

_SHOWN = 3
"""Proposals in the summary."""
_WATCHED = 12
"""Hidden effects that designs are tried for."""
_LITTLE = 0.05
"""Sum of log strengths by which a trial for hidden effects must lower what goes unnoticed."""


@checked_dataclass(frozen=True, config=STRICT)
class Config(Criteria):
    """Settings of the stage, those by which a diagnosis decides among them.

    Attributes:
        model: which model version.
        purpose: ``precision`` of all parameters; ``decision`` between effects that the diagnosis
            could not tell apart; ``sensitivity`` to effects that the trials at hand would not have
            shown; the name of a parameter; or ``auto``: what the diagnosis asks for.
        seconds: length of the trial.
        plan: whether to make a set of trials, and its protocol sheet.
        sd: goal of the plan for every standard deviation, as a share of the estimate.
        confusion: goal of the plan for every chance of confusing two effects.
        seed: seed of the variation between people, and of sensor noise.
        jobs: number of worker processes; 0 means one for each processor.
    """

    model: str = "base"
    purpose: str = "auto"
    seconds: Annotated[float, Field(ge=4, le=600)] = 20.0
    plan: bool = False
    sd: Annotated[float, Field(gt=0, lt=1)] = 0.05
    confusion: Annotated[float, Field(gt=0, lt=0.5)] = 0.05
    seed: Count = 0
    jobs: Count = 0


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Propose a trial for one identified model."""
    model = load_model(run, config.model)
    system = compile_model(model)
    if system.undriven:
        raise InputError(
            f"no force acts on {system.undriven[0]}: its motion cannot be prescribed, so no trial"
            " can be designed",
            where=f"device {model.device.name!r}",
        )
    p = identified(run, config.model, system)
    found = run.read(IdentifyResult, config.model)
    purpose, parameter = _split(config.purpose, list(found.parameters))
    diagnosed = None
    if run.exists(DiagnoseResult.file(config.model)):
        diagnosed = run.read(DiagnoseResult, config.model)
    elif purpose == "decision":
        raise InputError(
            "what is to be decided is not known yet",
            where=str(run.root),
            remedy=f"run `bampipe diagnose {run.root}{run.model_option(config.model)}` first",
        )
    progress(0.0, "what the trials at hand say")
    trials = read_measured_trials(run, system, every_input=True, timing=found.input_timing)
    trials = replace(trials, motions=tuple(trials.motions))
    recipe = read_recipe(run, config.model, model)
    session = Session(trials, config, config.jobs or os.cpu_count() or 1, config.seed)
    fitted = [trials.motions[k] for k in trials.folds.fitted_trials]
    noise = sensor_noise(trials.sensors, system, fitted, p, FilterChoice())
    seen = Envelope.of_trials(trials.motions, system, p)
    precision = Precision.of_trials(system, fitted, trials.band, p, found, noise)
    contest, blindness = None, None
    if diagnosed is not None and purpose in ("auto", "decision"):
        contest = _find_contest(session, recipe, system, p, diagnosed)
    if purpose == "decision" and contest is None:
        raise InputError(
            "the diagnosis left nothing to decide",
            where=str(run.path(DiagnoseResult.file(config.model))),
            remedy="ask for precision, sensitivity, or a parameter by name",
        )
    chosen = _settle(diagnosed, contest is not None) if purpose == "auto" else purpose
    if chosen == "sensitivity":
        progress(0.1, "what these trials would have shown of each effect")
        blindness = _find_blindness(session, recipe, p, diagnosed)
    judged = contest or (blindness.contest if blindness is not None else None)
    evidence = judged.fit.evidence if judged is not None else None
    # A design is followed with the model beside which effects are weighed on it.
    rehearsal = Rehearsal(
        evidence.system if evidence is not None else system,
        evidence.p if evidence is not None else p,
        trials.sensors,
        trials.kinematics,
        seen,
        config.seed,
    )
    forecast = Forecast(rehearsal, precision, contest)
    worth = _worth(chosen, parameter, forecast, blindness)
    axes = seen.movable
    if not axes:
        raise InputError("no axis moves in the trials at hand", where=str(run.root))

    free = [motion for motion in fitted if not _is_braked(motion, model.device.brakes)]
    alike = imitate_trials(free, seen, config.seconds)

    def rank(worth: Worth, of_effects: bool, first: float, least: float = -np.inf) -> list[Tried]:
        # No parameters are fitted to what has the brakes on, but for those of brakes.
        with_brakes = of_effects or system.braked

        def report(fraction: float, message: str) -> None:
            progress(first + 0.3 * fraction, message)

        return rank_designs(
            rehearsal, worth, config.seconds, axes, of_effects, with_brakes, report, alike, least
        )

    hidden = chosen == "sensitivity"
    tried = rank(worth, chosen != "precision", 0.2, _LITTLE if hidden else -np.inf)
    if hidden and (not tried or tried[0].worth < _LITTLE):
        # Nothing that a person could do here shows more: then for the parameters.
        tried = rank(_worth("precision", "", forecast, None), False, 0.5)
    progress(0.9, "what they are expected to give")
    proposals = tuple(forecast.proposal(one) for one in tried)
    best = proposals[0]
    table = _sensitivity(blindness, tried[0]) if blindness else {}
    plan: Plan | None = None
    if config.plan:
        progress(0.92, "planning a set of trials")
        estimates = [found.parameters[name].estimate for name in precision.names]
        goal = _goal(config, np.array(estimates), contest is None)
        # What the best design for all leaves too uncertain gets a design of its own.
        places = {name: k for k, name in enumerate(precision.names)}
        poor = [name for name, sd in best.sd.items() if sd.after > goal.sd[places[name]]]
        if poor:
            worths = [
                partial(precision.worth, seconds=config.seconds, parameter=name) for name in poor
            ]
            tried += find_best_of_each(
                rehearsal, precision.of_motion, worths, config.seconds, axes, alike
            )
        plan = record_plan(forecast, goal, plan_trials(forecast, tried, goal))
    unlimited = [axis for axis in system.coordinates if axis not in model.device.limits]
    lacking = _lacking(run, config.model, diagnosed)
    missing = diagnosed.selected if diagnosed is not None else None
    unbraked = blindness.of_brakes if blindness and not seen.field.any() else ()
    unpromised = tuple(blindness.unpromised) if blindness else ()
    reasons = explain_proposal(
        chosen, parameter, best, table, unlimited, lacking, missing, unbraked, unpromised
    )
    result = NextResult(
        model=config.model,
        purpose=chosen,
        parameter=parameter,
        trials=tuple(dict.fromkeys(trial_of_block(m.trial_id) for m in trials.motions)),
        sentence=best.sentence,
        why=reasons.why,
        expected=reasons.expected,
        proposals=proposals,
        sensitivity=table,
        unpromised=unpromised,
        shows=find_shown(table),
        plan=plan,
    )
    result.write(out)
    _write_earlier(run, out, result)
    followed = ""
    if model.device.robot is not None:
        # A controller follows positions, where a person follows a sentence.
        t, q = rehearsal.trajectory(tried[0].design)
        head, file = ",".join(["t", *system.coordinates]), f"models/{config.model}/trajectory.csv"
        path = np.column_stack([t, q])
        np.savetxt(out / file, path, "%.6f", ",", header=head, comments="")
        followed = (
            f"{file} of the run has the positions of the joints along it, {TRAJECTORY_HZ:g} a"
            " second; check them for collisions, of which the model knows none."
        )
    if plan is not None:
        # typst is slow to import: only here
        from bampipe.report.protocol import protocol_sheet

        by_hand = not (model.device.drive or model.device.prescribed)
        name = run.read(IngestResult).session_id
        sheet = protocol_sheet(plan, name, config.model, by_hand)
        (out / f"models/{config.model}/protocol.pdf").write_bytes(sheet)
    return _summary(result, followed)


def _write_earlier(run: RunFolder, out: Path, result: NextResult) -> None:
    """Write the earlier proposals whose trial may still come, each named by its content."""
    for one in find_open(read_forecasts(run.root, result.model), result):
        content = one.model_dump(mode="json")
        name = f"{digest_content(content)[:12]}.json"
        write_json(out / NextResult.EARLIER.format(model=result.model) / name, content)


def _split(asked: str, names: Sequence[str]) -> tuple[Purpose | Literal["auto"], str]:
    """The purpose that ``asked`` means, and the parameter where it is one of ``names``."""
    if asked in names:
        return "precision", asked
    for purpose in ("auto", *get_args(Purpose)):
        if asked == purpose:
            return purpose, ""
    raise InputError(
        f"nothing is called {asked!r} that a trial could be for",
        remedy=choose_from(asked, ["auto", *get_args(Purpose), *names]),
    )


def _settle(diagnosed: DiagnoseResult | None, is_open: bool) -> Purpose:
    """What a trial is for where nobody says: what the diagnosis left open, or would not show."""
    if is_open:
        return "decision"
    verdicts = [axis.verdict for axis in diagnosed.axes.values()] if diagnosed else [""]
    return "sensitivity" if set(verdicts) == {"nothing_missing"} else "precision"


def _find_contest(
    session: Session, recipe: Recipe, system: System, p: Array, diagnosed: DiagnoseResult
) -> Contest | None:
    """The rivals that a diagnosis left; None where it decided, or they cannot be replayed."""
    asked = find_ambiguity(diagnosed, session.criteria)
    if asked is None:
        return None
    final = without_members(recipe, (), diagnosed.selected)
    known = {name: v for row in diagnosed.ranking for name, v in row.parameters.items()}
    known |= {q.name: value for q, value in zip(system.parameters, p, strict=True)}
    start = np.array([known.get(q.name, q.prior) for q in system_of(final).parameters])
    fit = session.try_fit(final, start)
    return make_contest(session, fit, asked) if fit is not None else None


def _find_blindness(
    session: Session, recipe: Recipe, p: Array, diagnosed: DiagnoseResult | None
) -> Blindness:
    """What the trials would have shown of each effect, were it beside the model as it is."""
    try:
        fit = session.fit(recipe, p)
    except Runaway as error:
        raise NothingToDoError(
            f"what these trials would have shown is not known, for the model cannot be replayed:"
            f" {error.what}",
            where="next",
            remedy="ask for precision or for a parameter by name",
        ) from error
    chance = diagnosed.chance if diagnosed is not None else None
    return find_blindness(session, fit, chance.largest if chance is not None else ())


def _lacking(run: RunFolder, model: str, diagnosed: DiagnoseResult | None) -> list[str]:
    """Axes whose held-out error is above the noise floor."""
    entries: Mapping[str, AxisVerdict | JudgedError] = {}
    if diagnosed is not None:
        entries = diagnosed.axes
    elif run.exists(ValidateResult.file(model)):
        entries = run.read(ValidateResult, model).axes
    return [axis for axis, entry in entries.items() if entry.standing == "above_floor"]


def _goal(config: Config, estimates: Array, is_complete: bool) -> Goal:
    """What a plan is to reach; no uncertainty of parameters where the model lacks something."""
    asked = np.where(is_complete & (estimates != 0.0), config.sd * np.abs(estimates), np.inf)
    return Goal(asked, config.confusion)


def _worth(
    purpose: Purpose, parameter: str, forecast: Forecast, blindness: Blindness | None
) -> Worth:
    precision = forecast.precision
    if purpose == "decision":
        return lambda motion: -forecast.confusion_with(motion)
    if blindness is not None and blindness.hidden:
        watched = blindness.narrowed(blindness.hidden[:_WATCHED])
        now = np.minimum([v.factor for v in watched.found], HOPELESS)

        def shown(motion: Motion) -> float:
            then = np.clip(watched.factors_with([motion]), 1.0, now)
            return float(np.sum(np.log(now / then)))

        return shown
    return lambda motion: precision.worth(
        precision.of_motion(motion), float(motion.t[-1]), parameter
    )


def _is_braked(motion: Motion, brakes: Mapping[str, str]) -> bool:
    return any(motion.channels[name].any() for name in brakes.values() if name in motion.channels)


def _sensitivity(blindness: Blindness, best: Tried) -> dict[str, Detectable]:
    """The smallest strength of each effect that shows, without and with the best trial."""
    after = np.median([blindness.factors_with([motion]) for motion in best.usual], axis=0)
    axes = blindness.contest.fit.evidence.system.coordinates
    return {
        found.rival.name: Detectable(
            parameter=found.parameter.name,
            smallest=found.factor * found.typical if found.factor < HOPELESS else None,
            typical=found.typical,
            unit=found.parameter.unit,
            axis=axes[found.axis] if found.factor < HOPELESS else "",
            with_proposal=factor * found.typical if factor < HOPELESS else None,
        )
        for found, factor in zip(blindness.found, after, strict=True)
        if found.is_promised
    }


def _summary(result: NextResult, followed: str) -> dict[str, object]:
    """The sentence first, then why and what for; the runners-up beside their worth.

    Args:
        result: what is proposed; followed: where a robot's controller finds it, "" without one.
    """
    planned = [f"plan: {result.plan.sentence}"] if result.plan is not None else []
    return {
        "headline": result.sentence,
        "why": result.why,
        "expected": result.expected,
        "notes": [result.why, result.expected, *planned, *([followed] if followed else [])],
        "purpose": result.purpose,
        "proposals": [
            {"worth": one.worth, "sentence": one.sentence} for one in result.proposals[:_SHOWN]
        ],
    }
