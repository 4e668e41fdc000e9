"""Numba types of the model functions that the kernels here take as arguments."""

from numba import types

_vector = types.float64[::1]

DERIVATIVE = types.FunctionType(types.void(_vector, _vector, _vector, _vector, _vector))
"""f(x, u, p, w, dx) -> None: state derivative written into dx."""

MEASURE = types.FunctionType(types.void(_vector, _vector, _vector, _vector))
"""h(x, u, p, y) -> None: measurement of the state written into y."""

COMMAND = MEASURE
"""c(y, r, none, out) -> None: commands of a controller from readings and references."""
