"""Trajectories for drives: sums of harmonics from rest to rest within the limits of the machine.

Source: Swevers, Ganseman, Tükel, de Schutter and Van Brussel 1997, Optimal robot excitation and
identification.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bampipe.errors import InputError
from bampipe.files import json_text
from bampipe.lists import join_names
from bampipe.next_trial.motion import Rehearsal
from bampipe.next_trial.primitives import PARTS, SHORTEST_S, Envelope, Primitive, Series
from bampipe.physics.device import Device
from bampipe.results.next import Extent

Array = NDArray[np.float64]

Form = Literal["csv", "json", "yaml"]
HZ = 100.0
"""Points a second of a trajectory that is written."""
_OF_LIMIT, _OF_EFFORT = 0.9, 0.8
"""Shares of speed and acceleration, and of the effort, which the model forecasts with an error."""
_HARMONICS = 10
_RAMP_S, _RAMP_SHARE = 2.0, 0.2
"""In which a motion grows from rest, and fades: at most this share of the trial."""
_MOST = 60
_HALVINGS = 8
_TINY = 1e-300


def read_limits(device: Device, seen: Envelope, where: str) -> dict[str, Extent]:
    """The limits of each axis by name; an acceleration that is not stated is the highest seen.

    Raises:
        InputError: the device has no drives, or states no range, speed or effort of an axis.
    """
    if not (device.drive or device.prescribed):
        raise InputError(
            f"device {device.name!r} has no motors that could follow a trajectory: a person moves"
            f" it, and {join_names(device.forces)} is measured",
            where=where,
            remedy="record the sentence of `bampipe next` by hand; --plan prints a sheet of trials",
        )
    axes = [c.name for c in device.coordinates]
    stated = {
        "lower and upper": device.limits,
        "speed": device.speed_limits,
        "effort": device.effort_limits,
    }
    lacking = {name: [a for a in axes if a not in known] for name, known in stated.items()}
    if any(lacking.values()):
        said = [f"{name} of {join_names(of, 3)}" for name, of in lacking.items() if of]
        file = "device.toml or the URDF" if device.robot else "device.toml"
        first = next(axis for of in lacking.values() for axis in of)
        raise InputError(
            f"the limits that a trajectory must keep are not stated: {', '.join(said)}",
            where=where,
            remedy=f"state them in {file}, as in [limits.{first}] lower = …, upper = …, speed = …,"
            " effort = … (SI units)",
        )
    return {
        axis: Extent(
            lower=device.limits[axis][0],
            upper=device.limits[axis][1],
            speed=device.speed_limits[axis],
            acceleration=device.acceleration_limits.get(axis, float(seen.acceleration[i])),
            effort=device.effort_limits[axis],
        )
        for i, axis in enumerate(axes)
    }


def list_trajectories(
    rehearsal: Rehearsal, limits: Mapping[str, Extent], seconds: float, count: int
) -> list[Primitive]:
    """At most ``count`` random trajectories within ``limits``, half of them within what was seen.

    Raises:
        InputError: the weight alone takes more effort than a drive may give.
    """
    seen, found = rehearsal.seen, []
    bounds = _Bounds.of_limits(limits, seen)
    for number in range(min(count, _MOST)):
        rng = np.random.default_rng([rehearsal.seed, number])
        beyond = number % 2 == 0
        parts = PARTS if beyond and seconds >= PARTS * SHORTEST_S else 1
        series = _draw(bounds if beyond else bounds.within(seen), seconds / parts, rng)
        fitting = _scale_to_effort(rehearsal, bounds.effort, series)
        if fitting is not None:
            found.append(Primitive({}, fitting.middle, seconds, parts=parts, series=fitting))
    if not found:
        raise InputError(
            f"at rest the model takes more than {100.0 * _OF_EFFORT:.0f} % of the stated effort"
            " in every pose tried",
            where="limits",
            remedy="check effort in [limits] or in the URDF against the data sheet",
        )
    return found


@dataclass(frozen=True)
class _Bounds:
    """What trajectories keep to, each (n_q,); a speed of zero where an axis shall rest."""

    low: Array
    high: Array
    speed: Array
    acceleration: Array
    effort: Array

    @classmethod
    def of_limits(cls, limits: Mapping[str, Extent], seen: Envelope) -> _Bounds:
        """A little less than the limits; what the trials have not moved rests."""
        speed, acceleration, effort = np.array(
            [(one.speed, one.acceleration, one.effort) for one in limits.values()]
        ).T
        moves = np.isin(np.arange(len(speed)), seen.movable)
        low, high = seen.reach
        return cls(
            np.maximum(low, [one.lower for one in limits.values()]),
            np.minimum(high, [one.upper for one in limits.values()]),
            _OF_LIMIT * speed * moves, _OF_LIMIT * acceleration, _OF_EFFORT * effort,
        )  # fmt: skip

    def within(self, seen: Envelope) -> _Bounds:
        """The same within what the trials have shown."""
        return replace(
            self, low=np.maximum(self.low, seen.low), high=np.minimum(self.high, seen.high),
            speed=np.minimum(self.speed, seen.speed),
            acceleration=np.minimum(self.acceleration, seen.acceleration),
        )  # fmt: skip


def _draw(bounds: _Bounds, seconds: float, rng: np.random.Generator) -> Series:
    """A random series that touches one of the bounds of each axis: position, speed, acceleration.

    Its amplitudes fall with the number of the harmonic, less or more: slow and wide, or quick.
    """
    n = len(bounds.low)
    harmonics = np.arange(1, _HARMONICS + 1)[:, None]
    fall = harmonics ** -rng.uniform(0.0, 2.0)
    sine, cosine = fall * rng.standard_normal((2, _HARMONICS, n))
    # Most of the way to either end from wherever it starts.
    room = bounds.high - bounds.low
    middle = bounds.low + room * rng.uniform(0.35, 0.65, n)
    unit = Series(middle, sine, cosine, seconds, min(_RAMP_S, _RAMP_SHARE * seconds))
    low, high, speed, acceleration = unit.extent
    share = np.min(
        [
            (middle - bounds.low) / np.maximum(middle - low, _TINY),
            (bounds.high - middle) / np.maximum(high - middle, _TINY),
            bounds.speed / np.maximum(speed, _TINY),
            bounds.acceleration / np.maximum(acceleration, _TINY),
        ],
        axis=0,
    )
    return unit.scaled(share)


def _scale_to_effort(rehearsal: Rehearsal, most: Array, series: Series) -> Series | None:
    """The largest of the series that takes at most so much effort, (n_q,); None if none does."""

    def fits(share: float) -> bool:
        _, effort = rehearsal.effort(series.scaled(share))
        return bool((np.abs(effort).max(axis=0) <= most).all())

    if fits(1.0):
        return series
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return series.scaled(low) if low > 0.0 else None


@dataclass(frozen=True)
class Points:
    """Points along a trajectory, from rest to rest.

    Attributes:
        axes: their names; t: (T,) s.
        q, qd, qdd: (T, n_q), rad or m and derivatives; effort: (T, n_q) forecast, N.m or N.
    """

    axes: Sequence[str]
    t: Array
    q: Array
    qd: Array
    qdd: Array
    effort: Array

    @classmethod
    def of_series(cls, series: Series, rehearsal: Rehearsal) -> Points:
        """`HZ` points a second, and one at the end, where it is at rest again."""
        count = round(series.seconds * HZ)
        t = np.linspace(0.0, series.seconds, count + 1)
        clock, effort = rehearsal.effort(series)
        given = np.stack([np.interp(t, clock, column) for column in effort.T], axis=1)
        return cls(rehearsal.system.coordinates, t, *series.path(t), given)

    def extents(self) -> dict[str, Extent]:
        """How far, fast and hard each axis goes."""
        tops = (np.abs(part).max(axis=0) for part in (self.qd, self.qdd, self.effort))
        rows = zip(self.axes, self.q.min(axis=0), self.q.max(axis=0), *tops, strict=True)
        names = ("lower", "upper", "speed", "acceleration", "effort")
        return {axis: Extent(**dict(zip(names, row, strict=True))) for axis, *row in rows}

    def text(self, form: Form, names: Mapping[str, str], sentence: str) -> str:
        """The file: a table, or a trajectory_msgs/JointTrajectory as JSON or YAML.

        Args:
            form: of the file; names: that a robot's drives go by, where others than the axes'.
            sentence: what to do with it.
        """
        parts = (self.q, self.qd, self.qdd, self.effort)
        if form == "csv":
            head = ["t", *(f"{n}_{a}" for n in ("q", "qd", "qdd", "effort") for a in self.axes)]
            rows = np.column_stack([self.t, *parts])
            return "\n".join([",".join(head), *(",".join(map(_write, row)) for row in rows), ""])
        fields = ("positions", "velocities", "accelerations", "effort")
        points = []
        for k, t in enumerate(self.t):
            sec, nanosec = divmod(round(1e9 * float(t)), 10**9)
            values = ([float(_write(v)) for v in part[k]] for part in parts)
            clock = {"time_from_start": {"sec": sec, "nanosec": nanosec}}
            points.append(dict(zip(fields, values, strict=True)) | clock)
        header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
        joints = [names.get(axis, axis) for axis in self.axes]
        if form == "json":
            return json_text({"header": header, "joint_names": joints, "points": points})
        # JSON is YAML, so that a point takes a line.
        lines = [f"# trajectory_msgs/msg/JointTrajectory. {sentence}"]
        lines += [f"header: {json.dumps(header)}", f"joint_names: {json.dumps(joints)}", "points:"]
        return "\n".join([*lines, *(f"- {json.dumps(one)}" for one in points), ""])


def _write(value: float) -> str:
    return f"{value:.9g}"
