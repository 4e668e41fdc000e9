"""A primitive in a sentence that a student can follow."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bampipe.lists import join_names
from bampipe.next_trial.primitives import PEAK, Envelope, Example, Primitive, Stroke, find_beyond
from bampipe.physics.device import Coordinate, Device

_AGAIN = 1.2
"""Of the length of a trial that is imitated: what lasts longer goes through it more than once."""
_SLOW, _FAST = 0.12, 0.45
"""Of the speed that the trials show: where a motion is called slow, and where fast."""
_LONG_S = 2.0
"""Nobody calls a stroke fast that takes as long."""


def describe(design: Primitive, seen: Envelope, device: Device) -> str:
    """Say what to do in one sentence."""
    axes = device.coordinates
    if design.example is not None:
        return f"{_imitate(design, design.example, device)}{_with(design, device)}."
    if design.series is not None:
        time = f"{design.seconds:.3g} s{_in_parts(design)}"
        text = f"Let the drives follow the trajectory, for {time}"
        return f"{text}{_with(design, device)}{_say_beyond(design, seen, axes)}."
    first = next(iter(design.strokes))
    beside = [i for i, one in design.strokes.items() if one.gentle]
    strokes = {i: one for i, one in design.strokes.items() if i not in beside}
    names = [axes[i].name for i in strokes]
    ends = [_ends(one, axes[i].unit) for i, one in strokes.items()]
    pace, times = _pace(design.strokes[first], seen, first), [_times(s) for s in strokes.values()]
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
    text += f", for {design.seconds:.3g} s{_in_parts(design)}"
    if beside:
        about = join_names(_about(design.strokes[i], axes[i].unit) for i in beside)
        others = join_names(axes[i].name for i in beside)
        text += f"; meanwhile keep {others} moving gently, {about}"
    still = [axis.name for i, axis in enumerate(axes) if i not in design.strokes]
    if still:
        text += f"; leave {join_names(still)} alone"
    return f"{text}{_with(design, device)}{_say_beyond(design, seen, axes)}."


def _in_parts(design: Primitive) -> str:
    """In how many trials it is recorded, if in more than one."""
    return f" in {design.parts} trials of {design.part_s:.3g} s" if design.parts > 1 else ""


def _with(design: Primitive, device: Device) -> str:
    """What else is set, at the end of a sentence."""
    text = ""
    if design.field:
        share = "half as strong as" if design.field < 1.0 else "as"
        text += f"; with the brakes on, {share} in the viscous trials"
    for name, level in (design.levels or {}).items():
        text += f"; with {name} held at {level:.3g} {device.channels[name]}".rstrip()
    return text


def _imitate(design: Primitive, example: Example, device: Device) -> str:
    """What to do so that a trial becomes like one at hand."""
    axes = device.coordinates
    (low, high), speed = example.ends, example.speed
    moving = [i for i in range(len(axes)) if speed[i] > 0.0 and high[i] > low[i]]
    names = [f"{axes[i].name} " if len(moving) > 1 else "" for i in moving]
    each = ", ".join(
        f"{name}{_ends(Stroke(low[i], high[i], 0.0, 0.0), axes[i].unit)}"
        f" at up to {_speed(speed[i], axes[i].unit)}"
        for i, name in zip(moving, names, strict=True)
    )
    length_s = float(example.motion.t[-1] - example.motion.t[0])
    again = " over and over" if design.seconds > _AGAIN * length_s else ""
    return (
        f"Move {join_names(axes[i].name for i in moving)} as in trial {example.trial}, {each},"
        f"{again} for {design.seconds:.3g} s"
    )


def _speed(value: float, unit: str) -> str:
    if unit == "rad":
        return f"{_two_figures(math.degrees(value))}°/s"
    return f"{_two_figures(1e3 * value)} mm/s"


def _two_figures(value: float) -> str:
    """A number rounded to two figures."""
    return f"{float(f'{value:.2g}'):g}"


def _say_beyond(design: Primitive, seen: Envelope, axes: Sequence[Coordinate]) -> str:
    """What a design asks of the machine that no trial at hand has asked."""
    farther, faster = ([axes[i].name for i in group] for group in find_beyond(design, seen))
    if not (farther or faster):
        return ""
    if set(farther) == set(faster):
        text = f"{join_names(farther)} farther and faster"
    else:
        parts = (farther, "farther"), (faster, "faster")
        text = " and ".join(f"{join_names(names)} {how}" for names, how in parts if names)
    return f"; this takes {text} than so far" + (": try the way slowly first" if farther else "")


def _about(stroke: Stroke, unit: str) -> str:
    """Around where an axis is moved gently, how far, and about how long each way takes."""
    middle, half = 0.5 * (stroke.low + stroke.high), 0.5 * (stroke.high - stroke.low)
    if unit == "rad":
        text = f"{_rounded(math.degrees(middle), 0)}° ± {_rounded(math.degrees(half), 0)}°"
    else:
        text = f"{_rounded(1e3 * middle, 0)} ± {_rounded(1e3 * half, 0)} mm"
    return f"{text} in {_two_figures(stroke.typical_s)} s each way".replace("-", "−")


def _rounded(value: float, digits: int) -> str:
    """A number with so many digits behind the point, and without the sign of a zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _pace(stroke: Stroke, seen: Envelope, axis: int) -> str:
    share = np.sqrt(stroke.slow * stroke.fast) / float(seen.speed[axis])
    if share < _SLOW:
        return "slowly"
    return "fast" if share > _FAST and stroke.typical_s < _LONG_S else "at an easy pace"


def _ends(stroke: Stroke, unit: str) -> str:
    """Where to turn: degrees or millimetres first, for a person; the unit of the files after."""
    if unit == "rad":
        low, high = (_rounded(math.degrees(end), 0) for end in (stroke.low, stroke.high))
        radians = f"{_rounded(stroke.low, 2)} to {_rounded(stroke.high, 2)} rad"
        return f"between {low}° and {high}° ({radians})".replace("-", "−")
    digits = 0 if stroke.high - stroke.low > 0.01 else 2
    low, high = (_rounded(1e3 * end, digits) for end in (stroke.low, stroke.high))
    return f"between {low} and {high} mm".replace("-", "−")


def _times(stroke: Stroke) -> str:
    """How long a stroke takes, and how fast it is at its middle."""
    travel = stroke.high - stroke.low
    short, long = (PEAK * travel / speed for speed in (stroke.fast, stroke.slow))
    text = f"{short:.2g} s each way"
    if f"{long:.2g}" != f"{short:.2g}":
        text = f"{short:.2g} to {long:.2g} s each way, now quicker, now slower"
    if stroke.rest_s:
        text += f", with a rest of {stroke.rest_s:.2g} s at each end"
    return text
