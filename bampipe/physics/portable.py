"""An identified model as one self-contained function: the force that a motion requires.

The text is that of the compiled model, its parameters put in as numbers, in Python or in C, with
nothing but the mathematics that comes with the language.
"""

from typing import Literal

import sympy as sp

from bampipe.arrays import Array
from bampipe.errors import InputError
from bampipe.physics.codegen import print_block, unpack_groups
from bampipe.physics.derivation import derive
from bampipe.physics.model import Model

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
            what = "acts on encoder readings"
        if what:
            raise InputError(
                f"effect {item.name!r} {what}: the force is not a function of motion alone",
                remedy="export a model without it",
            )
    e = derive(model)
    numbers = {p: sp.Float(float(value)) for p, value in zip(e.p, parameters, strict=True)}
    required = [sp.sympify(force, strict=True).xreplace(numbers) for force in e.required]
    block = print_block(required, [(name, value.xreplace(numbers)) for name, value in e.steps])
    inputs = [symbol for symbol in e.u if symbol in block.used]
    names = [e.inputs[e.u.index(symbol)] for symbol in inputs]
    groups = {"q": e.q, "qd": e.qd, "qdd": e.qdd, "u": inputs}
    lines, values = [*unpack_groups(groups, block.used), *block.lines], block.values
    axes = model.device.coordinates
    of = ", ".join(f"{c.name} ({c.unit})" for c in axes)
    effects, logged = (
        ", ".join(item.name for item in model.effects if (item.effect.kind == "input") is on_inputs)
        for on_inputs in (False, True)
    )
    about = f"Coordinates: {of}." + (f" Inputs u: {', '.join(names)}." if names else "")
    if logged:
        about += f" Forces are those that act; logged values differ by {logged}."
    if language == "c":
        lines = [f"const double {line};" for line in lines]
        values = [f"force[{i}] = {v};" for i, v in enumerate(values)]
    python = language == "python"
    return (_PYTHON if python else _C).format(
        title=f"{model.device.name}{f' with {effects}' if effects else ''}, identified by bampipe.",
        about=about,
        summary="Generalised forces that the motion requires, N.m or N, one per coordinate.",
        coordinates=tuple(c.name for c in axes),
        inputs=tuple(names),
        more="" if not names else ", u" if python else ", const double *u",
        body="\n    ".join(lines) or ("pass" if python else ""),
        values=(", " if python else "\n    ").join(values),
    )
