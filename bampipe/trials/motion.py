"""A trial as its sensors gave it, and the motion that the session's filters make of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import takewhile
from typing import Protocol

import numpy as np

from bampipe.arrays import Array, Flags
from bampipe.physics import System
from bampipe.physics.device import INPUT_ORDERS, derivative
from bampipe.trials.cache import TrialCache

TIMING_ORDERS = 3
"""Time derivatives by which inputs are moved in time: half a sample, at the highest frequency of a
residual, to 0.7 %. By the first alone it is 20 %, which looks like a lag."""


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
        """Position, rate and acceleration that they make of a signal (T,) in the readings."""


@dataclass(frozen=True)
class Motion:
    """One trial with its derivatives, on a uniform grid; one row a sample.

    Attributes:
        t: time since the start of the trial, (T,), s.
        q, qd, qdd: (T, n_q), rad or m and derivatives.
        qd_sd: standard deviation of the velocities, (T, n_q).
        channels: inputs of the device and their time derivatives by name, each (T,).
        left_out: (T, n_q) samples that count no more than those at rest: of a replay, what its
            trial leaves out; of a trial, its disturbances. None where there are none.
        filters: that q, qd and qdd went through; None where they are no readings of encoders.
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
    _columns: dict[tuple[str, ...], Array] = field(default_factory=dict, repr=False, compare=False)

    def inputs(self, names: Sequence[str]) -> Array:
        """The channels called ``names`` as columns, (T, len(names)); do not write to them.

        Raises:
            KeyError: there is no such channel.
        """
        key = tuple(names)
        if key not in self._columns:
            columns = [self.t if name == "t" else self.channels[name] for name in key]
            self._columns[key] = np.column_stack(columns) if key else np.empty((self.t.size, 0))
        return self._columns[key]

    @property
    def kinematics(self) -> tuple[Array, Array, Array]:
        """Positions, rates and accelerations, each (T, n_q)."""
        return self.q, self.qd, self.qdd

    def of_mechanism(self, system: System, u: Array, p: Array) -> Motion:
        """The motion of the mechanism, which is `System.offset` from what its encoders read.

        The offset goes through the filters of the encoders. Where play is crossed it jumps as the
        readings do, and only what was filtered alike leaves nothing of the two.
        """
        if not system.moves_sensors:
            return self
        offset = system.offset(self.q, u, p)
        moved = [values.copy() for values in self.kinematics]
        for axis in np.flatnonzero(offset.any(axis=0)):
            added = offset[:, axis]
            if self.filters is None:
                rate = np.gradient(added, self.t)
                parts = added, rate, np.gradient(rate, self.t)
            else:
                parts = self.filters.derivatives_of(int(axis), added)
            for total, part in zip(moved, parts, strict=True):
                total[:, axis] += part
        return replace(self, q=moved[0], qd=moved[1], qdd=moved[2])

    def rows(self, which: slice) -> Motion:
        """Some of its samples, at the same times."""
        return replace(
            self,
            **{name: getattr(self, name)[which] for name in SAMPLED},
            channels={name: values[which] for name, values in self.channels.items()},
            left_out=None if self.left_out is None else self.left_out[which],
            _columns={},
        )

    def with_channels(self, changed: Mapping[str, Array]) -> Motion:
        """The same motion with some channels replaced."""
        return replace(self, channels={**self.channels, **changed}, _columns={})

    def with_input_timing(self, late_s: float) -> Motion:
        """The same motion with inputs that were sampled ``late_s`` after the positions moved back.

        A channel and its time derivatives move along the derivatives there are (Taylor's series); a
        channel without any, such as a brake command, stays.
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


def input_derivatives(name: str) -> tuple[str, ...]:
    """Names of all time derivatives of an input that a model may use, lowest order first."""
    return tuple(derivative(name, order) for order in range(1, len(INPUT_ORDERS)))


def force_columns(system: System) -> list[int]:
    """Columns of the inputs of a model that are measured forces."""
    return [system.inputs.index(name) for name in system.model.device.forces]


def n_samples(motion: Motion) -> int:
    """Return the number of samples of a trial."""
    return int(motion.t.size)


def trial_sizes(motions: Sequence[Motion]) -> list[int]:
    """Return the number of samples of each trial; none is fetched a second time for that."""
    if isinstance(motions, TrialCache):
        return [motions.size(place) for place in range(len(motions))]
    return [n_samples(motion) for motion in motions]


def trial_names(motions: Sequence[Motion]) -> list[str]:
    """Return the names of trials; where they are known, none is fetched for that."""
    if isinstance(motions, TrialCache) and motions.names:
        return list(motions.names)
    return [motion.trial_id for motion in motions]
