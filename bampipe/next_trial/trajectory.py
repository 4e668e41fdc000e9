"""Trajectories for drives: sums of harmonics, from rest to rest, within the machine's limits.

Source: Swevers, Ganseman, Tükel, de Schutter and Van Brussel 1997, Optimal robot excitation and
identification.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from bampipe.arrays import Array
from bampipe.errors import InputError
from bampipe.lists import join_names
from bampipe.next_trial.primitives import PARTS, SHORTEST_PART_S, Envelope, Primitive, Series
from bampipe.next_trial.rehearsal import Rehearsal
from bampipe.physics.device import Device
from bampipe.results.next import Extent

Form = Literal["csv", "json", "yaml"]
HZ = 100.0
"""Points per second of a trajectory file."""
_LIMIT_SHARE, _EFFORT_SHARE = 0.9, 0.8
"""Shares of the limits that are used: speed and acceleration, and effort, which is a forecast."""
_HARMONICS = 10
_RAMP_S, _RAMP_SHARE = 2.0, 0.2
"""Time in which a motion grows from rest and fades, and its largest share of the trial."""
_MOST_TRAJECTORIES = 60
_HALVINGS = 8
_SMALLEST_EXTENT = 1e-300
_POINT_FIELDS = ("positions", "velocities", "accelerations", "effort")
"""Fields of a point of the ROS message."""


def require_limits(device: Device, where: str) -> None:
    """Refuse a machine without drives, or with unknown limits.

    Raises:
        InputError: the device has no drives, or an axis has no stated range, speed or effort.
    """
    if not (device.drive or device.prescribed):
        raise InputError(
            "the device has no motors that could follow a trajectory: a person moves it, and the"
            " force is measured",
            where=where,
            remedy="follow the sentence of `bampipe next` by hand; --plan prints a sheet of trials",
        )
    axes = [c.name for c in device.coordinates]
    stated: dict[str, Mapping[str, object]] = {
        "lower and upper": device.limits, "speed": device.speed_limits,
        "effort": device.effort_limits,
    }  # fmt: skip
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


def read_limits(device: Device, seen: Envelope) -> dict[str, Extent]:
    """Return the limits of each axis; an unstated acceleration is the highest of the trials."""
    return {
        axis: Extent(
            lower=device.limits[axis][0],
            upper=device.limits[axis][1],
            speed=device.speed_limits[axis],
            acceleration=device.acceleration_limits.get(axis, float(seen.acceleration[i])),
            effort=device.effort_limits[axis],
        )
        for i, axis in enumerate(c.name for c in device.coordinates)
    }


def list_trajectories(
    rehearsal: Rehearsal, limits: Mapping[str, Extent], seconds: float, count: int
) -> list[Primitive]:
    """Return up to ``count`` random trajectories within ``limits``, half of them as in the trials.

    Raises:
        InputError: the weight alone takes more effort than a drive may give.
    """
    seen, found = rehearsal.seen, []
    stated = np.array([[*one.model_dump().values()] for one in limits.values()]).T
    usable = stated * np.array([1.0, 1.0, _LIMIT_SHARE, _LIMIT_SHARE, _EFFORT_SHARE])[:, None]
    known = usable.copy()
    known[2:4] = np.minimum(usable[2:4], [seen.speed, seen.acceleration])
    for number in range(min(count, _MOST_TRAJECTORIES)):
        rng = np.random.default_rng([rehearsal.seed, number])
        beyond = number % 2 == 0
        parts = PARTS if beyond and seconds >= PARTS * SHORTEST_PART_S else 1
        reach, most = (seen.wider or seen, usable) if beyond else (seen, known)
        series = _draw_series(reach, most, seen.moved_axes, seconds / parts, rng)
        fitting = _scale_to_effort(rehearsal, usable[4], series)
        if fitting is not None:
            found.append(Primitive({}, fitting.middle, seconds, parts=parts, series=fitting))
    if not found:
        raise InputError(
            f"at rest the model needs more than {100.0 * _EFFORT_SHARE:.0f} % of the stated effort"
            " in every pose tried",
            where="limits",
            remedy="check effort in [limits] or in the URDF against the data sheet",
        )
    return found


def _draw_series(
    reach: Envelope, limits: Array, axes: Sequence[int], seconds: float, rng: np.random.Generator
) -> Series:
    """Return a random series that reaches one bound of each axis: position, speed, acceleration.

    A random power law for the amplitudes of the harmonics gives slow wide or quick short motion.

    ``limits`` (5, n_q) are as in `Extent`; only ``axes`` move.
    """
    n = len(reach.low)
    fall = np.arange(1, _HARMONICS + 1)[:, None] ** -rng.uniform(0.0, 2.0)
    sine, cosine = fall * rng.standard_normal((2, _HARMONICS, n))
    low, high = np.maximum(reach.low, limits[0]), np.minimum(reach.high, limits[1])
    middle = low + (high - low) * rng.uniform(0.35, 0.65, n)
    unit = Series(middle, sine, cosine, seconds, min(_RAMP_S, _RAMP_SHARE * seconds))
    lowest, highest, speed, acceleration = unit.extent
    room = np.array([middle - low, high - middle, limits[2], limits[3]])
    taken = np.array([middle - lowest, highest - middle, speed, acceleration])
    share = np.min(room / np.maximum(taken, _SMALLEST_EXTENT), axis=0)
    return unit.scale_by(share * np.isin(np.arange(n), axes))


def _scale_to_effort(rehearsal: Rehearsal, most: Array, series: Series) -> Series | None:
    """Return the series scaled to the effort ``most``, (n_q,); None if no scale fits."""

    def fits(share: float) -> bool:
        _, effort = rehearsal.effort(series.scale_by(share))
        return bool((np.abs(effort).max(axis=0) <= most).all())

    if fits(1.0):
        return series
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return series.scale_by(low) if low > 0.0 else None


@dataclass(frozen=True)
class Points:
    """Points along a trajectory, from rest to rest.

    Attributes:
        axes: their names; t: (T,) s.
        columns: positions, velocities, accelerations and effort forecast by axis, each (T, n_q).
    """

    axes: Sequence[str]
    t: Array
    columns: tuple[Array, Array, Array, Array]

    @classmethod
    def of_series(cls, series: Series, rehearsal: Rehearsal) -> Self:
        """Return `HZ` points per second, and one at the end, where the motion rests again."""
        t = np.linspace(0.0, series.seconds, round(series.seconds * HZ) + 1)
        clock, effort = rehearsal.effort(series)
        given = np.stack([np.interp(t, clock, column) for column in effort.T], axis=1)
        return cls(rehearsal.system.coordinates, t, (*series.path(t), given))

    def extents(self) -> dict[str, Extent]:
        """Return range, highest speed, acceleration and effort of each axis."""
        q, *others = self.columns
        rows = np.stack([q.min(axis=0), q.max(axis=0), *(np.abs(c).max(axis=0) for c in others)])
        return {
            axis: Extent(**dict(zip(Extent.model_fields, row, strict=True)))
            for axis, row in zip(self.axes, rows.T.tolist(), strict=True)
        }

    def text(self, form: Form, names: Mapping[str, str], sentence: str) -> str:
        """Return the file: a table, or a trajectory_msgs/JointTrajectory as JSON or YAML.

        ``names`` are those of a robot's drives, if they differ from the axes'; the sentence, an
        instruction, is written as a comment.
        """
        if form == "csv":
            head = ["t", *(f"{n}_{a}" for n in ("q", "qd", "qdd", "effort") for a in self.axes)]
            rows = np.column_stack([self.t, *self.columns])
            return "\n".join(
                [",".join(head), *(",".join(map("{:.9g}".format, row)) for row in rows), ""]
            )
        points = []
        for k, t in enumerate(self.t):
            sec, nanosec = divmod(round(1e9 * float(t)), 10**9)
            values = [[float(f"{v:.9g}") for v in column[k]] for column in self.columns]
            clock = {"time_from_start": {"sec": sec, "nanosec": nanosec}}
            points.append(dict(zip(_POINT_FIELDS, values, strict=True)) | clock)
        header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
        joints = [names.get(axis, axis) for axis in self.axes]
        if form == "json":
            message = {"header": header, "joint_names": joints, "points": points}
            return json.dumps(message, indent=1) + "\n"
        # JSON is valid YAML: a point takes one line.
        lines = [f"# trajectory_msgs/msg/JointTrajectory. {sentence}"]
        lines += [f"header: {json.dumps(header)}", f"joint_names: {json.dumps(joints)}", "points:"]
        return "\n".join([*lines, *(f"- {json.dumps(one)}" for one in points), ""])
