"""The unscented filter in its covariance form: the oracle of the square-root form."""

import numpy as np
from numba import float64, int64, void
from numpy.typing import NDArray

from bampipe.compiled import njit
from bampipe.estimate.filter_signature import (
    DONE,
    INNOVATION_NOT_POSITIVE,
    NOT_FINITE,
    STATE_NOT_POSITIVE,
    kernel,
)
from bampipe.estimate.propagation import measure_points, propagate_points, scratch
from bampipe.estimate.triangular import cholesky, forward_substitute


@njit(
    float64(float64[::1], float64[::1], int64), cache=True, fastmath={"reassoc", "nsz", "contract"}
)
def product(a, b, count):  # type: ignore[no-untyped-def]
    """Return the inner product of the first ``count`` elements of ``a`` and ``b``."""
    total = 0.0
    for i in range(count):
        total += a[i] * b[i]
    return total


@njit(void(float64[::1], float64[:, ::1], float64[::1], float64[:, ::1]), cache=True)
def store(mean, covariance, mean_out, covariance_out):  # type: ignore[no-untyped-def]
    """Copy ``mean`` (n,) and ``covariance`` (n, n)."""
    for i in range(mean.shape[0]):
        mean_out[i] = mean[i]
        for j in range(mean.shape[0]):
            covariance_out[i, j] = covariance[i, j]


def memory(
    n: int, nx: int, nu: int, ny: int, nw: int, p: NDArray[np.float64]
) -> tuple[NDArray[np.float64], ...]:
    """Scratch of `filter_covariance`: points, images, root, gain, innovation, vectors, points.

    Args:
        n, nx, nu, ny, nw: lengths of mean, state, input, reading and process noise.
        p: (np + 1,) all parameters, then the timing of the inputs.
    """
    return (
        np.empty((nx, 1 + 2 * (n + nw))),
        np.empty((ny, 1 + 2 * n)),
        np.zeros((n, n)),
        np.empty((n, ny)),
        np.empty((ny, ny)),
        np.zeros((ny, ny)),
        np.empty((2, ny)),
        scratch(nx, nu, p, nw),
    )


@njit(kernel(8), cache=True)
def filter_covariance(  # type: ignore[no-untyped-def]
    derivative,
    measure,
    t,
    u,
    y,
    observed,
    reads_parameters,
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
    matrices,
):
    """Filter one trial, propagating the covariance. Returns the sample of failure or DONE."""
    n = mean.shape[0]
    nw = noise_sd.shape[0]
    ny = observed.shape[0]
    spread, centre, other = weights[0], weights[2], weights[3]
    reach = spread**0.5
    pairs = n + nw
    points, images, factor, gain, innovation_covariance, innovation_factor, vectors, work = matrices
    predicted, whitened = vectors[0], vectors[1]
    timing = p.shape[0] - 1
    store(mean, covariance, means[0], covariances[0])
    for k in range(1, t.shape[0]):
        dt = t[k] - t[k - 1]
        substeps = max(1, int(np.ceil(dt / longest_step - 1e-6)))
        if not cholesky(covariance, factor):
            reason[0] = STATE_NOT_POSITIVE
            return k
        propagate_points(
            derivative, mean, factor, reach, noise_sd, nx, timing, free, logarithmic, lower, upper,
            u[k - 1], u[k], dt, substeps, points, work,
        )  # fmt: skip
        for i in range(nx):
            middle = points[i, 2 * pairs]
            total = 0.0
            for row in range(2 * pairs):
                total += points[i, row] - middle
            mean[i] = middle + other * total
            for row in range(1 + 2 * pairs):
                points[i, row] -= mean[i]
        for i in range(n):
            for j in range(min(i + 1, nx)):
                if i < nx:
                    middle = centre * points[i, 2 * pairs] * points[j, 2 * pairs]
                    covariance[i, j] = middle + other * product(points[i], points[j], 2 * pairs)
                else:
                    # The parameters of opposite points differ by twice the root's row.
                    total = 0.0
                    for pair in range(i + 1):
                        total += factor[i, pair] * (points[j, pair] - points[j, pairs + pair])
                    covariance[i, j] = other * reach * total
                covariance[j, i] = covariance[i, j]
            if i >= nx:
                covariance[i, i] += walk_sd[i - nx] ** 2 * dt
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
                measure, mean, factor, reach, nx, free, logarithmic, lower, upper, u[k], observed,
                reads_parameters, images, work,
            )  # fmt: skip
            for i in range(ny):
                middle = images[i, 2 * n]
                total = 0.0
                for row in range(2 * n):
                    total += images[i, row] - middle
                predicted[i] = middle + other * total
                innovations[k, i] = y[k, i] - predicted[i]
                for row in range(1 + 2 * n):
                    images[i, row] -= predicted[i]
            for i in range(ny):
                for j in range(i + 1):
                    # The points that move the process noise alone coincide with the centre.
                    middle = (centre + 2 * nw * other) * images[i, 2 * n] * images[j, 2 * n]
                    total = middle + other * product(images[i], images[j], 2 * n)
                    innovation_covariance[i, j] = total
                    innovation_covariance[j, i] = total
                innovation_covariance[i, i] += reading_sd[i] ** 2
                innovation_sd[k, i] = innovation_covariance[i, i] ** 0.5
            for i in range(n):
                for j in range(ny):
                    total = 0.0
                    for pair in range(i + 1):
                        total += factor[i, pair] * (images[j, pair] - images[j, n + pair])
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
            store(mean, covariance, means[k // stride], covariances[k // stride])
    for i in range(n):
        if not np.isfinite(mean[i]):
            reason[0] = NOT_FINITE
            return t.shape[0] - 1
    return DONE
