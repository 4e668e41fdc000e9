"""A recorded velocity held against the position beside it: units and signs that cannot be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

WINDOW_S = 0.1
"""Length of the stretches that are compared, s: neither noise nor lag counts much."""


@dataclass(frozen=True)
class Agreement:
    """How a recorded velocity goes with the change of the position.

    Attributes:
        ratio: velocity over change of position, by least squares; 1 where they agree.
        correlation: of the two; near 1 or -1 where they are the same motion.
    """

    ratio: float
    correlation: float


def integral(t: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Position (T,) from 0 by trapezia, of a velocity (T,) at ``t`` (T,), s."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(t))])


def compare(t: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> Agreement | None:
    """Integral of the velocity against the change of the position over short stretches.

    Args:
        t: (T,) s, increasing.
        position: (T,) rad or m.
        velocity: (T,) rad/s or m/s.

    Returns:
        None where nothing moves.
    """
    step = max(1, round(WINDOW_S / float(np.median(np.diff(t)))))
    moved = np.diff(position[::step])
    expected = np.diff(integral(t, velocity)[::step])
    squares = float(moved @ moved), float(expected @ expected)
    if len(moved) < 10 or not all(squares):
        return None
    product = float(moved @ expected)
    return Agreement(product / squares[0], product / float(np.sqrt(squares[0] * squares[1])))
