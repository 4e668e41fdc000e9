"""Integration of the internal states of effects along a motion: kind and number of steps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from bampipe.arrays import Array, Flags

STEP_ERROR = 1e-6
"""Largest estimated error of a step of coupled states, of the largest value of a state."""
LEAST_STEP = 2.0**-12
"""Shortest step of coupled states, of the time from one sample to the next."""
ACCURATE = 0.25
"""Largest product of a step, from one sample to the next, and the rate of an uncoupled state: the
error is its fifth power over 720, 1.4e-6."""
STIFF_STEPS = (3, 24)
"""Exponential steps from one sample to the next, which are stable, if no state depends on another:
the fewer unless the more differ. The error of a hysteresis passed 300 times between two samples is
at most 0.6 % at a reversal, 60 times 0.06 %."""
TOLERANCE = 3e-4
"""Share of the largest value of a state by which the two may differ."""
_STEP_AGAINST_NEIGHBOURS = 8.0
"""A command that changes between two samples this many times more than before and after has been
switched. Ramps and sines change by at most twice as much from one sample to the next; noise of the
reading makes neighbours large."""
_STEP_SHARE = 0.02
"""Least share of the command's range that counts as switching: not a quantised slow change."""
_KEPT = 16
"""Number of results kept: two models on the same motion share most states."""

StateKey = tuple[str, tuple[str, ...], tuple[bytes, ...]]
"""Key of states along a motion: module, names of the inputs, and other numbers."""


@dataclass(frozen=True)
class StateGroup:
    """A group of internal states whose rates depend on no other internal state.

    Attributes:
        module: name of the generated module that follows them; see `memory_code`.
        places: their numbers among the internal states of the model.
        uses: numbers of the columns of q, qd and u and of the parameters that their rates take.
        commands: which of those columns of u may be switched.
    """

    module: str
    places: Sequence[int]
    uses: Mapping[str, Sequence[int]]
    commands: Sequence[int]

    def integrate(
        self,
        module: ModuleType,
        along: Sequence[Array],
        z0: Array,
        inputs: Sequence[str],
        parts: Sequence[slice],
        known: dict[StateKey, Array],
    ) -> Array:
        """Return the states along a motion, (T, n); see `System.memory`.

        The generated ``module`` follows them ``along`` q, qd, qdd, u, p and t, in each of ``parts``
        from ``z0``, (parts, n). ``inputs`` names the columns of u; ``known`` keeps the result.
        """
        q, qd, qdd, u, p, t = along
        uses, p = self.uses, p[self.uses["p"]]
        numbers = [np.array([*uses["q"], -1, *uses["qd"]]), p, z0]
        names = tuple(inputs[i] for i in uses["u"])
        key = module.__name__, names, tuple(x.tobytes() for x in numbers)
        found = known.pop(key, None)
        if found is None:
            columns = (q[:, uses["q"]], qd[:, uses["qd"]], qdd[:, uses["qd"]], u[:, uses["u"]])
            *arrays, p, z0 = [np.asarray(x, float, order="C") for x in (*columns, t, p, z0)]
            found = np.empty((len(t), z0.shape[1]))
            for part, start in zip(parts, z0, strict=True):
                *rows, moments = (x[part] for x in arrays)
                found[part] = _integrate(module, self.commands, (*rows, p, moments, start))
            while len(known) >= _KEPT:
                del known[next(iter(known))]
        known[key] = found  # the last used last
        return found


def _integrate(module: ModuleType, commands: Sequence[int], arrays: Sequence[Array]) -> Array:
    q, qd, qdd, u, p, t, z0 = arrays
    switched = _find_switches(u, commands)
    at = np.flatnonzero(switched.any(axis=1))
    if at.size:
        # One more row at the time of the switch, with the values before it.
        held = np.where(switched[at], u[at - 1], u[at])
        u = np.insert(u, at, held, axis=0)
        q, qd, qdd, t = (np.insert(x, at, x[at], axis=0) for x in (q, qd, qdd, t))
    out = np.empty((len(t), len(z0)))
    if module.memory(q, qd, qdd, u, p, t, z0, out):
        module.stiff_memory(q, qd, qdd, u, p, t, z0, out)
    return np.delete(out, at + np.arange(at.size), axis=0) if at.size else out


def _find_switches(u: Array, commands: Sequence[int]) -> Flags:
    """Find where one of ``commands`` has been switched since the sample before, (T, n_u)."""
    switched = np.zeros(u.shape, dtype=bool)
    for i in commands if len(u) > 3 else ():
        change = np.abs(np.diff(u[:, i]))
        around = np.maximum(change[:-2], change[2:])
        least = max(_STEP_SHARE * float(np.ptp(u[:, i])), 1e-300)
        middle = change[1:-1]
        switched[2:-1, i] = (middle > least) & (middle > _STEP_AGAINST_NEIGHBOURS * around)
    return switched
