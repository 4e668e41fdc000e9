"""Trials that a person can record: strokes of some axes, within what has been moved before."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bampipe.physics.device import Device
from bampipe.trials.motion import Motion

Array = NDArray[np.float64]

PEAK = 1.875
"""Highest over mean speed of a stroke of least jerk; of the acceleration, over travel per time
squared, see `PEAK_ACCELERATION` (Flash and Hogan 1985)."""
PEAK_ACCELERATION = 5.77
_FEWEST_STROKES = 3
"""In a trial: a sweep too slow for so many is made shorter."""
_SPEEDS = {"slow": (0.02, 0.08), "moderate": (0.15, 0.35), "fast": (0.35, 0.6)}
"""Bands of the highest speed of each stroke, as shares of the speed seen in the trials: people
hurry, and whether the model describes what is faster than anything seen is not known."""
_ACCELERATION = 0.25
"""Share of the acceleration seen, likewise."""
_SPANS = {"whole": (0.0, 1.0), "middle": (0.33, 0.67), "lower": (0.0, 0.4), "upper": (0.6, 1.0)}
"""Ends of the strokes, as shares of the range of the trials."""
_SMALL = (0.45, 0.55)
_REST_S = 1.0
GENTLE = 0.12
"""Half the range of an axis that is moved gently, so that it does not rest."""
_POSES = (0.2, 0.8)
"""Where other axes may be, as shares of their range; else at their usual place."""
_FIELDS = (0.5, 1.0)
"""Shares of the brake commands of the viscous trials."""


@dataclass(frozen=True)
class Envelope:
    """What the trials have shown that the device and its user can do.

    Attributes:
        low, high: ends of the travel by axis, (n_q,), rad or m.
        usual: median position, (n_q,).
        speed: (n_q,), rad/s or m/s; acceleration: (n_q,), per s squared.
        field: brake command over speed in the viscous trials by axis, (n_q,); zero without them.
        levels: lowest, usual and highest value of each further channel.
    """

    low: Array
    high: Array
    usual: Array
    speed: Array
    acceleration: Array
    field: Array
    levels: Mapping[str, tuple[float, float, float]]

    @classmethod
    def of_trials(cls, motions: Sequence[Motion], device: Device) -> Envelope:
        """The envelope of ``motions``, within the limits of the device."""
        axes = [c.name for c in device.coordinates]
        q, qd, qdd = (
            np.concatenate([getattr(motion, name) for motion in motions])
            for name in ("q", "qd", "qdd")
        )
        bounds = np.array([device.limits.get(axis, (-np.inf, np.inf)) for axis in axes])
        low = np.maximum(np.quantile(q, 0.01, axis=0), bounds[:, 0])
        high = np.minimum(np.quantile(q, 0.99, axis=0), bounds[:, 1])
        levels = {}
        for name in device.channels:
            values = np.concatenate([motion.channels[name] for motion in motions])
            least, usual, most = np.quantile(values, [0.05, 0.5, 0.95])
            levels[name] = (float(least), float(usual), float(most))
        return cls(
            low, np.maximum(high, low), np.clip(np.median(q, axis=0), low, high),
            np.quantile(np.abs(qd), 0.99, axis=0), np.quantile(np.abs(qdd), 0.99, axis=0),
            np.array([_field_of(motions, device.brakes.get(a), i) for i, a in enumerate(axes)]),
            levels,
        )  # fmt: skip

    @property
    def movable(self) -> list[int]:
        """Axes that the trials have moved."""
        return [i for i in range(len(self.low)) if self.high[i] > self.low[i] and self.speed[i] > 0]


def _field_of(motions: Sequence[Motion], brake: str | None, axis: int) -> float:
    """Command of a brake over the speed of its axis, in the trials in which it is commanded."""
    if brake is None:
        return 0.0
    ratios = []
    for motion in motions:
        command, speed = motion.channels.get(brake), np.abs(motion.qd[:, axis])
        if command is not None and command.any():
            ratios.append(float(command @ speed) / max(float(speed @ speed), 1e-30))
    return float(np.median(ratios)) if ratios else 0.0


@dataclass(frozen=True)
class Stroke:
    """Back and forth of one axis.

    Attributes:
        low, high: where it turns, rad or m.
        slow, fast: band of the highest speed of each stroke, rad/s or m/s.
        rest_s: pause at each turn, s.
    """

    low: float
    high: float
    slow: float
    fast: float
    rest_s: float = 0.0


@dataclass(frozen=True)
class Primitive:
    """One trial that a person can record.

    Attributes:
        strokes: by number of the axis, those that move; the first is the one that it is about.
        pose: where the others are held, (n_q,), rad or m.
        seconds: how long.
        field: share of the brake commands of the viscous trials, 0 without brakes.
        levels: values at which further channels are held.
    """

    strokes: Mapping[int, Stroke]
    pose: Array
    seconds: float
    field: float = 0.0
    levels: Mapping[str, float] | None = None

    @property
    def axis(self) -> int:
        """The axis that it is about."""
        return next(iter(self.strokes))


def list_primitives(
    seen: Envelope, seconds: float, axes: Sequence[int], with_rests: bool
) -> list[Primitive]:
    """Primitives about ``axes``; all other axes move gently about their usual place.

    What rests tells nothing, and estimators that use it all the same believe too much of it.
    """
    found = [
        _join(seen, [_strokes_of(seen, seconds, axis, span, band) for axis in seen.movable])
        for band in _SPEEDS.values()
        for span in (_SPANS["whole"], _SMALL)
        if len(seen.movable) > 1
    ]
    for axis in axes:
        own = [
            _strokes_of(seen, seconds, axis, span, band)
            for span in _SPANS.values()
            for band in _SPEEDS.values()
        ]
        own += [
            _strokes_of(seen, seconds, axis, _SMALL, _SPEEDS[name]) for name in ("slow", "fast")
        ]
        if with_rests:
            wide = [
                _strokes_of(seen, seconds, axis, _SPANS["whole"], _SPEEDS[name])
                for name in ("moderate", "fast")
            ]
            own += [replace(one, strokes=_with_rests(one.strokes)) for one in wide]
        others = [i for i in seen.movable if i != axis]
        gentle = [_gentle(seen, seconds, i, seen.usual[i]) for i in others]
        found += [_join(seen, [one, *gentle]) for one in own]
        for other in others:
            # One of them over all of its range.
            beside = [
                _strokes_of(seen, seconds, i, _SPANS["whole"], _SPEEDS["moderate"])
                if i == other
                else _gentle(seen, seconds, i, seen.usual[i])
                for i in others
            ]
            whole = _strokes_of(seen, seconds, axis, _SPANS["whole"], _SPEEDS["moderate"])
            found.append(_join(seen, [whole, *beside]))
    return found


def _join(seen: Envelope, parts: Sequence[Primitive]) -> Primitive:
    """All at once; the first is what it is about."""
    strokes = {axis: stroke for part in parts for axis, stroke in part.strokes.items()}
    return replace(parts[0], strokes=strokes)


def _with_rests(strokes: Mapping[int, Stroke]) -> dict[int, Stroke]:
    return {axis: replace(stroke, rest_s=_REST_S) for axis, stroke in strokes.items()}


def _gentle(seen: Envelope, seconds: float, axis: int, middle: float) -> Primitive:
    """Small easy strokes about a place."""
    share = (middle - seen.low[axis]) / (seen.high[axis] - seen.low[axis])
    ends = np.clip([share - GENTLE, share + GENTLE], 0.0, 1.0)
    return _strokes_of(seen, seconds, axis, (float(ends[0]), float(ends[1])), _SPEEDS["moderate"])


def _strokes_of(
    seen: Envelope,
    seconds: float,
    axis: int,
    span: tuple[float, float],
    band: tuple[float, float],
) -> Primitive:
    """Strokes of one axis over part of its range, at part of its speed."""
    travel = seen.high[axis] - seen.low[axis]
    low, high = (float(seen.low[axis] + share * travel) for share in span)
    slow, fast = (float(share * seen.speed[axis]) for share in band)
    longest = seconds * np.sqrt(slow * fast) / (PEAK * _FEWEST_STROKES)
    if high - low > longest:
        middle = 0.5 * (low + high)
        low, high = middle - 0.5 * float(longest), middle + 0.5 * float(longest)
    # Not faster than the acceleration that has been seen allows on that travel.
    most = PEAK * np.sqrt(
        _ACCELERATION * seen.acceleration[axis] * (high - low) / PEAK_ACCELERATION
    )
    fast = min(fast, float(most))
    return Primitive({axis: Stroke(low, high, min(slow, fast), fast)}, seen.usual, seconds)


def vary_surroundings(seen: Envelope, given: Primitive) -> Iterator[Primitive]:
    """The same design with other axes elsewhere, with brakes, and at other levels of channels."""
    for axis in list(given.strokes)[1:]:
        for share in _POSES:
            middle = float(seen.low[axis] + share * (seen.high[axis] - seen.low[axis]))
            moved = _gentle(seen, given.seconds, axis, middle).strokes
            yield replace(given, strokes={**given.strokes, **moved})
    if seen.field.any():
        for field in _FIELDS:
            yield replace(given, field=field)
    for name, (least, _, most) in seen.levels.items():
        for level in dict.fromkeys((least, most)):
            yield replace(given, levels={**(given.levels or {}), name: level})
