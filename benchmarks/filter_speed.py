"""Steps per second of the identification filter: bampipe, filterpy, dynamax and plain C.

One free trial of a simulated session is filtered by each, the same numbers in and, checked before
anything is timed, the same numbers out: six states and seven parameters of the BAM, noise on three
forces and one torque within the equations of motion, encoder readings, two Runge-Kutta steps a
sample. Times are processor seconds, the least of several repeats, because other programs may run.

``python benchmarks/filter_speed.py [--dynamax PYTHON]``; dynamax may live in an environment of its
own (``pip install dynamax``), whose interpreter PYTHON is.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bampipe.data.run_folder import RunFolder
from bampipe.data.store import read_parquet
from bampipe.estimate import filterpy_engine
from bampipe.estimate.square_root import ALPHA, FilterSettings
from bampipe.estimate.unscented import FilterModel, Trial, filter_trials
from bampipe.files import read_json
from bampipe.physics import Model, compile_model, registry
from bampipe.physics.system import System
from bampipe.progress import silent
from bampipe.simulator import simulated_session as simulate
from bampipe.stages import ingest

HERE = Path(__file__).parent / "filter_speed_engines"
LONGEST_STEP = 1e-3
AGREE = 1e-9
"""Largest difference, in starting standard deviations, of what computes the same."""
ROUNDING = {"dynamax": 1e-8, "filterpy": 1e-6}
"""The same of engines that carry the covariance itself and invert it: what rounding leaves."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Problem:
    """A trial, and what the filter is told of it; see `FilterModel` and `FilterSettings`."""

    system: System
    model: FilterModel
    trial: Trial
    mean: Array
    covariance: Array
    settings: FilterSettings

    def first(self, samples: int) -> Problem:
        """The same with the first ``samples`` of the trial."""
        return replace(self, trial=self.trial.first(samples))


@dataclass(frozen=True)
class Measured:
    """Parameters that an engine ended with, and processor seconds of each repeat."""

    theta: Array
    seconds: list[float]
    steps: int

    @property
    def step(self) -> float:
        """Microseconds of one step, at best."""
        return 1e6 * min(self.seconds) / self.steps


def make_problem(device: str, seconds: float, seed: int) -> Problem:
    """Simulate a session and take its first trial, raw."""
    system = compile_model(Model(registry.device(device)))
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        simulate.simulate_session(
            root / "session",
            simulate.Config(device=device, seed=seed, trials=1, duration=seconds),
            silent,
        )
        (root / "run" / "ingest").mkdir(parents=True)
        ingest.execute(
            RunFolder(root / "run"), root / "run",
            ingest.Config(session=str(root / "session")), silent,
        )  # fmt: skip
        session = read_json(root / "run/ingest/session.json")
        frame = read_parquet(root / "run/ingest/samples.parquet")
    n = len(system.coordinates)
    steps = np.array([session["axes"][axis]["resolution"] for axis in system.coordinates])
    t = frame["t"].to_numpy(dtype=float)
    y = np.ascontiguousarray(frame[[f"q_{a}" for a in system.coordinates]], dtype=float)
    u = np.zeros((len(t), len(system.inputs)))
    for place, name in enumerate(system.inputs):
        if name in frame:
            u[:, place] = frame[name]
    model = FilterModel(
        functions=system,
        n_states=2 * n,
        parameters=np.append(system.prior, 0.0),
        free=np.arange(len(system.parameters)),
        lower=np.array([item.lower for item in system.parameters]),
        upper=np.array([item.upper for item in system.parameters]),
        reads_parameters=system.moves_sensors,
    )
    # No sigma point may leave the bounds, which the C kernel knows nothing of.
    sds = np.array([min(item.sd, 0.1 * item.prior or item.sd) for item in system.parameters])
    mean, sd = model.to_estimated(system.prior, sds)
    settings = FilterSettings(
        observed=np.arange(n),
        reading_sd=steps / np.sqrt(12.0),
        noise_sd=np.full(len(system.noise), 0.05),
        walk_sd=np.zeros(sd.size),
        longest_step=LONGEST_STEP,
        stride=len(t),
    )
    speed = np.full(n, 0.2)
    trial = Trial(
        t, u, y,
        np.concatenate([y[0], np.zeros(n)]), np.concatenate([2.0 * settings.reading_sd, speed]),
    )  # fmt: skip
    return Problem(system, model, trial, mean, np.diag(sd**2), settings)


def timed(run: Callable[[], Array], repeats: int, steps: int) -> Measured:
    """Run once for the numbers, then ``repeats`` times for the time."""
    theta, seconds = run(), []
    for _ in range(repeats):
        begun = time.process_time()
        run()
        seconds.append(time.process_time() - begun)
    return Measured(theta, seconds, steps)


