"""Elementary functions without branches or calls, so that loops over them use vector registers.

The C library's functions take one number at a time; a loop that calls them cannot be vectorised.
These are rational and polynomial approximations on a reduced argument (coefficients: Moshier,
Cephes Mathematical Library, 1992), correct to 1e-15 of the value; beyond 1e5 rad, sine and cosine
lose as much as by rounding the argument. Infinite arguments give the limit or NaN as the C library
does; NaN stays NaN.
"""

from math import inf
from typing import Any

from numba import types
from numba.extending import intrinsic

from bampipe.compiled import part

# Adding 1.5 * 2^52 rounds to the nearest integer and leaves it in the lowest bits.
_ROUND = 6755399441055744.0
_LOG2_HIGH, _LOG2_LOW = 6.93145751953125e-1, 1.42860682030941723212e-6
_HALF_PI_HIGH, _HALF_PI_LOW = 1.5707963267948966, 6.123233995736766e-17
_FUSED = {"contract"}


def _same_bits(source: Any, target: Any) -> Any:
    """A compiled function that reads the bits of one type as another."""

    def typed(typing_context: Any, value: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.bitcast(arguments[0], context.get_value_type(target))

        return target(source), generate

    return intrinsic(typed)


_bits = _same_bits(types.float64, types.int64)
_double = _same_bits(types.int64, types.float64)


@part(fastmath=_FUSED, error_model="numpy", forceinline=True)
def _exponential_parts(x):  # type: ignore[no-untyped-def]
    """Return a, b and 2^k with e^x = 2^k (b + a) / (b - a), and k; |x| at most 700."""
    shifted = x * 1.4426950408889634 + _ROUND
    k = shifted - _ROUND
    r = x - k * _LOG2_HIGH
    r = r - k * _LOG2_LOW
    s = r * r
    a = r * ((1.26177193074810590878e-4 * s + 3.02994407707441961300e-2) * s + 1.0)
    b = (
        (3.00198505138664455042e-6 * s + 2.52448340349684104192e-3) * s + 2.27265548208155028766e-1
    ) * s + 2.0
    return a, b, _double((_bits(shifted) << 52) + (1023 << 52)), k


@part(fastmath=_FUSED, error_model="numpy", forceinline=True)
def exp(x):  # type: ignore[no-untyped-def]
    """e^x; 0 below x = -708, infinite from 709 on, where doubles end."""
    inside = x if x < 709.0 else 709.0
    inside = inside if inside > -708.0 else -708.0
    a, b, power, _ = _exponential_parts(inside)
    value = (1.0 + 2.0 * a / (b - a)) * power
    value = value if x > -708.0 else 0.0
    value = value if x < 709.0 else inf
    return value if x == x else x


@part(fastmath=_FUSED, error_model="numpy", forceinline=True)
def tanh(x):  # type: ignore[no-untyped-def]
    """Hyperbolic tangent."""
    size = abs(x)
    inside = size if size < 20.0 else 20.0
    a, b, power, k = _exponential_parts(2.0 * inside)
    # Where k is 0, e^2x - 1 would cancel; (e^2x - 1) / (e^2x + 1) is a / b there.
    near = k == 0.0
    above = a if near else power * (b + a) - (b - a)
    below = b if near else power * (b + a) + (b - a)
    value = above / below
    value = value if x >= 0.0 else -value
    return value if size == size else x


@part(fastmath=_FUSED, error_model="numpy", forceinline=True)
def _circle(x):  # type: ignore[no-untyped-def]
    """Sine and cosine of x modulo a quarter turn, and the bits of the quotient."""
    shifted = x * 0.63661977236758134308 + _ROUND
    k = shifted - _ROUND
    r = x - k * _HALF_PI_HIGH
    r = r - k * _HALF_PI_LOW
    s = r * r
    sine = (
        ((1.58962301576546568060e-10 * s - 2.50507477628578072866e-8) * s
         + 2.75573136213857245213e-6) * s - 1.98412698295895385996e-4
    ) * s + 8.33333333332211858878e-3  # fmt: skip
    sine = r + r * s * (sine * s - 1.66666666666666307295e-1)
    cosine = (
        ((-1.13585365213876817300e-11 * s + 2.08757008419747316778e-9) * s
         - 2.75573141792967388112e-7) * s + 2.48015872888517045348e-5
    ) * s - 1.38888888888730564116e-3  # fmt: skip
    cosine = 1.0 - 0.5 * s + s * s * (cosine * s + 4.16666666666665929218e-2)
    return sine, cosine, _bits(shifted)


@part(fastmath=_FUSED, error_model="numpy", forceinline=True)
def sin(x):  # type: ignore[no-untyped-def]
    """Sine of x rad."""
    sine, cosine, quarter = _circle(x)
    value = sine if quarter & 1 == 0 else cosine
    return value if quarter & 2 == 0 else -value


@part(fastmath=_FUSED, error_model="numpy", forceinline=True)
def cos(x):  # type: ignore[no-untyped-def]
    """Cosine of x rad."""
    sine, cosine, quarter = _circle(x)
    value = cosine if quarter & 1 == 0 else sine
    return value if (quarter + 1) & 2 == 0 else -value


@part(fastmath=_FUSED, error_model="numpy", forceinline=True)
def tan(x):  # type: ignore[no-untyped-def]
    """Tangent of x rad."""
    sine, cosine, quarter = _circle(x)
    return sine / cosine if quarter & 1 == 0 else -cosine / sine


@part(fastmath=_FUSED, error_model="numpy", forceinline=True)
def sign(x):  # type: ignore[no-untyped-def]
    """-1, 0 or 1."""
    return 1.0 if x > 0.0 else (-1.0 if x < 0.0 else x)


@part(fastmath=_FUSED, error_model="numpy", forceinline=True)
def heaviside(x, half):  # type: ignore[no-untyped-def]
    """0 below, 1 above, ``half`` at 0."""
    return 1.0 if x > 0.0 else (half if x == 0.0 else 0.0)
