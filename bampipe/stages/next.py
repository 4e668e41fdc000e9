"""Stage next: the trial to record next, in one sentence, and its expected gain."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.arrays import Array
from bampipe.data.chain import read_tree
from bampipe.data.refusals import refusal
from bampipe.data.robot_tree import identifier
from bampipe.data.run_folder import FILTERED, INGESTED, RunFolder
from bampipe.declarations.model_file import IDENTIFIED_MODEL, load_model, read_estimate, read_spec
from bampipe.declarations.recording import DRAWING
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.session import Session, change_effects, system_of
from bampipe.errors import InputError, NothingToDoError, choose_from
from bampipe.estimate.simulation import Runaway
from bampipe.files import digest_content, write_json, write_text
from bampipe.identification.sensor_noise import FilterChoice, untuned_settings
from bampipe.next_trial.discrimination import Comparison
from bampipe.next_trial.forecast import Forecast
from bampipe.next_trial.plan import Goal, plan_trials
from bampipe.next_trial.precision import Precision
from bampipe.next_trial.primitives import Envelope, imitate_trials
from bampipe.next_trial.ranking import (
    DesignSpace,
    RankedDesign,
    count_affordable,
    find_best_of_each,
    rank_designs,
)
from bampipe.next_trial.rehearsal import Rehearsal
from bampipe.next_trial.sensitivity import Detectability, find_detectability
from bampipe.next_trial.suggestion import compare_alternatives, find_ambiguity
from bampipe.next_trial.trajectory import Points, list_trajectories, read_limits, require_limits
from bampipe.phrases.forecast_outcome import find_open, read_forecasts
from bampipe.phrases.proposal import explain_proposal, find_shown, say_trajectory
from bampipe.physics import System, compile_model
from bampipe.physics.model_spec import ModelSpec
from bampipe.progress import Progress
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.identify import IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.next import Detectable, Extent, NextResult, Plan, Proposal, Purpose, Trajectory
from bampipe.results.validate import ValidateResult
from bampipe.schema import STRICT, Count
from bampipe.trials.measured import read_measured_trials, trial_of_block
from bampipe.trials.motion import Motion

SUMMARY = "The trial to record next, and its expected gain"
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
    "models/{model}/trajectory.*",
)


_SHOWN = 3
"""Proposals in the summary."""
_WATCHED = 12
"""Hidden effects that designs are ranked for."""
_LITTLE = 0.05
"""Least fall of the log detection limits, summed, by a trial for hidden effects."""


@checked_dataclass(frozen=True, config=STRICT)
class Config(Criteria):
    """Settings of the stage, those by which a diagnosis decides among them.

    Attributes:
        model: which model version.
        purpose: ``precision`` of all parameters; ``decision`` between effects that the diagnosis
            could not distinguish; ``sensitivity`` to effects that the present trials would not have
            shown; the name of a parameter; or ``auto``: by the diagnosis.
        seconds: length of the trial.
        plan: whether to make a set of trials, and its protocol sheet.
        trajectory: ``csv``, ``json`` or ``yaml``: the trial is a trajectory that drives follow, in
            a file of this form; empty: it is a motion that a person follows.
        sd: goal of the plan for every standard deviation, as a share of the estimate.
        confusion: goal of the plan for every chance of confusing two effects.
        seed: seed of the variation between people, and of sensor noise.
        jobs: number of worker processes; 0 means one for each processor.
    """

    model: str = "base"
    purpose: str = "auto"
    seconds: Annotated[float, Field(ge=4, le=600)] = 20.0
    plan: bool = False
    trajectory: Literal["", "csv", "json", "yaml"] = ""
    sd: Annotated[float, Field(gt=0, lt=1)] = 0.05
    confusion: Annotated[float, Field(gt=0, lt=0.5)] = 0.05
    seed: Count = 0
    jobs: Count = 0


@dataclass(frozen=True)
class _Case:
    """An identified model with its parameters, its trials and diagnosis, and the request."""

    run: RunFolder
    config: Config
    spec: ModelSpec
    system: System
    p: Array
    identified: IdentifyResult
    diagnosed: DiagnoseResult | None
    session: Session
    seen: Envelope
    limits: Mapping[str, Extent]

    @property
    def fitted(self) -> list[Motion]:
        """The trials to which the parameters were fitted."""
        trials = self.session.trials
        return [trials.motions[k] for k in trials.folds.fitted_trials]


def execute(run: RunFolder, out: Path, config: Config, progress: Progress) -> dict[str, object]:
    """Propose a trial for one identified model."""
    case, purpose, parameter = _read_case(run, config, progress)
    forecast = _make_forecast(case, purpose, progress)
    space = _lay_out_designs(case, forecast)
    ranked = _rank(forecast, space, parameter, progress)
    progress(0.9, "forecasting their gain")
    result = _record(case, forecast, parameter, ranked)
    if config.trajectory:
        result = _write_trajectory(out, case, forecast.rehearsal, ranked[0], result)
    if config.plan:
        progress(0.92, "planning a set of trials")
        plan = _plan_trials(case, forecast, space, ranked, result.proposals[0])
        result = result.model_copy(update={"plan": plan})
    result.write(out)
    # Earlier proposals whose trial may still come, each named by its content.
    for one in find_open(read_forecasts(run.root, result.model), result):
        content = one.model_dump(mode="json")
        name = f"{digest_content(content)[:12]}.json"
        write_json(out / NextResult.EARLIER.format(model=result.model) / name, content)
    if result.plan is not None:
        # typst is slow to import: only here
        from bampipe.report.protocol import protocol_sheet

        device = case.system.model.device
        by_hand = not (device.drive or device.prescribed)
        name = run.read(IngestResult).session_id
        sheet = protocol_sheet(result.plan, name, config.model, by_hand)
        (out / f"models/{config.model}/protocol.pdf").write_bytes(sheet)
    return _summary(result)


def _read_case(
    run: RunFolder, config: Config, progress: Progress
) -> tuple[_Case, Purpose | Literal["auto"], str]:
    """Return the model with its results, and the requested purpose and parameter."""
    model = load_model(run, config.model)
    if config.trajectory:
        require_limits(model.device, f"device {model.device.name!r}")
    system = compile_model(model)
    if system.undriven:
        where = f"device {model.device.name!r}"
        raise refusal("not_prescribed", where, axis=system.undriven[0])
    p, found = read_estimate(run, config.model, system), run.read(IdentifyResult, config.model)
    purpose, parameter = _split(config.purpose, list(found.parameters))
    diagnosed = run.find(DiagnoseResult, config.model)
    if diagnosed is None and purpose == "decision":
        model_option = run.model_option(config.model)
        raise refusal("no_diagnosis", str(run.root), root=run.root, option=model_option)
    progress(0.0, "information in the present trials")
    trials = read_measured_trials(run, system, every_input=True, timing=found.input_timing)
    session = Session(trials, config, config.jobs or os.cpu_count() or 1, config.seed)
    seen = Envelope.of_trials(trials.motions, system, p)
    if not seen.moved_axes:
        raise InputError("no axis moves in the present trials", where=str(run.root))
    limits = read_limits(model.device, seen) if config.trajectory else {}
    spec = read_spec(run, config.model, model)
    case = _Case(run, config, spec, system, p, found, diagnosed, session, seen, limits)
    return case, purpose, parameter


def _make_forecast(case: _Case, asked: Purpose | Literal["auto"], progress: Progress) -> Forecast:
    """Prepare a forecast for the purpose asked for, or else for what the diagnosis left open."""
    trials, comparison, detectability = case.session.trials, None, None
    if asked in ("auto", "decision") and case.diagnosed is not None:
        comparison = _compare_alternatives(case, case.diagnosed)
    if asked == "decision" and comparison is None:
        file = case.run.path(DiagnoseResult.file(case.config.model))
        raise refusal("nothing_to_decide", str(file))
    if asked == "auto" and comparison is None and case.diagnosed is not None:
        verdicts = {axis.verdict for axis in case.diagnosed.axes.values()}
        asked = "sensitivity" if verdicts == {"nothing_missing"} else "precision"
    if asked == "sensitivity":
        progress(0.1, "smallest strength of each effect that these trials would show")
        detectability = _find_detectability(case)
    noise = untuned_settings(trials.sensors, case.system, case.fitted, case.p, FilterChoice())
    precision = Precision.of_trials(
        case.system, case.fitted, trials.band, case.p, case.identified, noise
    )
    system, p, judged = case.system, case.p, comparison
    if detectability is not None:
        judged = detectability.comparison
    if judged is not None:
        # A design is followed with the model beside which effects are weighed on it.
        system, p = judged.fit.linearisation.system, judged.fit.linearisation.p
    seed = case.config.seed
    rehearsal = Rehearsal(system, p, trials.sensors, trials.kinematics, case.seen, seed)
    return Forecast(rehearsal, precision, comparison, detectability)


def _lay_out_designs(case: _Case, forecast: Forecast) -> DesignSpace:
    """Return the designs to try, including the present trials."""
    seconds, brakes = case.config.seconds, case.system.model.device.brakes
    if case.limits:
        count = count_affordable(forecast.rehearsal, seconds)
        drawn = list_trajectories(forecast.rehearsal, case.limits, seconds, count)
        return DesignSpace(forecast.rehearsal, seconds, (), drawn)
    free = [
        motion
        for motion in case.fitted
        if not any(motion.channels[n].any() for n in brakes.values() if n in motion.channels)
    ]
    examples, of_effects = imitate_trials(free, case.seen, seconds), forecast.purpose != "precision"
    # Only parameters of brakes are fitted to trials with the brakes on.
    brakes_on = of_effects or case.system.braked
    return DesignSpace(
        forecast.rehearsal, seconds, case.seen.moved_axes, examples, of_effects, brakes_on
    )


def _rank(
    forecast: Forecast, space: DesignSpace, parameter: str, progress: Progress
) -> list[RankedDesign]:
    """Return the designs of the highest utility."""

    def report(first: float, fraction: float, message: str) -> None:
        progress(first + 0.3 * fraction, message)

    early, comparison = partial(report, 0.2), forecast.comparison
    if comparison is not None:
        return rank_designs(space, lambda motion: -comparison.confusion_with(motion), early)
    if forecast.detectability is not None:
        watched = forecast.detectability.keep_hidden(_WATCHED)
        ranked = rank_designs(space, watched.gain, early, _LITTLE) if watched.limits else []
        if ranked and ranked[0].utility >= _LITTLE:
            return ranked
        # No motion would show more: propose for the parameters.
        space = replace(space, with_rests=False, with_brakes=forecast.rehearsal.system.braked)
    precision = forecast.precision

    def utility(motion: Motion) -> float:
        return precision.utility(precision.of_motion(motion), float(motion.t[-1]), parameter)

    return rank_designs(space, utility, partial(report, 0.5))


def _record(
    case: _Case, forecast: Forecast, parameter: str, ranked: Sequence[RankedDesign]
) -> NextResult:
    """Return the proposal, its reason and its expected gain."""
    proposals = tuple(forecast.proposal(one) for one in ranked)
    table: dict[str, Detectable] = {}
    unbraked: tuple[str, ...] = ()
    unpromised: tuple[str, ...] = ()
    if (found := forecast.detectability) is not None:
        table = found.tabulate(ranked[0].expected_motions)
        unpromised = tuple(one.alternative.name for one in found.limits if not one.is_promised)
        if not case.seen.field.any():  # some effects show with brakes on only
            braked = (one for one in found.limits if one.item.system.braked)
            unbraked = tuple(one.alternative.name for one in braked)
    motions, limits = case.session.trials.motions, case.system.model.device.limits
    result = NextResult(
        model=case.config.model,
        purpose=forecast.purpose,
        parameter=parameter,
        trials=tuple(dict.fromkeys(trial_of_block(m.trial_id) for m in motions)),
        sentence=proposals[0].sentence,
        why="",
        expected="",
        proposals=proposals,
        sensitivity=table,
        unpromised=unpromised,
        shows=find_shown(table),
    )
    unlimited = [axis for axis in case.system.coordinates if axis not in limits]
    diagnosed, missing = case.diagnosed, None
    if diagnosed is not None:
        certain = [v.effects for v in diagnosed.axes.values() if v.verdict == "missing"]
        missing = [e for e in diagnosed.selected if any(e in effects for effects in certain)]
    judged = diagnosed or case.run.find(ValidateResult, case.config.model)
    axes = judged.axes.items() if judged is not None else ()
    lacking = [axis for axis, entry in axes if entry.standing == "above_floor"]
    why, expected = explain_proposal(result, unlimited, lacking, missing, unbraked)
    return result.model_copy(update={"why": why, "expected": expected})


def _plan_trials(
    case: _Case,
    forecast: Forecast,
    space: DesignSpace,
    ranked: Sequence[RankedDesign],
    best: Proposal,
) -> Plan:
    """Return a set of trials that reaches the goal, chosen among ``ranked`` and further designs."""
    precision, config = forecast.precision, case.config
    estimates = np.array([case.identified.parameters[name].estimate for name in precision.names])
    # For a model that lacks something, the plan has no goal for uncertainties.
    is_asked = (forecast.comparison is None) & (estimates != 0.0)
    goal = Goal(np.where(is_asked, config.sd * np.abs(estimates), np.inf), config.confusion)
    # Parameters that the best design for all leaves too uncertain get designs of their own.
    asked = dict(zip(precision.names, goal.sd, strict=True))
    utilities = [
        partial(precision.utility, seconds=config.seconds, parameter=name)
        for name, sd in best.sd.items()
        if sd.after > asked[name]
    ]
    options = list(ranked)
    if utilities:
        fitted = replace(space, with_rests=False)
        options += find_best_of_each(fitted, precision.of_motion, utilities)
    return plan_trials(forecast, options, goal)


def _write_trajectory(
    out: Path, case: _Case, rehearsal: Rehearsal, best: RankedDesign, result: NextResult
) -> NextResult:
    """Write the trajectory of each trial of the best design, and record its extent."""
    config, series = case.config, best.design.series
    assert config.trajectory and series is not None
    points = Points.of_series(series, rehearsal)
    file = f"models/{config.model}/trajectory.{config.trajectory}"
    # Drives have the names of the drawing; a coordinate's name may be spelt differently.
    drawn = read_tree(case.run.path(DRAWING)).joints if case.run.exists(DRAWING) else ()
    names = {identifier(joint.name): joint.name for joint in drawn}
    write_text(out / file, points.text(config.trajectory, names, result.sentence))
    stated = case.system.model.device.acceleration_limits
    followed = Trajectory(
        file=file,
        seconds=series.seconds,
        limits=dict(case.limits),
        assumed=tuple(axis for axis in case.limits if axis not in stated),
        used=points.extents(),
    )
    return result.model_copy(update={"trajectory": followed})


def _split(asked: str, names: Sequence[str]) -> tuple[Purpose | Literal["auto"], str]:
    """Return the purpose that ``asked`` means, and the parameter if it is one of ``names``."""
    if asked in names:
        return "precision", asked
    for purpose in ("auto", *get_args(Purpose)):
        if asked == purpose:
            return purpose, ""
    raise InputError(
        f"there is no purpose or parameter {asked!r} for a trial",
        remedy=choose_from(asked, ["auto", *get_args(Purpose), *names]),
    )


def _compare_alternatives(case: _Case, diagnosed: DiagnoseResult) -> Comparison | None:
    """Return the alternatives that a diagnosis left open, None if there are none."""
    asked = find_ambiguity(diagnosed, case.config)
    if asked is None:
        return None
    final = change_effects(case.spec, (), diagnosed.selected)
    known = {name: v for row in diagnosed.ranking for name, v in row.parameters.items()}
    known |= case.system.by_name(case.p)
    start = np.array([known.get(q.name, q.prior) for q in system_of(final).parameters])
    fit = case.session.try_fit(final, start)
    return compare_alternatives(case.session, fit, asked) if fit is not None else None


def _find_detectability(case: _Case) -> Detectability:
    """Return the smallest strength of each effect that the trials show."""
    try:
        fit = case.session.fit(case.spec, case.p)
    except Runaway as error:
        raise NothingToDoError(
            "the sensitivity of these trials is not known, because the model cannot be simulated:"
            f" {error.what}",
            where="next",
            remedy="ask for precision or for a parameter by name",
        ) from error
    chance = case.diagnosed.chance if case.diagnosed is not None else None
    return find_detectability(case.session, fit, chance.largest if chance is not None else ())


def _summary(result: NextResult) -> dict[str, object]:
    """Return the sentence, reason and gain, then the runners-up with their utilities."""
    more = [f"plan: {result.plan.sentence}"] if result.plan is not None else []
    if result.trajectory is not None:
        more += say_trajectory(result.trajectory)
    return {
        "headline": result.sentence,
        "why": result.why,
        "expected": result.expected,
        "notes": [result.why, result.expected, *more],
        "purpose": result.purpose,
        "proposals": [
            {"worth": one.worth, "sentence": one.sentence} for one in result.proposals[:_SHOWN]
        ],
    }
