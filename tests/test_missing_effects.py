"""The benchmark of missing effects: frozen recipes, the generator's bytes, and the scorer."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from missing_effects import greedy, make, score
from missing_effects.recipes import TABLE, Recipe, draw_recipes, read_recipes

FOLDER = TABLE.parent


def test_the_recipes_are_those_that_the_seeds_draw():
    recipes = read_recipes()
    assert [replace(r, sha256="") for r in recipes] == draw_recipes()
    assert len({r.id for r in recipes}) == len(recipes) == 900
    for part in ("development", "test"):
        some = [r for r in recipes if r.part == part]
        assert (sum(not r.clean for r in some), sum(r.clean for r in some)) == (300, 150)
    seeds = [{r.seed for r in recipes if r.part == part} for part in ("development", "test")]
    assert not seeds[0] & seeds[1]


@pytest.mark.parametrize("name", ["development_007", "development_022"])
def test_the_generator_makes_the_bytes_of_the_sample(name: str, tmp_path: Path):
    recipe = next(r for r in read_recipes() if r.id == name)
    session = make.make_session(recipe, tmp_path)
    shipped = FOLDER / "sample/sessions" / name
    assert make.digest(shipped) == recipe.sha256
    assert make.digest(session) == recipe.sha256
    truth = json.loads((tmp_path / f"truth/{name}.json").read_text())
    assert truth == json.loads((FOLDER / f"sample/truth/{name}.json").read_text())
    assert truth["strengths"] == recipe.strengths and tuple(truth["outside"]) == recipe.outside
    told = "".join(p.read_text() for p in session.rglob("*.toml"))
    assert not any(effect.partition(":")[0] in told for effect in recipe.strengths)


def _recipe(name: str, *effects: str, outside: tuple[str, ...] = ()) -> Recipe:
    return Recipe(name, "test", "joint", "good", 1, dict.fromkeys((*effects, *outside), 0.7),
                  outside)  # fmt: skip


RECIPES = [
    _recipe("hit", "stribeck:joint", "presliding:joint"),
    _recipe("kin", "maxwell_slip:joint"),
    _recipe("clean"),
    _recipe("alarm"),
    _recipe("beyond", "quadratic_drag:joint", outside=("detent:joint",)),
    _recipe("unanswered", "return_spring:joint"),
]
LINES = [
    {"id": "hit", "effects": {"stribeck:joint": 0.95, "presliding:joint": 0.6}, "unknown": 0.0,
     "error": 1.0, "seconds": 2.0},
    {"id": "kin", "effects": {"presliding:joint": 1.0}, "unknown": 0.0, "seconds": 4.0},
    {"id": "clean", "effects": {}, "unknown": 0.2},
    {"id": "alarm", "effects": {"upper_stop:joint": 0.9}, "unknown": 0.0},
    {"id": "beyond", "effects": {"quadratic_drag:joint": 0.5}, "unknown": 0.99},
]  # fmt: skip


def _scored(lines: list[dict[str, object]], folder: Path) -> dict[str, str]:
    path = folder / "entry.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return score.score(score.match(score.read_entry(path), RECIPES))


def test_an_entry_scores_what_it_says(tmp_path: Path):
    found = _scored(LINES, tmp_path)
    assert found["sessions"].startswith("5: 2 clean, 2 with effects")
    assert found["of the effects named at 0.9, hidden"] == "1 of 3 (33 %)"
    assert found["the same, or another of the same kind hidden"] == "2 of 3 (67 %)"
    assert found["of the hidden effects, named at 0.9"] == "1 of 4 (25 %)"
    assert found["most probable effect hidden"] == "2 of 3 (67 %)"
    assert found["whole set right, library alone"] == "1 of 2 (50 %)"
    assert found["false alarms in clean sessions"].startswith("1 of 2 (50 %), at most")
    assert found["clean sessions left undecided"] == "1 of 2 (50 %)"
    assert found["effect outside the library recognised"] == "1 of 1 (100 %)"
    assert found["said to be unknown, library alone"] == "0 of 2 (0 %)"
    squares = 0.05**2 + 0.4**2 + 1.0 + 1.0 + 0.9**2 + 0.5**2
    assert found["Brier score of effects, a session"] == f"{squares / 5:.3f}"
    nats = -math.log(0.95 * 0.6 * 0.1 * 0.5) - 2 * math.log(1e-3)
    assert found["logarithmic score of effects, nats a session"] == f"{nats / 5:.3f}"
    assert found["Brier score of the unknown, a session"] == f"{(0.2**2 + 0.01**2) / 5:.3f}"
    assert found["time a session, median and longest"] == "3.0, 4.0 s"


def test_stating_what_one_believes_scores_best():
    """Of 10 effects 7 are there: no probability has a lower mean score than 0.7."""
    for rule in (score.brier, score.logarithmic):
        means = {p: rule([(p / 20, True)] * 7 + [(p / 20, False)] * 3) for p in range(21)}
        assert min(means, key=lambda p: means[p]) == 14


@pytest.mark.parametrize(
    ("lines", "fault"),
    [
        ([{"id": "hit", "effects": {}}], "line 1: KeyError"),
        ([LINES[0], {"id": "kin", "effects": {"a": 1.2}, "unknown": 0.0}], "line 2: a probability"),
        ([LINES[0], LINES[0]], "hit has two lines"),
    ],
)
def test_an_entry_that_cannot_be_scored_is_refused_by_line(lines, fault: str, tmp_path: Path):
    with pytest.raises(SystemExit, match=fault):
        _scored(lines, tmp_path)


def test_the_baseline_is_surer_of_an_effect_the_more_it_lowers_the_error():
    line = {"id": "test_001", "steps": [["a", 2.0], ["b", 0.1]], "seconds": 1.0}
    assert greedy.answer(line, [0.0, 1.0])["effects"] == {"a": 0.6667, "b": 0.0909}
