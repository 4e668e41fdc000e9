"""Shapes of drafts: functions of one quantity with their constants.

Arguments of functions are ratios, so that every strength is a force or torque.
"""

import ast
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from types import CodeType
from typing import Any

import numpy as np
from scipy.signal import lfilter

from bampipe.arrays import Array
from bampipe.estimate.hysteresis import drag_along
from bampipe.physics.expression import parse

Constants = Mapping[str, Any]


@dataclass(frozen=True)
class Memory:
    """An internal state that follows the quantity, in the same unit.

    Attributes:
        rate, initial: its expressions in an effect file.
        course: its values (T,), from those of the quantity (T,) and the constants.
        quick_course: the same for a quantity that rises too quickly for the state to relax.
    """

    rate: str
    initial: str
    course: Callable[[Array, Constants], Array]
    quick_course: Callable[[Array, Constants], Array]


@dataclass(frozen=True)
class Shape:
    """A function of quantities ``x``, ``x2``, ... that is linear in its strengths.

    Attributes:
        name, text: its name and its expression.
        strengths: strengths with their descriptions.
        searched: shape constants with their kinds: ``place``, ``length``, ``wavenumber``, ``time``
            or ``number``.
        fixed: constants that are not estimated, such as ``middle`` and ``reach`` of the span.
        words: predicate about ``{x}`` in a sentence.
        states: internal states by name.
    """

    name: str
    text: str
    strengths: Mapping[str, str]
    searched: Mapping[str, str]
    fixed: tuple[str, ...]
    words: str
    states: Mapping[str, Memory] = field(default_factory=dict)

    def columns(self, x: Array, constants: Constants, is_quick: bool = False) -> Array:
        """Return the function for each strength at one, (T, m).

        Args:
            x: quantities along a trial, (T, k).
            constants: searched and fixed constants, and the ``interval`` of samples, s.
            is_quick: whether the motion is too quick for the states to relax.
        """
        # As numpy's number, a constant of zero divides like one of a column.
        known: dict[str, Any] = {name: np.float64(value) for name, value in constants.items()}
        known |= {f"x{k + 1}" if k else "x": column for k, column in enumerate(x.T)}
        for name, state in self.states.items():
            known[name] = (state.quick_course if is_quick else state.course)(x[:, 0], known)
        code, known = _compile(self.text), known | dict.fromkeys(self.strengths, 0.0)
        values = [eval(code, _FUNCTIONS, known | {name: 1.0}) for name in self.strengths]
        return np.column_stack([np.broadcast_to(value, len(x)) for value in values])


@cache
def _compile(text: str) -> CodeType:
    """Return the code of an expression whose every node is checked, as in an effect file."""
    return compile(ast.Expression(parse(text, "a shape")), text, "eval")


_FUNCTIONS: dict[str, Any] = {
    "exp": np.exp, "tanh": np.tanh, "sin": np.sin, "cos": np.cos, "abs": np.abs,
    "max": np.maximum, "min": np.minimum, "clip": np.clip, "__builtins__": {},
}  # fmt: skip


def _lagged(x: Array, c: Constants, first: float) -> Array:
    """Apply a first-order lag of ``c["lag"]`` to ``x``."""
    keeps = np.exp(-c["interval"] / c["lag"])
    gain = 0.5 * (1.0 - keeps)
    return np.asarray(lfilter([gain, gain], [1.0, -keeps], x - first)) + first


def _slip(name: str, play: str) -> dict[str, Memory]:
    """Return the state that ``x`` drags along with a ``play``, within the time ``settling``."""
    rate = f"(x - {name} - clip(x - {name}, -{play}, {play}))/settling"

    def course(x: Array, c: Constants) -> Array:
        return np.asarray(drag_along(np.ascontiguousarray(x), float(c[play])))

    def quick_course(x: Array, c: Constants) -> Array:
        return np.asarray(np.maximum(x - c[play], x.min() + c[play]))

    return {name: Memory(rate, "x", course, quick_course)}


