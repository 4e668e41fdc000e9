"""Expressions in effect and device files: data, never code.

The text is parsed by Python's own grammar, walked against a whitelist and rebuilt node by node as
a sympy expression; nothing of it is ever evaluated.
"""

from __future__ import annotations

import ast
import difflib
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

from bampipe.errors import InputError

MAX_LENGTH = 2000
MAX_NODES = 500
MAX_EXPONENT = 12
FUNCTIONS = {
    "sin": 1,
    "cos": 1,
    "tan": 1,
    "atan": 1,
    "exp": 1,
    "log": 1,
    "sqrt": 1,
    "tanh": 1,
    "abs": 1,
    "sgn": 1,
    "heaviside": 1,
    "ddt": 1,
    "min": 2,
    "max": 2,
    "clip": 3,
}
_OPERATORS = (ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow)


def parse(text: object, where: str) -> ast.expr:
    """Parse ``text`` and check every node of it against the whitelist.

    Args:
        text: the expression, at most `MAX_LENGTH` characters and `MAX_NODES` nodes.
        where: file and field, for messages.

    Raises:
        InputError: it is not text, too large, or holds anything but numbers, names, ``+ - * / **``
            and the functions in `FUNCTIONS`.
    """
    if not isinstance(text, str):
        raise InputError(f"expected an expression as text, found {text!r}", where=where)
    if len(text) > MAX_LENGTH:
        raise InputError(
            f"expression is longer than {MAX_LENGTH} characters", where=where
        )
    try:
        tree = ast.parse(" ".join(text.split()), mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError) as error:
        reason = getattr(error, "msg", None) or type(error).__name__
        raise InputError(
            f"cannot read the expression {text[:60]!r}: {reason}", where=where
        ) from None
    try:
        nodes = list(ast.walk(tree))
        if len(nodes) > MAX_NODES:
            raise InputError(f"expression has more than {MAX_NODES} parts", where=where)
        _check(tree, where)
    except RecursionError:
        raise InputError("expression is nested too deeply", where=where) from None
    return tree


def _check(node: ast.AST, where: str) -> None:
    match node:
        case ast.Constant(value=value):
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise InputError(f"{value!r} is not a number", where=where)
            if not abs(value) < 1e30:
                raise InputError(f"the number {value!r} is too large", where=where)
        case ast.Name():
            pass
        case ast.BinOp(left=left, op=op, right=right) if isinstance(op, _OPERATORS):
            if isinstance(op, ast.Pow):
                _check_power(right, where)
            _check(left, where)
            _check(right, where)
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
            _check(operand, where)
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
            if name not in FUNCTIONS:
                raise InputError(
                    f"unknown function {name!r}{did_you_mean(name, FUNCTIONS)}",
                    where=where,
                    remedy=f"known: {', '.join(sorted(FUNCTIONS))}",
                )
            if len(args) != FUNCTIONS[name]:
                raise InputError(
                    f"{name}() takes {FUNCTIONS[name]} argument(s), found {len(args)}",
                    where=where,
                )
            for argument in args:
                _check(argument, where)
        case _:
            raise InputError(
                f"{type(node).__name__} is not allowed in an expression",
                where=where,
                remedy="use numbers, names, + - * / ** and the functions in the documentation",
            )


def _check_power(exponent: ast.AST, where: str) -> None:
    number = exponent.operand if isinstance(exponent, ast.UnaryOp) else exponent
    if not isinstance(number, ast.Constant):
        raise InputError("an exponent must be a plain number", where=where)
    if isinstance(number.value, int | float) and abs(number.value) > MAX_EXPONENT:
        raise InputError(f"an exponent must lie within +-{MAX_EXPONENT}", where=where)


def names(tree: ast.AST) -> set[str]:
    """Names of quantities that an expression uses (function names left out)."""
    functions = {id(n.func) for n in ast.walk(tree) if isinstance(n, ast.Call)}
    return {
        n.id
        for n in ast.walk(tree)
        if isinstance(n, ast.Name) and id(n) not in functions
    }


def did_you_mean(word: str, known: Any) -> str:
    """``, did you mean 'x'?`` where something known is close to ``word``, else nothing."""
    close = difflib.get_close_matches(word, [str(k) for k in known], n=1)
    return f", did you mean {close[0]!r}?" if close else ""


@cache
def _builders() -> dict[str, Callable[..., Any]]:
    import sympy as sp

    return {
        "sin": sp.sin,
        "cos": sp.cos,
        "tan": sp.tan,
        "atan": sp.atan,
        "exp": sp.exp,
        "log": sp.log,
        "sqrt": sp.sqrt,
        "tanh": sp.tanh,
        "abs": sp.Abs,
        "min": sp.Min,
        "max": sp.Max,
        "clip": lambda x, low, high: sp.Max(low, sp.Min(x, high)),
        "heaviside": lambda x: sp.Heaviside(x, sp.Rational(1, 2)),
    }


def build(
    tree: ast.expr,
    symbols: Mapping[str, Any],
    where: str,
    special: Mapping[str, Callable[[Any], Any]],
) -> Any:
    """Rebuild a checked tree as a sympy expression.

    Args:
        tree: what `parse` returned.
        symbols: sympy expression for every name that may appear.
        where: file and field, for messages.
        special: ``sgn`` and ``ddt``, which need to know the device.

    Raises:
        InputError: a name is not known here.
    """
    import sympy as sp

    def walk(node: ast.AST) -> Any:
        match node:
            case ast.Constant(value=value):
                return sp.Integer(value) if isinstance(value, int) else sp.Float(value)
            case ast.Name(id=name):
                if name not in symbols:
                    raise InputError(
                        f"unknown symbol {name!r}{did_you_mean(name, symbols)}",
                        where=where,
                    )
                return symbols[name]
            case ast.UnaryOp(op=op, operand=operand):
                return -walk(operand) if isinstance(op, ast.USub) else walk(operand)
            case ast.BinOp(left=left, op=op, right=right):
                a, b = walk(left), walk(right)
                if isinstance(op, ast.Add):
                    return a + b
                if isinstance(op, ast.Sub):
                    return a - b
                if isinstance(op, ast.Mult):
                    return a * b
                if isinstance(op, ast.Div):
                    if b == 0:
                        raise InputError("division by zero", where=where)
                    return a / b
                return a ** sp.nsimplify(b) if b.is_number else a**b
            case ast.Call(func=ast.Name(id=name), args=args):
                return {**_builders(), **special}[name](
                    *[walk(argument) for argument in args]
                )
        raise AssertionError(f"unchecked node {type(node).__name__}")

    return walk(tree)
