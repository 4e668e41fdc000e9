"""Fixed-interval smoother on top of the unscented filter (Rauch-Tung-Striebel; Sarkka 2008)."""

from __future__ import annotations

import numpy as np
from numba import boolean, float64, int64, void
from numpy.typing import NDArray

from bampipe.compiled import njit
from bampipe.estimate.propagation import propagate_points, scratch
from bampipe.estimate.signatures import DERIVATIVE_ROWS
from bampipe.estimate.unscented import (
    FilteredTrial,
    FilterModel,
    FilterSettings,
    Trial,
    lower_root,
)

Array = NDArray[np.float64]


@njit(
    void(
        DERIVATIVE_ROWS,
        float64[::1],
        float64[::1],
        float64[::1],
        float64[:, ::1],
        float64,
        float64,
        float64,
        float64[::1],
        int64,
        float64[::1],
        int64[::1],
        boolean[::1],
        float64[::1],
        float64[::1],
        float64,
        int64,
        float64[::1],
        float64[:, ::1],
        float64[:, ::1],
        float64[:, ::1],
        float64[:, ::1],
    ),
    cache=True,
)
def _predict(  # type: ignore[no-untyped-def]
    derivative, u0, u1, mean, factor, spread, centre, other, noise_sd, nx, p, free, logarithmic,
    lower, upper, dt, substeps, predicted, covariance, cross, states, work,
):  # fmt: skip
    """Repeat one prediction; also its covariance with the state that it starts from.

    ``states`` (nx, 1 + 2 (n + nw)) and ``work``, of `scratch`, are scratch.
    """
    n = mean.shape[0]
    nw = noise_sd.shape[0]
    pairs = n + nw
    reach = spread**0.5
    propagate_points(
        derivative, mean, factor, reach, noise_sd, nx, p.shape[0] - 1, free, logarithmic,
        lower, upper, u0, u1, dt, substeps, states, work,
    )  # fmt: skip
    for i in range(n):
        middle = states[i, 2 * pairs] if i < nx else mean[i]
        total = 0.0
        if i < nx:
            for row in range(2 * pairs):
                total += states[i, row] - middle
        predicted[i] = middle + other * total
    for i in range(nx):
        for row in range(1 + 2 * pairs):
            states[i, row] -= predicted[i]
    # The parameters of opposite points differ by twice the root's row, and stay.
    for i in range(n):
        for j in range(nx):
            total = 0.0
            for pair in range(n):
                ahead = states[j, pair] - states[j, pairs + pair]
                total += other * reach * factor[i, pair] * ahead
            cross[i, j] = total
            if i < nx:
                total = centre * states[i, 2 * pairs] * states[j, 2 * pairs]
                for row in range(2 * pairs):
                    total += other * states[i, row] * states[j, row]
            covariance[i, j] = total
            covariance[j, i] = total
        for j in range(nx, n):
            total = 0.0
            for pair in range(n):
                total += factor[i, pair] * factor[j, pair]
            cross[i, j] = total
            if i >= nx:
                covariance[i, j] = total


def smooth_trial(
    model: FilterModel, trial: Trial, filtered: FilteredTrial, settings: FilterSettings
) -> tuple[Array, Array]:
    """Return what the whole trial says of each sample, from the filter's forward pass.

    Args:
        model, trial, settings: as the filter was given them, ``settings.stride`` = 1.
        filtered: its result.

    Returns:
        means (T, n) and covariances (T, n, n), on the scale of estimation.

    Raises:
        ValueError: the filter did not store every sample.
    """
    if len(filtered.mean) != len(trial.t):
        raise ValueError("the smoother needs the distribution of every sample: stride 1")
    nx = model.n_states
    n = nx + model.free.size
    spread, _, centre, other = settings.points.weights(n + settings.noise_sd.size)
    lower, upper = model.range
    p = np.array(model.parameters, dtype=float)
    u = np.ascontiguousarray(trial.u, dtype=float)
    mean, covariance = filtered.mean.copy(), filtered.covariance.copy()
    predicted, spread_after, cross = np.empty(n), np.empty((n, n)), np.empty((n, n))
    nw = settings.noise_sd.size
    states, work = np.empty((nx, 1 + 2 * (n + nw))), scratch(nx, u.shape[1], p, nw)
    for k in range(len(trial.t) - 2, -1, -1):
        dt = float(trial.t[k + 1] - trial.t[k])
        substeps = max(1, int(np.ceil(dt / settings.longest_step - 1e-6)))
        _predict(
            model.derivative_rows, u[k], u[k + 1], filtered.mean[k],
            lower_root(filtered.covariance[k]),
            spread, centre, other, settings.noise_sd, nx, p, model.free, model.logarithmic,
            lower, upper, dt, substeps, predicted, spread_after, cross, states, work,
        )  # fmt: skip
        spread_after[range(nx, n), range(nx, n)] += np.square(settings.walk_sd) * dt
        scale = np.sqrt(np.diag(spread_after))
        scale[scale == 0.0] = 1.0
        normal = spread_after / np.outer(scale, scale)
        gain = np.linalg.lstsq(normal, (cross / scale).T, rcond=1e-14)[0].T / scale
        mean[k] += gain @ (mean[k + 1] - predicted)
        covariance[k] += gain @ (covariance[k + 1] - spread_after) @ gain.T
        covariance[k] = 0.5 * (covariance[k] + covariance[k].T)
    return mean, covariance
