"""What a diagnosis says of an axis is true of the numbers beside it."""

import itertools
import re
from collections.abc import Mapping

import pytest
from made_results import diagnosis, filled

from bampipe.phrases import diagnosis as phrases
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.floor import compare_with_floor

Sets = Mapping[tuple[str, ...], float]
A, B, C = "a:joint", "b:joint", "c:joint"
SHAPE = "a bump of +2 N.m near position 0.3 rad"


def made(verdict: str, sets: Sets, before=1.0, after=0.104, floor=0.1, **more) -> DiagnoseResult:
    """A diagnosis of one axis called joint, in N.m; of another, elbow, with ``elbow`` set."""
    axis = {
        "verdict": verdict, "rmse_before": before, "rmse_after": after, "noise_floor": floor,
        "rmse_beyond_bias": 0.0831, "standing": compare_with_floor(after, floor), "unit": "N.m",
        "explained": 0.98837, "unknown": 0.0312, "remains": verdict == "unknown_effect",
    }  # fmt: skip
    whole = {k: more.pop(k) for k in ("cut_short", "ranking", "worst_windows") if k in more}
    content = {**diagnosis({"joint": axis | more}, sets), **whole}
    return DiagnoseResult.model_validate(filled(DiagnoseResult, content))


def say(*args, shape: str = SHAPE, **more) -> str:
    return phrases.describe_axes(made(*args, **more), {"joint": shape})["joint"]


CASES = [
    (verdict, sets, *errors)
    for errors, (verdict, sets) in itertools.product(
        [(1.0, 0.1, 0.1), (1.0, 0.52, 0.1), (90.0, 1.14, 1.0)],
        [
            ("missing", {(A,): 0.97, (): 0.03}),
            ("missing", {(A, B): 0.96, (A,): 0.02}),
            ("undecided", {(A,): 0.6, (B,): 0.4}),
            ("undecided", {(A, B): 0.6, (A, C): 0.4}),
            ("undecided", {(): 0.55, (A, B): 0.45}),
            ("undecided", {(A,): 0.7}),
            ("unknown_effect", {(): 1.0}),
            ("unknown_effect", {(A,): 0.92, (): 0.08}),
            ("nothing_missing", {(): 0.98, (A,): 0.02}),
            ("no_verdict", {(A,): 0.92, (): 0.08}),
        ],
    )
]


@pytest.mark.parametrize(("verdict", "sets", "before", "after", "floor"), CASES)
def test_every_number_in_a_sentence_is_one_of_the_record(verdict, sets, before, after, floor):
    found = made(verdict, sets, before, after, floor)
    entry = found.axes["joint"]
    said = phrases.describe_axes(found)["joint"]
    error = after if found.selected else before  # without effects to add, the model stays
    share = 1 - min(1.0, (1 - entry.explained) * (error / after) ** 2)
    known = [before, error, floor, error / floor, entry.rmse_beyond_bias, entry.unknown, 0.99, 0.01]
    known += [100 * share, *entry.probabilities.values(), *sets.values()]
    for text in re.findall(r"(?<![\w.])\d+(?:\.\d+)?", said):
        assert any(float(text) == pytest.approx(x, rel=0.006, abs=0.006) for x in known), said
    assert f"{phrases.percent_of_force(share)} of the mean square of the applied force" in said
    named = {"missing": entry.effects, "unknown_effect": entry.effects, "nothing_missing": ()}
    assert {n for n in (A, B, C) if n in said} == {*named.get(verdict, entry.likely)}
    decided = verdict not in ("undecided", "no_verdict") or (A, C) in sets
    assert ("missing" in said) == decided and "()" not in said


@pytest.mark.parametrize(
    ("verdict", "sets", "start"),
    [
        (
            "missing",
            {(A, B): 0.96, (A,): 0.02},
            "Joint: a:joint and b:joint are missing (probability 0.98 and 0.96); adding them takes"
            " the held-out error from 1.00 to 0.104 N.m, 1.04 times the noise floor; the model then"
            " explains 98.8 % of the mean square of the applied force.",
        ),
        (
            "undecided",
            {(A, B): 0.6, (A, C): 0.4},
            "Joint: a:joint (probability > 0.99) is missing, and these trials do not decide between"
            " b:joint (probability 0.60) and c:joint (0.40); adding a:joint and b:joint takes",
        ),
        (
            "undecided",
            {(A,): 0.6, (B, C): 0.4},
            "Joint: these trials do not decide between a:joint (probability 0.60) and b:joint with"
            " c:joint (0.40); adding a:joint takes",
        ),
        ("undecided", {(A,): 0.7}, "Joint: these trials do not decide on a:joint (probability 0.7"),
        (
            "unknown_effect",
            {(): 1.0},
            "Joint: something is missing that no effect of the library explains (probability 0.03)",
        ),
    ],
)
def test_a_verdict_names_what_is_probable(verdict: str, sets: Sets, start: str) -> None:
    assert say(verdict, sets).startswith(start)


