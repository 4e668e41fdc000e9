"""Make the sessions of the benchmark from its recipes.

    cd benchmarks
    python -m missing_effects.make --part test --out FOLDER
    python -m missing_effects.make --id test_001 --out FOLDER

``FOLDER/sessions/<id>/`` then has the raw logs that a lab would have, ``FOLDER/devices/`` the
descriptions of the devices that sessions name without a file, ``FOLDER/truth/<id>.json`` what is
hidden. A session whose digest is not that of the recipe is reported: another version of numpy, or
another processor, rounds otherwise in a last digit.
"""

from __future__ import annotations

import argparse
import hashlib
import shutil
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from independent.draws import record_drawn

from missing_effects.recipes import PARTS, TABLE, Recipe, read_recipes, write_recipes

DEVICES = Path(__file__).parents[2] / "bampipe/physics/devices"
BUILT_IN = ("bam", "magnetic_damper", "slider")
"""Devices that sessions name without a file."""


def make_session(recipe: Recipe, out: Path) -> Path:
    """Record the session of a recipe into ``out``; returns its folder."""
    folder = out / "sessions" / recipe.id
    folder.mkdir(parents=True, exist_ok=True)
    record_drawn(folder, recipe.seed, recipe.machine, recipe.day, recipe.strengths)
    truth = out / "truth" / f"{recipe.id}.json"
    truth.parent.mkdir(exist_ok=True)
    folder.with_name(f"{recipe.id}.truth.json").replace(truth)
    return folder


def digest(folder: Path) -> str:
    """First 16 digits of the SHA-256 of a session: of each file's path and content, in order."""
    found = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        found.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return found.hexdigest()[:16]


def make_sessions(recipes: Iterable[Recipe], out: Path) -> list[str]:
    """Make the sessions of ``recipes``; returns the ids of those with another digest."""
    (out / "devices").mkdir(parents=True, exist_ok=True)
    for name in BUILT_IN:
        shutil.copy(DEVICES / f"{name}.toml", out / "devices")
    return [r.id for r in recipes if digest(make_session(r, out)) != r.sha256 != ""]


def main(arguments: Sequence[str]) -> None:
    """Make what is asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--part", choices=list(PARTS), help="all sessions of a part")
    parser.add_argument("--id", nargs="+", default=(), help="single sessions")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--freeze", type=int, help="add so many digests to the table of recipes")
    given = parser.parse_args(arguments)
    if given.freeze:
        recipes = read_recipes()
        turns = sorted((r for r in recipes if not r.sha256), key=lambda r: r.id.partition("_")[2])
        added = {r.id: digest(make_session(r, given.out)) for r in turns[: given.freeze]}
        write_recipes(replace(r, sha256=r.sha256 or added.get(r.id, "")) for r in recipes)
        return
    recipes = [r for r in read_recipes() if r.part == given.part or r.id in given.id]
    if missing := set(given.id) - {r.id for r in recipes}:
        raise SystemExit(f"there is no session {', '.join(sorted(missing))}: see {TABLE}")
    others = make_sessions(recipes, given.out)
    print(f"{len(recipes)} sessions in {given.out / 'sessions'}")
    if others:
        print(f"{len(others)} have other bytes than those of the recipe: {', '.join(others)}")


if __name__ == "__main__":
    main(sys.argv[1:])