def by_bampipe(problem: Problem, repeats: int) -> Measured:
    """The compiled filter."""

    def run() -> Array:
        return filter_trials(
            problem.model, [problem.trial], problem.mean, problem.covariance, problem.settings
        ).theta

    return timed(run, repeats, problem.trial.t.size - 1)


def in_python(derivative: Callable[..., None]) -> Callable[..., None]:
    """Runge-Kutta method over a plain Python derivative, vectors by numpy."""

    def advance(_, x, u0, u1, c0, c1, p, w, dt, substeps, work):  # type: ignore[no-untyped-def]
        delta, rise = dt / substeps, u1 - u0
        parameters, noise = p.tolist(), w.tolist()

        def rates(state: Array, share: float) -> Array:
            out = [0.0] * len(x)
            derivative(state.tolist(), (u0 + rise * share).tolist(), parameters, noise, out)
            return np.array(out)

        for step in range(substeps):
            k1 = rates(x, step / substeps)
            k2 = rates(x + 0.5 * delta * k1, (step + 0.5) / substeps)
            k3 = rates(x + 0.5 * delta * k2, (step + 0.5) / substeps)
            k4 = rates(x + delta * k3, (step + 1.0) / substeps)
            x += delta / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)

    return advance


def by_filterpy(problem: Problem, compiled: bool, repeats: int) -> Measured:
    """filterpy 2, the model compiled or in Python."""
    advance = (
        filterpy_engine.runge_kutta if compiled else in_python(problem.system.derivative.py_func)
    )

    def run() -> Array:
        return filterpy_engine.filter_trials_by_filterpy(
            problem.model, [problem.trial], problem.mean, problem.covariance, problem.settings,
            advance=advance,
        ).theta  # fmt: skip

    return timed(run, repeats, problem.trial.t.size - 1)


def body_of_derivative(system: System) -> list[str]:
    """Statements of the generated state derivative."""
    source = system._whole.sources["derivative"].partition("def derivative(")[2]
    return [line.strip() for line in source.splitlines()[1:]]


def by_c(problem: Problem, folder: Path, options: list[str], repeats: int) -> Measured:
    """The hand-written kernel with the model's statements, compiled here."""
    system, settings = problem.system, problem.settings
    body = body_of_derivative(system)
    names = sorted({m[1] for line in body if (m := re.match(r"(\w+) *[-+]?= ", line))})
    sizes = {
        "NX": len(system.states), "NU": len(system.inputs), "NP": len(system.parameters),
        "NW": len(system.noise), "NY": settings.observed.size,
        "LOGARITHMIC": int(np.flatnonzero(problem.model.logarithmic)[0]),
    }  # fmt: skip
    header = [f"#define {name} {value}" for name, value in sizes.items()]
    header.append(
        "static inline void derivative(const double *x, const double *u, const double *p,"
        " const double *w, double *dx) {"
    )
    header += [f"double {', '.join(names)};", *(f"{line};" for line in body), "}"]
    (folder / "model.h").write_text("\n".join(header) + "\n")
    library = folder / f"kernel{len(options)}.so"
    subprocess.run(
        ["cc", "-std=gnu11", *options, "-shared", "-fPIC", f"-I{folder}",
         "-o", str(library), str(HERE / "kernel.c"), "-lm"],
        check=True,
    )  # fmt: skip
    compiled = ctypes.CDLL(str(library)).filter
    pointer = np.ctypeslib.ndpointer(dtype=float, flags="C")
    compiled.argtypes = [ctypes.c_int, *[pointer] * 8, ctypes.c_double, pointer]
    nx = problem.model.n_states
    n = nx + problem.mean.size
    spread = ALPHA**2 * (n + settings.noise_sd.size)
    root = np.zeros((n, n))
    root[:nx, :nx] = np.diag(problem.trial.x_sd)
    root[nx:, nx:] = np.linalg.cholesky(problem.covariance)
    means = np.empty((problem.trial.t.size, n))

    def run() -> Array:
        mean = np.concatenate([problem.trial.x, problem.mean])
        failed = compiled(
            len(problem.trial.t), problem.trial.t, problem.trial.u, problem.trial.y, mean,
            root.copy(), settings.noise_sd, settings.reading_sd, np.array([spread, 0.5 / spread]),
            settings.longest_step, means,
        )  # fmt: skip
        if failed:
            raise SystemExit(f"the C kernel failed at sample {failed}")
        return mean[nx:]

    return timed(run, repeats, problem.trial.t.size - 1)


