"""A baseline: effects one at a time, by held-out error.

    cd benchmarks
    python -m missing_effects.greedy --part development --first 60 --out LEARN.jsonl
    python -m missing_effects.greedy --part test --first 60 --out STEPS.jsonl
    python -m missing_effects.greedy --learn LEARN.jsonl --steps STEPS.jsonl --out ENTRY.jsonl

The usual stepwise regression: at each step, the effect whose columns lower the held-out error most
is added, each trial left out in turn; at most five. Motion, bare model and columns of the effects
are those of bampipe (a grid of at most `SHAPES` shapes for each), the rule is plain numpy. How far
an effect lowers the error becomes a probability by a logistic curve that was fitted to sessions of
the development part.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from recovery import PIPELINE
from scipy.optimize import minimize

import bampipe
from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model_file import load_model, read_estimate, read_spec
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.dictionary import Dictionary
from bampipe.diagnosis.ranges import MachineScale
from bampipe.diagnosis.session import Session, candidates_of
from bampipe.physics import compile_model
from bampipe.results.identify import IdentifyResult
from bampipe.trials.measured import read_measured_trials
from bampipe.trials.samples import take_samples
from missing_effects.make import make_session
from missing_effects.recipes import PARTS, Recipe, read_recipes

SHAPES, MOST = 12, 5
UNKNOWN = 0.1
"""Probability of something unknown in any session: the share of the development part."""

Array = np.ndarray


class Regression:
    """Held-out error of linear models of the residual, with columns that come one by one.

    Attributes:
        y: the residual, weighted, (n,); group: that is left out together, of each row, (n,).
        x: columns of the model so far, (n, m).
    """

    def __init__(self, y: Array, x: Array, group: Array) -> None:
        self.y, self.group, self.x = y, group, x

    def error(self, more: Array) -> float:
        """Mean square on rows that the coefficients have not seen, with ``more`` columns (n, k)."""
        x = np.column_stack([self.x, more])
        x = x / np.maximum(np.linalg.norm(x, axis=0), 1e-300)
        parts = [(x[g], self.y[g]) for g in (self.group == k for k in np.unique(self.group))]
        normal = np.array([a.T @ a for a, _ in parts])
        right = np.array([a.T @ b for a, b in parts])
        ridge = 1e-9 * np.eye(x.shape[1])
        squares = 0.0
        for k, (a, b) in enumerate(parts):
            rest = np.linalg.solve(normal.sum(0) - normal[k] + ridge, right.sum(0) - right[k])
            squares += float(np.sum((b - a @ rest) ** 2))
        return squares / len(self.y)

    def reaches(self, force: Array, more: Array) -> bool:
        """Whether ``force`` (n,) is, but for rounding, a sum of the columns with ``more``."""
        x = np.column_stack([self.x, more])
        x = x / np.maximum(np.linalg.norm(x, axis=0), 1e-300)
        left = force - x @ np.linalg.lstsq(x, force)[0]
        return float(np.linalg.norm(left)) < 1e-3 * float(np.linalg.norm(force))


def search(session: Path, folder: Path) -> list[tuple[str, float]]:
    """Effects in the order in which they are added, with the fall of the error's logarithm."""
    (folder / "greedy.toml").write_text(PIPELINE)
    opened = bampipe.run_session(
        session, runs=folder / "runs", pipeline=str(folder / "greedy.toml")
    )
    run = RunFolder(opened.root)
    model = load_model(run, "base")
    system = compile_model(model)
    timing = run.read(IdentifyResult, "base").input_timing
    trials = Session(read_measured_trials(run, system, every_input=True, timing=timing), Criteria())
    spec = read_spec(run, "base", model)
    fit = trials.fit_plainly(spec, read_estimate(run, "base", system))
    e, samples = fit.linearisation, fit.likelihood.samples
    names = trials.candidate_names(spec)
    candidates = {c.name: c for c in candidates_of(spec, names)}
    dictionary = Dictionary(e, samples, candidates, MachineScale.of_trials(e))
    weights = [1.0 / max(float(np.sqrt(np.mean(take_samples(e.residual, s, a) ** 2))), 1e-300)
               for a, s in enumerate(samples)]  # fmt: skip

    def stack(values: Sequence[Array | None], width: int) -> Array:
        rows = zip(values, samples, weights, strict=True)
        return np.concatenate(
            [np.zeros((len(s.rows), width)) if v is None else w * v for v, s, w in rows]
        )

    axes = range(len(samples))
    residual = stack([take_samples(e.residual, s, a)[:, None] for a, s in enumerate(samples)], 1)
    slopes = [take_samples(e.jacobian, s, a) for a, s in enumerate(samples)]
    groups = np.concatenate([np.array(e.folds.groups)[s.trial] for s in samples])
    regression = Regression(residual[:, 0], stack(slopes, slopes[0].shape[1]), groups)
    thin = [e.band.thin(fitted.applied) for fitted in e.fitted]
    applied = stack([take_samples(thin, s, a)[:, None] for a, s in enumerate(samples)], 1)[:, 0]
    pool: dict[str, list[Array]] = {}
    for name in names:
        grid = dictionary.grid(name)
        atoms = (dictionary.make(key) for key in grid[:: -(-len(grid) // SHAPES)])
        columns = [stack([a.columns.get(k) for k in axes], a.width) for a in atoms if a]
        # With a factor on the measured force free, zero solves the equations of motion.
        if not any(regression.reaches(applied, x) for x in columns[:1]):
            pool[name] = columns
    found: list[tuple[str, float]] = []
    before = regression.error(np.zeros((len(groups), 0)))
    while len(found) < MOST:
        tried = [(regression.error(x), name, k)
                 for name, columns in pool.items() for k, x in enumerate(columns)]  # fmt: skip
        after, name, k = min(tried, default=(before, "", 0))
        if after >= before:
            break
        regression.x = np.column_stack([regression.x, pool.pop(name)[k]])
        found.append((name, float(np.log(before / after))))
        before = after
    return found


def learn(lines: Sequence[dict[str, Any]], recipes: Sequence[Recipe]) -> Array:
    """Offset and slope of the logistic curve over the logarithm of what an effect brings, (2,)."""
    known = {r.id: r for r in recipes}
    pairs = [(np.log(max(fall, 1e-9)), e in known[line["id"]].effects)
             for line in lines for e, fall in line["steps"]]  # fmt: skip
    x, there = (np.array(column, float) for column in zip(*pairs, strict=True))

    def loss(c: Array) -> float:
        return float(np.sum(np.logaddexp(0.0, -(2.0 * there - 1.0) * (c[0] + c[1] * x))))

    return np.asarray(minimize(loss, np.array([0.0, 1.0])).x)


def search_recipe(recipe: Recipe) -> dict[str, object]:
    """The steps of one session, and how long they took."""
    with tempfile.TemporaryDirectory() as name:
        session = make_session(recipe, Path(name))
        begun = time.perf_counter()
        try:
            steps = search(session, Path(name))
        except bampipe.InputError as problem:
            print(f"{recipe.id} {problem}", file=sys.stderr)
            steps = []
        seconds = round(time.perf_counter() - begun, 1)
    return {"id": recipe.id, "steps": steps, "seconds": seconds}


def answer(line: dict[str, Any], curve: Array) -> dict[str, object]:
    """The answer that the steps of a session give."""
    chances = {e: 1.0 / (1.0 + np.exp(-curve[0] - curve[1] * np.log(max(fall, 1e-9))))
               for e, fall in line["steps"]}  # fmt: skip
    effects = {e: round(float(p), 4) for e, p in chances.items()}
    return {"id": line["id"], "effects": effects, "unknown": UNKNOWN, "seconds": line["seconds"]}


def _read(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def main(arguments: Sequence[str]) -> None:
    """Answer sessions, a line each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--part", choices=list(PARTS), help="to search")
    parser.add_argument("--first", type=int, default=60, help="so many sessions of it")
    parser.add_argument("--learn", type=Path, help="steps of the development part")
    parser.add_argument("--steps", type=Path, help="steps to make an entry of")
    parser.add_argument("--out", type=Path, required=True, help="lines are added to it")
    given = parser.parse_args(arguments)
    recipes = read_recipes()
    if given.learn:
        curve = learn(_read(given.learn), recipes)
        print(f"logit of the probability: {curve[0]:.2f} + {curve[1]:.2f} ln(fall)")
        lines = [json.dumps(answer(line, curve)) + "\n" for line in _read(given.steps)]
        given.out.write_text("".join(lines), encoding="utf-8")
        return
    done = given.out.read_text(encoding="utf-8") if given.out.exists() else ""
    for recipe in [r for r in recipes if r.part == given.part][: given.first]:
        if f'"{recipe.id}"' in done:
            continue
        line = json.dumps(search_recipe(recipe))
        with given.out.open("a", encoding="utf-8") as log:
            log.write(line + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
