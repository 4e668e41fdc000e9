"""Estimators side by side on simulated sessions of known truth.

The unscented filter, least squares, instrumental variables and output error estimate
friction and mass of the BAM from the same sessions, made by `bampipe simulate` with fresh seeds:
bias, standard deviation, how often the stated 95 % interval holds the truth, seconds.

``python benchmarks/estimators.py [--sessions N]``
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bampipe.data.run_folder import RunFolder
from bampipe.estimate.least_squares import Problem, Stacked, fit, stacked_residual
from bampipe.estimate.unscented import Trial
from bampipe.files import read_json, write_text
from bampipe.identification.filter_choice import FilterChoice
from bampipe.identification.filter_run import load_filter_trial
from bampipe.identification.output_estimate import cut_segments
from bampipe.identification.sensor_noise import sensor_noise
from bampipe.physics import Model, System, compile_model, registry
from bampipe.progress import silent
from bampipe.simulator import session as simulate
from bampipe.stages import filter as filter_stage
from bampipe.stages import identify, ingest
from bampipe.trials.motion import Motion
from bampipe.trials.reading import read_band, read_motions, read_sensors
from bampipe.trials.residuals import problem_of

Array = NDArray[np.float64]

MODEL = 'schema = "bampipe.model/1"\nname = "base"\ndevice = "bam"\neffects = []\n'
BY_STAGE = {
    "unscented filter": {},
    "least squares": {"method": "least-squares"},
    "least squares, bias left in": {"method": "least-squares", "remove_bias": False},
    "output error": {"method": "output-error"},
}


@dataclass(frozen=True)
class Found:
    """Estimates and standard deviations of one estimator, and what it took, s."""

    value: Array
    sd: Array
    seconds: float


def prepare(root: Path, config: simulate.Config) -> tuple[RunFolder, dict[str, float]]:
    """Simulate a session up to the filter stage; return it, with a base model, and the truth."""
    simulate.simulate_session(root / "session", config, silent)
    run = RunFolder(root / "run")
    for folder in ("ingest", "filter", "models/base"):
        run.path(folder).mkdir(parents=True)
    ingest.execute(run, run.root, ingest.Config(session=str(root / "session")), silent)
    filter_stage.execute(run, run.root, filter_stage.Config(), silent)
    write_text(run.path("models/base/model.toml"), MODEL)
    truth: dict[str, float] = read_json(root / "session.truth.json")["parameters"]
    return run, truth


def by_stage(run: RunFolder, names: Sequence[str], settings: dict[str, object]) -> Found:
    """What `bampipe identify` finds."""
    begun = time.process_time()
    found = identify.execute(run, run.root, identify.Config(**settings), silent)["parameters"]
    seconds = time.process_time() - begun
    return Found(
        np.array([found[name]["estimate"] for name in names]),
        np.array([found[name]["sd"] for name in names]),
        seconds,
    )


def by_instruments(run: RunFolder, system: System) -> Found:
    """Instrumental variables, from the motion that output error simulates."""
    begun = time.process_time()
    motions = list(read_motions(run, system, fitted=True))
    sensors = read_sensors(run, system)
    band = read_band(run, system)
    problem = problem_of(system, motions, band, timing=True)
    squares = fit(problem, np.append(system.prior, 0.0))
    choice = FilterChoice()
    near = squares.p[: len(system.parameters)]
    noise = sensor_noise(sensors, system, motions, near, choice)
    trials = [load_filter_trial(run, motion, system, near, noise, 1, choice) for motion in motions]
    simulated = [
        _simulated(system, motion, trial, squares.p)
        for motion, trial in zip(motions, trials, strict=True)
    ]
    p, covariance = fit_with_instruments(
        problem, replace(problem_of(system, simulated, band, timing=True), resting=problem.resting),
        squares.p,
    )  # fmt: skip
    seconds = time.process_time() - begun
    own = slice(0, len(system.parameters))
    return Found(p[own], np.sqrt(np.diag(covariance))[own], seconds)


def fit_with_instruments(
    measured: Problem, instruments: Problem, p: Array, block_s: float = 2.0
) -> tuple[Array, Array]:
    """Estimate the free parameters of a residual that is linear in them.

    Noise of the measured motion pulls least squares towards zero; the regressors of a simulated
    motion, which that noise has not touched, do not (Janot, Vandanjon and Gautier 2014). Solves
    ``sum Z^T W (e + S step) = 0`` with e and S the residual of the measured motion at ``p`` and
    its slope, Z the slope of the simulated motion, W one over the residual's variance.

    Args:
        measured: the residual on measured motion.
        instruments: the same on simulated motion, at the same samples.
        p: (np,) parameters to start from, near the answer.
        block_s: length of the blocks of the covariance, s.

    Returns:
        (np,) parameters and the covariance (n_free, n_free) of the free ones, from the scatter of
        blocks.
    """
    own = [stacked_residual(measured, k, p) for k in range(measured.n_trials)]
    other = [stacked_residual(instruments, k, p) for k in range(measured.n_trials)]
    weight = 1.0 / _variance(own)
    n_free = measured.free.size
    normal, side = np.zeros((n_free, n_free)), np.zeros(n_free)
    for s, z in zip(own, other, strict=True):
        weighted = z.slope * weight[None, :, None]
        normal += np.einsum("tqi,tqj->ij", weighted, s.slope)
        side -= np.einsum("tqi,tq->i", weighted, s.residual)
    scale = np.sqrt(np.abs(np.diag(normal)))
    scale[scale == 0.0] = 1.0
    inverse = np.linalg.pinv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    step = inverse @ side
    samples = max(1, round(block_s * measured.band.rate_hz / measured.band.step))
    scores = []
    for s, z in zip(own, other, strict=True):
        left = s.residual + s.slope @ step
        score = np.einsum("tqi,tq->ti", z.slope * weight[None, :, None], left)
        scores += [score[k : k + samples].sum(axis=0) for k in range(0, len(score), samples)]
    meat = np.array(scores).T @ np.array(scores) * (len(scores) / max(len(scores) - n_free, 1))
    found = p.copy()
    found[measured.free] = np.clip(p[measured.free] + step, measured.lower, measured.upper)
    return found, np.asarray(inverse @ meat @ inverse.T)


def _variance(stacked: Sequence[Stacked]) -> Array:
    square = np.sum([np.sum(s.residual**2, axis=0) for s in stacked], axis=0)
    count = np.sum([np.sum(s.used, axis=0) for s in stacked], axis=0)
    return np.asarray(np.maximum(square / np.maximum(count, 1), 1e-300))


def _simulated(system: System, motion: Motion, trial: Trial, p: Array) -> Motion:
    """The motion of the fitted model, segment by segment, on the grid of the measured one."""
    n = len(system.coordinates)
    dt = float(np.median(np.diff(trial.t)))
    segments = cut_segments(system, motion, trial, p[:-1])
    q = np.concatenate([segment.simulate(segment.x0, p) for segment in segments])
    t = dt * np.arange(len(q))
    q = np.stack([np.interp(motion.t, t, column) for column in q.T], axis=1)
    rate = np.empty(2 * n)
    qd = np.gradient(q, motion.t, axis=0)
    qdd = np.empty_like(q)
    u = motion.inputs(system.inputs)
    for k in range(len(q)):
        x = np.concatenate([q[k], qd[k]])
        system.derivative(x, u[k].copy(), p[:-1], np.zeros(len(system.noise)), rate)
        qdd[k] = rate[n:]
    return replace(motion, q=q, qd=qd, qdd=qdd)


def main() -> None:
    """Estimate every session by every method and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--sessions", type=int, default=8)
    parser.add_argument("--seed", type=int, default=7000, help="of the first session")
    parser.add_argument("--trials", type=int, default=3)
    parser.add_argument("--duration", type=float, default=10.0)
    chosen = parser.parse_args()
    system = compile_model(Model(registry.device("bam")))
    names = [item.name for item in system.parameters]
    errors: dict[str, list[Array]] = defaultdict(list)
    found: dict[str, list[Found]] = defaultdict(list)
    for seed in range(chosen.seed, chosen.seed + chosen.sessions):
        with tempfile.TemporaryDirectory() as folder:
            config = simulate.Config(seed=seed, trials=chosen.trials, duration=chosen.duration)
            run, report_progress = prepare(Path(folder), config)
            truth = np.array([report_progress[name] for name in names])
            results = {label: by_stage(run, names, dict(s)) for label, s in BY_STAGE.items()}
            results["instrumental variables"] = by_instruments(run, system)
        for label, one in results.items():
            errors[label].append((one.value - truth) / truth)
            found[label].append(replace(one, sd=one.sd / truth))
            within = int(np.sum(np.abs(errors[label][-1]) < 1.96 * found[label][-1].sd))
            print(
                f"{seed} {label}: {within} of {len(names)} within, {one.seconds:.1f} s", flush=True
            )
    print(f"\nload {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores\n")
    print("| estimator | bias, % | standard deviation, % | stated, % | 95 % interval holds | s |")
    print("|-|-|-|-|-|-|")
    for label, rows in errors.items():
        error = 100.0 * np.array(rows)
        sd = 100.0 * np.array([one.sd for one in found[label]])
        held = np.mean(np.abs(error) < 1.96 * sd)
        bias = np.sqrt(np.mean(np.square(error.mean(axis=0))))
        spread = np.sqrt(np.mean(np.square(error.std(axis=0, ddof=1))))
        seconds = np.median([one.seconds for one in found[label]])
        print(
            f"| {label} | {bias:.3f} | {spread:.3f} | {np.sqrt(np.mean(np.square(sd))):.3f} "
            f"| {100 * held:.0f} % of {error.size} | {seconds:.1f} |"
        )
    print("\n| bias, % | " + " | ".join(names) + " |\n|-|" + "-|" * len(names))
    for label, rows in errors.items():
        means = 100.0 * np.mean(rows, axis=0)
        print(f"| {label} | " + " | ".join(f"{value:+.3f}" for value in means) + " |")


if __name__ == "__main__":
    main()
