"""At most twelve numbers decide: no other is compared with in the rooms that decide."""

import ast
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import pytest
from pydantic import ValidationError

import bampipe.diagnosis
from bampipe.diagnosis.criteria import Criteria
from bampipe.stages.diagnose import Config

NUMERICAL = {
    "verdict": {
        "0.001": "less probable sets are not listed, whatever is said",
        "0.5": "more probable than not",
        "2": "effects in which two sets differ by an exchange",
    },
    "probability": {
        "LEAST_P_VALUE": "no chance is known to be smaller, so that nothing can be asked beyond it",
        "_MARGIN": "what is less probable by a factor of a million changes no probability",
    },
    "select": {
        "0.5": "more probable than not",
        "2": "tasks from which on processes share them",
        "NOTICEABLE": "a set is not proposed that the ladder would refuse",
        "_MOST_ROUNDS": "work, not a judgement",
        "_MOST_FITS": "work, not a judgement",
        "_LEAST_GAIN": "half a nat: a set that is no better is weighed, but not fitted",
        "_MINOR_SHARE": "what is put off until the rest is fitted, and weighed then",
    },
    "search": {
        "0.02": "nats up to which a descent of shapes is not worth a step",
        "0.3": "nats by which it goes on",
        "0.5": "the middle of a range, towards which slopes are taken",
    },
    "unknown": {"3": "the fewest knots of a spline that bends"},
    "set_cost": {
        "_LEAST_SLOPE": "below it the equation has no scale, and its cost no meaning",
        "NOTHING": "what moves nothing over its whole range cannot be told from rounding",
    },
}
"""By room that decides: numbers that are compared with, and why each is no criterion."""


def numbers_compared(tree: ast.AST) -> set[str]:
    """Numbers other than 0 and 1, and constants of the module, on either side of a comparison."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare):
            for side in (node.left, *node.comparators):
                found |= {*numbers_in(side)}
    return found


def numbers_in(side: ast.AST) -> Iterator[str]:
    if isinstance(side, ast.Constant) and type(side.value) in (int, float):
        # What is rounded to zero is no threshold.
        if side.value not in (0, 1) and abs(side.value) > 1e-5:
            yield str(side.value)
    elif isinstance(side, ast.Name) and side.id.isupper():
        yield side.id
    for part in ast.iter_child_nodes(side):
        if not (isinstance(side, ast.BinOp) and isinstance(side.op, ast.Pow)) or part is side.left:
            yield from numbers_in(part)


@pytest.mark.parametrize("room", NUMERICAL)
def test_no_number_decides_that_is_not_a_criterion(room: str) -> None:
    path = Path(bampipe.diagnosis.__file__).with_name(f"{room}.py")
    found = numbers_compared(ast.parse(path.read_text(encoding="utf-8")))
    assert found == {*NUMERICAL[room]}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("error > 1.2 * floor", {"1.2"}),
        ("floor <= ENOUGH", {"ENOUGH"}),
        ("0.0 < x <= 1", set()),
        ("x > criteria.size", set()),
    ],
)
def test_a_number_in_a_comparison_is_seen(text: str, found: set[str]) -> None:
    assert numbers_compared(ast.parse(text)) == found


def test_at_most_twelve_numbers_decide_and_a_user_can_set_each() -> None:
    names = [f.name for f in fields(Criteria)]
    assert len(names) <= 12
    assert isinstance(Config(), Criteria)
    for name in names:
        value = {"probability": 0.95}.get(name, 2 * getattr(Criteria(), name))
        changed = Config(**{name: value})
        assert getattr(changed, name) == value
        assert [n for n in names if getattr(changed, n) != getattr(Criteria(), n)] == [name]
        for kind in (Config, Criteria):
            with pytest.raises(ValidationError):
                kind(**{name: 0})
