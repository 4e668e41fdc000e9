"""The unscented filter with all noise in the state: the form that the simplified one shortens.

State, parameters, process noise, random walk of the parameters and measurement noise are one
vector, and one set of sigma points is carried through motion and measurement (Julier and Uhlmann
2004). The compiled filter is simpler: measurement noise and walk are additive, and points are drawn
afresh before the measurement. Where motion and measurement are linear, both compute the same;
elsewhere they differ in the terms that the unscented transform leaves out anyway. Python over
compiled motion: slow, for comparison.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.placement import place_parameters
from bampipe.estimate.runge_kutta import runge_kutta
from bampipe.estimate.unscented import (
    FilteredTrial,
    FilterFailure,
    FilterModel,
    FilterResult,
    FilterSettings,
    Trial,
    in_sequence,
)

Array = NDArray[np.float64]


def filter_trials_augmented(
    model: FilterModel,
    trials: Sequence[Trial],
    theta: Array,
    covariance: Array,
    settings: FilterSettings,
) -> FilterResult:
    """Filter trials in sequence, as `unscented.filter_trials` does; same arguments and result.

    Raises:
        FilterFailure: the covariance lost positive definiteness or a number is not finite.
    """

    def one(
        index: int, trial: Trial, theta: Array, covariance: Array
    ) -> tuple[FilteredTrial, Array, Array]:
        return _filter(model, index, trial, theta, covariance, settings)

    return in_sequence(one, trials, np.clip(theta, *model.range), covariance)


def _filter(
    model: FilterModel,
    index: int,
    trial: Trial,
    theta: Array,
    covariance: Array,
    settings: FilterSettings,
) -> tuple[FilteredTrial, Array, Array]:
    """Filter one trial; return it and the parameters with their covariance after it."""
    nx, nt, nw = model.n_states, model.free.size, settings.noise_sd.size
    n, ny, size = nx + nt, settings.observed.size, trial.t.size
    total = n + nw + nt + ny
    walk, reading = slice(n + nw, n + nw + nt), slice(n + nw + nt, total)
    spread, mean_0, centre, other = settings.points.weights(total)
    lower, upper = model.range
    p = np.array(model.parameters, dtype=float)
    u = np.array(trial.u, dtype=float, order="C")
    work = np.empty((6, max(2 * nx, u.shape[1])))
    output = np.empty(2 * nx)
    in_mean = np.full(1 + 2 * total, other)
    in_mean[0] = mean_0
    in_covariance = np.full(1 + 2 * total, other)
    in_covariance[0] = centre

    mean = np.concatenate([trial.x, theta])
    joint = np.zeros((n, n))
    joint[:nx, :nx], joint[nx:, nx:] = np.diag(np.square(trial.x_sd)), covariance
    means, covariances = np.empty((size, n)), np.empty((size, n, n))
    means[0], covariances[0] = mean, joint
    innovation, innovation_sd = np.full((size, ny), np.nan), np.full((size, ny), np.nan)
    nis, log_likelihood = np.full(size, np.nan), np.full(size, np.nan)
    for k in range(1, size):
        dt = float(trial.t[k] - trial.t[k - 1])
        substeps = max(1, int(np.ceil(dt / settings.longest_step - 1e-6)))
        root = np.zeros((total, total))
        try:
            root[:n, :n] = np.linalg.cholesky(joint)
        except np.linalg.LinAlgError as error:
            reason = "the covariance of the state lost positive definiteness"
            raise FilterFailure(index, k, reason) from error
        noise = [settings.noise_sd, settings.walk_sd * np.sqrt(dt), settings.reading_sd]
        root[n:, n:] = np.diag(np.concatenate(noise))
        away = np.ascontiguousarray(np.sqrt(spread) * root.T)
        points = np.concatenate([mean, np.zeros(total - n)]) + np.vstack(
            [np.zeros(total), away, -away]
        )
        images = np.empty((len(points), ny))
        for point, image in zip(points, images, strict=True):
            place_parameters(point, nx, model.free, model.logarithmic, lower, upper, p)
            x, w = point[:nx].copy(), point[n : n + nw].copy()
            late = p[-1] / dt * (u[k] - u[k - 1])
            runge_kutta(model.derivative, x, u[k - 1] - late, u[k] - late, p, w, dt, substeps, work)
            point[:nx] = x
            point[nx:n] += point[walk]
            place_parameters(point, nx, model.free, model.logarithmic, lower, upper, p)
            model.measure(x, u[k], p, output)
            image[:] = output[settings.observed] + point[reading]
        # Relative to the centre: the weights are large and of both signs.
        mean = points[0, :n] + in_mean @ (points[:, :n] - points[0, :n])
        if not np.isfinite(mean).all():
            raise FilterFailure(index, k, "the predicted motion grew without bound")
        deviation = points[:, :n] - mean
        joint = deviation.T @ (in_covariance[:, None] * deviation)
        if np.isfinite(trial.y[k]).all():
            expected = images[0] + in_mean @ (images - images[0])
            unlike = images - expected
            s = unlike.T @ (in_covariance[:, None] * unlike)
            gain = np.linalg.solve(s, unlike.T @ (in_covariance[:, None] * deviation)).T
            innovation[k] = trial.y[k] - expected
            innovation_sd[k] = np.sqrt(np.diag(s))
            nis[k] = innovation[k] @ np.linalg.solve(s, innovation[k])
            log_likelihood[k] = -0.5 * (nis[k] + np.linalg.slogdet(2.0 * np.pi * s)[1])
            mean = mean + gain @ innovation[k]
            joint = joint - gain @ s @ gain.T
            mean[nx:] = np.clip(mean[nx:], lower, upper)
        joint = 0.5 * (joint + joint.T)
        means[k], covariances[k] = mean, joint
    stored = slice(None, None, settings.stride)
    filtered = FilteredTrial(
        t=np.asarray(trial.t, dtype=float)[stored],
        mean=means[stored],
        covariance=covariances[stored],
        innovation=innovation,
        innovation_sd=innovation_sd,
        nis=nis,
        log_likelihood=log_likelihood,
    )
    return filtered, mean[nx:].copy(), joint[nx:, nx:].copy()
