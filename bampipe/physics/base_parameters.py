"""Base parameters of a robot (Gautier and Khalil 1990).

They are found numerically: the columns of all inertial numbers along a rich motion are taken in
order, from the base to the tip, and a column that depends on earlier ones is joined to them.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bampipe.physics.robot import Robot

_DEPENDENT = 1e-7
"""A column depends on earlier ones if they leave less than this share of it."""
_NOTHING = 1e-6
"""Coefficients below this share of the largest are rounding errors."""


@dataclass(frozen=True)
class BaseParameter:
    """A base parameter: a combination of inertial numbers that motion determines only as a whole.

    Attributes:
        name: of the number that stands for it; terms: coefficient by number, its own 1.
    """

    name: str
    terms: Mapping[str, float]

    @property
    def words(self) -> str:
        """The combination as text."""
        parts: list[str] = []
        for name, factor in self.terms.items():
            size = "" if abs(abs(factor) - 1.0) < 1e-9 else f"{abs(factor):.4g} "
            sign = "-" if factor < 0.0 else "+"
            parts.append(f"{sign} {size}{name}" if parts else f"{size}{name}")
        return " ".join(parts)


def base_parameters(robot: Robot) -> list[BaseParameter]:
    """Return the base parameters, from the base to the tip."""
    names = [p.name for p in robot.parameters]
    columns = robot.regressor
    size = np.linalg.norm(columns, axis=0)
    chosen: list[int] = []
    basis = np.zeros((len(columns), 0))
    terms: dict[int, dict[str, float]] = {}
    for k in np.flatnonzero(robot.matters).tolist():
        unit = columns[:, k] / size[k]
        left = unit - basis @ (basis.T @ unit)
        left -= basis @ (basis.T @ left)
        if np.linalg.norm(left) > _DEPENDENT:
            chosen.append(k)
            basis = np.column_stack([basis, left / np.linalg.norm(left)])
            terms[k] = {names[k]: 1.0}
            continue
        scaled = columns[:, chosen] / size[chosen]
        share = np.linalg.lstsq(scaled, unit, rcond=None)[0]
        for place, part in zip(chosen, share, strict=True):
            if abs(part) > _NOTHING * np.abs(share).max():
                terms[place][names[k]] = float(part * size[k] / size[place])
    return [BaseParameter(names[k], terms[k]) for k in chosen]
