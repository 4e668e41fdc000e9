"""Score entries of the benchmark: lines of JSON, one a session.

    cd benchmarks
    python -m missing_effects.score ENTRY.jsonl --part test

A line has ``id``, ``effects`` (probability of each effect that the tool believes in, those left out
have none), ``unknown`` (probability that something is missing beyond them) and may have ``set``
(the most probable set of effects; by default those of probability 0.5 or more), ``error`` (held-out
error over noise floor, the largest of the axes) and ``seconds``. Only sessions with a line are
scored, and how many those are stands in the first row.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import beta

from missing_effects.recipes import CLEAN, HIDDEN, PARTS, Recipe, read_recipes

SURE = 0.9
"""Probability from which on something counts as named."""
LEAST = 1e-3
"""Least probability of what came true in the logarithmic score: no session costs all."""
KINDS = (
    ("presliding", "maxwell_slip", "load_dependent_presliding"),
    ("actuator_delay", "actuator_lag", "force_delay"),
)
"""Effects that write the same cause in other mathematics: friction that builds up over a distance,
and a drive that is late."""
LOG_SCORE = "logarithmic score of effects, nats a session"
DETAILS = (
    "the same, or another of the same kind hidden",
    "clean sessions left undecided",
    "Brier score of effects, a session",
    "Brier score of the unknown, a session",
    "logarithmic score of the unknown, nats a session",
    "error over floor, median and 95 %",
    "sessions",
)
"""Rows that a summary leaves out."""
ENTRIES = Path(__file__).parents[1] / "results/missing_effects"


@dataclass(frozen=True)
class Answer:
    """What a tool says of one session; see the top of this module."""

    id: str
    effects: Mapping[str, float]
    unknown: float
    set: frozenset[str]
    error: float | None
    seconds: float | None

    @property
    def named(self) -> list[str]:
        """Effects of a probability of `SURE` or more."""
        return [e for e, p in self.effects.items() if p >= SURE]

    @property
    def most_probable(self) -> float:
        """Largest probability of anything missing."""
        return max([self.unknown, *self.effects.values()])


Pair = tuple[Recipe, Answer]


def read_entry(path: Path) -> list[Answer]:
    """The answers of an entry; leaves with file and line where one cannot be scored."""
    found: dict[str, Answer] = {}
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        where = f"{path}, line {number}"
        try:
            row = json.loads(line)
            effects = {str(e): float(p) for e, p in row["effects"].items()}
            unknown = float(row["unknown"])
            said = row.get("set", [e for e, p in effects.items() if p >= 0.5])
            answer = Answer(row["id"], effects, unknown, frozenset(said), row.get("error"),
                            row.get("seconds"))  # fmt: skip
        except (ValueError, KeyError, TypeError, AttributeError) as problem:
            raise SystemExit(f"{where}: {problem!r}; write the fields of an answer") from problem
        if not all(0.0 <= p <= 1.0 for p in (unknown, *effects.values())):
            raise SystemExit(f"{where}: a probability lies outside 0 to 1")
        if answer.id in found:
            raise SystemExit(f"{where}: {answer.id} has two lines; keep one")
        found[answer.id] = answer
    return list(found.values())


def match(answers: Iterable[Answer], recipes: Iterable[Recipe]) -> list[Pair]:
    """Each answer with the recipe of its session; those of other parts are left out."""
    known = {r.id: r for r in recipes}
    return [(known[a.id], a) for a in answers if a.id in known]


def same_kind(effect: str, other: str) -> bool:
    """Whether two effects on one target write the same cause."""
    (name, _, at), (name_2, _, at_2) = effect.partition(":"), other.partition(":")
    return effect == other or (
        (at == at_2 or not at or not at_2) and any(name in k and name_2 in k for k in KINDS)
    )


def brier(stated: Sequence[tuple[float, bool]]) -> float:
    """Sum of squared differences between probabilities and what is there."""
    return float(sum((p - there) ** 2 for p, there in stated))


def logarithmic(stated: Sequence[tuple[float, bool]]) -> float:
    """Minus the logarithm of the probability of what is there, nats, cut at `LEAST`."""
    return float(sum(-np.log(max(p if there else 1.0 - p, LEAST)) for p, there in stated))


def statements(pair: Pair) -> list[tuple[float, bool]]:
    """Probability of every effect that is stated or hidden, and whether it is there."""
    recipe, answer = pair
    names = answer.effects.keys() | recipe.effects.keys()
    return [(answer.effects.get(e, 0.0), e in recipe.effects) for e in sorted(names)]


def score(pairs: Sequence[Pair]) -> dict[str, str]:
    """The rows of the table, by title."""
    clean = [(r, a) for r, a in pairs if r.clean]
    library = [(r, a) for r, a in pairs if r.effects and not r.outside]
    beyond = [(r, a) for r, a in pairs if r.outside]
    holding = [(r, a) for r, a in pairs if r.effects]
    hidden = [(e, s, a) for r, a in holding for e, s in r.effects.items()]
    named = [(e, r) for r, a in pairs for e in a.named]
    right = sum(e in r.effects for e, r in named)
    kin = sum(any(same_kind(e, h) for h in r.effects) for e, r in named)
    first = [(r, max(a.effects, key=lambda e: a.effects[e], default="")) for r, a in holding]
    alarms = sum(a.most_probable >= SURE for _, a in clean)
    unsure = sum(1.0 - SURE <= a.most_probable < SURE for _, a in clean)
    bound = float(beta.ppf(0.95, alarms + 1, max(len(clean) - alarms, 1e-9))) if clean else 1.0
    errors = [float(a.error) for _, a in pairs if a.error is not None]
    seconds = [float(a.seconds) for _, a in pairs if a.seconds is not None]

    def found(low: float, high: float) -> str:
        some = [(e, a) for e, s, a in hidden if low <= s < high]
        return _share(sum(e in a.named for e, a in some), len(some))

    every = [statements(pair) for pair in pairs]
    about_unknown = [(a.unknown, bool(r.outside)) for r, a in pairs]
    count = max(len(pairs), 1)
    return {
        "sessions": f"{len(pairs)}: {len(clean)} clean, {len(library)} with effects of the"
        f" library, {len(beyond)} with one outside",
        f"of the effects named at {SURE:g}, hidden": _share(right, len(named)),
        "the same, or another of the same kind hidden": _share(kin, len(named)),
        f"of the hidden effects, named at {SURE:g}": found(0.0, 2.0),
        "of strength 0.1 to 0.2": found(0.0, 0.2),
        "of strength 0.2 to 0.5": found(0.2, 0.5),
        "of strength 0.5 to 1": found(0.5, 2.0),
        "most probable effect hidden": _share(sum(e in r.effects for r, e in first), len(first)),
        "whole set right, library alone": _share(
            sum(set(a.set) == set(r.effects) for r, a in library), len(library)
        ),
        "Brier score of effects, a session": f"{sum(map(brier, every)) / count:.3f}",
        LOG_SCORE: f"{sum(map(logarithmic, every)) / count:.3f}",
        "false alarms in clean sessions": _share(alarms, len(clean))
        + (f", at most {100.0 * bound:.1f} % at 95 % confidence" if clean else ""),
        "clean sessions left undecided": _share(unsure, len(clean)),
        "effect outside the library recognised": _share(
            sum(a.unknown >= SURE for _, a in beyond), len(beyond)
        ),
        "said to be unknown, library alone": _share(
            sum(a.unknown >= SURE for _, a in library), len(library)
        ),
        "Brier score of the unknown, a session": f"{brier(about_unknown) / count:.3f}",
        "logarithmic score of the unknown, nats a session": (
            f"{logarithmic(about_unknown) / count:.3f}"
        ),
        "error over floor, median and 95 %": _quantiles(errors, (50, 95), 2),
        "time a session, median and longest": _quantiles(seconds, (50, 100), 1, " s"),
    }  # fmt: skip


def _share(part: int, whole: int) -> str:
    return f"{part} of {whole} ({100.0 * part / whole:.0f} %)" if whole else "–"


def _quantiles(values: Sequence[float], at: tuple[int, int], digits: int, unit: str = "") -> str:
    if not values:
        return "–"
    low, high = np.percentile(values, at)
    return f"{low:.{digits}f}, {high:.{digits}f}{unit}"


def write_table(columns: Mapping[str, Sequence[Pair]], without: Collection[str] = ()) -> str:
    """Scores of entries side by side, as Markdown; ``without`` these rows."""
    scored = {title: score(pairs) for title, pairs in columns.items()}
    lines = ["| | " + " | ".join(scored) + " |", "|-|" + "-|" * len(scored)]
    for row in (row for row in next(iter(scored.values())) if row not in without):
        lines.append(f"| {row} | " + " | ".join(s[row] for s in scored.values()) + " |")
    return "\n".join(lines)


def write_groups(pairs: Sequence[Pair], title: str, group_of: Callable[[Recipe], str]) -> str:
    """The main scores by group, as Markdown."""
    rows = {
        "sessions": lambda s: s["sessions"].partition(":")[0],
        "named right": lambda s: s[f"of the effects named at {SURE:g}, hidden"],
        "hidden named": lambda s: s[f"of the hidden effects, named at {SURE:g}"],
        "whole sets": lambda s: s["whole set right, library alone"],
        "log score": lambda s: s[LOG_SCORE],
        "false alarms": lambda s: s["false alarms in clean sessions"].partition(",")[0],
        "s, median and longest": lambda s: s["time a session, median and longest"],
    }
    lines = [f"| {title} | {' | '.join(rows)} |", "|-|" + "-|" * len(rows)]
    for group in sorted({group_of(r) for r, _ in pairs}):
        scored = score([(r, a) for r, a in pairs if group_of(r) == group])
        lines.append(f"| {group} | " + " | ".join(of(scored) for of in rows.values()) + " |")
    return "\n".join(lines)


def read_entries(folder: Path = ENTRIES, part: str = "test") -> dict[str, list[Pair]]:
    """The stored entries by name, with the recipes of the sessions that they answer."""
    recipes = [r for r in read_recipes() if r.part == part]
    return {p.stem: match(read_entry(p), recipes) for p in sorted(folder.glob("*.jsonl"))}


def common(entries: Mapping[str, Sequence[Pair]]) -> dict[str, list[Pair]]:
    """The same on the sessions that all answer."""
    ids = set.intersection(*({r.id for r, _ in pairs} for pairs in entries.values()))
    return {name: [(r, a) for r, a in ps if r.id in ids] for name, ps in entries.items()}


def write_summary(folder: Path = ENTRIES, without: Collection[str] = DETAILS) -> str:
    """How many sessions each stored entry answers, and all on those that all answer."""
    entries = read_entries(folder)
    answered, every = {name: len(pairs) for name, pairs in entries.items()}, HIDDEN + CLEAN
    head = f"All entries answer the {every} sessions of the test part:"
    if {*answered.values()} != {every}:
        each = ", ".join(f"{count} by {name}" for name, count in answered.items())
        head = f"Answered, of the {every} sessions of the test part: {each}."
        head += " On those that all entries answer:"
    return f"{head}\n\n{write_table(common(entries), without)}"


def write_results(folder: Path = ENTRIES) -> str:
    """`write_summary`, then each stored entry on all that it answers."""
    parts = [write_summary(folder, ())]
    for name, pairs in read_entries(folder).items():
        parts += [f"All that {name} answers:", write_table({name: pairs})]
        parts += [write_groups(pairs, "machine", _machine), write_groups(pairs, "day", _day)]
    return "\n\n".join(parts)


def _machine(recipe: Recipe) -> str:
    return recipe.machine


def _day(recipe: Recipe) -> str:
    return recipe.day


def main(arguments: Sequence[str]) -> None:
    """Print the tables of entries."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("entry", type=Path, nargs="+")
    parser.add_argument("--part", choices=list(PARTS), default="test")
    parser.add_argument("--common", action="store_true", help="sessions that all entries answer")
    given = parser.parse_args(arguments)
    recipes = [r for r in read_recipes() if r.part == given.part]
    entries = {str(path.stem): match(read_entry(path), recipes) for path in given.entry}
    if given.common:
        entries = common(entries)
    if not all(entries.values()):
        raise SystemExit(f"no session of the {given.part} part is answered")
    print(write_table(entries))
    for name, pairs in entries.items():
        for title, group_of in (("machine", _machine), ("day", _day)):
            print(f"\n{name}\n\n{write_groups(pairs, title, group_of)}")


if __name__ == "__main__":
    main(sys.argv[1:])
