"""Change of variables of the likelihood, from the residual to the measured quantity.

The likelihood adds log |d residual / d force| to the density of the residual. A model therefore
gains nothing by making both sides of the equation small.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.signal import get_window

from bampipe.arrays import Array, Flags, Indices
from bampipe.estimate.low_pass import Band
from bampipe.physics import Model, System, compile_model
from bampipe.trials.motion import Motion

Spectra = NDArray[np.complex128]

NO_SLOPE = 1e-3
"""Largest slope by a constant force at which effects count as passing the force unchanged."""
_LEAST_SHARE = 1e-3
_STEP = 1e-4
"""Finite-difference step as a fraction of a parameter's value or uncertainty."""
_SEGMENT = 128
"""Thinned samples in a segment of a spectrum."""


def bare_slopes(
    system: System, motions: Sequence[Motion], band: Band, p: Array
) -> tuple[Array, ...]:
    """Derivative of the applied force of the device alone by each measured force, by trial.

    Each (K, n_q, n_forces), at the thinned samples.
    """
    return tuple(
        system.input_map(m.q[kept], m.inputs(system.inputs)[kept], p)
        for m in motions
        for kept in [m.thinned_rows(band)]
    )


def slopes_by_force(
    system: System, motions: Sequence[Motion], band: Band, probes: Sequence[Array]
) -> tuple[Array, ...]:
    """Derivative of the effects' contribution by each measured force, by trial.

    The force changes by a constant, so that internal states that follow it have settled. The
    parameters ``probes``, m times (n_p,), must give the same internal states. Each result is
    (K, n_q, n_forces, m), at the thinned samples.
    """
    model = system.model
    passing = [e for e in model.effects if not e.effect.has_play]
    if len(passing) < len(model.effects):
        # A contact only delays the force that a gap holds back, so it takes nothing away.
        names = [q.name for q in system.parameters]
        known = [e.effect for e in passing]
        system = compile_model(Model(model.device, [e.name for e in passing], known))
        probes = [p[[names.index(q.name) for q in system.parameters]] for p in probes]
    shape = len(system.coordinates), len(system.model.device.forces), len(probes)
    kept = [m.thinned_rows(band) for m in motions]
    if not (system.driven or system.force_fed):
        return tuple(np.zeros((len(rows), *shape)) for rows in kept)
    return tuple(_slopes(system, m, rows, probes) for m, rows in zip(motions, kept, strict=True))


def _slopes(system: System, motion: Motion, kept: Indices, probes: Sequence[Array]) -> Array:
    p, slopes = probes[0], []
    motion = motion.of_mechanism(system, motion.inputs(system.inputs), p)

    def added(motion: Motion, z: Array) -> Array:
        at = motion.q[kept], motion.qd[kept], motion.qdd[kept]
        u = motion.inputs(system.inputs)[kept]
        return np.array([system.contribution(*at, z[kept], u, p) for p in probes])

    z = motion.memory(system, p)
    here = added(motion, z)
    for force in system.model.device.forces:
        more, step = motion.with_more_force(force)
        changed = added(more, more.memory(system, p) if system.force_fed else z)
        slopes.append((changed - here) / step[kept, None])
    return np.moveaxis(np.array(slopes), (0, 1), (2, 3))


def log_of_share(plain: Array, added: Array) -> Array:
    """Log of the fraction of the slopes ``plain`` by the forces that remains with ``added``, (n,).

    Both are (n, n_forces). Where no force acts, the result is zero.
    """
    before, after = (np.linalg.norm(x, axis=-1) for x in (plain, plain + added))
    share = after / np.where(before > 0.0, before, 1.0)
    return np.asarray(np.where(before > 0.0, np.log(np.maximum(share, _LEAST_SHARE)), 0.0))


def log_scale(
    system: System,
    motions: Sequence[Motion],
    band: Band,
    used: Sequence[Flags],
    p: Array,
    free: Sequence[int],
    added: Sequence[Array],
) -> tuple[Array, Array]:
    """Mean log of the fraction of the measured quantity that a model's effects leave, with slopes.

    Both by axis, (n_q,) and (n_q, n_free). Filters pass a constant force, so they leave all of it.

    Args:
        used: which samples count, by trial, each (K, n_q).
        p: parameters, (n_p,); free: indices of those by which slopes are taken.
        added: slopes of the effects by the forces at ``p``, each (K, n_q, n_forces).
    """
    nothing = np.zeros(len(system.coordinates)), np.zeros((len(system.coordinates), len(free)))
    if not system.parameters_by_force:
        return nothing
    bare = np.concatenate(bare_slopes(system, motions, band, p))
    ends = np.cumsum([len(moves) for moves in used])[:-1]

    def mean_log(added: Sequence[Array]) -> Array | None:
        if all((np.abs(slope) <= NO_SLOPE).all() for slope in added):
            return None
        logs = np.split(log_of_share(bare, np.concatenate(added)), ends)
        total = sum(np.sum(x * moves, axis=0) for x, moves in zip(logs, used, strict=True))
        return np.asarray(total / np.maximum(sum(moves.sum(axis=0) for moves in used), 1))

    here = mean_log(added)
    if here is None:
        return nothing
    slopes = nothing[1]
    for k, number in enumerate(free):
        if number in system.parameters_by_force:
            q, moved = system.parameters[number], p.copy()
            step = _STEP * max(abs(p[number]), q.sd)
            moved[number] += step if p[number] + step <= q.upper else -step
            rows = slopes_by_force(system, motions, band, [moved])
            there = mean_log([r[..., 0] for r in rows])
            if there is not None:
                slopes[:, k] = (there - here) / (moved[number] - p[number])
    return here, slopes


def find_spectra(applied: Sequence[Array]) -> Spectra:
    """Spectra of half-overlapping segments of all trials, (segments, n_q, _SEGMENT // 2).

    ``applied`` is a low-passed force by trial, each (K, n_q).
    """
    found = []
    for x in applied:
        n = min(_SEGMENT, len(x))
        segments = sliding_window_view(x, n, axis=0)[:: max(n // 2, 1)]
        found.append(segments @ _to_spectrum(n).T)
    return np.concatenate(found)


def gain_of_filter(before: Spectra, after: Spectra, band: Band) -> Array:
    """Fraction of white force noise's variance in the band that passes a filter, (n_q,).

    ``before`` and ``after`` are spectra of the applied force as in `find_spectra`.
    """
    cross = np.abs(np.sum(before.conj() * after, axis=0))
    gain = cross / np.maximum(np.sum(np.abs(before) ** 2, axis=0), 1e-300)
    left = np.clip(gain, 1e-2, 1.0) ** 2
    left[(before == after).all(axis=(0, 2))] = 1.0
    return np.average(left, axis=1, weights=band.passed_power(_SEGMENT // 2).T)


@cache
def _to_spectrum(n: int) -> Spectra:
    """Matrix that removes the linear trend of ``n`` samples and transforms them (Hann window)."""
    line = np.column_stack([np.ones(n), np.arange(n)])
    windowed = get_window("hann", n)[:, None] * (np.eye(n) - line @ np.linalg.pinv(line))
    return np.asarray(np.fft.rfft(windowed, _SEGMENT, axis=0)[: _SEGMENT // 2])
