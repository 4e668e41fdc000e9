"""The tables of docs/validation.md, made from the results that benchmarks have stored.

    python benchmarks/validation.py            # write them into the pages
    python benchmarks/validation.py --check    # fail where a page has other ones

`benchmarks/results/` has one file a benchmark: a line of JSON a session, and in `measured.json` the
commit and the command of each; or one object that holds its commit, command and versions. The page
of the benchmark of missing effects is filled as well.
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
import speed
import tables
from missing_effects.score import write_results, write_summary
from pydantic import TypeAdapter
from scores import read_scores, write_tables

from bampipe.diagnosis.criteria import Criteria

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGES = (ROOT / "docs/validation.md", ROOT / "benchmarks/missing_effects/README.md")
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
    return f"{head}\n\n{write_tables(scores, criteria, by_set=False)}"


def write_mistakes(path: Path) -> str:
    """How many mistakes of a set-up are named."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return mistakes.write_table(
        [TypeAdapter(mistakes.Outcome).validate_json(line) for line in lines]
    )


def write_speed(path: Path) -> str:
    """Times, memory and size, beside those of another commit."""
    return speed.write_table(json.loads(path.read_text(encoding="utf-8")))


def write_rivals(path: Path) -> str:
    """Results of other programs beside those of bampipe on the same records."""
    files = (path, RESULTS / "emps.json", RESULTS / "measured_sets.json")
    stored = (json.loads(file.read_text(encoding="utf-8")) for file in files)
    return tables.write_rivals(*(content["result"] for content in stored))


def _stored(write: Callable[[Any], str]) -> Callable[[Path], str]:
    """What makes a table from the file of a result that holds its own command."""
    return lambda path: write(json.loads(path.read_text(encoding="utf-8"))["result"])


TABLES: dict[str, tuple[str, str, Callable[[Path], str]]] = {
    "calibration": ("calibration", "calibration.jsonl", write_calibration),
    "mistakes": ("mistakes", "mistakes.jsonl", write_mistakes),
    "missing_effects": ("missing_effects", "missing_effects", write_summary),
    "entries": ("missing_effects", "missing_effects", write_results),
    "speed": ("speed", "speed.json", write_speed),
    "emps": ("emps", "emps.json", _stored(tables.write_emps)),
    "kr300": ("kr300", "kr300.json", _stored(tables.write_kr300)),
    "measured_sets": ("measured_sets", "measured_sets.json", _stored(tables.write_measured_sets)),
    "rivals": ("rivals", "rivals.json", write_rivals),
}
"""By the name of a block: result in `measured.json`, what is stored, and what writes it."""


def read_measured() -> dict[str, dict[str, str]]:
    """Command and commit of each stored result."""
    found = dict(json.loads((RESULTS / "measured.json").read_text(encoding="utf-8")))
    for path in sorted(RESULTS.glob("*.json")):
        held = json.loads(path.read_text(encoding="utf-8"))
        if path.stem in TABLES and "versions" in held and path.stem not in found:
            numbers = held["versions"].items()
            versions = ", ".join(f"{name} {one}" for name, one in numbers if name != "bampipe")
            found[path.stem] = {
                "command": held["command"],
                "commit": f"{held['commit']}; {versions}",
            }
    return found


def fill(page: str) -> str:
    """The page with the tables of the stored results in it."""
    measured = read_measured()

    def filled(match: re.Match[str]) -> str:
        head, name, _, end = match.groups()
        result, stored, write = TABLES[name]
        about = f"`{measured[result]['command']}`, commit {measured[result]['commit']}."
        return f"{head}\n{about}\n\n{write(RESULTS / stored)}\n\n{end}"

    return BLOCK.sub(filled, page)


def main(arguments: Sequence[str]) -> None:
    """Write the tables, or compare them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--check", action="store_true", help="write nothing")
    given = parser.parse_args(arguments)
    for path in PAGES:
        page = path.read_text(encoding="utf-8")
        made = fill(page)
        if given.check and made != page:
            raise SystemExit(f"{path} is not what the results give: {__file__}")
        if not given.check:
            path.write_text(made, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