def test_what_is_doubted_left_or_of_another_axis_is_said() -> None:
    unsure = {A: 0.66, B: 0.6, C: 0.4}
    said = say("undecided", {(A, B): 0.6, (A, C): 0.4}, probabilities=unsure)
    assert "a:joint (probability 0.66) may be missing, and these trials do not decide" in said
    for verdict, sets in (("missing", {(A,): 1.0}), ("undecided", {(A,): 0.6, (B,): 0.4})):
        said = say(verdict, sets, remains=True, unknown=0.957)
        assert "In addition, something is missing that no effect of the library explains" in said
        assert "(probability 0.96)" in said and said.endswith(f"Its shape: {SHAPE}.")
        assert SHAPE not in say(verdict, sets)
    assert say("unknown_effect", {(): 1.0}).endswith(f"Its shape: {SHAPE}.")
    assert "Its shape" not in say("unknown_effect", {(): 1.0}, shape="")
    assert "the library" not in say("unknown_effect", {(): 1.0}, cut_short=True)
    ranked = {"effect": C, "axis": "joint"}
    open_sets = {(A,): 0.5, (B,): 0.43, (C,): 0.07}
    said = say("undecided", open_sets, probabilities={A: 0.5, B: 0.43}, ranking=[ranked])
    assert "b:joint (0.43) and c:joint (0.07)" in said and "nothing" not in said
    both = {(A, "b:elbow"): 1.0}
    assert "adding all selected effects (a:joint and b:elbow) takes" in say("missing", both)
    clean = say("nothing_missing", {("b:elbow",): 1.0}, before=0.104)
    assert "the held-out error is 0.104 N.m" in clean and "b:elbow" not in clean
    filters = (
        "Without the bias that filters leave where friction changes sign, the error is 0.0831 N.m."
    )
    assert say("nothing_missing", {(): 1.0}, before=0.5, after=0.5).endswith(filters)
    assert filters not in say("nothing_missing", {(): 1.0})


@pytest.mark.parametrize(
    ("after", "floor", "why"),
    [
        (0.3, 1.0, "its held-out error of 0.300 N.m is far below its noise floor, which is"),
        (0.3, 0.0, "its held-out error of 0.300 N.m is without a noise floor for comparison."),
        (20.0, 1.0, "replicates of the model do not resemble the measurement"),
    ],
)
def test_no_verdict_says_why_and_what_to_do(after: float, floor: float, why: str) -> None:
    window = {"axis": "joint", "trial_id": "t3", "t_start": 4.0, "t_end": 4.5, "rmse": 31.2,
              "unit": "N.m", "doing": "reversing"}  # fmt: skip
    said = say("no_verdict", {(A,): 1.0}, after=after, floor=floor, worst_windows=[window])
    assert said.startswith(f"Joint: no verdict, because {why}")
    assert "Judged by fit alone: a:joint (> 0.99)." in said and "is missing" not in said
    assert "Compare the noise and resolution in session.toml" in said
    assert ("31.2 N.m, from 4.0 to 4.5 s of trial t3 (reversing)" in said) == (after > floor > 0.0)


def test_nothing_is_called_certain() -> None:
    """Neither a probability nor a share of the force rounds to all or nothing."""
    assert [phrases.probability(p) for p in (0.9996, 0.99, 0.5, 0.0004)] == [
        "> 0.99", "0.99", "0.50", "< 0.01",
    ]  # fmt: skip
    shares = (0.5, 0.988, 0.99961, 0.9999993, -0.2)
    shown = ["50.0 %", "98.8 %", "99.96 %", "99.99993 %", "-20.0 %"]
    assert [phrases.percent_of_force(share) for share in shares] == shown
    found = made("undecided", {(A, B): 0.6, (A, C): 0.4})
    assert phrases.find_open_effects(found) == {B, C} and found.lacking == ("joint",)
    shown = "undecided: a:joint (> 0.99), and either b:joint (0.60) or c:joint (0.40)"
    assert phrases.verdict(found, "joint") == shown
    decided = made("missing", {(A,): 0.97, (B,): 0.03})
    assert phrases.find_open_effects(decided) == frozenset()
