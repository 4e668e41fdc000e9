"""A rigid body by its mass, its centre and its inertia: moved, joined to another, parted again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bampipe.arrays import Array

_ROUNDING = 1e-6
"""Share of the largest second moment of mass by which one may be below zero."""


@dataclass
class Body:
    """Mass, centre (3,) and inertia about it (3, 3), in the axes of a frame."""

    mass: float = 0.0
    center: Array = field(default_factory=lambda: np.zeros(3))
    inertia: Array = field(default_factory=lambda: np.zeros((3, 3)))

    @classmethod
    def of_table(cls, table: Mapping[str, Any]) -> Body:
        """As of a joint, or of a payload, in a device file."""
        center = np.array(table.get("center", (0.0,) * 3), dtype=float)
        inertia = symmetric(table.get("inertia", (0.0,) * 6))
        return cls(float(table.get("mass", 0.0)), center, inertia)

    def moved(self, turn: Array, offset: Array) -> Body:
        """The same body seen from a frame in which its own lies at ``offset``, ``turn``."""
        return Body(self.mass, turn @ self.center + offset, turn @ self.inertia @ turn.T)

    def joined(self, other: Body) -> Body:
        """Both as one."""
        mass = self.mass + other.mass
        if mass == 0.0:
            return Body(0.0, self.center, self.inertia + other.inertia)
        center = (self.mass * self.center + other.mass * other.center) / mass
        return Body(mass, center, self.about(center) + other.about(center))

    def without(self, other: Body) -> Body:
        """What is left when a part of it is taken off."""
        return self.joined(Body(-other.mass, other.center, -other.inertia))

    def about(self, point: Array) -> Array:
        """Inertia about a point, (3, 3)."""
        r = self.center - point
        return self.inertia + self.mass * ((r @ r) * np.eye(3) - np.outer(r, r))

    @property
    def is_possible(self) -> bool:
        """Whether a distribution of mass has these numbers."""
        spread = 0.5 * np.trace(self.inertia) * np.eye(3) - self.inertia
        moments = np.linalg.eigvalsh(spread)
        return self.mass >= 0.0 and bool(moments[0] >= -_ROUNDING * abs(moments[2]))

    def table(self) -> dict[str, Any]:
        """As of a joint in a device file."""
        upper = [float(v) for v in self.inertia[np.triu_indices(3)]]
        return {"mass": self.mass, "center": [float(v) for v in self.center], "inertia": upper}


def symmetric(six: Any) -> Array:
    """The matrix, (3, 3), of its upper triangle by rows."""
    xx, xy, xz, yy, yz, zz = (float(v) for v in six)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
