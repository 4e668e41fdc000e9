"""Structural identifiability: numbers that no motion separates, and slopes of the residual.

The kinetic and potential energy and the other generalised forces are sums of terms: a function of
the motion and the inputs, times a factor made of constants and parameters. Data can determine the
factors, never their parts (the base parameters of Gautier and Khalil 1990, IEEE Transactions on
Robotics and Automation 6(3)). The scale is that of the measured force.
"""

from dataclasses import dataclass
from typing import Any

from bampipe import generated_code
from bampipe.arrays import Array
from bampipe.physics.system import System, stack_columns


@dataclass(frozen=True)
class Combination:
    """Numbers that enter only through combinations of each other.

    Attributes:
        members: names of constants and parameters.
        combinations: what data could determine of them, as text.
    """

    members: tuple[str, ...]
    combinations: tuple[str, ...]


@dataclass(frozen=True)
class DeterminableNumber:
    """A constant, or a sum of constants, that data could determine.

    Attributes:
        name: the constant, or the combination as text.
        value: as the device file has it; unit: SI.
    """

    name: str
    value: float
    unit: str


@dataclass(frozen=True)
class Structure:
    """Structural identifiability of the numbers in the equations.

    Attributes:
        together: groups whose members no data can separate. numbers: constants that enter on their
        own, in the order of the device file, then the sums of the others.
    """

    together: tuple[Combination, ...]
    numbers: tuple[DeterminableNumber, ...]
    _slopes: Any

    def slopes(self, q: Array, qd: Array, qdd: Array, z: Array, u: Array, p: Array) -> Array:
        """d residual / d number, for those in `numbers`, (T, n_q, len(numbers)).

        Arguments as in `System.required`.
        """
        columns = self._slopes(q.T, qd.T, qdd.T, z.T, u.T, p) if self.numbers else ()
        shape = len(q), q.shape[1], len(self.numbers)
        return stack_columns(columns, len(q)).reshape(shape)


def structure(system: System) -> Structure:
    """The structure of a model, derived once and then read from the cache."""

    def generate() -> tuple[dict[str, Any], dict[str, str]]:
        from bampipe.physics.structure_code import structure_code

        return structure_code(system.model)

    code = generated_code.load(f"{system.model.key}_structure", generate)
    together = tuple(Combination(tuple(m), tuple(c)) for m, c in code.facts["together"])
    found = tuple(DeterminableNumber(*entry) for entry in code.facts["numbers"])
    return Structure(together, found, code.module("slopes").slopes)
