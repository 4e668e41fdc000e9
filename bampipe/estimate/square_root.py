"""The unscented filter in its square-root form (section V-C), the default."""

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
from bampipe.estimate.triangular import factor_of_rows, forward_substitute, rank_one_update


@njit(KERNEL, cache=True)
def filter_square_root(  # type: ignore[no-untyped-def]
    derivative,
    measure,
    t,
    u,
    y,
    observed,
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
):
    """Filter one trial, propagating the lower root of the covariance.

    The prediction is one QR factorisation of the weighted deviations (Van der Merwe and Wan
    2001); the update triangularises the joint root of measurement and state, so that it needs no
    downdate and cannot lose positive definiteness. Returns the sample of failure or DONE.
    """
    n = mean.shape[0]
    nw = noise_sd.shape[0]
    ny = observed.shape[0]
    nt = n - nx
    spread, centre, other = weights[0], weights[2], weights[3]
    reach = spread**0.5
    root_other = other**0.5
    rows = 1 + 2 * (n + nw)
    points = np.empty((rows, n))
    images = np.empty((1 + 2 * n, ny))
    deviations = np.empty((n, rows - 1 + nt))
    noise_rows = np.empty((ny, n + ny + 1))
    noise_factor = np.zeros((ny, ny))
    joint_rows = np.empty((ny + n, ny + n))
    joint = np.zeros((ny + n, ny + n))
    single = np.empty(max(n, ny))
    predicted = np.empty(ny)
    whitened = np.empty(ny)
    work = np.empty((10, n + nw + 2 * u.shape[1] + 2 * nx + ny))
    centre_image = centre + 2 * nw * other
    means[0] = mean
    covariances[0] = factor @ factor.T
    for k in range(1, t.shape[0]):
        dt = t[k] - t[k - 1]
        substeps = max(1, int(np.ceil(dt / longest_step - 1e-6)))
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
            if not np.isfinite(mean[i]):
                reason[0] = NOT_FINITE
                return k
            for row in range(1, rows):
                deviations[i, row - 1] = root_other * (points[row, i] - mean[i])
            for j in range(nt):
                deviations[i, rows - 1 + j] = 0.0
            if i >= nx:
                deviations[i, rows - 1 + i - nx] = walk_sd[i - nx] * dt**0.5
            single[i] = abs(centre) ** 0.5 * (points[0, i] - mean[i])
        factor_of_rows(deviations, rows - 1 + nt, factor)
        if centre != 0.0 and not rank_one_update(factor, 1.0 if centre > 0.0 else -1.0, single[:n]):
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
                # A pair of opposite points splits into its sum, which only curvature moves,
                # and its difference, which is correlated with the state.
                for pair in range(n):
                    noise_rows[i, pair] = (other / 2.0) ** 0.5 * (
                        images[1 + 2 * pair, i] + images[2 + 2 * pair, i] - 2.0 * predicted[i]
                    )
                for j in range(ny):
                    noise_rows[i, n + j] = reading_sd[i] if i == j else 0.0
                single[i] = abs(centre_image) ** 0.5 * (images[0, i] - predicted[i])
            factor_of_rows(noise_rows, n + ny, noise_factor)
            if not rank_one_update(noise_factor, 1.0 if centre_image >= 0.0 else -1.0, single[:ny]):
                reason[0] = INNOVATION_NOT_POSITIVE
                return k
            for i in range(ny):
                for j in range(ny):
                    joint_rows[i, j] = noise_factor[i, j]
                for pair in range(n):
                    joint_rows[i, ny + pair] = (other / 2.0) ** 0.5 * (
                        images[1 + 2 * pair, i] - images[2 + 2 * pair, i]
                    )
            for i in range(n):
                for j in range(ny):
                    joint_rows[ny + i, j] = 0.0
                for j in range(n):
                    joint_rows[ny + i, ny + j] = factor[i, j]
            factor_of_rows(joint_rows, ny + n, joint)
            nis = 0.0
            log_likelihood = 0.0
            for i in range(ny):
                whitened[i] = innovations[k, i]
                total = 0.0
                for j in range(i + 1):
                    total += joint[i, j] * joint[i, j]
                innovation_sd[k, i] = total**0.5
                if not joint[i, i] > 0.0:
                    reason[0] = INNOVATION_NOT_POSITIVE
                    return k
            forward_substitute(joint, ny, whitened)
            for i in range(ny):
                nis += whitened[i] ** 2
                log_likelihood -= np.log(joint[i, i]) + 0.5 * np.log(2.0 * np.pi)
            consistency[k, 0] = nis
            consistency[k, 1] = log_likelihood - 0.5 * nis
            for i in range(n):
                for j in range(ny):
                    mean[i] += joint[ny + i, j] * whitened[j]
                for j in range(i + 1):
                    factor[i, j] = joint[ny + i, ny + j]
            for j in range(nt):
                mean[nx + j] = min(max(mean[nx + j], lower[j]), upper[j])
        if k % stride == 0:
            means[k // stride] = mean
            for i in range(n):
                for j in range(i + 1):
                    total = 0.0
                    for m in range(j + 1):
                        total += factor[i, m] * factor[j, m]
                    covariances[k // stride, i, j] = total
                    covariances[k // stride, j, i] = total
    for i in range(n):
        if not np.isfinite(mean[i]):
            reason[0] = NOT_FINITE
            return t.shape[0] - 1
    return DONE
