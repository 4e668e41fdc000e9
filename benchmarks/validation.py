"""The tables of docs/validation.md, made from the results that benchmarks have stored.

    python benchmarks/validation.py            # write them into the page
    python benchmarks/validation.py --check    # fail where the page has other ones

`benchmarks/results/` has one file a benchmark: a line of JSON a session, and in `measured.json` the
commit and the command of each; or one object that holds its commit, command and versions.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mistakes
import tables
from pydantic import TypeAdapter
from scores import read_scores, write_tables

from bampipe.diagnosis.criteria import Criteria

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGE = ROOT / "docs" / "validation.md"
BLOCK = re.compile(r"(<!-- results of (\w+) -->\n)(.*?)(<!-- end -->)", re.S)


def write_calibration(path: Path) -> str:
    """Stated probabilities against the share that is there."""
    scores, criteria = list(read_scores(path)), Criteria()
    stated = [
        effect in one.effects
        for one in scores
        for effect, p in one.probabilities(criteria).items()
        if p >= criteria.probability
    ]
    met = "met" if sum(stated) >= criteria.probability * len(stated) else "not met"
    head = (
        f"Of the {len(stated)} effects stated with a probability of {criteria.probability:g} or"
        f" more, {sum(stated)} exist: the first target is {met}."
    )
    return f"{head}\n\n{write_tables(scores, criteria)}"


def write_mistakes(path: Path) -> str:
    """How many mistakes of a set-up are named."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return mistakes.write_table(
        [TypeAdapter(mistakes.Outcome).validate_json(line) for line in lines]
    )


def _stored(write: Callable[[Any], str]) -> Callable[[Path], str]:
    """What makes a table from the file of a result that holds its own command."""
    return lambda path: write(json.loads(path.read_text(encoding="utf-8"))["result"])


TABLES: dict[str, Callable[[Path], str]] = {
    "calibration": write_calibration,
    "mistakes": write_mistakes,
    "emps": _stored(tables.write_emps),
    "kr300": _stored(tables.write_kr300),
    "measured_sets": _stored(tables.write_measured_sets),
    "rivals": _stored(tables.write_rivals),
}


def read_measured() -> dict[str, dict[str, str]]:
    """Command and commit of each stored result, and its file."""
    known = json.loads((RESULTS / "measured.json").read_text(encoding="utf-8"))
    found = {name: {**head, "file": f"{name}.jsonl"} for name, head in known.items()}
    for path in sorted(RESULTS.glob("*.json")):
        if path.stem in TABLES:
            head = json.loads(path.read_text(encoding="utf-8"))
            versions = ", ".join(f"{name} {number}" for name, number in head["versions"].items())
            commit = f"{head['commit']}; {versions}"
            found[path.stem] = {"command": head["command"], "commit": commit, "file": path.name}
    return found


def fill(page: str) -> str:
    """The page with the tables of the stored results in it."""
    measured = read_measured()

    def filled(match: re.Match[str]) -> str:
        head, name, _, end = match.groups()
        about = f"`{measured[name]['command']}`, commit {measured[name]['commit']}."
        return f"{head}\n{about}\n\n{TABLES[name](RESULTS / measured[name]['file'])}\n\n{end}"

    return BLOCK.sub(filled, page)


def main(arguments: Sequence[str]) -> None:
    """Write the tables, or compare them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--check", action="store_true", help="write nothing")
    given = parser.parse_args(arguments)
    page = PAGE.read_text(encoding="utf-8")
    made = fill(page)
    if given.check and made != page:
        raise SystemExit(f"{PAGE} is not what the results give: python benchmarks/validation.py")
    if not given.check:
        PAGE.write_text(made, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