def by_dynamax(problem: Problem, python: str, folder: Path, repeats: int) -> Measured | None:
    """dynamax in its own process; None where it is not installed."""
    if subprocess.run([python, "-c", "import dynamax"], capture_output=True).returncode:
        return None
    trial, settings = problem.trial, problem.settings
    # dynamax starts with a reading; here the first reading follows a prediction.
    start = replace(trial, t=trial.t[:2], u=trial.u[:2], y=np.full_like(trial.y[:2], np.nan))
    ahead = filter_trials(
        problem.model, [start], problem.mean, problem.covariance, settings._replace(stride=1)
    ).trials[0]
    dt = np.diff(trial.t)
    steps = np.unique(np.ceil(dt / settings.longest_step - 1e-6))
    if steps.size > 1:
        raise SystemExit("the sampling is too uneven for one number of Runge-Kutta steps")
    np.savez(
        folder / "problem.npz", u=trial.u, y=trial.y, p=problem.model.parameters[:-1],
        nx=problem.model.n_states, noise_sd=settings.noise_sd, reading_sd=settings.reading_sd,
        mean=ahead.mean[1], covariance=ahead.covariance[1], dt=dt,
        steps=int(steps[0]), alpha=ALPHA,
        logarithmic=int(np.flatnonzero(problem.model.logarithmic)[0]), repeats=repeats,
    )  # fmt: skip
    source = ["def derivative(x, u, p, w, dx):", *body_of_derivative(problem.system)]
    (folder / "derivative.py").write_text("\n    ".join(source) + "\n")
    found = subprocess.run(
        [python, str(HERE / "by_dynamax.py"), folder / "problem.npz", folder / "derivative.py"],
        capture_output=True, text=True, check=True,
        env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"},
    )  # fmt: skip
    content = json.loads(found.stdout)
    return Measured(np.array(content["theta"]), content["seconds"], trial.t.size - 1)


def require_same(name: str, theta: Array, expected: Array, scale: Array) -> None:
    """Leave with a message where two engines disagree: their times would mean nothing."""
    worst = float(np.max(np.abs(theta - expected) / scale))
    print(f"{name}: differs by {worst:.1e} of the starting uncertainty")
    if not worst < ROUNDING.get(name.partition(",")[0], AGREE):
        raise SystemExit(f"{name} does not compute the same: nothing is timed")


def main() -> None:
    """Check, time, print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--device", default="bam", choices=["bam", "slider"])
    parser.add_argument("--only-c", action="store_true", help="beside C alone")
    parser.add_argument("--seconds", type=float, default=16.0, help="length of the trial")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--slow", type=int, default=300, help="samples for filterpy")
    parser.add_argument("--dynamax", default=sys.executable, metavar="PYTHON")
    chosen = parser.parse_args()
    whole = make_problem(chosen.device, chosen.seconds, chosen.seed)
    part = whole.first(chosen.slow)
    scale = np.sqrt(np.diag(whole.covariance))
    print(f"{whole.trial.t.size} samples, {whole.mean.size + whole.model.n_states} states, "
          f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows: dict[str, Measured] = {}
        limit = ["-O3"], ["-O3", "-march=native", "-ffast-math"]
        rows["C, `cc -O3`"] = by_c(whole, folder, limit[0], chosen.repeats)
        rows["C, `cc -O3 -march=native -ffast-math`"] = by_c(
            whole, folder, limit[1], chosen.repeats
        )
        rows["bampipe"] = by_bampipe(whole, chosen.repeats)
        if not chosen.only_c:
            jitted = by_dynamax(whole, chosen.dynamax, folder, 5)
            if jitted is None:
                print(f"dynamax is not installed for {chosen.dynamax}: pip install dynamax")
            else:
                rows["dynamax, jitted"] = jitted
        expected = rows["bampipe"].theta
        for label, found in rows.items():
            require_same(label, found.theta, expected, scale)
        if not chosen.only_c:
            expected = by_bampipe(part, 0).theta
            for label, compiled in (("compiled", True), ("Python", False)):
                title = f"filterpy, {label} model"
                rows[title] = by_filterpy(part, compiled, 3)
                require_same(title, rows[title].theta, expected, scale)
    ours = rows["bampipe"].step
    print("\n| filter | µs a step | steps per second | time over bampipe's |\n|-|-|-|-|")
    for label, found in rows.items():
        print(f"| {label} | {found.step:.1f} | {1e6 / found.step:,.0f} | {found.step / ours:.2f} |")


if __name__ == "__main__":
    main()
