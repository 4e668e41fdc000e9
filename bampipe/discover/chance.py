"""Chance levels: what every number would be if the model were the whole truth.

Each replicate replays all trials with the fitted model, filters them like the measurements, fits
the model again and scores the same candidates. Replicates run in worker processes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.candidates import Candidate, build_candidate_model, compile_candidate
from bampipe.discover.scorer import Score, Scorer
from bampipe.discover.shape import explainable_share
from bampipe.physics import System, compile_model
from bampipe.physics.recipe import Recipe
from bampipe.physics.registry import effect_from
from bampipe.trials.evidence import Evidence, gather_evidence
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.replay import StandIn, replay_motions
from bampipe.workers import process_pool

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Replicate:
    """What one replay of the session gave.

    Attributes:
        error: cross-validated error of the model itself among the trials that are fitted, by axis.
        held_out_rmse: its error on the trials that count, by axis: the same, unless the session
            holds trials out.
        p: parameters fitted to it.
        scores: by candidate.
        share: explainable share by axis, empty where not asked for.
    """

    error: Array
    held_out_rmse: Array
    p: Array
    scores: dict[str, Score]
    share: Array


_STEPS_OF_A_REPLAY = 4
"""Most Gauss-Newton steps of the fit to a replay: it starts at the parameters that made it."""

_open_trials: MeasuredTrials | None = None
_timed_trials: MeasuredTrials | None = None
"""The same with the timing that was asked for last."""


def _open(trials: MeasuredTrials | None) -> None:
    global _open_trials, _timed_trials, _stand_in
    _open_trials = _timed_trials = trials
    _stand_in = None
    _linearised.clear()


def open_trials(late_s: float | None = None) -> MeasuredTrials:
    """The trials that this process works on, with ``late_s`` taken off their inputs where given.

    Raises:
        RuntimeError: no pool has been opened.
    """
    global _timed_trials
    if _open_trials is None or _timed_trials is None:
        raise RuntimeError("no trials are open in this process")
    if late_s is None:
        return _open_trials
    if late_s != _timed_trials.late_s:
        # From the trials as they came, whatever was asked before: the same bytes in any process.
        _timed_trials = _open_trials.with_input_timing(late_s)
    return _timed_trials


_UNMOVED = 0.05
"""Of half a sample: inputs that move by less stay."""


def retimed_trials(trials: MeasuredTrials, by_s: float) -> MeasuredTrials:
    """The trials that are open, as ``trials`` but with ``by_s`` more taken off their inputs."""
    if abs(by_s) <= _UNMOVED * trials.limit_s:
        return trials
    return open_trials(trials.late_s + by_s)


_systems: dict[str, System] = {}
_candidates: dict[str, Candidate] = {}
"""By `Model.key`: of two devices of one name and other contents it differs."""
_MOST_MODELS = 500
"""In either, in a process that lives long; a diagnosis compiles a few hundred."""


def system_of(recipe: Recipe) -> System:
    """The compiled model of a recipe, built once a process for each content."""
    model = recipe.model()
    if model.key not in _systems:
        _make_room(_systems)
        _systems[model.key] = compile_model(model)
    return _systems[model.key]


def _make_room(built: dict[str, Any]) -> None:
    if len(built) >= _MOST_MODELS:
        built.clear()


def fit_trials(
    trials: MeasuredTrials, recipe: Recipe, start: Array, like: Evidence | None = None
) -> Evidence:
    """Least squares of the model of ``recipe`` on the measured trials.

    What a model ``like`` it has in common with it, fitted to the same, is not computed again.
    """
    system = system_of(recipe)
    return gather_evidence(
        system, trials.motions, trials.band, start, trials.folds, like=like, timing=trials.timing
    )


_linearised: dict[tuple[str, bytes, float | None], Evidence] = {}
"""What was linearised last in this process: the next task is mostly about the same."""


def linearise(recipe: Recipe, p: Array, late_s: float | None) -> Evidence:
    """The model of ``recipe`` at parameters ``p``, (n_p,), on the measured trials."""
    system = system_of(recipe)
    key = system.model.key, p.tobytes(), late_s
    if key not in _linearised:
        trials = open_trials(late_s)
        _linearised.clear()
        _linearised[key] = gather_evidence(
            system, trials.motions, trials.band, p, trials.folds, most_iterations=0,
            timing=trials.timing,
        )  # fmt: skip
    return _linearised[key]


def candidates_of(recipe: Recipe, names: Sequence[str]) -> list[Candidate]:
    """Candidates by name, built once a process for each content of device and effects."""
    device, extra = recipe.model().device, [effect_from(e) for e in recipe.extra]
    out = []
    for name in names:
        model = build_candidate_model(device, name, extra, recipe.effects)
        if model.key not in _candidates:
            _make_room(_candidates)
            _candidates[model.key] = compile_candidate(model)
        out.append(_candidates[model.key])
    return out


@dataclass(frozen=True)
class ReplicateTask:
    """One replay of the session.

    Attributes:
        recipe, p: the model that is replayed, and its parameters.
        analysed, start: the model that is fitted to the replay, and where its fit starts.
        seed: of the sensor noise.
        names: candidates to score.
        late_s: time by which inputs were sampled after positions.
        share: whether to find the explainable share.
    """

    recipe: Recipe
    p: Array
    analysed: Recipe
    start: Array
    seed: tuple[int, ...]
    names: tuple[str, ...]
    late_s: float | None = None
    share: bool = False


_stand_in: StandIn | None = None
"""What was replayed last in this process: the next replay is mostly of the same."""


def stand_in_for(trials: MeasuredTrials, recipe: Recipe, p: Array) -> StandIn:
    """The model of ``recipe`` with parameters ``p``, (n_p,), in place of the machine."""
    global _stand_in
    system, known = system_of(recipe), _stand_in
    if (
        known is None
        or known.system is not system
        or known.motions is not trials.motions
        or not np.array_equal(known.p, p)
    ):
        known = _stand_in = StandIn(system, p, trials.motions, trials.sensors.rate_hz)
    return known


def run_replicate(task: ReplicateTask) -> Replicate:
    """Replay, filter, fit and score one replicate."""
    trials, system = open_trials(task.late_s), system_of(task.recipe)
    stand_in = stand_in_for(trials, task.recipe, task.p)
    replays = replay_motions(stand_in, trials.sensors, trials.kinematics, task.seed)
    analysed = system_of(task.analysed)
    evidence = gather_evidence(
        analysed, replays, trials.band, task.start, trials.folds,
        most_iterations=_STEPS_OF_A_REPLAY, timing=trials.timing,
    )  # fmt: skip
    scorer = Scorer(evidence)
    found = {c.name: scorer.score(c) for c in candidates_of(task.analysed, task.names)}
    axes = range(len(system.coordinates))
    share = np.array([explainable_share(evidence, a) for a in axes]) if task.share else np.zeros(0)
    scores = {name: score for name, score in found.items() if score is not None}
    # Refits without each trial are dear where the model is not linear: for the floor alone.
    unseen = evidence.held_out_rmse if task.share or evidence.is_linear else scorer.base_error
    return Replicate(scorer.base_error, unseen, evidence.p, scores, share)


@dataclass(frozen=True)
class ScoreTask:
    """Some candidates against the measured session."""

    recipe: Recipe
    evidence_p: Array
    names: tuple[str, ...]
    late_s: float | None = None


def run_scores(task: ScoreTask) -> dict[str, Score]:
    """Score candidates against the measured session."""
    scorer = Scorer(linearise(task.recipe, task.evidence_p, task.late_s))
    found = {c.name: scorer.score(c) for c in candidates_of(task.recipe, task.names)}
    return {name: score for name, score in found.items() if score is not None}


@dataclass(frozen=True)
class ShareTask:
    """The explainable share of one axis of a fitted model."""

    recipe: Recipe
    p: Array
    axis: int
    late_s: float | None = None


def run_share(task: ShareTask) -> float:
    """Find it on the measured session."""
    return explainable_share(linearise(task.recipe, task.p, task.late_s), task.axis)


Progress = Callable[[float, str], None]
"""Called with a fraction of the work done and what is being done."""

Pool = Callable[[Callable[[Any], Any], Sequence[Any]], Iterator[Any]]


@contextmanager
def workers(trials: MeasuredTrials, jobs: int) -> Iterator[Pool]:
    """A `map` over worker processes that share ``trials``; over none if jobs is 1."""
    _open(trials)
    try:
        if jobs <= 1:
            yield lambda function, tasks: map(function, tasks)
            return
        with process_pool(jobs, _open, trials) as pool:
            yield lambda function, tasks: pool.map(function, tasks)
    finally:
        _open(None)
