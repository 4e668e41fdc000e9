"""A mass with viscous and Coulomb friction, written by hand, and recordings of it."""

import math
import sys
from functools import partial

import numpy as np
from numba import njit

from bampipe import compiled
from bampipe.estimate.square_root import FilterSettings
from bampipe.estimate.unscented import FilterModel, Trial
from bampipe.model_functions import DERIVATIVE, DERIVATIVE_ROWS, MEASURE, MEASURE_ROWS, ROWS

TRUTH = np.array([4.0, 1.1, 2.0])
"""Viscous N.s/m, Coulomb N, mass kg."""
RESOLUTION = 2e-5
FORCE_SD = 0.05
BEND = 0.1
"""Of the tachometer, s/m."""
RATE = 500.0
# Of processes that collect tests at once, one compiles what functions take as arguments.
argument = partial(compiled.njit, cache=True, no_cfunc_wrapper=False)


@argument(DERIVATIVE.signature)
def derivative(x, u, p, w, dx):
    dx[0] = x[1]
    dx[1] = (u[0] + w[0] - p[0] * x[1] - p[1] * math.tanh(x[1] / 1e-3)) / p[2]


@argument(MEASURE.signature)
def measure(x, u, p, y):
    y[0] = x[0]
    y[1] = x[1] + BEND * x[1] * x[1]


@argument(DERIVATIVE_ROWS.signature)
def derivative_rows(count, x, u, p, w, dx):
    for r in range(count):
        friction = p[r] * x[ROWS + r] + p[ROWS + r] * math.tanh(x[ROWS + r] / 1e-3)
        dx[r] = x[ROWS + r]
        dx[ROWS + r] = (u[r] + w[r] - friction) / p[2 * ROWS + r]


@argument(MEASURE_ROWS.signature)
def measure_rows(count, x, u, p, y):
    for r in range(count):
        y[r] = x[r]
        y[ROWS + r] = x[ROWS + r] + BEND * x[ROWS + r] * x[ROWS + r]


def record(seed: int, seconds: float = 8.0, truth=TRUTH, resolution: float = RESOLUTION):
    """One trial: a hand's force of a few sines, integrated finely, read by the sensors."""
    rng = np.random.default_rng(seed)
    fine, count = 20, int(seconds * RATE)
    dt = 1.0 / (RATE * fine)
    t = np.arange(count * fine) * dt
    force = np.zeros_like(t)
    for size, f, phase in zip(
        rng.uniform(3, 8, 6), rng.uniform(0.1, 2, 6), rng.uniform(0, 6, 6), strict=True
    ):
        force += size * np.sin(2 * np.pi * f * t + phase)
    x = _integrate(force, np.asarray(truth, dtype=float), dt)
    q, qd = x[::fine, 0], x[::fine, 1]
    counts = np.floor(q / resolution + rng.uniform()) * resolution
    noisy = force[::fine] + FORCE_SD * rng.standard_normal(count)
    return Trial(
        t=t[::fine].copy(),
        u=noisy[:, None],
        y=np.stack([counts, qd + BEND * qd**2], axis=1),
        x=np.array([counts[0], 0.0]),
        x_sd=np.array([resolution, 0.1]),
    )


@njit(cache=True)
def _integrate(force, p, dt):
    x = np.zeros((len(force), 2))
    for i in range(len(force) - 1):
        v = x[i, 1]
        for _ in range(2):  # midpoint rule
            v = (
                x[i, 1]
                + 0.5
                * dt
                * (0.5 * (force[i] + force[i + 1]) - p[0] * v - p[1] * math.tanh(v / 1e-3))
                / p[2]
            )
        x[i + 1, 1] = 2.0 * v - x[i, 1]
        x[i + 1, 0] = x[i, 0] + dt * v
    return x


def position_only(trial: Trial) -> Trial:
    return Trial(trial.t, trial.u, np.ascontiguousarray(trial.y[:, :1]), trial.x, trial.x_sd)


def model(start=TRUTH, *, timing: bool = False) -> FilterModel:
    """The slider as the filter wants it; optionally with the timing of the inputs."""
    free = [0, 1, 2, 3] if timing else [0, 1, 2]
    return FilterModel(
        functions=sys.modules[__name__],
        n_states=2,
        parameters=np.append(start, 0.0),
        free=np.array(free),
        lower=np.array([0.0, 0.0, 1e-3, -1e-3])[free],
        upper=np.array([np.inf, np.inf, np.inf, 1e-3])[free],
    )


def settings(**changes) -> FilterSettings:
    standard = {
        "observed": np.array([0]),
        "reading_sd": np.array([RESOLUTION / np.sqrt(12.0)]),
        "noise_sd": np.array([FORCE_SD]),
        "walk_sd": np.zeros(3),
    }
    return FilterSettings(**(standard | changes))
