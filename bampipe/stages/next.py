"""Stage next: the trial to record next, in one sentence, and what it is expected to give."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from bampipe.data.run_folder import FILTERED, INGESTED, RunFolder
from bampipe.declarations.model_file import IDENTIFIED_MODEL, identified, load_model, read_recipe
from bampipe.errors import InputError, choose_from
from bampipe.files import digest_content, write_json
from bampipe.identification.filter_choice import FilterChoice
from bampipe.identification.sensor_noise import sensor_noise
from bampipe.next_trial.choice import Tried, Worth, find_best_of_each, rank_designs
from bampipe.next_trial.forecast import Forecast
from bampipe.next_trial.motion import TRAJECTORY_HZ, Rehearsal
from bampipe.next_trial.plan import Goal, plan_trials, record_plan
from bampipe.next_trial.precision import Precision
from bampipe.next_trial.primitives import Envelope, imitate_trials
from bampipe.next_trial.questions import (
    Blindness,
    find_ambiguity,
    find_blindness,
    make_contest,
)
from bampipe.next_trial.reasons import explain_proposal, find_shown
from bampipe.next_trial.sensitivity import HOPELESS
from bampipe.physics import compile_model
from bampipe.progress import Progress
from bampipe.results.diagnose import AxisVerdict, DiagnoseResult
from bampipe.results.forecast import find_open, read_forecasts
from bampipe.results.identify import IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.next import Detectable, NextResult, Plan, Purpose
from bampipe.results.validate import JudgedError, ValidateResult
from bampipe.schema import STRICT, Count
from bampipe.trials.evidence import Evidence, gather_evidence
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
class Config:
    """Settings of the stage.

    Attributes:
        model: which model version.
        purpose: ``precision`` of all parameters; ``decision`` between effects that the diagnosis
            could not tell apart; ``sensitivity`` to effects that the trials at hand would not have
            shown; the name of a parameter; or ``auto``: what the diagnosis asks for.
        seconds: length of the trial.
        plan: whether to make a set of trials, and its protocol sheet.
        sd: what the plan is to bring every standard deviation below, as a share of the estimate.
        confusion: what it is to bring every chance of confusing two effects below.
        seed: of how people differ, and of sensor noise.
    """

    model: str = "base"
    purpose: str = "auto"
    seconds: Annotated[float, Field(ge=4, le=600)] = 20.0
    plan: bool = False
    sd: Annotated[float, Field(gt=0, lt=1)] = 0.05
    confusion: Annotated[float, Field(gt=0, lt=0.5)] = 0.05
    seed: Count = 0


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
    recipe = read_recipe(run, config.model, model)
    evidence = gather_evidence(system, trials.motions, trials.band, p, trials.folds)
    floor = _floor(run, config.model, diagnosed, evidence)
    fitted = [trials.motions[k] for k in trials.folds.fitted_trials]
    noise = sensor_noise(trials.sensors, system, fitted, p, FilterChoice())
    seen = Envelope.of_trials(trials.motions, system, p)
    rehearsal = Rehearsal(system, p, trials.sensors, trials.kinematics, seen, config.seed)
    precision = Precision.of_trials(system, fitted, trials.band, p, found, noise)
    contest, blindness = None, None
    asked = find_ambiguity(diagnosed) if diagnosed and purpose in ("auto", "decision") else None
    if asked is not None and diagnosed is not None:
        values = {name: v for row in diagnosed.ranking for name, v in row.parameters.items()}
        contest = make_contest(trials, recipe, p, asked, values, floor)
    at_hand = contest.sums(trials.weighed) if contest else None
    distinguishable: tuple[str, ...] = ()
    if purpose == "auto" and contest and at_hand and contest.tells_apart(at_hand):
        distinguishable = tuple(rival.name for rival in contest.rivals if rival.name)
        contest, at_hand = None, None
    if purpose == "decision" and contest is None:
        raise InputError(
            "the diagnosis left nothing to decide",
            where=str(run.path(DiagnoseResult.file(config.model))),
            remedy="ask for precision, sensitivity, or a parameter by name",
        )
    chosen = _settle(diagnosed, contest is not None) if purpose == "auto" else purpose
    if chosen == "sensitivity":
        progress(0.1, "what these trials would have shown of each effect")
        error, spread = _errors(diagnosed, evidence)
        blindness = find_blindness(evidence, trials, recipe, error, floor, spread)
    forecast = Forecast(rehearsal, precision, contest, at_hand)
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
        chosen, parameter, best, table, unlimited, lacking, missing, distinguishable, unbraked,
        unpromised,
    )  # fmt: skip
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
        session = run.read(IngestResult).session_id
        sheet = protocol_sheet(plan, session, config.model, by_hand)
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


def _floor(
    run: RunFolder, model: str, diagnosed: DiagnoseResult | None, evidence: Evidence
) -> Array:
    """Noise floor of each axis, (n_q,), N.m or N; what the fit leaves where there is none."""
    left = evidence.rmse()
    known: Mapping[str, float | None] = {}
    if diagnosed is not None:
        known = {axis: entry.noise_floor for axis, entry in diagnosed.axes.items()}
    elif run.exists(ValidateResult.file(model)):
        entries = run.read(ValidateResult, model).axes
        known = {axis: entry.noise_floor for axis, entry in entries.items()}
    found = [
        known.get(axis) or float(left[i]) for i, axis in enumerate(evidence.system.coordinates)
    ]
    return np.maximum(found, 1e-12)


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


def _errors(diagnosed: DiagnoseResult | None, evidence: Evidence) -> tuple[Array, Array]:
    """Held-out error of each axis, and the scatter of its floor, each (n_q,), N.m or N."""
    axes = evidence.system.coordinates
    if diagnosed is None:
        return np.maximum(evidence.held_out_rmse, 1e-12), np.zeros(len(axes))
    entries = [diagnosed.axes[axis] for axis in axes]
    error = np.maximum([entry.rmse_before for entry in entries], 1e-12)
    return error, np.array([entry.noise_floor_sd for entry in entries])


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
    axes = blindness.contest.system.coordinates
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
