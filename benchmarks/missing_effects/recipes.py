"""The recipes of the benchmark's sessions, `recipes.tsv`: what each is, and what it hides."""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from independent import MACHINES
from independent.draws import draw_session

VERSION = "7.0"
TABLE = Path(__file__).with_name("recipes.tsv")
PARTS = {"development": 50001, "test": 120001}
"""First seed of each part."""
HIDDEN, CLEAN = 300, 150
"""Sessions of a part, with and without something hidden."""
COLUMNS = ("id", "part", "machine", "day", "seed", "effects", "outside", "sha256")


@dataclass(frozen=True)
class Recipe:
    """A session.

    Attributes:
        id: tells nothing of what is hidden; part: development or test.
        machine, day, seed: what is recorded, and how.
        strengths: by hidden effect, in the order in which it is hidden.
        outside: of those, the ones that the library of effects has not.
        sha256: first 16 digits of the session's, see `make.digest`; empty where it was not made.
    """

    id: str
    part: str
    machine: str
    day: str
    seed: int
    strengths: dict[str, float]
    outside: tuple[str, ...]
    sha256: str = ""

    @property
    def effects(self) -> dict[str, float]:
        """Strengths of the hidden effects that the library has."""
        return {e: s for e, s in self.strengths.items() if e not in self.outside}

    @property
    def clean(self) -> bool:
        """Whether nothing is hidden."""
        return not self.strengths


def draw_recipes() -> list[Recipe]:
    """The recipes as they were drawn, without digests.

    Within a part they are in the order of a hash, so that a number says nothing of a session.
    """
    found = []
    for part, first in PARTS.items():
        drawn = []
        for seed, clean in (
            *((first + k, False) for k in range(HIDDEN)),
            *((first + k, True) for k in range(CLEAN)),
        ):
            machine, day, strengths = draw_session(seed, clean)
            outside = tuple(e for e in strengths if e in MACHINES[machine].UNKNOWN)
            order = hashlib.sha256(f"{part} {seed} {clean}".encode()).hexdigest()
            drawn.append((order, machine, day, seed, strengths, outside))
        found += [
            Recipe(f"{part}_{number:03d}", part, *row)
            for number, (_, *row) in enumerate(sorted(drawn, key=lambda row: row[0]), 1)
        ]
    return found


def write_recipes(recipes: Iterable[Recipe], path: Path = TABLE) -> None:
    """Write the table."""
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, delimiter="\t", lineterminator="\n")
        table.writerow(COLUMNS)
        for r in recipes:
            strengths = "+".join(f"{e}={s}" for e, s in r.strengths.items())
            table.writerow(
                [r.id, r.part, r.machine, r.day, r.seed, strengths, "+".join(r.outside), r.sha256]
            )


def read_recipes(path: Path = TABLE) -> list[Recipe]:
    """The recipes of a table."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    return [
        Recipe(
            row["id"], row["part"], row["machine"], row["day"], int(row["seed"]),
            {e: float(s) for e, _, s in (x.partition("=") for x in row["effects"].split("+") if x)},
            tuple(x for x in row["outside"].split("+") if x),
            row["sha256"],
        )
        for row in rows
    ]  # fmt: skip
