"""Triangular factors of covariances, compiled: Cholesky, QR, substitution.

All matrices are float64 and C-contiguous; factors are lower triangular. The loops replace
LAPACK because at 13 x 13 the call and its allocations cost more than the arithmetic.
"""

from numba import boolean, float64, int64, njit, void

_REASSOCIATE = {"reassoc", "nsz", "contract"}  # lets sums use vector registers; NaN stays NaN


@njit(boolean(float64[:, ::1], float64[:, ::1]), cache=True, fastmath=_REASSOCIATE)
def cholesky(covariance, factor):  # type: ignore[no-untyped-def]
    """Write the lower Cholesky factor of ``covariance`` (n, n) into ``factor`` (n, n).

    A coordinate with exactly zero variance gets a zero column: it is known and stays so.

    Returns:
        Whether the matrix is positive semidefinite; ``factor`` is meaningless otherwise.
    """
    n = covariance.shape[0]
    for j in range(n):
        for k in range(j):
            factor[k, j] = 0.0
        pivot = covariance[j, j]
        known = pivot == 0.0
        for k in range(j):
            pivot -= factor[j, k] * factor[j, k]
        if known:
            factor[j, j] = 0.0
            for i in range(j + 1, n):
                factor[i, j] = 0.0
            continue
        if not pivot > 0.0:
            return False
        diagonal = pivot**0.5
        factor[j, j] = diagonal
        for i in range(j + 1, n):
            total = covariance[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            factor[i, j] = total / diagonal
    return True


@njit(void(float64[:, ::1], int64, float64[:, ::1]), cache=True, fastmath=_REASSOCIATE)
def factor_of_rows(columns, n_rows, factor):  # type: ignore[no-untyped-def]
    """Write the lower L with L L^T = A^T A into ``factor`` (n, n), by Householder reflections.

    Args:
        columns: (n, >= n_rows) A transposed, so that each column of A is contiguous; destroyed.
        n_rows: number of rows of A in use, at least n.
        factor: (n, n) result, its diagonal not negative.
    """
    n = columns.shape[0]
    for j in range(n):
        square = 0.0
        for i in range(j, n_rows):
            square += columns[j, i] * columns[j, i]
        for i in range(j):
            factor[i, j] = 0.0
        if square == 0.0:
            for i in range(j, n):
                factor[i, j] = 0.0
            continue
        norm = square**0.5
        head = columns[j, j]
        reflected = -norm if head > 0.0 else norm
        sign = -1.0 if head > 0.0 else 1.0
        columns[j, j] = head - reflected
        scale = 1.0 / (norm * (norm + abs(head)))
        factor[j, j] = norm
        for k in range(j + 1, n):
            projection = 0.0
            for i in range(j, n_rows):
                projection += columns[j, i] * columns[k, i]
            projection *= scale
            for i in range(j, n_rows):
                columns[k, i] -= projection * columns[j, i]
            factor[k, j] = sign * columns[k, j]


@njit(void(float64[:, ::1], int64, float64[::1]), cache=True)
def forward_substitute(factor, n, vector):  # type: ignore[no-untyped-def]
    """Replace ``vector`` (>= n,) by L^-1 vector, L the leading (n, n) block of ``factor``."""
    for i in range(n):
        total = vector[i]
        for k in range(i):
            total -= factor[i, k] * vector[k]
        vector[i] = total / factor[i, i]


@njit(void(float64[:, ::1], int64, float64[::1]), cache=True)
def back_substitute(factor, n, vector):  # type: ignore[no-untyped-def]
    """Replace ``vector`` (>= n,) by L^-T vector, L the leading (n, n) block of ``factor``."""
    for i in range(n - 1, -1, -1):
        total = vector[i]
        for k in range(i + 1, n):
            total -= factor[k, i] * vector[k]
        vector[i] = total / factor[i, i]


@njit(boolean(float64[:, ::1], float64, float64[::1]), cache=True)
def rank_one_update(factor, sign, vector):  # type: ignore[no-untyped-def]
    """Replace L by the factor of L L^T + sign vector vector^T; ``vector`` (n,) is destroyed.

    Returns:
        Whether the result is positive definite (always for ``sign`` = 1).
    """
    n = vector.shape[0]
    for k in range(n):
        diagonal = factor[k, k]
        square = diagonal * diagonal + sign * vector[k] * vector[k]
        if vector[k] == 0.0:
            continue
        if not square > 0.0:
            return False
        updated = square**0.5
        if diagonal == 0.0:
            # Sigma points leave the centre behind along a direction of no spread.
            factor[k, k] = updated
            for i in range(k + 1, n):
                factor[i, k] = sign * vector[i] * vector[k] / updated
                vector[i] = 0.0
            continue
        cosine = updated / diagonal
        sine = vector[k] / diagonal
        factor[k, k] = updated
        for i in range(k + 1, n):
            factor[i, k] = (factor[i, k] + sign * sine * vector[i]) / cosine
            vector[i] = cosine * vector[i] - sine * factor[i, k]
    return True
