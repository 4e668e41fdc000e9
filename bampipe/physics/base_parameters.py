"""Which combinations of a robot's inertial numbers motion can show (Gautier and Khalil 1990).

Found numerically: along a rich motion the columns of all numbers are taken one after the other,
from the base to the tip, and each that depends on those before it is joined to them.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bampipe.physics.robot import Robot

_DEPENDENT = 1e-7
"""Share of a column that those before it leave, below which it depends on them."""
_NOTHING = 1e-6
"""Of the largest coefficient: less is rounding."""


@dataclass(frozen=True)
class BaseParameter:
    """A combination of inertial numbers that motion shows, and no part of it alone.

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
    """Return the combinations that motion can show, from the base to the tip."""
    names = [p.name for p in robot.parameters]
    columns = robot.regressor
    size = np.linalg.norm(columns, axis=0)
    order = [k for k, matters in enumerate(robot.matters.ravel()) if matters]
    chosen: list[int] = []
    basis = np.zeros((len(columns), 0))
    terms: dict[int, dict[str, float]] = {}
    for k in order:
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
