"""A trial as its sensors gave it, and the motion that the session's filters make of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bampipe.physics.device import INPUT_ORDERS, derivative
from bampipe.trials.cache import TrialCache

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Recording:
    """One trial on a uniform grid, SI units, unfiltered.

    Attributes:
        trial_id: its name.
        q: encoder readings, (T, n_q), rad or m.
        channels: every other logged input of the device by name, each (T,): forces, brake
            commands, further channels.
    """

    trial_id: str
    q: Array
    channels: Mapping[str, Array]


@dataclass(frozen=True)
class Motion:
    """One trial with its derivatives, on a uniform grid; one row a sample.

    Attributes:
        trial_id: its name.
        t: time since the start of the trial, (T,), s.
        q, qd, qdd: (T, n_q), rad or m and derivatives.
        qd_sd: standard deviation of the velocities, (T, n_q).
        channels: inputs of the device and their time derivatives by name, each (T,).
        left_out: (T, n_q) samples that count no more than those at rest: of a replay, what its
            trial leaves out; of a trial, its disturbances. None where there are none.
    """

    trial_id: str
    t: Array
    q: Array
    qd: Array
    qdd: Array
    qd_sd: Array
    channels: Mapping[str, Array]
    left_out: NDArray[np.bool_] | None = None
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

    def input_rates(self, names: Sequence[str]) -> Array:
        """Time derivatives of the channels called ``names``, (T, len(names)); zero if unknown."""
        none = np.zeros(self.t.size)
        rates = [self.channels.get(derivative(name, 1), none) for name in names]
        return np.column_stack(rates) if rates else np.empty((self.t.size, 0))

    def rows(self, which: slice) -> Motion:
        """Some of its samples, at the same times."""
        return replace(
            self,
            t=self.t[which],
            q=self.q[which],
            qd=self.qd[which],
            qdd=self.qdd[which],
            qd_sd=self.qd_sd[which],
            channels={name: values[which] for name, values in self.channels.items()},
            left_out=None if self.left_out is None else self.left_out[which],
            _columns={},
        )

    def with_channels(self, changed: Mapping[str, Array]) -> Motion:
        """The same motion with some channels replaced."""
        return replace(self, channels={**self.channels, **changed}, _columns={})

    def with_input_timing(self, late_s: float) -> Motion:
        """The same motion with inputs that were sampled ``late_s`` after the positions moved back.

        A channel moves along its own time derivative; one without a derivative, such as a brake
        command, stays.
        """
        if late_s == 0.0:
            return self
        moved = {}
        for name, values in self.channels.items():
            rate = derivative(name, 1)
            if rate in self.channels:
                moved[name] = values - late_s * self.channels[rate]
        return self.with_channels(moved)


def input_derivatives(name: str) -> tuple[str, ...]:
    """Names of all time derivatives of an input that a model may use, lowest order first."""
    return tuple(derivative(name, order) for order in range(1, len(INPUT_ORDERS)))


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
