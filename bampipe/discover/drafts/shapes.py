"""Functions of one coordinate that a draft may use, with the constants that shape them.

Arguments of functions are ratios, so that every strength is a force or torque.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from bampipe.estimate.play import drag_along

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Shape:
    """A function of one coordinate ``x``, linear in its strengths.

    Attributes:
        name, text: as in names and in expressions, where ``x`` stands for the coordinate.
        strengths: what it is linear in, each with what it means.
        searched: constants that shape it, each with its kind: ``place``, ``length``,
            ``wavenumber``.
        fixed: constants that scale it and are not estimated: ``middle``, ``reach`` of the span.
        columns: value by strength: of x (T, 1), the searched constants (G,) and the fixed ones,
            each (T, G); with states, of x along a trial and its ``interval``, s.
        words: what it does, of ``{x}``.
        states: where it has memory, rate and value at the start by name; states have the unit of
            the coordinate.
        drawn: of a shape with memory, its curve for motion that is quicker than what it remembers.
    """

    name: str
    text: str
    strengths: Mapping[str, str]
    searched: Mapping[str, str]
    fixed: tuple[str, ...]
    columns: Callable[..., tuple[Array, ...]]
    words: str
    states: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    drawn: Callable[..., tuple[Array, ...]] | None = None


def _lagged(x: Array, c: Mapping[str, Any], first: float) -> Array:
    """x (T, 1) behind a first-order lag of each ``c["lag"]`` (G,), (T, G)."""
    keeps = np.exp(-c["interval"] / np.atleast_1d(c["lag"]))
    found = [lfilter([0.5 * (1 - a), 0.5 * (1 - a)], [1.0, -a], x[:, 0] - first) for a in keeps]
    return np.asarray(found).T + first


def _dragged(x: Array, play: Array) -> Array:
    """What x (T, 1) drags along with each ``play`` (G,), (T, G)."""
    plays = np.ascontiguousarray(np.atleast_1d(play), dtype=np.float64)
    return np.asarray(drag_along(np.ascontiguousarray(x[:, 0]), plays))


def _held(x: Array, play: Array) -> Array:
    """What a spring that slips after ``play`` (G,) holds of x (T, 1), between -1 and 1, (T, G)."""
    return np.asarray((x - _dragged(x, play)) / play)


def _rising(x: Array, play: float) -> Array:
    """What it holds while x rises from where it turned, at its least."""
    return np.asarray(np.clip((x - x.min()) / play - 1.0, -1.0, 1.0))


def _slip(name: str, play: str) -> dict[str, tuple[str, str]]:
    """The state that x drags along with a ``play``, within the time ``settling``."""
    return {name: (f"(x - {name} - clip(x - {name}, -{play}, {play}))/settling", "x")}


def _ratio(x: Array, c: Mapping[str, Any]) -> Array:
    return np.asarray((x - c["middle"]) / c["reach"])


def _away(x: Array, c: Mapping[str, Any]) -> Array:
    return np.asarray((x - c["place"]) / c["width"])


KNOTS = 16
"""Points of a curve in an effect file: an expression has no room for many more."""


def hats(x: Array, low: float, spacing: float, count: int) -> Array:
    """Piecewise linear columns (T, count), each 1 at its knot and 0 at all others."""
    at = (x - low) / spacing
    return np.asarray(np.maximum(1.0 - np.abs(at - np.arange(count)), 0.0))


def _curve_columns(x: Array, c: Mapping[str, Any]) -> tuple[Array, ...]:
    return tuple(column[:, None] for column in hats(x, c["start"], c["spacing"], KNOTS).T)


_AT_END = "what it comes to at the end of the range"
_U = "((x - middle)/reach)"
_V = "((x - place)/width)"
SHAPES = {
    shape.name: shape
    for shape in (
        Shape(
            "slope", f"height*{_U}", {"height": _AT_END}, {}, ("middle", "reach"),
            lambda x, c: (_ratio(x, c),), "changes in proportion to {x}",
        ),
        Shape(
            "parabola", f"slope*{_U} + bow*{_U}**2",
            {"slope": "its linear part at the end of the range",
             "bow": "its quadratic part there"}, {}, ("middle", "reach"),
            lambda x, c: (_ratio(x, c), _ratio(x, c) ** 2), "follows a parabola in {x}",
        ),
        Shape(
            "cubic", f"slope*{_U} + bow*{_U}**2 + twist*{_U}**3",
            {"slope": "its linear part at the end of the range",
             "bow": "its quadratic part there", "twist": "its cubic part there"},
            {}, ("middle", "reach"),
            lambda x, c: (_ratio(x, c), _ratio(x, c) ** 2, _ratio(x, c) ** 3),
            "follows a cubic curve in {x}",
        ),
        Shape(
            "bump", f"height*exp(-{_V}**2)", {"height": "at its top"},
            {"place": "place", "width": "length"}, (),
            lambda x, c: (np.exp(-(_away(x, c) ** 2)),),
            "has a bump at one {x}",
        ),
        Shape(
            "snag", f"height*{_V}*exp((1 - {_V}**2)/2)", {"height": "at either bump"},
            {"place": "place", "width": "length"}, (),
            lambda x, c: (_away(x, c) * np.exp(0.5 * (1.0 - _away(x, c) ** 2)),),
            "has opposite bumps on the two sides of one {x}",
        ),
        Shape(
            "step", f"height*tanh{_V}", {"height": "half of the step"},
            {"place": "place", "width": "length"}, (),
            lambda x, c: (np.tanh(_away(x, c)),), "changes from one level to another at one {x}",
        ),
        Shape(
            "rise", "height*max(x - place, 0)/reach",
            {"height": "what it grows by over half the range"}, {"place": "place"}, ("reach",),
            lambda x, c: (np.maximum(x - c["place"], 0.0) / c["reach"],),
            "begins at one {x} and grows in proportion beyond it",
        ),
        Shape(
            "fall", "height*max(place - x, 0)/reach",
            {"height": "what it grows by over half the range"}, {"place": "place"}, ("reach",),
            lambda x, c: (np.maximum(c["place"] - x, 0.0) / c["reach"],),
            "ends at one {x} and grows in proportion below it",
        ),
        Shape(
            "dead_zone", "height*(x - clip(x, place - width, place + width))/reach",
            {"height": "what it grows by over half the range"},
            {"place": "place", "width": "length"}, ("reach",),
            lambda x, c: (
                (x - np.clip(x, c["place"] - c["width"], c["place"] + c["width"])) / c["reach"],
            ),
            "is nothing within a range of {x} and grows in proportion beyond either end of it",
        ),
        Shape(
            "ripple", "sine*sin(wavenumber*x) + cosine*cos(wavenumber*x)",
            {"sine": "in phase with the sine", "cosine": "in phase with the cosine"},
            {"wavenumber": "wavenumber"}, (),
            lambda x, c: (np.sin(c["wavenumber"] * x), np.cos(c["wavenumber"] * x)),
            "ripples with {x}",
        ),
        Shape(
            "decay", "height*exp(-x/width)", {"height": "at zero"}, {"width": "length"}, (),
            lambda x, c: (np.exp(-x / c["width"]),), "fades as {x} grows",
        ),
        Shape(
            "relaxing", "height*(x - rest)/reach",
            {"height": "what a quick motion over half the range builds up"}, {"lag": "time"},
            ("reach",), lambda x, c: ((x - _lagged(x, c, float(x[0, 0]))) / c["reach"],),
            "builds up with {x} and relaxes with time", {"rest": ("(x - rest)/lag", "x")},
            lambda x, c: (_ratio(x, c | {"middle": x.mean()}),),
        ),
        Shape(
            "lagging", "height*trail/reach", {"height": "what it comes to at the end of the range"},
            {"lag": "time"}, ("reach",), lambda x, c: (_lagged(x, c, 0.0) / c["reach"],),
            "follows {x} with a lag", {"trail": ("(x - trail)/lag", "0")},
            lambda x, c: (x / c["reach"],),
        ),
        Shape(
            "play", "height*(trail - middle)/reach", {"height": _AT_END}, {"width": "length"},
            ("middle", "reach", "settling"),
            lambda x, c: (_ratio(_dragged(x, c["width"]), c),),
            "follows {x} with play, up to its width behind it", _slip("trail", "width"),
            lambda x, c: (_ratio(np.maximum(x - c["width"], x.min() + c["width"]), c),),
        ),
        Shape(
            "hysteresis", "height*clip((x - trail)/width, -1, 1)", {"height": "what it comes to"},
            {"width": "length"}, ("settling",), lambda x, c: (_held(x, c["width"]),),
            "builds up as {x} turns round and stays once that has changed by twice its width",
            _slip("trail", "width"), lambda x, c: (_rising(x, c["width"]),),
        ),
        Shape(
            "two_hystereses",
            "short*clip((x - near)/width, -1, 1) + long*clip((x - far)/longer, -1, 1)",
            {"short": "what the part of the shorter width comes to",
             "long": "what the other part comes to"},
            {"width": "length", "longer": "length"}, ("settling",),
            lambda x, c: (_held(x, c["width"]), _held(x, c["longer"])),
            "builds up in two parts as {x} turns round, each of which stays once that has changed "
            "by twice its width",
            _slip("near", "width") | _slip("far", "longer"),
            lambda x, c: (_rising(x, c["width"]), _rising(x, c["longer"])),
        ),
        Shape(
            "curve",
            " + ".join(f"h{k}*max(1 - abs((x - start)/spacing - {k}), 0)" for k in range(KNOTS)),
            {f"h{k}": f"at point {k + 1} of {KNOTS}" for k in range(KNOTS)}, {},
            ("start", "spacing"), _curve_columns,
            f"is a curve through {KNOTS} points along {{x}}; it is no formula",
        ),
    )
}  # fmt: skip
