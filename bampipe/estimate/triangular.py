"""Triangular factors of covariances, compiled: QR, rotations, substitution.

All matrices are float64 and C-contiguous. The loops replace LAPACK because at 13 x 13 the call
and its allocations cost more than the arithmetic.
"""

from bampipe.compiled import part

_REASSOCIATE = {"reassoc", "nsz", "contract"}  # lets sums use vector registers; NaN stays NaN


_LANES = 16


@part()
def padded(n):  # type: ignore[no-untyped-def]
    """Return the least length from ``n`` on that fills whole vector registers, unrolled.

    Loops over rows padded with zeros to this length are faster than shorter ones with a
    remainder.
    """
    return (n + _LANES - 1) // _LANES * _LANES


@part(fastmath=_REASSOCIATE)
def append_rows(upper, n, columns, n_rows):  # type: ignore[no-untyped-def]
    """Replace the triangular R by that of R^T R + A^T A, by Householder reflections.

    Each reflection touches one row of R and the rows of A; zeros in R stay zero.

    Args:
        upper: (>= n, >= n) R, upper triangular; its leading (n, n) block is replaced, diagonal
            not negative.
        n: number of columns.
        columns: (>= n, >= n_rows) A transposed, so that each column of A is contiguous;
            destroyed.
        n_rows: number of rows of A.
    """
    for j in range(n):
        square = 0.0
        for i in range(n_rows):
            square += columns[j, i] * columns[j, i]
        if square == 0.0:
            if upper[j, j] < 0.0:
                for k in range(j, n):
                    upper[j, k] = -upper[j, k]
            continue
        head = upper[j, j]
        norm = (head * head + square) ** 0.5
        # The row is reflected to the side away from its head, then its sign is turned.
        sign = 1.0 if head < 0.0 else -1.0
        pivot = head - sign * norm
        scale = 1.0 / (norm * (norm + abs(head)))
        upper[j, j] = norm
        for k in range(j + 1, n):
            projection = 0.0
            for i in range(n_rows):
                projection += columns[j, i] * columns[k, i]
            projection = scale * (projection + pivot * upper[j, k])
            for i in range(n_rows):
                columns[k, i] -= projection * columns[j, i]
            upper[j, k] = sign * (upper[j, k] - projection * pivot)


@part(fastmath={"contract"})
def condition(upper, noise, cross, gain, cosine, sine):  # type: ignore[no-untyped-def]
    """Triangularise the joint root of readings and state, by Givens rotations.

    The joint root ``[[noise, cross], [0, R^T]]`` is rotated, column by column, until the block at
    ``cross`` is zero: its diagonal blocks then are the roots of the covariances of the innovation
    and of the state given the reading. Each sweep leaves R triangular (Carlson 1973), and nothing
    is subtracted, so that positive definiteness cannot be lost.

    Args:
        upper: (n, width) R with R^T R the covariance of the state, in and out; zeros below the
            diagonal and beyond column n (`padded`).
        noise: (ny, ny) lower root of the readings' covariance given the state; becomes the lower
            root of the innovation's covariance.
        cross: (ny, n) readings along the columns of R^T; destroyed.
        gain: (ny, width) result: transposed gain for the innovation divided by its root.
        cosine, sine: (n + 1,) scratch.
    """
    n, width = upper.shape
    ny = noise.shape[0]
    for i in range(ny):
        square = noise[i, i] * noise[i, i]
        cosine[n] = square
        for j in range(n - 1, -1, -1):
            square += cross[i, j] * cross[i, j]
            cosine[j] = square
        for j in range(n + 1):
            cosine[j] = cosine[j] ** 0.5
        noise[i, i] = cosine[0]
        for j in range(n):
            root = cosine[j]
            turned = root > 0.0
            sine[j] = cross[i, j] / root if turned else 0.0
            cosine[j] = cosine[j + 1] / root if turned else 1.0
        for k in range(width):
            gain[i, k] = 0.0
        for j in range(n - 1, -1, -1):
            s, c = sine[j], cosine[j]
            if s == 0.0:
                continue
            for k in range(width):
                old = upper[j, k]
                upper[j, k] = c * old - s * gain[i, k]
                gain[i, k] = s * old + c * gain[i, k]
            for k in range(i + 1, ny):
                old = cross[k, j]
                cross[k, j] = c * old - s * noise[k, i]
                noise[k, i] = s * old + c * noise[k, i]


@part()
def forward_substitute(factor, n, vector):  # type: ignore[no-untyped-def]
    """Replace ``vector`` (>= n,) by L^-1 vector, L the leading (n, n) block of ``factor``."""
    for i in range(n):
        total = vector[i]
        for k in range(i):
            total -= factor[i, k] * vector[k]
        vector[i] = total / factor[i, i]


@part()
def transpose(upper, factor):  # type: ignore[no-untyped-def]
    """Write the transpose of the upper triangular R (n, >= n) into ``factor`` (n, n)."""
    n = upper.shape[0]
    for i in range(n):
        for j in range(i + 1):
            factor[i, j] = upper[j, i]
        for j in range(i + 1, n):
            factor[i, j] = 0.0


@part(fastmath=_REASSOCIATE)
def covariance_of(upper, covariance):  # type: ignore[no-untyped-def]
    """Write R^T R into ``covariance`` (n, n), R upper triangular (n, >= n), zeros below."""
    n = upper.shape[0]
    for i in range(n):
        for j in range(n):
            covariance[i, j] = upper[0, i] * upper[0, j]
        for m in range(1, i + 1):
            for j in range(n):
                covariance[i, j] += upper[m, i] * upper[m, j]
