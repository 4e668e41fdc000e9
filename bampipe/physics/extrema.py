"""Minimum and maximum that are compared as numbers only, not as expressions.

Whenever an expression is rebuilt, sympy's own ask of every pair of arguments whether one is always
the larger, which takes about half the time of deriving the equations of an effect with internal
states.
"""

from collections.abc import Callable, Iterable
from typing import Any

import sympy as sp


def _with_one_number(select: Callable[..., Any], values: Iterable[Any]) -> frozenset[Any]:
    """The values, with one in place of those that are numbers."""
    numbers = {value for value in values if value.is_number}
    return frozenset({*values} - numbers | ({select(numbers)} if numbers else set()))


class Max(sp.Max):  # type: ignore[misc]
    """The largest of its arguments."""

    @classmethod
    def _collapse_arguments(cls, args: Any, **_: Any) -> Any:
        return args

    @classmethod
    def _find_localzeros(cls, values: Any, **_: Any) -> Any:
        return _with_one_number(max, values)


class Min(sp.Min):  # type: ignore[misc]
    """The smallest of its arguments."""

    @classmethod
    def _collapse_arguments(cls, args: Any, **_: Any) -> Any:
        return args

    @classmethod
    def _find_localzeros(cls, values: Any, **_: Any) -> Any:
        return _with_one_number(min, values)