_RELAXING = Memory(
    "(x - rest)/lag", "x",
    lambda x, c: _lagged(x, c, float(x[0])), lambda x, c: np.full_like(x, x.mean()),
)  # fmt: skip
_TRAILING = Memory("(x - trail)/lag", "0", lambda x, c: _lagged(x, c, 0.0), lambda x, c: x)
KNOTS = 16
"""Points of a curve; an expression of an effect file has no room for many more."""
_AT_END = "value at the end of the range"
_PER_REACH = "increase over half the range"
_LINEAR, _SQUARE = "linear part at the end of the range", "quadratic part there"
_U = "((x - middle)/reach)"
_V = "((x - place)/width)"
_PLACED = {"place": "place", "width": "length"}
SHAPES = {
    shape.name: shape
    for shape in (
        Shape(
            "slope", f"height*{_U}", {"height": _AT_END}, {}, ("middle", "reach"),
            "changes in proportion to {x}",
        ),
        Shape(
            "parabola", f"slope*{_U} + bow*{_U}**2", {"slope": _LINEAR, "bow": _SQUARE}, {},
            ("middle", "reach"), "follows a parabola in {x}",
        ),
        Shape(
            "cubic", f"slope*{_U} + bow*{_U}**2 + twist*{_U}**3",
            {"slope": _LINEAR, "bow": _SQUARE, "twist": "cubic part there"}, {},
            ("middle", "reach"), "follows a cubic curve in {x}",
        ),
        Shape(
            "bump", f"height*exp(-{_V}**2)", {"height": "peak value"}, _PLACED, (),
            "has a bump at one {x}",
        ),
        Shape(
            "snag", f"height*{_V}*exp((1 - {_V}**2)/2)", {"height": "peak value"}, _PLACED, (),
            "has opposite bumps on the two sides of one {x}",
        ),
        Shape(
            "step", f"height*tanh{_V}", {"height": "half the height of the step"}, _PLACED, (),
            "changes from one level to another at one {x}",
        ),
        Shape(
            "rise", "height*max(x - place, 0)/reach", {"height": _PER_REACH}, {"place": "place"},
            ("reach",), "begins at one {x} and grows in proportion beyond it",
        ),
        Shape(
            "fall", "height*max(place - x, 0)/reach", {"height": _PER_REACH}, {"place": "place"},
            ("reach",), "ends at one {x} and grows in proportion below it",
        ),
        Shape(
            "dead_zone", "height*(x - clip(x, place - width, place + width))/reach",
            {"height": _PER_REACH}, _PLACED, ("reach",),
            "is zero within a range of {x} and grows in proportion beyond its ends",
        ),
        Shape(
            "ripple", "sine*sin(wavenumber*x) + cosine*cos(wavenumber*x)",
            {"sine": "amplitude of the sine", "cosine": "amplitude of the cosine"},
            {"wavenumber": "wavenumber"}, (), "ripples with {x}",
        ),
        Shape(
            "decay", "height*exp(-x/width)", {"height": "value at zero"}, {"width": "length"}, (),
            "fades as {x} grows",
        ),
        Shape(
            "relaxing", "height*(x - rest)/reach",
            {"height": "increase by a quick motion over half the range"}, {"lag": "time"},
            ("reach",), "builds up with {x} and relaxes with time", {"rest": _RELAXING},
        ),
        Shape(
            "lagging", "height*trail/reach", {"height": _AT_END}, {"lag": "time"}, ("reach",),
            "follows {x} with a lag", {"trail": _TRAILING},
        ),
        Shape(
            "play", "height*(trail - middle)/reach", {"height": _AT_END}, {"width": "length"},
            ("middle", "reach", "settling"),
            "follows {x} with play, at most a width behind it", _slip("trail", "width"),
        ),
        Shape(
            "hysteresis", "height*clip((x - trail)/width, -1, 1)", {"height": "largest value"},
            {"width": "length"}, ("settling",),
            "builds up after a reversal of {x} until that has changed by twice a width",
            _slip("trail", "width"),
        ),
        Shape(
            "two_hystereses",
            "short*clip((x - near)/width, -1, 1) + long*clip((x - far)/longer, -1, 1)",
            {"short": "largest value of the part of shorter width",
             "long": "largest value of the other part"},
            {"width": "length", "longer": "length"}, ("settling",),
            "builds up in two parts after a reversal of {x}, each until that has changed by twice "
            "its width",
            _slip("near", "width") | _slip("far", "longer"),
        ),
        Shape(
            "curve",
            " + ".join(f"h{k}*max(1 - abs((x - start)/spacing - {k}), 0)" for k in range(KNOTS)),
            {f"h{k}": f"value at point {k + 1} of {KNOTS}" for k in range(KNOTS)}, {},
            ("start", "spacing"),
            f"is a curve through {KNOTS} points along {{x}}, not a formula",
        ),
    )
}  # fmt: skip
