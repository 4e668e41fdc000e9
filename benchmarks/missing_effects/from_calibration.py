"""The entry of bampipe, from the scores that a calibration has stored.

    cd benchmarks
    python calibration.py --hidden 300 --clean 150 --first-seed 120001 --out SCORES.jsonl
    python -m missing_effects.from_calibration SCORES.jsonl --out ENTRY.jsonl

The calibration draws the same sessions from the same seeds, and diagnoses each bare model.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from scores import Scores, read_scores

from bampipe.diagnosis.criteria import Criteria
from missing_effects.recipes import Recipe, read_recipes


def convert(scores: Iterable[Scores], recipes: Iterable[Recipe]) -> list[dict[str, object]]:
    """The answers to the sessions of the benchmark that are among ``scores``."""
    known = {(f"{r.machine} {r.day} {r.seed}", r.clean): r for r in recipes}
    found: list[dict[str, object]] = []
    for one in scores:
        recipe = known.get((one.id, not (one.effects or one.outside)))
        if recipe is None:
            continue
        if one.effects != recipe.effects or set(one.outside) != set(recipe.outside):
            raise SystemExit(f"{one.id}: the scores are of another session than {recipe.id}")
        answer: dict[str, object] = {"id": recipe.id}
        answer["effects"] = {
            e: round(p, 4) for e, p in one.probabilities(Criteria()).items()
        }  # fmt: skip
        answer["unknown"] = max(one.unknown.values(), default=0.0)
        answer["set"] = sorted(one.sets[0]["effects"]) if one.sets else []
        if one.over_floor:
            answer["error"] = max(one.over_floor.values())
        found.append(answer | {"seconds": one.seconds})
    return sorted(found, key=lambda answer: str(answer["id"]))


def main(arguments: Sequence[str]) -> None:
    """Convert scores."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scores", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args(arguments)
    answers = convert((s for path in given.scores for s in read_scores(path)), read_recipes())
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text("".join(json.dumps(a) + "\n" for a in answers), encoding="utf-8")
    print(f"{len(answers)} sessions")


if __name__ == "__main__":
    main(sys.argv[1:])
