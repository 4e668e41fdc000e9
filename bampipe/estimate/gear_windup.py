"""Wind-up and play of a gear, from the difference of the encoders on its two sides."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bampipe.arrays import Array
from bampipe.errors import InputError
from bampipe.estimate.bounded import invert_scaled

_BLOCKS = 20
"""Parts of the record with independent errors, whose scatter gives the uncertainties."""
_EITHER_SIGN = 0.05
"""The play counts as crossed if loads of either sign make up this fraction of the samples."""
_CLOSING = 0.02
"""A gap is closed at a few times this fraction of the largest load."""
_TURNING = 0.01
"""Dry friction is fully developed at a few times this fraction of the largest velocity."""


@dataclass(frozen=True)
class Windup:
    """Relative motion of the two sides of a gear.

    Attributes:
        compliance, compliance_sd: rad/(N.m) or m/N; positive if the second encoder leads with the
            load of the drive, as it does on the motor's side.
        play, play_sd: rad or m; None if the load never changes sign.
        late_s, late_sd: delay of the second encoder's reading behind the first's; viscous friction
            of the drive adds a little.
        explained: fraction, by compliance and play, of the difference's variance that remains after
            timing and the drive's own losses.
    """

    compliance: float
    compliance_sd: float
    play: float | None
    play_sd: float | None
    late_s: float
    late_sd: float
    explained: float


def find_windup(
    difference: Sequence[Array],
    load: Sequence[Array],
    rate: Sequence[Array],
    rotor_known: bool = False,
) -> Windup:
    """Regress the difference of two encoders on the drive's load.

    The inertia and friction of the drive itself do not load the gear: terms with acceleration,
    velocity and its sign remove them. A late encoder adds a difference in proportion to the
    velocity. Each trial has its own offset, since the zeros of two encoders differ.

    Args:
        difference: by trial, (T,), second reading minus first, rad or m; the samples, as those of
            ``load``, the drive's generalised force, and ``rate``, the axis' velocity, are evenly
            spaced.
        rotor_known: whether ``load`` excludes the force on the drive's inertia; otherwise that is
            estimated, which leaves little information on an axis without weight.

    Raises:
        InputError: the load does not change.
    """
    largest = max(float(np.abs(x).max(initial=0.0)) for x in load)
    if not largest > 0.0 or max(float(np.ptp(x)) for x in load) < 1e-9 * largest:
        raise InputError("the drive's load never changes")
    fastest = max(float(np.abs(v).max(initial=0.0)) for v in rate) or 1.0
    every = np.concatenate(load)
    crossed = min(np.mean(every > 0.0), np.mean(every < 0.0)) > _EITHER_SIGN
    columns, target = [], []
    for d, x, v in zip(difference, load, rate, strict=True):
        parts = [v, np.tanh(v / (_TURNING * fastest))]
        parts += [] if rotor_known else [np.gradient(v)]
        own = len(parts)
        parts.append(x)
        if crossed:
            parts.append(0.5 * np.tanh(x / (_CLOSING * largest)))
        columns.append(np.column_stack([part - part.mean() for part in parts]))
        target.append(d - d.mean())
    table, wanted = np.vstack(columns), np.concatenate(target)
    inverse = invert_scaled(table.T @ table)
    found = inverse @ (table.T @ wanted)
    left = wanted - table @ found
    blocks = (np.array_split(rows, _BLOCKS) for rows in (table, left))
    scores = [part.T @ rest for part, rest in zip(*blocks, strict=True)]
    covariance = inverse @ sum(np.outer(s, s) for s in scores) @ inverse
    sd = np.sqrt(np.diag(covariance) * _BLOCKS / (_BLOCKS - len(found)))
    play = len(found) - 1
    rest = wanted - table[:, :own] @ np.linalg.lstsq(table[:, :own], wanted, rcond=None)[0]
    return Windup(
        float(found[own]), float(sd[own]), float(found[play]) if crossed else None,
        float(sd[play]) if crossed else None, -float(found[0]), float(sd[0]),
        float(1.0 - np.var(left) / max(float(np.var(rest)), 1e-300)),
    )  # fmt: skip
