"""Chance levels: what every number would be if the model were the whole truth.

Each replicate replays all trials with the fitted model, filters them like the measurements, fits
the model again and scores the same candidates. Replicates run in worker processes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bampipe.discover.candidates import Candidate, Score, Scorer, candidate
from bampipe.discover.evidence import Evidence, fit
from bampipe.discover.shape import explainable_share
from bampipe.estimate.low_pass import Band
from bampipe.physics import Model, System, compile_model
from bampipe.physics.registry import device_from, effect_from
from bampipe.trials.observation import Motion, Sensors, observe
from bampipe.trials.replay import replay
from bampipe.workers import process_pool

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Recipe:
    """A model as plain data, so that a worker process can build it again.

    Attributes:
        device: the device's declaration.
        effects: canonical names.
        extra: declarations of effects that are not built in.
    """

    device: Mapping[str, Any]
    effects: tuple[str, ...]
    extra: tuple[Mapping[str, Any], ...]

    def model(self) -> Model:
        """Build the model."""
        return Model(device_from(self.device), self.effects, [effect_from(e) for e in self.extra])


@dataclass(frozen=True)
class Session:
    """What every replicate shares: the measured trials and how they were measured."""

    motions: tuple[Motion, ...]
    sensors: Sensors
    band: Band


@dataclass(frozen=True)
class Replicate:
    """What one replay of the session gave.

    Attributes:
        error: held-out error of the model itself, by axis.
        p: parameters fitted to it.
        scores: by candidate.
        share: explainable share by axis, empty where not asked for.
    """

    error: Array
    p: Array
    scores: dict[str, Score]
    share: Array


_session: Session | None = None


def _enter(session: Session) -> None:
    global _session
    _session = session


def shared_session() -> Session:
    """The session that this process works on.

    Raises:
        RuntimeError: no pool has been opened.
    """
    if _session is None:
        raise RuntimeError("no session is open in this process")
    return _session


_systems: dict[str, System] = {}
_candidates: dict[tuple[str, str], Candidate] = {}


def system_of(recipe: Recipe) -> System:
    """The compiled model of a recipe, built once a process."""
    model = recipe.model()
    if model.key not in _systems:
        _systems[model.key] = compile_model(model)
    return _systems[model.key]


def fit_session(session: Session, recipe: Recipe, start: Array) -> Evidence:
    """Least squares of the model of ``recipe`` on the measured trials; see `fit`."""
    return fit(system_of(recipe), session.motions, session.sensors, session.band, start)


def candidates_of(recipe: Recipe, names: Sequence[str]) -> list[Candidate]:
    """Candidates by name, built once a process."""
    device = device_from(recipe.device)
    extra = [effect_from(e) for e in recipe.extra]
    out = []
    for name in names:
        key = (device.name, name)
        if key not in _candidates:
            _candidates[key] = candidate(device, name, extra)
        out.append(_candidates[key])
    return out


@dataclass(frozen=True)
class PrepareTask:
    """Candidates to derive and compile, so that workers share this work instead of repeating it."""

    recipe: Recipe
    names: tuple[str, ...]


def prepare(task: PrepareTask) -> int:
    """Derive and compile candidates into the cache; returns how many."""
    motion = shared_session().motions[0]
    for item in candidates_of(task.recipe, task.names):
        system = item.system
        if system.memory_names:
            few = slice(0, 2)
            u = motion.inputs(system.inputs)[few]
            q, qd, qdd = motion.q[few], motion.qd[few], motion.qdd[few]
            system.memory(q, qd, qdd, u, system.prior, motion.t[few])
    return len(task.names)


@dataclass(frozen=True)
class ReplicateTask:
    """One replay of the session.

    Attributes:
        recipe, p: the model that is replayed, and its parameters.
        analysed, start: the model that is fitted to the replay, and where its fit starts.
        seed: of the sensor noise.
        names: candidates to score.
        share: whether to find the explainable share.
    """

    recipe: Recipe
    p: Array
    analysed: Recipe
    start: Array
    seed: tuple[int, ...]
    names: tuple[str, ...]
    share: bool = False


def run_replicate(task: ReplicateTask) -> Replicate:
    """Replay, filter, fit and score one replicate."""
    session, system = shared_session(), system_of(task.recipe)
    motions = []
    for k, motion in enumerate(session.motions):
        rng = np.random.default_rng([*task.seed, k])
        recording = replay(system, task.p, motion, session.sensors, rng)
        motions.append(observe(recording, session.sensors, system))
    analysed = system_of(task.analysed)
    evidence = fit(analysed, motions, session.sensors, session.band, task.start)
    scorer = Scorer(evidence)
    found = {c.name: scorer.score(c) for c in candidates_of(task.analysed, task.names)}
    axes = range(len(system.coordinates))
    share = np.array([explainable_share(evidence, a) for a in axes]) if task.share else np.zeros(0)
    scores = {name: score for name, score in found.items() if score is not None}
    return Replicate(scorer.before.error, evidence.p, scores, share)


@dataclass(frozen=True)
class ScoreTask:
    """Some candidates against the measured session."""

    recipe: Recipe
    evidence_p: Array
    names: tuple[str, ...]


@cache
def _measured(model_key: str, p: bytes) -> Evidence:
    session = shared_session()
    system = _systems[model_key]
    start = np.frombuffer(p)
    return fit(system, session.motions, session.sensors, session.band, start.copy(), 1)


def run_scores(task: ScoreTask) -> dict[str, Score]:
    """Score candidates against the measured session."""
    system = system_of(task.recipe)
    evidence = _measured(system.model.key, task.evidence_p.tobytes())
    scorer = Scorer(evidence)
    found = {c.name: scorer.score(c) for c in candidates_of(task.recipe, task.names)}
    return {name: score for name, score in found.items() if score is not None}


Progress = Callable[[float, str], None]
"""Called with a fraction of the work done and what is being done."""

Pool = Callable[[Callable[[Any], Any], Sequence[Any]], Iterator[Any]]


@contextmanager
def workers(session: Session, jobs: int) -> Iterator[Pool]:
    """A `map` over worker processes that share ``session``; over none if jobs is 1."""
    _enter(session)
    if jobs <= 1:
        yield lambda function, tasks: map(function, tasks)
        return
    with process_pool(jobs, _enter, session) as pool:
        yield lambda function, tasks: pool.map(function, tasks)
