"""The best information that data can give on parameters, its weak directions and its trials.

The residual of the inverse dynamics, e = D(theta) y - B u, is linear in what the sensors add to
the motion y and the force u. With white sensor noise its spectrum is known, and the information on
theta is that of a regression in coloured noise (Whittle 1953): the sum over frequencies of slope
times slope over spectrum. Its inverse is the Cramér-Rao bound on the covariance of any unbiased
estimate. Everything here sees arrays and callables only.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import rfft

from bampipe.arrays import Array
from bampipe.estimate.bounded import scaled_eigenbasis

_WEAK, _SMALLEST_PART = 0.1, 0.3
"""A direction of the information, scaled to a unit diagonal, is weak if its eigenvalue is below the
first number; parameters whose part in it is below this fraction of the largest are not named."""
_LEAST_NOISE = 1e-12
"""Smallest noise at any frequency, relative to the mean over frequencies."""


def residual_spectrum(
    count: int,
    rate_hz: float,
    inertia: Array,
    damping: Array,
    stiffness: Array,
    reading_sd: Array,
    force_sd: Array,
) -> Array:
    """Return the spectrum of sensor noise in the residual, (count // 2 + 1, n_q).

    It is in squared units of the residual per sample, at the frequencies of a real discrete Fourier
    transform of ``count`` samples. Noise ``reading_sd`` of a position reading acts through inertia,
    damping and stiffness of its axis; ``force_sd`` is that of the generalised force, zero on an
    axis that nothing drives. All are (n_q,).
    """
    omega = 2.0 * np.pi * np.fft.rfftfreq(count, 1.0 / rate_hz)[:, None]
    gain = (inertia * omega**2) ** 2 + (damping * omega) ** 2 + stiffness**2
    spectrum = force_sd**2 + reading_sd**2 * gain
    # Without force and stiffness, an axis would seem noise-free at rest.
    return np.asarray(np.maximum(spectrum, _LEAST_NOISE * spectrum.mean(axis=0)))


def information(slope: Array, spectrum: Array) -> Array:
    """Fisher information of one trial, (n, n).

    Args:
        slope: (T, n_q, n) of the residual, zero where an axis stands still.
        spectrum: (T // 2 + 1, n_q) of the residual's noise, positive.
    """
    transformed = rfft(slope, axis=0, norm="ortho")
    weight = np.full(len(spectrum), 2.0)  # each bin stands for itself and its negative
    weight[0] = 1.0
    if len(slope) % 2 == 0:
        weight[-1] = 1.0
    scaled = transformed * np.sqrt(weight[:, None] / spectrum)[:, :, None]
    flat = scaled.reshape(-1, slope.shape[2])
    # Real arithmetic suffices, because only the real part of the complex product is needed.
    parts = [np.ascontiguousarray(part) for part in (flat.real, flat.imag)]
    return np.asarray(parts[0].T @ parts[0] + parts[1].T @ parts[1])


def cramer_rao_bound(matrix: Array) -> Array:
    """Return the Cramér-Rao bound, the inverse of the information ``matrix`` (n, n).

    The matrix is symmetric and not negative; parameters in its null space have an infinite bound.
    """
    scale, value, vector, null = scaled_eigenbasis(matrix)
    inverse = (vector[:, ~null] / value[~null]) @ vector[:, ~null].T / np.outer(scale, scale)
    lost = (np.abs(vector[:, null]) > 1e-6).any(axis=1)
    inverse[lost] = inverse[:, lost] = 0.0
    inverse[lost, lost] = np.inf
    return np.asarray(inverse)


def undetermined_covariance(matrix: Array, prior_sd: Array) -> Array:
    """Return the prior covariance (n, n) given all combinations that the data determine.

    The information ``matrix`` (n, n) is symmetric and not negative; in the prior, parameters are
    independent, with positive standard deviations (n,).
    """
    scale, _, vector, null = scaled_eigenbasis(matrix)
    free = vector[:, null] / scale[:, None]
    return np.asarray(free @ np.linalg.inv(free.T @ (free / prior_sd[:, None] ** 2)) @ free.T)


@dataclass(frozen=True)
class Weak:
    """A direction in which parameters can move at little cost, because their effects cancel.

    Attributes:
        members: indices of the parameters that move, largest part first.
        parts: (len(members),) how far each moves, in units of its standard deviation with all
            others known; the largest is 1.
        strength: fraction of the information that is left in this direction, 0 to 1.
    """

    members: tuple[int, ...]
    parts: tuple[float, ...]
    strength: float


def weak_directions(matrix: Array) -> list[Weak]:
    """Return directions with much less information (n, n) than each parameter alone would have."""
    _, value, vector, _ = scaled_eigenbasis(matrix)
    found = []
    for k in np.flatnonzero(value < _WEAK):
        parts = vector[:, k] / vector[np.argmax(np.abs(vector[:, k])), k]
        order = [int(i) for i in np.argsort(-np.abs(parts)) if abs(parts[i]) >= _SMALLEST_PART]
        if len(order) > 1:
            shown = tuple(float(parts[i]) for i in order)
            found.append(Weak(tuple(order), shown, float(max(value[k], 0.0))))
    return found


def growth_without(parts: Sequence[Array]) -> Array:
    """Return the relative growth of each parameter's bound if a trial is left out, (trials, n).

    Args:
        parts: by trial, (n, n) information.
    """
    total = np.sum(parts, axis=0)
    with_all = np.sqrt(np.diag(cramer_rao_bound(total)))
    rows = []
    for part in parts:
        without = np.sqrt(np.diag(cramer_rao_bound(total - part)))
        known = np.isfinite(with_all) & (with_all > 0.0)
        rows.append(np.where(known, without / np.where(known, with_all, 1.0) - 1.0, 0.0))
    return np.array(rows)
