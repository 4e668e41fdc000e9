"""A trial as recorded by its sensors, and its motion behind the session's filters."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product, takewhile
from operator import attrgetter
from typing import Any, Protocol

import numpy as np

from bampipe.arrays import Array, Flags, Indices
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.physics.device import INPUT_ORDERS, derivative
from bampipe.trials.kept import KeptItems

TIMING_ORDERS = 3
"""Orders of the Taylor series that shifts inputs in time: half a sample to within 0.7 % at the
highest frequency of a residual. The first order alone errs by 20 %, which looks like a lag."""
_MOST_JOINED = 100_000
"""Largest number of samples, over all axes, up to which a session's trials are joined."""
STAMP_OFFSET = "stamp_offset"
"""Channel with the time of the nearest logged sample less ``t``, s; all zero on a uniform grid."""
SAMPLED = ("t", "q", "qd", "qdd", "qd_sd")
"""Fields of a motion with one row a sample."""


@dataclass(frozen=True)
class Recording:
    """One trial on a uniform grid, SI units, unfiltered.

    Attributes:
        q: encoder readings, (T, n_q), rad or m.
        channels: every other logged input of the device by name, each (T,): forces, brake
            commands, further channels.
    """

    trial_id: str
    q: Array
    channels: Mapping[str, Array]


class EncoderFilters(Protocol):
    """The filters between encoders and motion."""

    def derivatives_of(self, axis: int, signal: Array) -> tuple[Array, Array, Array]:
        """Position, rate and acceleration that a signal (T,) in the readings adds to the motion."""


@dataclass(frozen=True)
class Motion:
    """One trial with its derivatives, on a uniform grid.

    Attributes:
        t: time since the start of the trial, (T,), s.
        q, qd, qdd: (T, n_q), rad or m and derivatives.
        qd_sd: standard deviation of the velocities, (T, n_q).
        channels: inputs of the device and their time derivatives by name, each (T,).
        left_out: (T, n_q) samples that do not count: a trial's disturbances, or in a replicate all
            samples that its trial leaves out. None if there are none.
        filters: filters that produced q, qd and qdd; None if they do not stem from encoders.
        parts: rows of each trial, if several have been joined.
    """

    trial_id: str
    t: Array
    q: Array
    qd: Array
    qdd: Array
    qd_sd: Array
    channels: Mapping[str, Array]
    left_out: Flags | None = None
    filters: EncoderFilters | None = None
    parts: Sequence[slice] = (slice(None),)
    _states: dict[Any, Array] = field(default_factory=dict, init=False, repr=False, compare=False)
    _kept: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __getstate__(self) -> dict[str, object]:
        return {**vars(self), "_states": {}, "_kept": {}}

    def inputs(self, names: Sequence[str]) -> Array:
        """The channels called ``names`` as columns, (T, len(names)); do not write to them.

        Raises:
            KeyError: there is no such channel.
        """
        key = tuple(names)
        if key not in self._kept:
            columns = [self.t if name == "t" else self.channels[name] for name in key]
            self._kept[key] = np.column_stack(columns) if key else np.empty((self.t.size, 0))
        return np.asarray(self._kept[key])

    @property
    def kinematics(self) -> tuple[Array, Array, Array]:
        """Positions, rates and accelerations, each (T, n_q)."""
        return self.q, self.qd, self.qdd

    def thinned_rows(self, band: Band) -> Indices:
        """Indices of the samples that the thinning of a low-pass keeps."""
        kept = ((part.start or 0) + band.thinned_rows(len(self.t[part])) for part in self.parts)
        return np.concatenate([*kept])

    def memory(self, system: System, p: Array) -> Array:
        """Internal states of a model with parameters ``p``, (n_p,), along this motion, (T, n_z)."""
        u = self.inputs(system.inputs)
        return system.memory(*self.kinematics, u, p, self.t, self.parts, self._states)

    def of_mechanism(self, system: System, u: Array, p: Array) -> "Motion":
        """The motion of the mechanism, which differs from the encoder readings by `System.offset`.

        The offset passes the filters of the encoders: it jumps like the readings where play is
        crossed, and the jumps cancel only if both are filtered alike. The last result is cached
        with the internal states along it.
        """
        if not system.moves_sensors:
            return self
        offset = system.offset(self.q, u, p)
        mechanism: Motion
        last, mechanism = self._kept.get("mechanism", (None, self))
        if np.array_equal(last, offset):
            return mechanism
        moved = [values.copy() for values in self.kinematics]
        for axis, part in product(np.flatnonzero(offset.any(axis=0)), self.parts):
            added, t = offset[part, axis], self.t[part]
            if self.filters is None:
                rate = np.gradient(added, t)
                orders = added, rate, np.gradient(rate, t)
            else:
                orders = self.filters.derivatives_of(int(axis), added)
            for total, order in zip(moved, orders, strict=True):
                total[part, axis] += order
        mechanism = replace(self, q=moved[0], qd=moved[1], qdd=moved[2])
        self._kept["mechanism"] = offset, mechanism
        return mechanism

    def rows(self, which: slice) -> "Motion":
        """The rows ``which`` of the motion, with their times."""
        return replace(
            self,
            **{name: getattr(self, name)[which] for name in SAMPLED},
            channels={name: values[which] for name, values in self.channels.items()},
            left_out=None if self.left_out is None else self.left_out[which],
            parts=(slice(None),),
        )

    def split(self) -> "list[Motion]":
        """The trials of which a joined motion consists."""
        return [self.rows(part) for part in self.parts] if len(self.parts) > 1 else [self]

    def with_channels(self, changed: Mapping[str, Array]) -> "Motion":
        """The same motion with some channels replaced."""
        return self._share_states(replace(self, channels={**self.channels, **changed}), changed)

    def _share_states(self, other: "Motion", changed: Collection[str]) -> "Motion":
        """Pass on the cached internal states that depend on none of the ``changed`` channels."""
        alike = {key: z for key, z in self._states.items() if not {*changed} & {*key[1]}}
        other._states.update(alike)
        return other

    def with_more_force(self, force: str) -> "tuple[Motion, Array]":
        """The same motion with a force increased by a small constant, and that constant, (T,)."""
        if force not in self._kept:
            values = self.channels[force]
            step = np.empty_like(values)
            for part in self.parts:
                step[part] = 1e-6 * max(float(np.abs(values[part]).max()), 1e-6)
            self._kept[force] = self.with_channels({force: values + step}), step
        more, step = self._kept[force]
        return self._share_states(more, (force,)), step

    def with_input_timing(self, late_s: float) -> "Motion":
        """The same motion with inputs shifted to compensate a delay of ``late_s`` in sampling.

        A channel and its time derivatives are shifted by their Taylor series; a channel without
        derivatives, such as a brake command, stays.
        """
        if late_s == 0.0:
            return self
        moved = {}
        for name in self.channels:
            orders = [name, *takewhile(self.channels.__contains__, input_derivatives(name))]
            for k, order in enumerate(orders[:-1]):
                total, factor = self.channels[order].copy(), 1.0
                for power, term in enumerate(orders[k + 1 : k + 1 + TIMING_ORDERS], start=1):
                    factor *= -late_s / power
                    total += factor * self.channels[term]
                moved[order] = total
        return self.with_channels(moved)


