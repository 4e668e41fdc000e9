"""Numba types of a model's compiled functions: what is generated has them, kernels take them."""

from numba import types

_vector = types.float64[::1]

DERIVATIVE = types.FunctionType(types.void(*[_vector] * 5))
"""f(x, u, p, w, dx) -> None: state derivative written into dx."""

MEASURE = types.FunctionType(types.void(*[_vector] * 4))
"""h(x, u, p, y) -> None: encoder readings, positions then velocities, written into y."""

COMMAND = MEASURE
"""c(y, r, s, out) -> None: commands of a controller and rates of its states, from readings,
references and these states."""

ROWS = 64
"""Most rows of one call of a function over rows; quantity i of row r is at [i*ROWS + r]."""

DERIVATIVE_ROWS = types.FunctionType(types.void(types.int64, *[_vector] * 5))
"""f(count, x, u, p, w, dx) -> None: `DERIVATIVE` of the first ``count`` rows at once."""

MEASURE_ROWS = types.FunctionType(types.void(types.int64, *[_vector] * 4))
"""h(count, x, u, p, y) -> None: `MEASURE` of the first ``count`` rows at once."""
