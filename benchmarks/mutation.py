"""How many mistakes in the code that estimates and decides the tests notice.

One mistake at a time is put at a random place: a comparison or an operator turned round, a number
changed, a condition negated. The tests of the room then run until the first failure. A mistake
that no test notices is printed: either a test is missing, or the code makes no difference. With
one seed and one version of the code, two versions of the tests meet the same mistakes; `--tests`
takes the tests of another checkout.

    python benchmarks/mutation.py --count 30 --seed 1 --rooms estimate trials --out caught.jsonl
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
NEEDED = ("bampipe", "benchmarks", "pipelines", "sample_runs", "schemas", "pyproject.toml")
TESTS = {
    "estimate": ("estimate",),
    "identification": ("identification", "stages/test_identify.py"),
    "trials": ("diagnosis", "stages/test_filter.py", "stages/test_validate.py"),
    "diagnosis": ("diagnosis",),
}
"""Where the tests of a room are; those that take the whole loop through it are left out."""
TURNED: dict[type, type] = {
    ast.Lt: ast.GtE,
    ast.GtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
LONGEST_S = 900.0


def mutate(node: ast.AST) -> ast.expr | None:
    """Return ``node`` with a mistake in it; None where none of these mistakes can be made."""
    match node:
        case ast.Compare(left, [op], right) if type(op) in TURNED:
            return ast.Compare(left, [TURNED[type(op)]()], right)
        case ast.BinOp(left, op, right) if type(op) in TURNED:
            return ast.BinOp(left, TURNED[type(op)](), right)
        case ast.BoolOp(op, values):
            return ast.BoolOp(TURNED[type(op)](), values)
        case ast.UnaryOp(ast.Not(), operand):
            return operand
        case ast.UnaryOp(ast.USub(), operand) if not isinstance(operand, ast.Constant):
            return operand
        case ast.Constant(bool() as value):
            return ast.Constant(not value)
        case ast.Constant(int() as value):
            return ast.Constant(value + 1)
        case ast.Constant(float() as value):
            return ast.Constant(2.0 * value or 1.0)
    return None


def expressions(tree: ast.AST) -> Iterator[ast.expr]:
    """Expressions that run: neither annotations nor decorators nor what strings contain."""
    for name, value in ast.iter_fields(tree):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not isinstance(child, ast.JoinedStr):
                if isinstance(child, ast.expr):
                    yield child
                yield from expressions(child)


def places(room: str) -> list[tuple[str, Path, ast.expr]]:
    """All places of ``room`` that a mistake can be put at."""
    return [
        (room, path.relative_to(ROOT), node)
        for path in sorted((ROOT / "bampipe" / room).rglob("*.py"))
        for node in expressions(ast.parse(path.read_text()))
        if mutate(node)
    ]


def put(path: Path, node: ast.expr) -> str:
    """Write the mistake at ``node`` into the file ``path``; returns what now stands there."""
    lines = path.read_bytes().splitlines(keepends=True)
    before = b"".join(lines[: node.lineno - 1]) + lines[node.lineno - 1][: node.col_offset]
    assert node.end_lineno is not None and node.end_col_offset is not None
    after = lines[node.end_lineno - 1][node.end_col_offset :] + b"".join(lines[node.end_lineno :])
    mistake = mutate(node)
    assert mistake is not None
    text = f"({ast.unparse(ast.fix_missing_locations(mistake))})"
    path.write_bytes(before + text.encode() + after)
    ast.parse(path.read_text())
    return text


def run_tests(copy: Path, room: str) -> tuple[bool, str]:
    """Run the tests of ``room`` in ``copy``; returns whether all pass, and the first that fails."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    command += [str(Path("tests") / name) for name in TESTS[room]]
    settings = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    process = subprocess.Popen(
        command, cwd=copy, env=settings, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        printed, _ = process.communicate(timeout=LONGEST_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return False, "no end"
    failed = [line for line in printed.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return process.returncode == 0, failed[0].partition(" - ")[0] if failed else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rooms", nargs="+", choices=TESTS, default=list(TESTS))
    parser.add_argument("--tests", type=Path, default=ROOT / "tests", help="tests to run")
    parser.add_argument("--out", type=Path, help="a line of JSON a mistake")
    given = parser.parse_args()
    every = [place for room in given.rooms for place in places(room)]
    chosen = random.Random(given.seed).sample(every, given.count)
    chosen.sort(key=lambda place: given.rooms.index(place[0]))
    caught, made = Counter[str](), Counter(room for room, *_ in chosen)
    with tempfile.TemporaryDirectory(prefix="mutation") as folder:
        copy = Path(folder)
        for name in NEEDED:
            there = ROOT / name
            if there.is_dir():
                shutil.copytree(there, copy / name, symlinks=True)
            else:
                shutil.copy(there, copy / name)
        shutil.copytree(given.tests, copy / "tests")
        for room in made:
            passed, failed = run_tests(copy, room)
            if not passed:
                sys.exit(f"the tests of {room} fail without a mistake: {failed}")
        for room, path, node in chosen:
            sound, begun = (copy / path).read_bytes(), time.monotonic()
            text = put(copy / path, node)
            passed, failed = run_tests(copy, room)
            (copy / path).write_bytes(sound)
            caught[room] += not passed
            where = f"{path}:{node.lineno}"
            if passed:
                print(f"not noticed: {where}: {text}", flush=True)
            if given.out:
                with given.out.open("a") as lines:
                    seconds = round(time.monotonic() - begun, 1)
                    row = {"place": where, "mistake": text, "by": failed, "noticed": not passed}
                    lines.write(json.dumps(row | {"seconds": seconds}) + "\n")
    for room, count in made.items():
        print(f"{room}: {caught[room]} of {count} noticed")


if __name__ == "__main__":
    main()
