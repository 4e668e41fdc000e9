"""The unscented filter in its covariance form: the oracle of the square-root form."""

import numpy as np
from numba import njit

from bampipe.estimate.filter_signature import (
    DONE,
    INNOVATION_NOT_POSITIVE,
    KERNEL,
    NOT_FINITE,
    STATE_NOT_POSITIVE,
)
from bampipe.estimate.propagation import measure_points, propagate_points
from bampipe.estimate.triangular import cholesky, forward_substitute


@njit(KERNEL, cache=True)
def filter_covariance(  # type: ignore[no-untyped-def]
    derivative,
    measure,
    t,
    u,
    y,
    observed,
    nx,
    mean,
    covariance,
    p,
    free,
    logarithmic,
    lower,
    upper,
    noise_sd,
    walk_sd,
    reading_sd,
    weights,
    longest_step,
    stride,
    means,
    covariances,
    innovations,
    innovation_sd,
    consistency,
    reason,
):
    """Filter one trial, propagating the covariance. Returns the sample of failure or DONE."""
    n = mean.shape[0]
    nw = noise_sd.shape[0]
    ny = observed.shape[0]
    spread, centre, other = weights[0], weights[2], weights[3]
    reach = spread**0.5
    rows = 1 + 2 * (n + nw)
    points = np.empty((rows, n))
    images = np.empty((1 + 2 * n, ny))
    factor = np.zeros((n, n))
    gain = np.empty((n, ny))
    innovation_covariance = np.empty((ny, ny))
    innovation_factor = np.zeros((ny, ny))
    predicted = np.empty(ny)
    whitened = np.empty(ny)
    work = np.empty((10, n + nw + 2 * u.shape[1] + 2 * nx + ny))
    means[0] = mean
    covariances[0] = covariance
    for k in range(1, t.shape[0]):
        dt = t[k] - t[k - 1]
        substeps = max(1, int(np.ceil(dt / longest_step - 1e-6)))
        if not cholesky(covariance, factor):
            reason[0] = STATE_NOT_POSITIVE
            return k
        propagate_points(
            derivative,
            mean,
            factor,
            reach,
            noise_sd,
            nx,
            p,
            free,
            logarithmic,
            lower,
            upper,
            u[k - 1],
            u[k],
            dt,
            substeps,
            points,
            work,
        )
        for i in range(n):
            total = 0.0
            for row in range(1, rows):
                total += points[row, i] - points[0, i]
            mean[i] = points[0, i] + other * total
        for row in range(rows):
            for i in range(n):
                points[row, i] -= mean[i]
        for i in range(n):
            for j in range(i + 1):
                total = 0.0
                for row in range(1, rows):
                    total += points[row, i] * points[row, j]
                covariance[i, j] = other * total + centre * points[0, i] * points[0, j]
            if i >= nx:
                covariance[i, i] += walk_sd[i - nx] ** 2 * dt
            for j in range(i):
                covariance[j, i] = covariance[i, j]
            if not np.isfinite(covariance[i, i]):
                reason[0] = NOT_FINITE
                return k
        missing = False
        for i in range(ny):
            missing = missing or np.isnan(y[k, i])
            innovations[k, i] = np.nan
            innovation_sd[k, i] = np.nan
        consistency[k, 0] = np.nan
        consistency[k, 1] = np.nan
        if not missing:
            if not cholesky(covariance, factor):
                reason[0] = STATE_NOT_POSITIVE
                return k
            measure_points(
                measure,
                mean,
                factor,
                reach,
                nx,
                p,
                free,
                logarithmic,
                lower,
                upper,
                u[k],
                observed,
                images,
                work,
            )
            for i in range(ny):
                total = 0.0
                for row in range(1, 1 + 2 * n):
                    total += images[row, i] - images[0, i]
                predicted[i] = images[0, i] + other * total
                innovations[k, i] = y[k, i] - predicted[i]
            for row in range(1 + 2 * n):
                for i in range(ny):
                    images[row, i] -= predicted[i]
            for i in range(ny):
                for j in range(i + 1):
                    # The points that move the process noise alone coincide with the centre.
                    total = (centre / other + 2 * nw) * images[0, i] * images[0, j]
                    for row in range(1, 1 + 2 * n):
                        total += images[row, i] * images[row, j]
                    innovation_covariance[i, j] = other * total
                    innovation_covariance[j, i] = other * total
                innovation_covariance[i, i] += reading_sd[i] ** 2
                innovation_sd[k, i] = innovation_covariance[i, i] ** 0.5
            for i in range(n):
                for j in range(ny):
                    total = 0.0
                    for pair in range(n):
                        total += factor[i, pair] * (
                            images[1 + 2 * pair, j] - images[2 + 2 * pair, j]
                        )
                    gain[i, j] = other * reach * total
            if not cholesky(innovation_covariance, innovation_factor):
                reason[0] = INNOVATION_NOT_POSITIVE
                return k
            for i in range(ny):
                whitened[i] = innovations[k, i]
            forward_substitute(innovation_factor, ny, whitened)
            nis = 0.0
            log_likelihood = 0.0
            for i in range(ny):
                nis += whitened[i] ** 2
                log_likelihood -= np.log(innovation_factor[i, i]) + 0.5 * np.log(2.0 * np.pi)
            consistency[k, 0] = nis
            consistency[k, 1] = log_likelihood - 0.5 * nis
            # K S^(T/2) = P_xy S^(-1/2): a Cholesky factor in place of an inverse.
            for i in range(n):
                forward_substitute(innovation_factor, ny, gain[i])
                for j in range(ny):
                    mean[i] += gain[i, j] * whitened[j]
            for i in range(n):
                for j in range(i + 1):
                    total = covariance[i, j]
                    for m in range(ny):
                        total -= gain[i, m] * gain[j, m]
                    covariance[i, j] = total
                    covariance[j, i] = total
            for j in range(n - nx):
                mean[nx + j] = min(max(mean[nx + j], lower[j]), upper[j])
        if k % stride == 0:
            means[k // stride] = mean
            covariances[k // stride] = covariance
    for i in range(n):
        if not np.isfinite(mean[i]):
            reason[0] = NOT_FINITE
            return t.shape[0] - 1
    return DONE
