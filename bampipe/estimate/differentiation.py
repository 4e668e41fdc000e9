"""Parts that all methods of differentiating a sampled motion share.

A method takes positions on a uniform grid and returns position, velocity and acceleration with
their standard deviations. Two are implemented: a zero-phase Butterworth filter followed by central
differences (:mod:`bampipe.estimate.butterworth`), and a Kalman smoother of an integrated white
noise (:mod:`bampipe.estimate.kalman_smoother`).
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval, polyvander
from scipy.interpolate import Akima1DInterpolator, CubicSpline, PchipInterpolator

from bampipe.arrays import Array, Flags

_GAP = 2.5
"""Splines do not bridge gaps longer than this multiple of the median sampling interval."""


@dataclass(frozen=True)
class Derivatives:
    """A motion and its first two derivatives, each of shape (T,).

    The standard deviations (``*_sd``) cover the measurement noise; those of the Kalman smoother
    also cover possible motion between and beyond the samples.
    """

    position: Array
    velocity: Array
    acceleration: Array
    position_sd: Array
    velocity_sd: Array
    acceleration_sd: Array


@dataclass(frozen=True)
class UniformGrid:
    """Time stamps put on a uniform grid.

    Attributes:
        t: the grid, shape (T,), s.
        bridged: shape (T,), true where no sample lies within one sampling interval of the grid
            point, so that the value is a guess across a gap.
        exact: whether all samples lie on the grid, so that nothing is interpolated.
        source: time stamps of the samples, shape (N,), s.
    """

    t: Array
    bridged: Flags
    exact: bool
    source: Array

    def hold(self, values: Array) -> Array:
        """Return ``values`` (N,) on the grid (T,), each held until the next, as commands are."""
        if self.exact:
            return np.array(values, dtype=np.float64)
        last = np.searchsorted(self.source, self.t + 1e-9, side="right") - 1
        return np.asarray(values[np.clip(last, 0, len(values) - 1)], dtype=np.float64)

    @property
    def stamp_offset(self) -> Array:
        """Time of the nearest sample less that of each grid point, (T,), s; 0 across gaps."""
        after = np.clip(np.searchsorted(self.source, self.t), 1, len(self.source) - 1)
        sides = self.source[after - 1] - self.t, self.source[after] - self.t
        nearest = np.where(np.abs(sides[0]) < np.abs(sides[1]), *sides)
        return np.where(self.exact | self.bridged, 0.0, nearest)

    def resample(self, values: Array, jumps: bool = False) -> Array:
        """Interpolate ``values`` (N,) to the grid (T,).

        A cubic spline is used, whose error falls with the fourth power of the sampling interval (de
        Boor 1978, A Practical Guide to Splines), and across gaps a monotone cubic interpolation
        (Fritsch and Butland 1984), which does not overshoot. Of values with ``jumps``, such as a
        force when friction reverses, a spline would ring: Akima's interpolation (1970, Journal of
        the ACM 17, 589), modified, hardly does.
        """
        if self.exact:
            return np.array(values, dtype=np.float64)
        inside = np.clip(self.t, self.source[0], self.source[-1])
        t, values = _well_apart(self.source, values, (self.t[-1] - self.t[0]) / len(self.t) / 4)
        monotone = PchipInterpolator(t, values)
        if len(t) < 4:
            return np.asarray(monotone(inside), dtype=np.float64)
        akima = Akima1DInterpolator(t, values, method="makima", extrapolate=True) if jumps else None
        on_grid = np.asarray((akima or CubicSpline(t, values))(inside), dtype=np.float64)
        on_grid[self.bridged] = monotone(inside[self.bridged])
        return on_grid


def spline_curvature(t: Array, values: Array) -> Array:
    """Second derivatives (N, n) of cubic splines through ``values`` (N, n) at times ``t`` (N,), s.

    Between two samples a second derivative is linear. Splines end with zero curvature at gaps,
    where they would overshoot, and between stamps that are close together, where they would follow
    noise.
    """
    curvature = np.zeros(values.shape)
    step = np.diff(t)
    usual = np.median(step)
    ends = np.flatnonzero((step > _GAP * usual) | (step < usual / _GAP)) + 1
    for run in np.split(np.arange(len(t)), ends):
        if len(run) > 2:
            curvature[run] = CubicSpline(t[run], values[run], bc_type="natural")(t[run], 2)
    return curvature


def _well_apart(t: Array, values: Array, closest: float) -> tuple[Array, Array]:
    """Return stamps (N,) and values (N,), averaging those closer together than ``closest``.

    Otherwise a spline would follow the slope of noise between close stamps, which is unbounded.
    """
    group = np.concatenate(([0], np.cumsum(np.diff(t) >= closest)))
    if group[-1] == 0 or group[-1] == len(t) - 1:
        return t, values
    size = np.bincount(group)
    return np.bincount(group, t) / size, np.bincount(group, values) / size


def uniform_grid(t: Array, rate_hz: float) -> UniformGrid:
    """Return the uniform grid of nominal rate for time stamps ``t`` (N,), s, increasing.

    The grid starts at the first sample. Stamps within 2 % of a sampling interval of their grid
    points, one by one, count as being on the grid.

    Raises:
        ValueError: fewer than two samples, or stamps that do not increase.
    """
    if len(t) < 2 or np.any(np.diff(t) <= 0.0):
        raise ValueError("time stamps must increase, and there must be two at least")
    step = 1.0 / rate_hz
    count = int(np.floor((t[-1] - t[0]) / step + 0.02)) + 1
    grid = t[0] + step * np.arange(count)
    exact = count == len(t) and bool(np.all(np.abs(grid - t) < 0.02 * step))
    found = UniformGrid(grid, np.zeros(count, dtype=bool), exact, t)
    return replace(found, bridged=np.abs(found.stamp_offset) >= step)


def extend(values: Array, reach: int, fit: int) -> Array:
    """Return ``values`` (T,) with ``reach`` samples added at both ends, shape (T + 2 reach,).

    The signal is reflected in its end point so that position, velocity and acceleration are
    continuous: x(-t) = 2 x0 - x(t) + a t², with x0 and a from a cubic fitted to the ``fit`` samples
    at the end. A plain odd reflection (a = 0) would reverse the acceleration, so that the filtered
    acceleration would go to zero at either end.
    """
    reach = min(reach, len(values) - 1)
    fit = min(fit, len(values))
    weights = _end_weights(fit, min(3, fit - 1))
    offsets = np.arange(1, reach + 1, dtype=np.float64)

    def extrapolate(end: Array) -> Array:
        """Return the samples before ``end[0]``, the nearest first."""
        start, curvature = weights @ end[:fit]
        return np.asarray(2.0 * start - end[1 : reach + 1] + curvature * offsets**2)

    return np.concatenate((extrapolate(values)[::-1], values, extrapolate(values[::-1])))


@lru_cache(maxsize=64)
def _end_weights(fit: int, degree: int) -> Array:
    """Weights for value and second derivative of a fit at the first of ``fit`` samples.

    Returns:
        (2, fit) weights of the samples, which are not to be written to.
    """
    scale = 2.0 / max(fit - 1, 1)
    fitted = np.linalg.pinv(polyvander(scale * np.arange(fit) - 1.0, degree))
    curved = polyder(np.eye(degree + 1), 2) if degree >= 2 else np.zeros((1, degree + 1))
    at_start = [polyval(-1.0, np.eye(degree + 1)), scale**2 * polyval(-1.0, curved)]
    return np.asarray(np.array(at_start) @ fitted)
