"""The filter of `unscented` by filterpy: slow, an independent check of the compiled engine.

filterpy has no process noise that enters the equations of motion. The noise is therefore part of
its state: each step forgets it, and Q restores its variance. Since version 2.0, filterpy draws the
sigma points afresh after adding Q, as the compiled engine does.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from bampipe.arrays import Array
from bampipe.estimate.runge_kutta import runge_kutta
from bampipe.estimate.square_root import ALPHA, FilterSettings
from bampipe.estimate.unscented import (
    FilteredTrial,
    FilterFailure,
    FilterModel,
    FilterOutcome,
    Trial,
    in_sequence,
)


def filter_trials_by_filterpy(
    model: FilterModel,
    trials: Sequence[Trial],
    theta: Array,
    covariance: Array,
    settings: FilterSettings,
    advance: Callable[..., None] = runge_kutta,
) -> FilterOutcome:
    """Filter trials as `unscented.filter_trials` does, with the same arguments and result.

    ``advance`` carries one point over an interval, with the arguments of `runge_kutta`.

    Raises:
        FilterFailure: the covariance lost positive definiteness.
    """
    return in_sequence(partial(_filter, model, settings, advance), trials, theta, covariance)


def _filter(
    model: FilterModel,
    settings: FilterSettings,
    advance: Callable[..., None],
    trial: Trial,
    theta: Array,
    covariance: Array,
) -> tuple[FilteredTrial, Array, Array]:
    """Filter one trial; return it and the parameters with their covariance after it."""
    nx, n, ny = model.n_states, model.n_states + model.free.size, settings.observed.size
    t, (lower, upper) = np.asarray(trial.t, dtype=float), model.range
    ukf = _make_filter(model, trial, settings, advance)
    ukf.x[nx:n], ukf.P[nx:n, nx:n] = np.clip(theta, lower, upper), covariance
    means, covariances = [ukf.x[:n].copy()], [ukf.P[:n, :n].copy()]
    innovation, innovation_sd = np.full((2, t.size, ny), np.nan)
    nis, log_likelihood = np.full((2, t.size), np.nan)
    for k in range(1, t.size):
        dt = t[k] - t[k - 1]
        walk = np.square(settings.walk_sd) * dt
        ukf.Q = np.diag(np.concatenate([np.zeros(nx), walk, np.square(settings.noise_sd)]))
        try:
            ukf.predict(dt=dt, k=k)
            if np.isfinite(trial.y[k]).all():
                ukf.update(np.asarray(trial.y[k], dtype=float), k=k)
                innovation[k], innovation_sd[k] = ukf.y, np.sqrt(np.diag(ukf.S))
                nis[k] = float(ukf.y @ ukf.SI @ ukf.y)
                log_likelihood[k] = -0.5 * (nis[k] + np.linalg.slogdet(2.0 * np.pi * ukf.S)[1])
                ukf.x[nx:n] = np.clip(ukf.x[nx:n], lower, upper)
        except np.linalg.LinAlgError as error:
            reason = "the covariance of the state lost positive definiteness"
            raise FilterFailure(k, reason) from error
        if k % settings.stride == 0:
            means.append(ukf.x[:n].copy())
            covariances.append(ukf.P[:n, :n].copy())
    filtered = FilteredTrial(
        t[:: settings.stride], np.array(means), np.array(covariances),
        innovation, innovation_sd, nis, log_likelihood,
    )  # fmt: skip
    return filtered, ukf.x[nx:n].copy(), ukf.P[nx:n, nx:n].copy()


def _make_filter(
    model: FilterModel, trial: Trial, settings: FilterSettings, advance: Callable[..., None]
) -> Any:
    """Return filterpy's filter of state, parameters and noise at the first sample of a trial."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    nx, nw = model.n_states, settings.noise_sd.size
    n, ny = nx + model.free.size, settings.observed.size
    p, curvature = np.array(model.parameters, dtype=float), trial.input_curvature
    u = np.ascontiguousarray(trial.u, dtype=float)
    work, reading = np.empty((6, max(n, 2 * nx) + u.shape[1])), np.empty(2 * nx)

    def move(point: Array, dt: float, k: int) -> Array:
        model.place_parameters(point[nx:n], p)
        x, w = point[:nx].copy(), point[n:].copy()
        c0, c1 = curvature[k - 1], curvature[k]
        late = p[-1] * ((u[k] - u[k - 1]) / dt - 0.25 * p[-1] * (c0 + c1))
        start, end = u[k - 1] - late, u[k] - late
        substeps = max(1, int(np.ceil(dt / settings.longest_step - 1e-6)))
        advance(model.functions.derivative, x, start, end, c0, c1, p, w, dt, substeps, work)
        return np.concatenate([x, point[nx:n], np.zeros(nw)])

    def read(point: Array, k: int) -> Array:
        model.place_parameters(point[nx:n], p)
        model.functions.measure(point[:nx].copy(), u[k], p, reading)
        return reading[settings.observed].copy()

    points = MerweScaledSigmaPoints(n + nw, ALPHA, 2.0, 0.0)
    ukf = UnscentedKalmanFilter(n + nw, ny, 1.0, hx=read, fx=move, points=points)
    ukf.x = np.concatenate([trial.x, np.zeros(n - nx + nw)])
    ukf.P = np.zeros((n + nw, n + nw))
    ukf.P[:nx, :nx] = np.diag(np.square(trial.x_sd))
    ukf.P[n:, n:] = np.diag(np.square(settings.noise_sd))
    ukf.R = np.diag(np.square(settings.reading_sd))
    return ukf
