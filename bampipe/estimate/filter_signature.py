"""The one signature of both forms of the unscented filter, and why they may stop.

A filter may be stopped and continued: ``mean`` and the covariance (or its root) go in as the
distribution at sample 0 and come out as that at the last sample, so that a filter fed sample by
sample computes what the batch filter computes.
"""

from typing import Any

from numba import boolean, float64, int64, types

from bampipe.estimate.signatures import DERIVATIVE_ROWS, MEASURE_ROWS

DONE = -1
NOT_FINITE = 1
STATE_NOT_POSITIVE = 2
INNOVATION_NOT_POSITIVE = 3

_ARGUMENTS = (
    DERIVATIVE_ROWS,  # f(count, x, u, p, w, dx)
    MEASURE_ROWS,  # h(count, x, u, p, y)
    float64[::1],  # t (T,) s
    float64[:, ::1],  # u (T, nu)
    float64[:, ::1],  # y (T, ny), NaN where a reading is missing
    int64[::1],  # observed (ny,): which elements of h are in y
    boolean,  # whether h depends on estimated parameters
    int64,  # nx
    float64[::1],  # mean (n,), in and out
    float64[:, ::1],  # covariance, or its lower root (n, n), in and out
    float64[::1],  # p (np + 1,): all parameters, then the timing of the inputs
    int64[::1],  # free (n - nx,): places of the estimated ones in p
    boolean[::1],  # logarithmic (n - nx,): which of them are estimated as logarithms
    float64[::1],  # lower (n - nx,)
    float64[::1],  # upper (n - nx,)
    float64[::1],  # noise_sd (nw,): process noise of each sample
    float64[::1],  # walk_sd (n - nx,): random walk of the parameters, per square root of s
    float64[::1],  # reading_sd (ny,): measurement noise, additive
    float64[::1],  # weights: spread, mean_0, covariance_0, other
    float64,  # longest Runge-Kutta step, s
    int64,  # stride of the stored distributions
    float64[:, ::1],  # means (ceil(T / stride), n), out
    float64[:, :, ::1],  # covariances (ceil(T / stride), n, n), out
    float64[:, ::1],  # innovations (T, ny), out
    float64[:, ::1],  # innovation_sd (T, ny), out
    float64[:, ::1],  # consistency (T, 2), out: NIS and log likelihood
    int64[::1],  # reason (1,), out: why it stopped
)


def kernel(matrices: int) -> Any:
    """Signature of a filter that is given so many matrices of scratch as a tuple.

    Kernels get their memory from the caller: in each process, numba takes a second to compile
    what allocates arrays. The result is the sample of failure, or `DONE`.
    """
    scratch = types.UniTuple(float64[:, ::1], matrices)  # type: ignore[no-untyped-call]
    return int64(*_ARGUMENTS, scratch)
