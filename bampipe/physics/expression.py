"""Expressions in effect and device files: data, never code.

The text is parsed by Python's own grammar, walked against a whitelist and rebuilt node by node as
a sympy expression; nothing of it is ever evaluated.
"""

import ast
import keyword
import math
import operator
import warnings
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Annotated, Any

from pydantic import BeforeValidator, PlainValidator, WithJsonSchema

from bampipe.errors import InputError, did_you_mean
from bampipe.schema import checked_by

MAX_LENGTH = 2000
MAX_NODES = 500
MAX_EXPONENT = 12
MAX_NUMBER = 1e30
MAX_EXPANDED = 20_000
"""Most parts of an expression once definitions are put in and rates are taken: 65 times the
kinetic energy of the BAM, 18 times that of a planar arm with six links; equations derived from as
many take seconds."""
FUNCTIONS = dict.fromkeys(
    ("sin", "cos", "tan", "atan", "exp", "log", "sqrt", "tanh", "abs", "sgn", "heaviside", "ddt"), 1
) | {"min": 2, "max": 2, "clip": 3}
"""Number of arguments, by name."""
_ARITHMETIC: Mapping[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
}  # fmt: skip


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
        raise InputError(f"expected an expression as text, found {text!r:.60}", where=where)
    if len(text) > MAX_LENGTH:
        raise InputError(f"expression is longer than {MAX_LENGTH} characters", where=where)
    odd = next((c for c in text if c == "#" or not c.isascii()), "")
    if odd:
        raise InputError(
            f"character {odd!r} is not allowed in an expression",
            where=where,
            remedy="write names in plain ASCII letters and comments outside",
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # such as "1if": read by today's Python, with a warning
            tree = ast.parse(" ".join(text.split()), mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError, Warning) as error:
        reason = getattr(error, "msg", None) or type(error).__name__
        raise InputError(
            f"cannot read the expression {text[:60]!r}: {reason}", where=where
        ) from None
    try:
        nodes = list(ast.walk(tree))
        if len(nodes) > MAX_NODES:
            raise InputError(f"expression has more than {MAX_NODES} parts", where=where)
        _check_node(tree, where)
    except RecursionError:
        raise InputError("expression is nested too deeply", where=where) from None
    return tree


def _check_node(node: ast.AST, where: str, power: float = 1.0, rates: int = 0) -> None:
    """Check ``node``, which stands under powers that multiply to ``power`` and ``rates`` ddt()."""
    match node:
        case ast.Constant(value=value):
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise InputError(f"{value!r:.60} is not a number", where=where)
            if not abs(value) < MAX_NUMBER:
                raise InputError(f"the number {value!r:.60} is too large", where=where)
        case ast.Name():
            pass
        case ast.BinOp(left=left, op=op, right=right) if type(op) in (*_ARITHMETIC, ast.Pow):
            if isinstance(op, ast.Pow):
                power *= _check_power(right, where, power)
            _check_node(left, where, power, rates)
            _check_node(right, where)
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
            _check_node(operand, where, power, rates)
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
            if name not in FUNCTIONS:
                raise InputError(
                    f"unknown function {name!r:.60}{did_you_mean(name, FUNCTIONS)}",
                    where=where,
                    remedy=f"known: {', '.join(sorted(FUNCTIONS))}",
                )
            if len(args) != FUNCTIONS[name]:
                raise InputError(
                    f"{name}() takes {FUNCTIONS[name]} argument(s), found {len(args)}", where=where
                )
            rates += name == "ddt"
            if rates > 2:
                raise InputError("ddt() may be nested twice at most", where=where)
            for argument in args:
                _check_node(argument, where, power, rates)
        case _:
            raise InputError(
                f"{type(node).__name__} is not allowed in an expression",
                where=where,
                remedy="use numbers, names, + - * / ** and the functions in the documentation",
            )


def _check_power(exponent: ast.AST, where: str, outer: float) -> float:
    """Size of a plain exponent that stands under powers multiplying to ``outer``, at least 1."""
    number = exponent.operand if isinstance(exponent, ast.UnaryOp) else exponent
    if not isinstance(number, ast.Constant):
        raise InputError("an exponent must be a plain number", where=where)
    _check_node(number, where)
    size = max(1.0, abs(float(number.value)))  # type: ignore[arg-type]
    if size * outer > MAX_EXPONENT:
        raise InputError(
            f"an exponent, or exponents of nested powers multiplied, must lie within "
            f"+-{MAX_EXPONENT}",
            where=where,
        )
    return size


def names(tree: ast.AST) -> set[str]:
    """Names of quantities that an expression uses (function names left out)."""
    functions = {id(n.func) for n in ast.walk(tree) if isinstance(n, ast.Call)}
    return {n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and id(n) not in functions}


def names_within(trees: Iterable[ast.expr], function: str) -> set[str]:
    """Names in the arguments of every call of ``function``."""
    calls = (n for t in trees for n in ast.walk(t) if isinstance(n, ast.Call))
    arguments = (c.args for c in calls if isinstance(c.func, ast.Name) and c.func.id == function)
    return {name for some in arguments for argument in some for name in names(argument)}


def reached_names(trees: Iterable[ast.expr], definitions: Mapping[str, ast.expr]) -> set[str]:
    """Every name that expressions use, through definitions too."""
    found: set[str] = set()
    waiting = {name for tree in trees for name in names(tree)}
    while waiting:
        name = waiting.pop()
        found.add(name)
        if name in definitions:
            waiting |= names(definitions[name]) - found
    return found


def expanded_size(tree: ast.AST, sizes: Mapping[str, int]) -> int:
    """Return the parts of ``tree`` with names replaced by their definitions, of ``sizes`` parts."""
    return sum(
        sizes.get(node.id, 1) if isinstance(node, ast.Name) else 1 for node in ast.walk(tree)
    )


def check_name(name: object, where: str) -> str:
    """Return ``name`` if an expression can use it as the name of a quantity.

    Raises:
        InputError: it is not a plain ASCII identifier, or it is the name of a function.
    """
    if (
        not isinstance(name, str)
        or not (name.isascii() and name.isidentifier() and len(name) <= 60)
        or keyword.iskeyword(name)
    ):
        raise InputError(
            f"{str(name)[:60]!r} cannot be a name in expressions",
            where=where,
            remedy="use letters, digits and underscores, a letter first",
        )
    if name in FUNCTIONS:
        raise InputError(f"{name!r} is the name of a function", where=where)
    return name


Expression = Annotated[
    ast.expr,
    PlainValidator(checked_by(lambda text: parse(text, ""))),
    WithJsonSchema({"type": "string", "minLength": 1, "maxLength": MAX_LENGTH}),
]
Name = Annotated[
    str,
    BeforeValidator(checked_by(lambda name: check_name(name, ""))),
    WithJsonSchema({"type": "string", "pattern": "^[A-Za-z_][A-Za-z0-9_]*$"}),
]


def _is_bounded(value: Any) -> bool:
    """Whether a number is real and below `MAX_NUMBER`."""
    if not (value.is_extended_real and value.is_finite):
        return False
    return math.isfinite(float(value)) and abs(float(value)) < MAX_NUMBER


@cache
def _builders() -> dict[str, Callable[..., Any]]:
    import sympy as sp

    from bampipe.physics.real_functions import Max, Min, log

    same = {n: getattr(sp, n) for n in ("sin", "cos", "tan", "atan", "exp", "sqrt", "tanh")}
    return same | {
        "log": log,
        "abs": sp.Abs,
        "min": Min,
        "max": Max,
        "clip": lambda x, low, high: Max(low, Min(x, high)),
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
        InputError: a name is not known here, or a part of the expression is a constant that is
            not a real number below `MAX_NUMBER`.
    """
    import sympy as sp

    def walk(node: ast.AST) -> Any:
        value = sp.sympify(combine(node), strict=True)
        if value.is_number and not _is_bounded(value):
            raise InputError(
                f"{ast.unparse(node)[:60]!r} is not a real number below {MAX_NUMBER:g}", where=where
            )
        # sympy's 0.0 is not equal to 0, and everything here and later asks whether terms are 0.
        return sp.Integer(0) if value.is_number and value.is_zero else value

    def combine(node: ast.AST) -> Any:
        match node:
            case ast.Constant(value=value):
                return sp.Integer(value) if isinstance(value, int) else sp.Float(value)
            case ast.Name(id=name):
                if name not in symbols:
                    raise InputError(
                        f"unknown symbol {name!r:.60}{did_you_mean(name, symbols)}", where=where
                    )
                return symbols[name]
            case ast.UnaryOp(op=op, operand=operand):
                return -walk(operand) if isinstance(op, ast.USub) else walk(operand)
            case ast.BinOp(left=left, op=ast.Pow(), right=right):
                a, b = walk(left), walk(right)
                if a == 0 and b < 0:
                    raise InputError("division by zero", where=where)
                if a.is_number and a != 0 and b * math.log(abs(a)) > math.log(MAX_NUMBER):
                    return sp.oo
                # Halves stay exact: sympy then sees a square root.
                halves = 2.0 * float(b)
                return a ** (sp.Rational(int(halves), 2) if halves.is_integer() else b)
            case ast.BinOp(left=left, op=op, right=right):
                a, b = walk(left), walk(right)
                if isinstance(op, ast.Div) and b == 0:
                    raise InputError("division by zero", where=where)
                return _ARITHMETIC[type(op)](a, b)
            case ast.Call(func=ast.Name(id=name), args=args):
                values = [walk(argument) for argument in args]
                if name == "exp" and values[0].is_number and values[0] > 69:
                    return sp.oo
                return {**_builders(), **special}[name](*values)
        raise AssertionError(f"unchecked node {type(node).__name__}")

    return walk(tree)
