"""Recorded signals of a session, and motions under another meaning of them (sign, unit, zero)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from bampipe.arrays import Array
from bampipe.estimate.low_pass import Band
from bampipe.physics import System
from bampipe.physics.device import derivative
from bampipe.results.ingest import IngestResult
from bampipe.trials.motion import Motion

ZERO_OF = "zero of "
"""Prefix of the name for the uncertainty of an encoder's zero, before its axis."""


@dataclass(frozen=True)
class Signals:
    """Axes, forces, other channels and brakes in one order, and their calibration.

    Attributes:
        axes, forces, channels, brakes: names of the signals of each kind.
        units: SI unit of each; stated: the unit that the session file gives for its readings.
        gain: (n, n), offset: (n,): value = gain @ raw + offset.
        gain_sd: (n, n) relative standard uncertainty of the gain: value' = (1 + that) @ value.
        offset_sd: (n,) standard uncertainty of the offset. The zero of an encoder is known to one
            step, whether it rounds or truncates (rectangular distribution, JCGM 100:2008, 4.3.7).
    """

    axes: tuple[str, ...]
    forces: tuple[str, ...]
    channels: tuple[str, ...]
    brakes: tuple[str, ...]
    units: tuple[str, ...]
    stated: tuple[str, ...]
    gain: Array
    offset: Array
    gain_sd: Array
    offset_sd: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all signals, the axes first."""
        return (*self.axes, *self.inputs)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Signals other than coordinates."""
        return (*self.forces, *self.channels, *self.brakes)

    def places(self, names: Sequence[str]) -> list[int]:
        """Indices of the signals called ``names``."""
        return [self.names.index(name) for name in names]

    @classmethod
    def of_session(cls, system: System, session: IngestResult) -> Self:
        """The signals of a session that a model uses."""
        device = system.model.device
        axes, forces = system.coordinates, tuple(device.forces)
        channels = tuple(name for name in device.channels if name not in forces)
        brakes = tuple(device.brakes[a] for a in axes if a in device.brakes)
        inputs = (*forces, *channels, *brakes)
        units: list[str] = [session.axes[axis].unit for axis in axes]
        units += [device.force_unit] * len(forces) + [device.channels[name] for name in channels]
        units += [
            "N.m" if session.axes[axis].unit == "rad" else "N"
            for axis in axes
            if axis in device.brakes
        ]
        stated = [session.axes[axis].raw_unit or session.axes[axis].unit for axis in axes]
        stated += [_stated(name, session) for name in inputs]
        gain, offset = np.eye(len(axes) + len(inputs)), np.zeros(len(axes) + len(inputs))
        offset_sd = np.zeros_like(offset)
        for i, axis in enumerate(axes):
            encoder = session.axes[axis]
            gain[i, i], offset[i] = encoder.scale, -encoder.scale * encoder.zero
            offset_sd[i] = encoder.resolution / np.sqrt(3.0)
        for i, name in enumerate(inputs, len(axes)):
            if name in session.channels:
                channel = session.channels[name]
                gain[i, i], offset[i] = channel.scale, channel.offset
        force = session.force
        matrix = np.array(force.calibration)
        places = [i for i, name in enumerate(inputs, len(axes)) if name in force.columns]
        # If several columns make up one component, no column can stand for another.
        if matrix.shape == (len(places), len(places)) and places:
            order = [session.force.columns.index((*axes, *inputs)[i]) for i in places]
            matrix = matrix[np.ix_(order, order)]
            gain[np.ix_(places, places)] = matrix
            offset[places] = -matrix @ np.array(session.force.zero)[order]
        gain_sd = np.zeros_like(gain)
        gain_sd[np.ix_(places, places)] = force.crosstalk_sd
        scale_sd = dict.fromkeys(force.columns, force.gain_sd)
        scale_sd |= {name: one.scale_sd for name, one in session.channels.items()}
        scale_sd |= {name: one.scale_sd for name, one in session.axes.items()}
        for i, name in enumerate((*axes, *inputs)):
            gain_sd[i, i] = scale_sd.get(name, 0.0)
        return cls(
            axes, forces, channels, brakes, tuple(units), tuple(stated), gain, offset, gain_sd,
            offset_sd,
        )  # fmt: skip


def _stated(name: str, session: IngestResult) -> str:
    if name in session.channels:
        return session.channels[name].raw_unit or session.channels[name].unit
    return session.force.unit if session.force.raw_unit in ("", "V") else session.force.raw_unit


@dataclass(frozen=True)
class Change:
    """Another reading of the signals: value' = gain @ value + offset, t' = time * t, and gravity.

    Attributes:
        gain: (n, n); offset: (n,), in the order of the signals; time: factor of the clock.
        gravity: in the frame of a robot's base, m/s2; None for that of the device file.
    """

    gain: Array
    offset: Array
    time: float = 1.0
    gravity: tuple[float, float, float] | None = None

    @classmethod
    def none(cls, count: int) -> Self:
        """The stated reading of ``count`` signals."""
        return cls(np.eye(count), np.zeros(count))

    def after(self, first: "Change") -> "Change":
        """Both changes, ``first`` being applied first."""
        return Change(
            self.gain @ first.gain,
            self.gain @ first.offset + self.offset,
            self.time * first.time,
            self.gravity or first.gravity,
        )

    def of_motion(self, motion: Motion, signals: Signals) -> Motion:
        """The motion that the same readings give under this change."""
        n = len(signals.axes)
        none = np.zeros_like(motion.t)
        orders = []
        for order, positions in enumerate(motion.kinematics):
            inputs = [motion.channels.get(derivative(name, order), none) for name in signals.inputs]
            values = np.column_stack([positions, *inputs]) @ self.gain.T
            orders.append((values + self.offset if order == 0 else values) / self.time**order)
        sd = np.zeros((motion.t.size, len(self.gain)))
        sd[:, :n] = motion.qd_sd
        channels = dict(zip(signals.inputs, orders[0][:, n:].T, strict=True))
        return replace(
            motion,
            t=motion.t * self.time,
            q=orders[0][:, :n],
            qd=orders[1][:, :n],
            qdd=orders[2][:, :n],
            qd_sd=np.sqrt(sd**2 @ (self.gain[:n] ** 2).T) / self.time,
            channels={**motion.channels, **channels},
        )

    def of_band(self, band: Band) -> Band:
        """The same band in the time of the changed clock."""
        return Band(
            band.rate_hz / self.time,
            tuple(f / self.time for f in band.cutoff_hz),
            band.margin_s * self.time,
        )


def calibration_changes(signals: Signals) -> Iterator[tuple[str, Change]]:
    """Change of the signals by one standard uncertainty of each calibration, with its name."""
    for row, column in np.argwhere(signals.gain_sd > 0.0):
        change = Change.none(len(signals.names))
        change.gain[row, column] += signals.gain_sd[row, column]
        one, other = signals.names[row], signals.names[column]
        yield f"scale of {one}" if row == column else f"{other} in {one}", change
    for row in np.flatnonzero(signals.offset_sd):
        change = Change.none(len(signals.names))
        change.offset[row] = signals.offset_sd[row]
        yield f"{ZERO_OF}{signals.names[row]}", change
