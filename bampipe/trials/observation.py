"""A trial as its sensors gave it, and the motion that filtering makes of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bampipe.estimate.butterworth import rates, zero_phase
from bampipe.physics import System
from bampipe.physics.device import LAST_ORDER, derivative

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sensors:
    """What lies between the mechanism and a recording.

    Attributes:
        rate_hz: sampling rate.
        resolution: of each encoder, (n_q,), rad or m.
        force_sd: noise of the force channels, (n_f,), N; zero where it is not known.
        cutoff_hz: of the filter that velocities, accelerations and force rates go through; a
            fifth of the sampling rate where that is lower.
    """

    rate_hz: float
    resolution: Array
    force_sd: Array
    cutoff_hz: float = 25.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "cutoff_hz", min(self.cutoff_hz, 0.2 * self.rate_hz))


@dataclass(frozen=True)
class Recording:
    """One trial on a uniform grid, SI units.

    Attributes:
        trial_id: its name.
        q: encoder readings, (T, n_q), rad or m.
        force: force channels, (T, n_f), N.
        brake: brake commands in the order of the coordinates, (T, n_q), N.m or N; zeros where
            an axis has none.
        other: channels that are neither, by name, each (T,); no noise is added to them.
    """

    trial_id: str
    q: Array
    force: Array
    brake: Array
    other: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class Motion:
    """A recording with its derivatives; one row a sample.

    Attributes:
        trial_id: its name.
        t: time since the start of the trial, (T,), s.
        q, qd, qdd: (T, n_q), rad or m and derivatives.
        channels: every input that a model may use, by name, each (T,).
    """

    trial_id: str
    t: Array
    q: Array
    qd: Array
    qdd: Array
    channels: Mapping[str, Array]
    _columns: dict[tuple[str, ...], Array] = field(default_factory=dict, repr=False, compare=False)

    def inputs(self, names: Sequence[str]) -> Array:
        """The channels called ``names`` as columns, (T, len(names)); do not write to them."""
        key = tuple(names)
        if key not in self._columns:
            self._columns[key] = np.column_stack([self.channels[name] for name in key])
        return self._columns[key]


def observe(recording: Recording, sensors: Sensors, system: System) -> Motion:
    """Filter a recording the way every recording, measured or replayed, is filtered.

    Positions, velocities and accelerations go through a zero-phase Butterworth filter at
    ``sensors.cutoff_hz``; the force itself is left as it is, its derivatives like velocities.
    """
    device = system.model.device
    rate, cutoff = sensors.rate_hz, sensors.cutoff_hz
    columns = [zero_phase(column, rate, cutoff) for column in recording.q.T]
    t = np.arange(len(recording.q)) / rate
    channels: dict[str, Array] = {"t": t, **recording.other}
    for name, column in zip(device.forces, recording.force.T, strict=True):
        channels[name] = column
        found = rates(column, rate, cutoff, LAST_ORDER)
        channels |= {derivative(name, k): values for k, values in enumerate(found, start=1)}
    for i, axis in enumerate(system.coordinates):
        if axis in device.brakes:
            channels[device.brakes[axis]] = recording.brake[:, i]
    return Motion(
        recording.trial_id,
        t,
        np.column_stack([c[0] for c in columns]),
        np.column_stack([c[1] for c in columns]),
        np.column_stack([c[2] for c in columns]),
        channels,
    )
