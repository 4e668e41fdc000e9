"""The unscented filter in its square-root form (section V-C), the default."""

import numpy as np
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
from bampipe.estimate.triangular import (
    append_rows,
    condition,
    covariance_of,
    forward_substitute,
    padded,
    rank_one_update,
    transpose,
)


def memory(
    n: int, nx: int, nu: int, ny: int, nw: int, p: NDArray[np.float64]
) -> tuple[NDArray[np.float64], ...]:
    """Scratch of `filter_square_root`: points, images, roots, noise, gain, vectors, points.

    Args:
        n, nx, nu, ny, nw: lengths of mean, state, input, reading and process noise.
        p: (np + 1,) all parameters, then the timing of the inputs.
    """
    pairs = n + nw
    wide = padded(n)
    return (
        np.empty((nx, 1 + 2 * pairs)),
        np.empty((ny, 1 + 2 * n)),
        np.zeros((n, wide)),
        np.zeros((n, padded(pairs + nw))),
        np.zeros((ny, wide)),
        np.empty((ny, ny)),
        np.empty((ny, n)),
        np.empty((ny, wide)),
        np.empty((5, n + ny + 1)),
        scratch(nx, nu, p, nw),
    )


@njit(kernel(10), cache=True, fastmath={"contract"})
def filter_square_root(  # type: ignore[no-untyped-def]
    derivative,
    measure,
    t,
    u,
    y,
    observed,
    reads_parameters,
    nx,
    mean,
    factor,
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
    """Filter one trial, propagating the lower root of the covariance.

    The prediction is a QR factorisation of the weighted deviations (Van der Merwe and Wan 2001),
    by differences and sums of opposite points: parameters stay where they are, so that in the
    sums, and in the points that move the noise, only the state is not zero. The update rotates
    the joint root of measurement and state, so that it needs no downdate and cannot lose positive
    definiteness. Returns the sample of failure or DONE.
    """
    n = mean.shape[0]
    nw = noise_sd.shape[0]
    ny = observed.shape[0]
    nt = n - nx
    spread, centre, other = weights[0], weights[2], weights[3]
    reach = spread**0.5
    half = (0.5 * other) ** 0.5
    pairs = n + nw
    # root is R = L^T, so that what is rotated together is contiguous
    points, images, root, columns, noise_columns, noise, cross, gain, vectors, work = matrices
    cosine, sine, single = vectors[0], vectors[1], vectors[2]
    predicted, whitened = vectors[3], vectors[4]
    wide = root.shape[1]
    timing = p.shape[0] - 1
    centre_image = centre + 2 * nw * other
    log_normal = 0.5 * ny * np.log(2.0 * np.pi)
    walking = False
    for j in range(nt):
        walking = walking or walk_sd[j] != 0.0
    for i in range(n):
        for j in range(n):
            root[i, j] = factor[j, i] if i <= j else 0.0
    for i in range(n):
        means[0, i] = mean[i]
    covariance_of(root, covariances[0])
    for k in range(1, t.shape[0]):
        dt = t[k] - t[k - 1]
        substeps = max(1, int(np.ceil(dt / longest_step - 1e-6)))
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
            if not np.isfinite(mean[i]):
                reason[0] = NOT_FINITE
                return k
            for pair in range(pairs):
                columns[i, pair] = half * (
                    points[i, pair] + points[i, pairs + pair] - 2.0 * mean[i]
                )
            for pair in range(n, pairs):
                columns[i, pairs + pair - n] = half * (points[i, pair] - points[i, pairs + pair])
            single[i] = abs(centre) ** 0.5 * (middle - mean[i])
            for j in range(n):
                root[i, j] = 0.0
        append_rows(root, nx, columns, columns.shape[1])
        for i in range(n):
            for pair in range(n, wide):
                columns[i, pair] = 0.0
            for pair in range(n):
                columns[i, pair] = (
                    half * (points[i, pair] - points[i, pairs + pair])
                    if i < nx
                    else (factor[i, pair] if pair <= i else 0.0)
                )
        for i in range(nx, n):
            single[i] = 0.0
            for j in range(n):
                root[i, j] = walk_sd[i - nx] * dt**0.5 if i == j else 0.0
        # Columns of the state first; then the parameters' rows start from their random walk.
        append_rows(root, n, columns, wide)
        if centre != 0.0 and not rank_one_update(root, n, 1.0 if centre > 0.0 else -1.0, single):
            reason[0] = STATE_NOT_POSITIVE
            return k
        missing = False
        for i in range(ny):
            missing = missing or np.isnan(y[k, i])
            innovations[k, i] = np.nan
            innovation_sd[k, i] = np.nan
        consistency[k, 0] = np.nan
        consistency[k, 1] = np.nan
        if not missing:
            transpose(root, factor)
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
                # A pair of opposite points splits into its sum, which only curvature moves,
                # and its difference, which is correlated with the state.
                for pair in range(n):
                    noise_columns[i, pair] = half * (
                        images[i, pair] + images[i, n + pair] - 2.0 * predicted[i]
                    )
                    cross[i, pair] = half * (images[i, pair] - images[i, n + pair])
                for j in range(ny):
                    noise[i, j] = reading_sd[i] if i == j else 0.0
                single[i] = abs(centre_image) ** 0.5 * (middle - predicted[i])
            append_rows(noise, ny, noise_columns, wide)
            if not rank_one_update(noise, ny, 1.0 if centre_image >= 0.0 else -1.0, single):
                reason[0] = INNOVATION_NOT_POSITIVE
                return k
            for i in range(ny):
                for j in range(i):
                    noise[i, j] = noise[j, i]
            condition(root, noise, cross, gain, cosine, sine)
            nis = 0.0
            log_likelihood = -log_normal
            for i in range(ny):
                whitened[i] = innovations[k, i]
                total = 0.0
                for j in range(i + 1):
                    total += noise[i, j] * noise[i, j]
                innovation_sd[k, i] = total**0.5
                if not noise[i, i] > 0.0:
                    reason[0] = INNOVATION_NOT_POSITIVE
                    return k
            forward_substitute(noise, ny, whitened)
            for i in range(ny):
                nis += whitened[i] ** 2
                log_likelihood -= np.log(noise[i, i])
                for j in range(n):
                    mean[j] += gain[i, j] * whitened[i]
            consistency[k, 0] = nis
            consistency[k, 1] = log_likelihood - 0.5 * nis
            for j in range(nt):
                mean[nx + j] = min(max(mean[nx + j], lower[j]), upper[j])
        transpose(root, factor)
        if k % stride == 0:
            for i in range(n):
                means[k // stride, i] = mean[i]
            covariance_of(root, covariances[k // stride])
    for i in range(n):
        if not np.isfinite(mean[i]):
            reason[0] = NOT_FINITE
            return t.shape[0] - 1
    return DONE