def join_short(motions: Sequence[Motion]) -> Sequence[Motion]:
    """Join short trials into one motion: a call costs as much as thousands of samples."""
    sizes = trial_sizes(motions)
    if len(motions) == 1 or sum(sizes) * motions[0].q.shape[1] > _MOST_JOINED:
        return motions
    names = set[str].intersection(*({*m.channels} for m in motions))
    out = [m.left_out if m.left_out is not None else np.zeros(m.q.shape, bool) for m in motions]
    sampled: dict[str, Any] = {n: np.concatenate([getattr(m, n) for m in motions]) for n in SAMPLED}
    channels = {name: np.concatenate([m.channels[name] for m in motions]) for name in names}
    parts = [slice(end - size, end) for end, size in zip(np.cumsum(sizes), sizes, strict=True)]
    whole = replace(motions[0], trial_id="", **sampled, channels=channels, parts=parts)
    return [replace(whole, left_out=np.concatenate(out))]


def input_derivatives(name: str) -> tuple[str, ...]:
    """Names of all time derivatives of an input that a model may use, lowest order first."""
    return tuple(derivative(name, order) for order in range(1, len(INPUT_ORDERS)))


def force_columns(system: System) -> list[int]:
    """Columns of a model's inputs that hold measured forces."""
    return [system.inputs.index(name) for name in system.model.device.forces]


def trial_sizes(motions: Sequence[Motion]) -> list[int]:
    """Return the number of samples of each trial."""
    return motions.each(_size) if isinstance(motions, KeptItems) else [*map(_size, motions)]


def trial_names(motions: Sequence[Motion]) -> list[str]:
    """Return the names of trials."""
    return motions.each(_name) if isinstance(motions, KeptItems) else [*map(_name, motions)]


_size, _name = (lambda motion: len(motion.t)), attrgetter("trial_id")
