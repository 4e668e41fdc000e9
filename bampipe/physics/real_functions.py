"""Functions of real numbers, where sympy's own are slow or allow for complex ones.

Whenever an expression is rebuilt, sympy's minimum and maximum ask of every pair of arguments
whether one is always the larger, which takes about half the time of deriving the equations of an
effect with internal states. Those here compare numbers only.
"""

from collections.abc import Iterable
from typing import Any

import sympy as sp


class _ComparesNumbers:
    @classmethod
    def _collapse_arguments(cls, args: Any, **_: Any) -> Any:
        return args

    @classmethod
    def _find_localzeros(cls, values: Iterable[Any], **_: Any) -> frozenset[Any]:
        numbers = {value for value in values if value.is_number}
        select = max if issubclass(cls, sp.Max) else min
        return frozenset({*values} - numbers | ({select(numbers)} if numbers else set()))


class Max(_ComparesNumbers, sp.Max):  # type: ignore[misc]
    """The largest of its arguments."""


class Min(_ComparesNumbers, sp.Min):  # type: ignore[misc]
    """The smallest of its arguments."""


class log(sp.log):  # type: ignore[misc]
    """The natural logarithm, real wherever a model can be computed.

    Of sympy's own, a modulus has the slope of that of a complex number.
    """

    def _eval_is_extended_real(self) -> bool:
        return True
