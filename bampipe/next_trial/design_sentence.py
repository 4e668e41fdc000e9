"""A design as a sentence that a student can follow."""

import math
from collections.abc import Sequence

import numpy as np

from bampipe.lists import join_names
from bampipe.next_trial.primitives import PEAK, Envelope, Example, Primitive, Stroke, find_beyond
from bampipe.physics.device import Coordinate, Device
from bampipe.results.rounding import rounded

_REPEATED_FROM = 1.2
"""A design longer than this times the imitated trial repeats it."""
_SLOW_BELOW, _FAST_FROM = 0.12, 0.45
"""Shares of the highest speed in the trials below and above which motion is called slow or fast."""
_SHOWN = {"rad": (math.degrees(1.0), "°"), "m": (1e3, " mm")}
"""By unit, the factor and the unit in which people read it."""
_LONG_STROKE_S = 2.0
"""A stroke that takes this long is not called fast."""


def describe_design(design: Primitive, seen: Envelope, device: Device) -> str:
    """Return the instruction in one sentence."""
    axes = device.coordinates
    if design.example is not None:
        return f"{_say_example(design, design.example, device)}{_say_settings(design, device)}."
    if design.series is not None:
        time = f"{design.seconds:.3g} s{_say_parts(design)}"
        text = f"Let the drives follow the trajectory, for {time}"
        return f"{text}{_say_settings(design, device)}{_say_beyond(design, seen, axes)}."
    first = next(iter(design.strokes))
    beside = [i for i, one in design.strokes.items() if one.gentle]
    strokes = {i: one for i, one in design.strokes.items() if i not in beside}
    names = [axes[i].name for i in strokes]
    ends = [_say_ends(one, axes[i].unit) for i, one in strokes.items()]
    pace = _say_speed(design.strokes[first], seen, first)
    times = [_say_pace(stroke) for stroke in strokes.values()]
    if len(strokes) == 1:
        text = f"Move {names[0]} {pace} back and forth {ends[0]}, {times[0]}"
    elif len(set(times)) == 1:
        each = ", ".join(f"{name} {end}" for name, end in zip(names, ends, strict=True))
        text = f"Move {join_names(names)} {pace} back and forth at once, {each}, {times[0]}"
    else:
        each = ", ".join(
            f"{name} {end}, {time}" for name, end, time in zip(names, ends, times, strict=True)
        )
        text = f"Move {join_names(names)} back and forth at once, {each}"
    text += f", for {design.seconds:.3g} s{_say_parts(design)}"
    if beside:
        about = join_names(_say_gentle(design.strokes[i], axes[i].unit) for i in beside)
        others = join_names(axes[i].name for i in beside)
        text += f"; meanwhile keep {others} moving gently, {about}"
    still = [axis.name for i, axis in enumerate(axes) if i not in design.strokes]
    if still:
        text += f"; leave {join_names(still)} alone"
    return f"{text}{_say_settings(design, device)}{_say_beyond(design, seen, axes)}."


def _say_parts(design: Primitive) -> str:
    """Return the number of trials in which it is recorded, if there are several."""
    return f" in {design.parts} trials of {design.part_s:.3g} s" if design.parts > 1 else ""


def _say_settings(design: Primitive, device: Device) -> str:
    """Return brakes and channel levels, as the end of a sentence."""
    text = ""
    if design.field:
        share = "half as strong as" if design.field < 1.0 else "as"
        text += f"; with the brakes on, {share} in the viscous trials"
    for name, level in (design.levels or {}).items():
        text += f"; with {name} held at {level:.3g} {device.channels[name]}".rstrip()
    return text


def _say_example(design: Primitive, example: Example, device: Device) -> str:
    """Return the instruction to imitate a trial."""
    axes = device.coordinates
    (low, high), speed = example.ends, example.speed
    moving = [i for i in range(len(axes)) if speed[i] > 0.0 and high[i] > low[i]]
    names = [f"{axes[i].name} " if len(moving) > 1 else "" for i in moving]
    each = ", ".join(
        f"{name}{_say_ends(Stroke(low[i], high[i], 0.0, 0.0), axes[i].unit)}"
        f" at up to {rounded(_SHOWN[axes[i].unit][0] * speed[i])}{_SHOWN[axes[i].unit][1]}/s"
        for i, name in zip(moving, names, strict=True)
    )
    length_s = float(example.motion.t[-1] - example.motion.t[0])
    again = " over and over" if design.seconds > _REPEATED_FROM * length_s else ""
    return (
        f"Move {join_names(axes[i].name for i in moving)} as in trial {example.trial}, {each},"
        f"{again} for {design.seconds:.3g} s"
    )


def _say_beyond(design: Primitive, seen: Envelope, axes: Sequence[Coordinate]) -> str:
    """Return the axes that go farther or faster than in the trials, as the end of a sentence."""
    farther, faster = ([axes[i].name for i in group] for group in find_beyond(design, seen))
    if not (farther or faster):
        return ""
    if set(farther) == set(faster):
        text = f"{join_names(farther)} farther and faster"
    else:
        parts = (farther, "farther"), (faster, "faster")
        text = " and ".join(f"{join_names(names)} {how}" for names, how in parts if names)
    return f"; this takes {text} than so far" + (": try the way slowly first" if farther else "")


def _say_gentle(stroke: Stroke, unit: str) -> str:
    """Return centre, half travel and time of the gentle strokes of an axis."""
    factor, symbol = _SHOWN[unit]
    middle, half = 0.5 * (stroke.low + stroke.high), 0.5 * (stroke.high - stroke.low)
    text = f"{_round(factor * middle, 0)}{symbol} ± {_round(factor * half, 0)}{symbol}"
    return f"{text} in {rounded(stroke.typical_s)} s each way".replace("-", "−")


def _round(value: float, digits: int) -> str:
    """Return a number with ``digits`` decimals, without the sign of a zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _say_speed(stroke: Stroke, seen: Envelope, axis: int) -> str:
    share = np.sqrt(stroke.slow * stroke.fast) / float(seen.speed[axis])
    if share < _SLOW_BELOW:
        return "slowly"
    return "fast" if share > _FAST_FROM and stroke.typical_s < _LONG_STROKE_S else "at an easy pace"


def _say_ends(stroke: Stroke, unit: str) -> str:
    """Return the turning points: degrees or millimetres for a person, then the unit of files."""
    if unit == "rad":
        low, high = (_round(math.degrees(end), 0) for end in (stroke.low, stroke.high))
        radians = f"{_round(stroke.low, 2)} to {_round(stroke.high, 2)} rad"
        return f"between {low}° and {high}° ({radians})".replace("-", "−")
    digits = 0 if stroke.high - stroke.low > 0.01 else 2
    low, high = (_round(1e3 * end, digits) for end in (stroke.low, stroke.high))
    return f"between {low} and {high} mm".replace("-", "−")


def _say_pace(stroke: Stroke) -> str:
    """Return how long a stroke takes, and the rest at its ends."""
    travel = stroke.high - stroke.low
    short, long = (PEAK * travel / speed for speed in (stroke.fast, stroke.slow))
    text = f"{short:.2g} s each way"
    if f"{long:.2g}" != f"{short:.2g}":
        text = f"{short:.2g} to {long:.2g} s each way, now quicker, now slower"
    if stroke.rest_s:
        text += f", with a rest of {stroke.rest_s:.2g} s at each end"
    return text
