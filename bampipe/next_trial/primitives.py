"""Trials that a person can record: strokes of some axes, within the limits of both."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from bampipe.arrays import Array
from bampipe.physics import System
from bampipe.trials.measured import trial_of_block
from bampipe.trials.motion import Motion

PEAK = 1.875
"""Highest over mean speed of a minimum-jerk stroke (Flash and Hogan 1985)."""
PEAK_ACCELERATION = 5.77
"""Its highest acceleration over travel per time squared."""
FEWEST_STROKES = 3
"""Fewest strokes in a trial: a slower sweep is made shorter."""
PARTS = 2
"""Trials in which motion beyond the present range is recorded: each trial is judged by parameters
fitted to the others, and none of them resembles a trial that is the only one of its kind."""
SHORTEST_PART_S = 4.0
"""Shortest of these trials."""
_FASTEST_SHARE = 0.6
_SPEEDS = {"slow": (0.02, 0.08), "moderate": (0.15, 0.35), "fast": (0.35, _FASTEST_SHARE)}
"""Bands of the highest speed of each stroke, as shares of the highest speed in the trials: people
hurry, and the model may not describe faster motion."""
_ACCELERATION_SHARE = 0.25
"""Share of the highest acceleration in the trials, for the same reason."""
_RANGE_MARGIN = 0.05
"""Margin of designs beyond the trials to the ends of the stated range, as a share of it."""
_MOST_SPEED_GAIN = 2.0
"""No design is faster than this times the highest speed in the trials."""
_LIMIT_SHARE = 0.5
"""Share of the stated speed limit: somebody at twice the speed of a design still keeps it."""
_HAND_SPEED = 1.0
"""Speed of a grip moved by hand, m/s (reaching movements; Flash and Hogan 1985)."""
_LEAST_GAIN = 1.1
"""Least ratio of allowed to recorded range or speed that makes wider designs worthwhile."""
_TOLERATED_EXCESS = 0.02
"""Share by which a design may exceed range or speed of the trials before that is mentioned."""
_SPANS = {
    "whole": (0.0, 1.0), "middle": (0.33, 0.67), "lower": (0.0, 0.4), "upper": (0.6, 1.0),
    "low end": (0.0, 0.2), "high end": (0.8, 1.0),
}  # fmt: skip
"""Ends of the strokes, as shares of the range of the trials. Near an end, half a stroke is about as
useful as a whole one, so that a person who covers only half loses little."""
_SMALL_SPAN = (0.45, 0.55)
_EXTENT_POINTS = 2000
"""Points at which the extent of a series is computed."""
_REST_S = 1.0
GENTLE_SPAN = 0.12
"""Half the travel of an axis that moves only to avoid rest, as a share of its range."""
_POSE_SHARES = (0.2, 0.8)
"""Places of other axes that are tried beside their usual one, as shares of their range."""
_BRAKE_SHARES = (0.5, 1.0)
"""Shares of the brake commands of the viscous trials."""


@dataclass(frozen=True)
class Envelope:
    """The range, speed and acceleration that the trials have shown.

    Attributes:
        low, high: ends of the travel by axis, (n_q,), rad or m.
        usual: median position, (n_q,).
        speed: (n_q,), rad/s or m/s; acceleration: (n_q,), per s squared.
        field: brake command over speed in the viscous trials by axis, (n_q,); zero without them.
        levels: low, median and high value of each further channel.
        wider: the wider envelope that the device allows; None if it allows nothing more.
    """

    low: Array
    high: Array
    usual: Array
    speed: Array
    acceleration: Array
    field: Array
    levels: Mapping[str, tuple[float, float, float]]
    wider: "Envelope | None" = None

    @classmethod
    def of_trials(cls, motions: Sequence[Motion], system: System, p: Array) -> Self:
        """Return the envelope of the trials at hand, for a model with parameters ``p`` (n_p,)."""
        device = system.model.device
        axes = [c.name for c in device.coordinates]
        q, qd, qdd = map(np.concatenate, zip(*(m.kinematics for m in motions), strict=True))
        bounds = np.array([device.limits.get(axis, (-np.inf, np.inf)) for axis in axes])
        low = np.maximum(np.quantile(q, 0.01, axis=0), bounds[:, 0])
        high = np.minimum(np.quantile(q, 0.99, axis=0), bounds[:, 1])
        levels = {}
        for name in device.channels:
            values = np.concatenate([motion.channels[name] for motion in motions])
            least, usual, most = np.quantile(values, [0.05, 0.5, 0.95])
            levels[name] = (float(least), float(usual), float(most))
        seen = cls(
            low, np.maximum(high, low), np.clip(np.median(q, axis=0), low, high),
            np.quantile(np.abs(qd), 0.99, axis=0), np.quantile(np.abs(qdd), 0.99, axis=0),
            np.array([_brake_gain(motions, device.brakes.get(a), i) for i, a in enumerate(axes)]),
            levels,
        )  # fmt: skip
        return seen.widen(bounds, _find_speed_limits(motions, system, p))

    def widen(self, bounds: Array, speeds: Array) -> Self:
        """Return the envelope with a wider one within the limits of the device.

        ``bounds`` (n_q, 2) of the range are infinite, and ``speeds`` (n_q,) NaN, if not stated. The
        acceleration stays that of the trials, also for faster motion.
        """
        stated = np.isfinite(bounds[:, 0]) & np.isfinite(bounds[:, 1])
        bounds = np.where(stated[:, None], bounds, np.column_stack([self.low, self.high]))
        margin = _RANGE_MARGIN * (bounds[:, 1] - bounds[:, 0]) * stated
        low = np.minimum(self.low, bounds[:, 0] + margin)
        high = np.maximum(self.high, bounds[:, 1] - margin)
        far = high - low > _LEAST_GAIN * (self.high - self.low)
        highest = np.fmin(_MOST_SPEED_GAIN * self.speed, _LIMIT_SHARE * speeds)
        highest = highest * np.isfinite(speeds)
        fast = np.nan_to_num(highest) > _LEAST_GAIN * _FASTEST_SHARE * self.speed
        if not (far | fast).any():
            return self
        wider = replace(
            self,
            low=np.where(far, low, self.low),
            high=np.where(far, high, self.high),
            speed=np.where(fast, highest / _FASTEST_SHARE, self.speed),
            acceleration=np.where(fast, self.acceleration / _ACCELERATION_SHARE, self.acceleration),
        )
        return replace(self, wider=wider)

    @property
    def moved_axes(self) -> list[int]:
        """Axes that the trials have moved."""
        return [i for i in range(len(self.low)) if self.high[i] > self.low[i] and self.speed[i] > 0]


def _find_speed_limits(motions: Sequence[Motion], system: System, p: Array) -> Array:
    """Return the speed limit of each axis, (n_q,): of the device or of a hand; NaN if unknown."""
    device = system.model.device
    known = [device.speed_limits.get(axis, np.nan) for axis in system.coordinates]
    if device.drive or device.prescribed or device.force_unit != "N":
        return np.array(known)
    # The lever of a force at the grip is the one by which the axis moves the grip.
    levers = [
        np.linalg.norm(system.input_map(m.q, m.inputs(system.inputs), p), axis=2) for m in motions
    ]
    longest = np.quantile(np.concatenate(levers), 0.99, axis=0)
    by_hand = np.where(longest > 0.0, _HAND_SPEED / np.maximum(longest, 1e-12), np.nan)
    return np.where(np.isnan(known), by_hand, known)


def _brake_gain(motions: Sequence[Motion], brake: str | None, axis: int) -> float:
    """Return brake command over speed of the axis, in the trials in which it is commanded."""
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
    """Motion of one axis back and forth.

    Attributes:
        low, high: where it turns, rad or m.
        slow, fast: band of the highest speed of each stroke, rad/s or m/s.
        rest_s: pause at each turn, s.
        gentle: whether its only purpose is that the axis does not rest.
    """

    low: float
    high: float
    slow: float
    fast: float
    rest_s: float = 0.0
    gentle: bool = False

    @property
    def typical_s(self) -> float:
        """Duration of a stroke in the middle of its band, with the pause after it."""
        return PEAK * (self.high - self.low) / float(np.sqrt(self.slow * self.fast)) + self.rest_s


@dataclass(frozen=True)
class Example:
    """A trial at hand that is imitated.

    Attributes:
        reach: share of its range that is covered; haste: factor on its speeds.
    """

    motion: Motion
    trial: str
    reach: float = 1.0
    haste: float = 1.0

    @property
    def ends(self) -> tuple[Array, Array]:
        """Lowest and highest positions: the 1 % and 99 % quantiles, each (n_q,)."""
        return np.quantile(self.motion.q, 0.01, axis=0), np.quantile(self.motion.q, 0.99, axis=0)

    @property
    def speed(self) -> Array:
        """Highest speed: the 99 % quantile, (n_q,), rad/s or m/s."""
        return np.asarray(np.quantile(np.abs(self.motion.qd), 0.99, axis=0))


@dataclass(frozen=True)
class Series:
    """A motion of all axes for drives: harmonics about a middle position, from rest to rest.

    Attributes:
        middle: start and end, (n_q,), rad or m.
        sine, cosine: amplitudes of the harmonics, (K, n_q).
        seconds: its length, which is the period of the first harmonic.
        ramp_s: time in which it grows, and fades.
    """

    middle: Array
    sine: Array
    cosine: Array
    seconds: float
    ramp_s: float

    def path(self, t: Array) -> tuple[Array, Array, Array]:
        """Return position, velocity and acceleration at times ``t``, each (T, n_q), repeated."""
        t = np.mod(t, self.seconds)
        w = 2.0 * np.pi / self.seconds * np.arange(1, len(self.sine) + 1)
        sin, cos = np.sin(t[:, None] * w), np.cos(t[:, None] * w)
        x = sin @ self.sine + cos @ self.cosine
        v = (cos * w) @ self.sine - (sin * w) @ self.cosine
        a = -(sin * w**2) @ self.sine - (cos * w**2) @ self.cosine
        left = self.seconds - t
        u = np.clip(np.minimum(t, left) / self.ramp_s, 0.0, 1.0)[:, None]
        slope = np.where(t < left, 1.0, -1.0)[:, None] / self.ramp_s
        size = u**4 * (35.0 - 84.0 * u + 70.0 * u**2 - 20.0 * u**3)
        rate = 140.0 * (u * (1.0 - u)) ** 3 * slope
        bend = 420.0 * (u * (1.0 - u)) ** 2 * (1.0 - 2.0 * u) / self.ramp_s**2
        return (self.middle + size * x, size * v + rate * x, size * a + 2.0 * rate * v + bend * x)

    def scale_by(self, share: Array | float) -> Self:
        """Return the series with all amplitudes times ``share``, a number or one for each axis."""
        return replace(self, sine=share * self.sine, cosine=share * self.cosine)

    @property
    def extent(self) -> tuple[Array, Array, Array, Array]:
        """Lowest and highest positions, highest speeds and accelerations, each (n_q,)."""
        q, qd, qdd = self.path(np.linspace(0.0, self.seconds, _EXTENT_POINTS))
        return q.min(axis=0), q.max(axis=0), np.abs(qd).max(axis=0), np.abs(qdd).max(axis=0)


@dataclass(frozen=True)
class Primitive:
    """One trial that a person can record, or one in several parts.

    Attributes:
        strokes: by number of the axis; the first is the one that the trial excites.
        pose: position at which the other axes are held, (n_q,), rad or m.
        seconds: total length.
        field: share of the brake commands of the viscous trials, 0 without brakes.
        levels: values at which further channels are held.
        parts: number of trials in which it is recorded, of equal length.
        example: the trial that is imitated, if there are no strokes.
        series: the motion that drives follow, if there is neither.
    """

    strokes: Mapping[int, Stroke]
    pose: Array
    seconds: float
    field: float = 0.0
    levels: Mapping[str, float] | None = None
    parts: int = 1
    example: Example | None = None
    series: Series | None = None

    @property
    def moves(self) -> Mapping[int, Stroke]:
        """Its strokes by number of the axis; of a series, the range and highest speed of each."""
        if self.series is None:
            return self.strokes
        extent = enumerate(zip(*self.series.extent[:3], strict=True))
        return {i: Stroke(low, high, fast, fast) for i, (low, high, fast) in extent}

    @property
    def part_s(self) -> float:
        """Length of each of its trials, s."""
        return self.seconds / self.parts


def list_primitives(
    seen: Envelope, seconds: float, axes: Sequence[int], with_rests: bool
) -> list[Primitive]:
    """Return primitives that excite ``axes``; all other axes move gently about their usual place.

    Designs within the range of the trials come first, then those beyond it. No axis rests: rest
    holds no information, and estimators overrate it.
    """
    found = _list_within(seen, seen, seconds, axes, with_rests)
    if seen.wider is not None:
        part_s = max(seconds / PARTS, min(seconds, SHORTEST_PART_S))
        others = _list_within(seen.wider, seen, part_s, axes, with_rests)
        found += [
            _split_if_new(replace(design, seconds=seconds), seen)
            for design in others
            if any(find_beyond(design, seen, _FASTEST_SHARE))
        ]
    return _drop_repeated(found)


def _drop_repeated(designs: Sequence[Primitive]) -> list[Primitive]:
    """Return the designs without repetition: slow strokes of several ranges may be the same."""
    found: dict[tuple[object, ...], Primitive] = {}
    for design in designs:
        key: list[object] = [design.parts]
        for axis, stroke in design.strokes.items():
            travel = stroke.high - stroke.low
            key += [axis, round(stroke.low / travel, 6), round(stroke.high / travel, 6)]
            key += [f"{value:.6g}" for value in (stroke.slow, stroke.fast, stroke.rest_s)]
        found.setdefault(tuple(key), design)
    return list(found.values())


def imitate_trials(motions: Sequence[Motion], seen: Envelope, seconds: float) -> list[Primitive]:
    """Return primitives that imitate each of ``motions``; of a trial in blocks, the longest one."""
    examples: dict[str, Example] = {}
    for motion in sorted(motions, key=lambda motion: -motion.t.size):
        example = Example(motion, trial_of_block(motion.trial_id))
        if (example.speed > 0.0).any():
            examples.setdefault(example.trial, example)
    return [Primitive({}, seen.usual, seconds, example=examples[name]) for name in sorted(examples)]


def _split_if_new(design: Primitive, seen: Envelope) -> Primitive:
    """Return the design in several trials if it exceeds the present range and is long enough."""
    is_new = any(find_beyond(design, seen)) and design.seconds >= PARTS * SHORTEST_PART_S
    return replace(design, parts=PARTS if is_new else 1)


def find_beyond(
    design: Primitive, seen: Envelope, share: float = 1.0
) -> tuple[list[int], list[int]]:
    """Return the axes that go farther than in the trials, and those faster than a share of that."""
    slack = _TOLERATED_EXCESS * (seen.high - seen.low)
    moves = design.moves
    lowest, highest = seen.low - slack, seen.high + slack
    most = (share + _TOLERATED_EXCESS) * seen.speed
    farther = [i for i, one in moves.items() if one.low < lowest[i] or one.high > highest[i]]
    return farther, [i for i, one in moves.items() if one.fast > most[i]]


def _list_within(
    reach: Envelope, seen: Envelope, seconds: float, axes: Sequence[int], with_rests: bool
) -> list[Primitive]:
    """Return primitives within ``reach``; gentle strokes stay within ``seen``."""

    def stroke(axis: int, span: tuple[float, float], pace: str) -> Stroke:
        return _make_stroke(reach, seconds, axis, span, _SPEEDS[pace])

    whole = _SPANS["whole"]
    designs = [
        {axis: stroke(axis, span, pace) for axis in seen.moved_axes}
        for pace in _SPEEDS
        for span in (whole, _SMALL_SPAN)
        if len(seen.moved_axes) > 1
    ]
    for axis in axes:
        own = [stroke(axis, span, pace) for span in _SPANS.values() for pace in _SPEEDS]
        own += [stroke(axis, _SMALL_SPAN, pace) for pace in ("slow", "fast")]
        if with_rests:
            wide = (stroke(axis, whole, pace) for pace in ("moderate", "fast"))
            own += [replace(one, rest_s=_REST_S) for one in wide]
        others = [i for i in seen.moved_axes if i != axis]
        gentle = {i: _make_gentle(seen, seconds, i, seen.usual[i]) for i in others}
        designs += [{axis: one, **gentle} for one in own]
        # One further axis over its whole range.
        both = {axis: stroke(axis, whole, "moderate"), **gentle}
        designs += [both | {i: stroke(i, whole, "moderate")} for i in others]
    return [Primitive(strokes, seen.usual, seconds) for strokes in designs]


def _make_gentle(seen: Envelope, seconds: float, axis: int, middle: float) -> Stroke:
    """Return small easy strokes of an axis about ``middle``."""
    share = (middle - seen.low[axis]) / (seen.high[axis] - seen.low[axis])
    low, high = np.clip([share - GENTLE_SPAN, share + GENTLE_SPAN], 0.0, 1.0)
    span = float(low), float(high)
    return replace(_make_stroke(seen, seconds, axis, span, _SPEEDS["moderate"]), gentle=True)


def _make_stroke(
    reach: Envelope, seconds: float, axis: int, span: tuple[float, float], band: tuple[float, float]
) -> Stroke:
    """Return strokes of one axis over a span of its range, within a band of its speed."""
    travel = reach.high[axis] - reach.low[axis]
    low, high = (float(reach.low[axis] + share * travel) for share in span)
    slow, fast = (float(share * reach.speed[axis]) for share in band)
    longest = seconds * np.sqrt(slow * fast) / (PEAK * FEWEST_STROKES)
    if high - low > longest:
        middle = 0.5 * (low + high)
        low, high = middle - 0.5 * float(longest), middle + 0.5 * float(longest)
    # Not faster than the acceleration limit allows on that travel.
    hardest = _ACCELERATION_SHARE * reach.acceleration[axis]
    fast = min(fast, float(PEAK * np.sqrt(hardest * (high - low) / PEAK_ACCELERATION)))
    return Stroke(low, high, min(slow, fast), fast)


def vary_surroundings(seen: Envelope, given: Primitive) -> Iterator[Primitive]:
    """Yield the design with other axes elsewhere, with brakes, and at other channel levels."""
    for axis in list(given.strokes)[1:]:
        for reach in [seen] if seen.wider is None else [seen, seen.wider]:
            low, high = float(reach.low[axis]), float(reach.high[axis])
            if reach is seen or high - low > float(seen.high[axis] - seen.low[axis]):
                for share in _POSE_SHARES:
                    moved = _make_gentle(reach, given.seconds, axis, low + share * (high - low))
                    yield _split_if_new(
                        replace(given, strokes={**given.strokes, axis: moved}), seen
                    )
    if seen.field.any():
        for field in _BRAKE_SHARES:
            yield replace(given, field=field)
    for name, (least, _, most) in seen.levels.items():
        for level in dict.fromkeys((least, most)):
            yield replace(given, levels={**(given.levels or {}), name: level})
