"""An identified model as one self-contained function: the force that a motion requires.

The text is that of the compiled model, its parameters put in as numbers, in Python or in C, with
nothing but the mathematics that comes with the language.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bampipe.errors import InputError
from bampipe.physics.codegen import portable_expressions
from bampipe.physics.derivation import derive
from bampipe.physics.model import Model

Array = NDArray[np.float64]
Language = Literal["python", "c"]

_PYTHON = '''"""{title}

{about}
"""

from math import atan as arctan, cos, exp, log, sin, sqrt, tan, tanh

COORDINATES = {coordinates!r}
INPUTS = {inputs!r}
maximum, minimum, absolute = max, min, abs


def sign(x):
    return (x > 0.0) - (x < 0.0)


def heaviside(x, half):
    return 1.0 if x > 0.0 else (half if x == 0.0 else 0.0)


def inverse_dynamics(q, qd, qdd{more}):
    """{summary}"""
    {body}
    return [{values}]
'''

_C = """/* {title}

   {about}
*/
#include <math.h>

#define arctan atan
#define absolute fabs
#define maximum fmax
#define minimum fmin
static double sign(double x) {{ return (x > 0.0) - (x < 0.0); }}
static double heaviside(double x, double half) {{ return x > 0.0 ? 1.0 : (x == 0.0 ? half : 0.0); }}

/* {summary} */
void inverse_dynamics(const double *q, const double *qd, const double *qdd{more}, double *force)
{{
    (void)sign; (void)heaviside;
    {body}
    {values}
}}
"""


@dataclass(frozen=True)
class _Words:
    title: str
    about: str
    summary: str


def portable_source(model: Model, parameters: Array, language: Language) -> str:
    """Return the source of ``inverse_dynamics(q, qd, qdd[, u])``.

    Args:
        model: without internal states and effects on encoders. Effects on inputs, such as a drive's
            offset, are no part of the force that a motion requires: the text names them.
        parameters: (n_p,), SI.
        language: of the source.

    Raises:
        InputError: an effect of the model has memory, or acts on encoders.
    """
    for item in model.effects:
        what = "has internal states" if item.effect.states else ""
        if item.effect.kind == "measurement":
            what = "acts on what encoders read"
        if what:
            raise InputError(
                f"effect {item.name!r} {what}: it is no function of motion alone",
                remedy="export a model without it",
            )
    e = derive(model)
    lines, values, inputs = portable_expressions(
        e, dict(zip(e.p, map(float, parameters), strict=True))
    )
    names = [e.inputs[e.u.index(symbol)] for symbol in inputs]
    known = {
        **{symbol: f"q[{i}]" for i, symbol in enumerate(e.q)},
        **{symbol: f"qd[{i}]" for i, symbol in enumerate(e.qd)},
        **{symbol: f"qdd[{i}]" for i, symbol in enumerate(e.qdd)},
        **{symbol: f"u[{i}]" for i, symbol in enumerate(inputs)},
    }
    places = {str(symbol): text for symbol, text in known.items()}
    pattern = re.compile(r"\b(" + "|".join(sorted(places, key=len, reverse=True)) + r")\b")
    lines, values = (
        [pattern.sub(lambda found: places[found[0]], text) for text in texts]
        for texts in (lines, values)
    )
    axes = model.device.coordinates
    of = ", ".join(f"{c.name} ({c.unit})" for c in axes)
    effects, logged = (
        ", ".join(item.name for item in model.effects if (item.effect.kind == "input") is on_inputs)
        for on_inputs in (False, True)
    )
    about = f"Coordinates: {of}." + (f" Inputs u: {', '.join(names)}." if names else "")
    if logged:
        about += f" Forces are those that act; what is logged differs by {logged}."
    words = _Words(
        f"{model.device.name}{f' with {effects}' if effects else ''}, identified by bampipe.",
        about,
        "Generalised forces that the motion requires, N.m or N, one a coordinate.",
    )
    return _print(language, words, [c.name for c in axes], names, lines, values)


def _print(
    language: Language,
    words: _Words,
    coordinates: Sequence[str],
    inputs: Sequence[str],
    lines: Sequence[str],
    values: Sequence[str],
) -> str:
    if language == "python":
        return _PYTHON.format(
            **vars(words),
            coordinates=tuple(coordinates),
            inputs=tuple(inputs),
            more=", u" if inputs else "",
            body="\n    ".join(lines) or "pass",
            values=", ".join(values),
        )
    return _C.format(
        **vars(words),
        more=", const double *u" if inputs else "",
        body="\n    ".join(f"const double {_in_c(line)};" for line in lines),
        values="\n    ".join(f"force[{i}] = {_in_c(v)};" for i, v in enumerate(values)),
    )


def _in_c(text: str) -> str:
    """Python's ``(a)**(b)`` as C's ``pow(a, b)``; all else is written alike in both."""
    while "**" in text:
        at = text.index("**")
        start, end = _opening(text, at - 1), _closing(text, at + 2)
        base, exponent = text[start:at], text[at + 2 : end + 1]
        text = f"{text[:start]}pow({base}, {exponent}){text[end + 1 :]}"
    return text


def _opening(text: str, at: int) -> int:
    depth = 0
    while True:
        depth += (text[at] == ")") - (text[at] == "(")
        if depth == 0:
            return at
        at -= 1


def _closing(text: str, at: int) -> int:
    depth = 0
    while True:
        depth += (text[at] == "(") - (text[at] == ")")
        if depth == 0:
            return at
        at += 1
