"""The internal states of effects along a motion: which steps generated code takes, and how many."""

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from bampipe.arrays import Array, Flags

_STEPS = (1, 3, 12, 48, 192)
"""Steps a sample tried in turn, until a stiff state is integrated without running away."""
ACCURATE = 0.25
"""Largest product of a step and a state's rate for which a single step a sample will do: what RK4
leaves out of it is its fifth power over 120, 8e-6."""
STIFF_STEPS = 24
"""Exponential steps a sample, stable ones, in place of more than these, where no state depends on
another. A hysteresis passed 600 times between two samples is 1 % off, 60 times 0.1 %."""
STABLE = 2.5
"""Largest product of a step and the rate at which a state decays for which RK4 is stable, with a
margin: it is up to 2.78 (Hairer and Wanner, Solving Ordinary Differential Equations II, IV.2)."""
_RUNAWAY = 1e9
_STEP_AGAINST_NEIGHBOURS = 8.0
"""A command that changes between two samples this many times more than before and after has been
switched. Ramps and sines change by at most twice as much from one sample to the next; noise of the
reading makes neighbours large."""
_STEP_SHARE = 0.02
"""Least share of the command's range that counts as switching: not a quantised slow change."""
_KEPT_BYTES = 1 << 26
"""Results kept for the next time: of two models on the same motion most states are the same."""


@dataclass(frozen=True)
class StateGroup:
    """Internal states of effects whose rates depend on no internal state outside of it.

    Attributes:
        module: name of the generated module that follows them; see `memory_code`.
        places: their numbers among the internal states of the model.
        uses: numbers of the columns of q, qd and u and of the parameters that their rates take.
        commands: which of those columns of u may be switched.
        parameters: numbers of all parameters that the states depend on.
    """

    module: str
    places: Sequence[int]
    uses: Mapping[str, Sequence[int]]
    commands: Sequence[int]
    parameters: Sequence[int]

    def integrate(self, module: ModuleType, along: Sequence[Array], z0: Array) -> Array:
        """Return the states along the motion of one trial, (T, n); see `System.memory`.

        Args:
            module: the generated code; along: q, qd, qdd, u, p and t of the trial.
            z0: the states at its start, (n,).
        """
        q, qd, qdd, u, p, t = along
        uses = self.uses
        columns = (q[:, uses["q"]], qd[:, uses["qd"]], qdd[:, uses["qd"]], u[:, uses["u"]])
        arrays = [
            np.ascontiguousarray(x, dtype=np.float64) for x in (*columns, p[uses["p"]], t, z0)
        ]
        digest = hashlib.sha256(f"{module.__name__} {self.commands}".encode())
        for array in arrays:
            digest.update(array.data)
        return _kept.find(digest.digest(), lambda: _integrate(module, self.commands, arrays))


class _LastUsed:
    """Arrays by the hash of all that they depend on, as many as `_KEPT_BYTES` hold."""

    def __init__(self) -> None:
        self._arrays: OrderedDict[bytes, Array] = OrderedDict()
        self._bytes = 0

    def find(self, key: bytes, compute: Callable[[], Array]) -> Array:
        """The array of ``key``, computed where it is not known."""
        if key not in self._arrays:
            found = compute()
            self._bytes += found.nbytes
            while self._arrays and self._bytes > _KEPT_BYTES:
                self._bytes -= self._arrays.popitem(last=False)[1].nbytes
            self._arrays[key] = found
        self._arrays.move_to_end(key)
        return self._arrays[key]


_kept = _LastUsed()


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
    stiff, least = getattr(module, "stiff_memory", None), 0.0
    for steps in _STEPS:
        if stiff is not None and max(steps, least) > STIFF_STEPS:
            stiff(q, qd, qdd, u, p, t, z0, STIFF_STEPS, out)
            break
        if steps < least and steps < _STEPS[-1]:
            continue
        fastest = module.memory(q, qd, qdd, u, p, t, z0, steps, out)
        enough = STABLE if steps > 1 else ACCURATE
        if fastest < enough and np.all(np.abs(out) < _RUNAWAY):
            break
        least = steps * fastest / STABLE
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
