"""What a diagnosis says agrees with its numbers: right, close, weak, far from the floor."""

from __future__ import annotations

import itertools
import re
from types import SimpleNamespace

import pytest

from bampipe.discover import sentences, verdict
from bampipe.discover.findings import Diagnosis
from bampipe.discover.settings import Settings
from bampipe.results.diagnose import (
    AxisVerdict,
    Contender,
    DiagnoseResult,
    RefusedEffect,
    Stretch,
    TransientCandidate,
    in_words,
)
from bampipe.results.standing import standing

SECOND = Stretch(trial_id="t3", t_start=4.0, t_end=5.0)
SHAPE = "a bump"


def finding(verdict, before, after, floor, **more):
    """An axis with these numbers."""
    known = {
        "effects": (), "likely": {}, "remains": False, "explained_by_effects": 0.0,
        "rmse_without_worst_second": after,
    } | more  # fmt: skip
    return AxisVerdict(
        verdict=verdict, rmse_before=before, rmse_after=after, noise_floor=floor,
        noise_floor_sd=0.0, standing=standing(after, floor), worst_second=SECOND,
        other_band=None, unit="N.m", explainable_share=0.3, explainable_after=0.1,
        explainable_chance=0.05, sentence="", **known,
    )  # fmt: skip


def say(
    monkeypatch, axis, contests=None, transients=(), cut_short=False, refused=(), prescribed=False
):
    """The sentence of one axis called joint, in N.m."""
    monkeypatch.setattr(sentences, "describe", lambda evidence, axis, s: SHAPE)
    model = SimpleNamespace(device=SimpleNamespace(prescribed=prescribed))
    system = SimpleNamespace(coordinates=("joint",), torque_units=("N.m",), model=model)
    evidence = SimpleNamespace(system=system, timing=(0.0, 0.0))
    found = Diagnosis(
        (axis,),
        (),
        axis.effects,
        {},
        contests or {},
        (),
        cut_short,
        transients,
        evidence,
        evidence,
        refused,
    )
    return sentences.axis_sentences(found, Settings())[0]


def contender(effect, held_out_rmse, score, without_trial, without_second, odds):
    """An effect on the joint, with its scores."""
    return Contender(
        effect=effect, axis="joint", held_out_rmse=held_out_rmse, score=score,
        score_without_trial=without_trial, score_without_second=without_second, odds=odds,
    )  # fmt: skip


def test_a_rival_that_leaves_less_on_this_axis_says_why_it_is_none(monkeypatch):
    axis = finding("missing", 2.0, 0.84, 0.1, effects=("a:joint",))
    contest = (contender("a:joint", 0.84, 90.0, 50.0, 60.0, 1.0),)
    for score, said in ((80.0, "over all axes together it explains most"), (95.0, "Close to")):
        rival = contender("b:joint", 0.73, score, 50.0, 60.0, 0.0)
        sentence = say(monkeypatch, axis, {"a:joint": (*contest, rival)})
        assert said in sentence
        assert ("over all axes" in sentence) is (score < 90.0)
        assert "comes b:joint (leaves 0.730 N.m)" in sentence


def numbers(sentence):
    """Every number in it."""
    return [float(x) for x in re.findall(r"(?<![\w.])\d+(?:\.\d+)?(?:e-?\d+)?", sentence)]


def number_of_case(axis):
    return f"{axis.verdict}-{axis.rmse_after}-{axis.explained_by_effects}"


CASES = [
    finding(verdict, before, after, floor, **more)
    for (before, after, floor), (verdict, more) in itertools.product(
        [(1.0, 0.1, 0.1), (1.0, 0.5, 0.1), (0.226, 0.13, 0.122), (90.0, 1.14, 1.0)],
        [
            ("missing", {"effects": ("stribeck:joint",), "explained_by_effects": 0.9}),
            (
                "missing",
                {"effects": ("a:joint", "b:joint"), "explained_by_effects": 0.6, "remains": True},
            ),
            (
                "undecided",
                {"effects": ("a:joint",), "likely": {"a:joint": 0.6, "b:joint": 0.4}},
            ),
            (
                "undecided",
                {"likely": {"a:joint": 1.0}, "explained_by_effects": 0.4, "remains": True},
            ),
            ("undecided", {"likely": {"a:joint": 0.7}, "remains": True}),
            ("unknown_effect", {"remains": True}),
            (
                "unknown_effect",
                {"likely": {"a:joint": 1.0}, "explained_by_effects": 0.2, "remains": True},
            ),
            ("nothing_missing", {}),
        ],
    )
]


@pytest.mark.parametrize(
    "axis", CASES, ids=lambda a: f"{a.verdict}-{a.rmse_after}-{a.explained_by_effects}"
)
def test_every_number_in_a_sentence_stands_in_the_table(monkeypatch, axis):
    said = say(monkeypatch, axis)
    ratios = [error / axis.noise_floor for error in (axis.rmse_before, axis.rmse_after)]
    shares = [100 * axis.explained_by_effects, *(100 * odds for odds in axis.likely.values())]
    known = [axis.rmse_before, axis.rmse_after, axis.noise_floor, *ratios, *shares]
    for number in numbers(said):
        assert any(number == pytest.approx(value, rel=0.02, abs=0.051) for value in known), said


@pytest.mark.parametrize(
    "axis", CASES, ids=lambda a: f"{a.verdict}-{a.rmse_after}-{a.explained_by_effects}"
)
def test_no_effect_explains_it_never_stands_beside_one_that_does(monkeypatch, axis):
    said = say(monkeypatch, axis)
    if axis.verdict == "unknown_effect":
        assert "no effect in the library explains" in said
        assert axis.explained_by_effects < 0.35
    elif not axis.remains:
        assert "no effect in the library" not in said
    for effect in (*axis.effects, *axis.likely):
        assert effect in said
    assert (SHAPE in said) == axis.remains
    assert "the library" not in say(monkeypatch, axis, cut_short=True)


def test_rivals_are_listed_with_what_they_would_leave(monkeypatch):
    axis = finding("missing", 1.0, 0.1, 0.1, effects=("a:joint",), explained_by_effects=1.0)
    contest = (
        contender("a:joint", 0.1, 456.5, 400.0, 430.0, 1.0),
        contender("b:joint", 0.12, 454.3, 440.0, 431.0, 0.0),
    )
    said = say(monkeypatch, axis, contests={"a:joint": contest})
    assert "b:joint (leaves 0.120 N.m)" in said


def test_a_rival_about_as_likely_is_named_in_the_verdict(monkeypatch):
    """Odds of less than two to one set no effect apart; of more they do."""
    axis = finding("missing", 1.0, 0.1, 0.1, effects=("a:joint",), explained_by_effects=1.0)
    for share, beside, head in (
        (0.30, "", "Joint: a:joint is missing; adding it takes"),
        (0.35, "about as likely", "Joint: a:joint or, about as likely, b:joint is missing"),
        (0.54, "about as likely", "Joint: a:joint or, about as likely, b:joint is missing"),
        (0.70, "likelier by score", "Joint: a:joint or, likelier by score, b:joint is missing"),
    ):
        contest = (
            contender("a:joint", 0.1, 60.0, None, 52.0, 0.0),
            contender("b:joint", 0.13, 59.0, None, 35.0, 0.0),
        )
        odds = {"a:joint": 1.0 - share, "b:joint": share}
        listed = verdict._listed(contest, odds, Settings())
        assert [c.beside for c in listed] == ["", beside]
        said = say(monkeypatch, axis, contests={"a:joint": listed})
        assert said.startswith(head)
        assert ("adding a:joint takes" in said) is bool(beside)
        told = SimpleNamespace(axes={"joint": axis}, contests={"a:joint": listed})
        words = DiagnoseResult.verdicts_in_words.fget(told)
        assert words == {"joint": f"missing {head.removeprefix('Joint: ').partition(' is ')[0]}"}
        marked = in_words("a:joint", listed, "`")
        assert marked == (f"`a:joint` or, {beside}, `b:joint`" if beside else "`a:joint`")


@pytest.mark.parametrize(
    ("after", "without", "why", "said"),
    [
        (0.98, 0.60, "held_out", "takes the held-out error only from 1.00 to 0.980 N.m: it is not"),
        (
            0.70,
            0.78,
            "held_out",
            "only from 0.800 to 0.780 N.m but for the worst second: it is not",
        ),
        (1.02, 0.60, "held_out", "does not lower the held-out error (1.00 to 1.02 N.m): it is not"),
        (0.20, 0.10, "replays", "from 1.00 to 0.200 N.m, but replays with it give no floor"),
        (1e-5, 1e-5, "scale", "lag:x fits best where next to nothing is left of what the applied"),
        (None, None, "runs_away", "its score, but, fitted without one of the trials, runs away"),
    ],
)
def test_what_beats_chance_and_is_refused_is_said(monkeypatch, after, without, why, said):
    """No effect explains what is left: then the table's first line needs a reason."""
    one = RefusedEffect(
        effect="lag:x", axis="joint", held_out_rmse_before=1.0, held_out_rmse_after=after,
        without_worst_second_before=0.8, without_worst_second_after=without, why=why,
    )  # fmt: skip
    axis = finding("unknown_effect", 1.0, 1.0, 0.1, remains=True)
    assert said in say(monkeypatch, axis, refused=(one,))
    other = one.model_copy(update={"axis": "elbow"})
    assert "lag:x" not in say(monkeypatch, axis, refused=(other,))
    fine = finding("nothing_missing", 1.0, 1.0, 1.0)
    assert "lag:x" not in say(monkeypatch, fine, refused=(one,))


def test_what_stopping_replays_explain_is_said_where_nothing_is_missing(monkeypatch):
    """The ranking shows a candidate that halves the error beside "nothing is missing"."""
    one = RefusedEffect(
        effect="lag:x", axis="joint", held_out_rmse_before=1.0, held_out_rmse_after=0.5, why="stops"
    )
    said = say(monkeypatch, finding("nothing_missing", 1.0, 1.0, 1.0), refused=(one,))
    assert "from 1.00 to 0.500 N.m, but replays without it that truly stand still at" in said
    other = one.model_copy(update={"effect": "play:x", "held_out_rmse_after": 0.7})
    said = say(monkeypatch, finding("nothing_missing", 1.0, 1.0, 1.0), refused=(one, other))
    assert "lag:x would take the held-out error from 1.00 to 0.500 N.m and play:x from" in said
    assert said.endswith("give them most of that gain as well: none of them is named.")


def test_odds_are_given_where_no_replay_looks_like_the_measurement(monkeypatch):
    axis = finding("missing", 1.0, 0.1, 0.1, effects=("a:joint",), explained_by_effects=1.0)
    contest = (
        contender("a:joint", 0.1, 60.0, None, 52.0, 0.84),
        contender("b:joint", 0.13, 37.0, None, 35.0, 0.16),
    )
    said = say(monkeypatch, axis, contests={"a:joint": contest})
    assert "84 % for a:joint (leaves 0.100 N.m) and 16 % for b:joint (leaves 0.130 N.m)" in said
    sure = (contest[0].model_copy(update={"odds": 0.97}), contest[1])
    assert "%" not in say(monkeypatch, axis, contests={"a:joint": sure})


def test_an_error_above_its_floor_for_one_second_says_which(monkeypatch):
    axis = finding("nothing_missing", 1.0, 1.0, 0.5, rmse_without_worst_second=0.55)
    said = say(monkeypatch, axis)
    assert "4.0 to 5.0 s of trial t3" in said and "0.550 N.m" in said


def test_a_candidate_that_one_second_speaks_for_is_not_called_missing(monkeypatch):
    axis = finding("nothing_missing", 0.1, 0.1, 0.1)
    only = TransientCandidate(effect="drive_sag:joint", axis="joint", second=SECOND)
    said = say(monkeypatch, axis, transients=(only,))
    assert "Only 4.0 to 5.0 s of trial t3 speaks for drive_sag:joint" in said
    assert "drive_sag:joint is missing" not in said


def test_a_wrong_floor_gives_no_verdict(monkeypatch):
    axis = finding("undecided", 1.0, 0.3, 1.0, effects=("a:joint",))
    said = say(monkeypatch, axis)
    assert "no verdict can be trusted" in said and "is missing" not in said


def test_a_floor_of_replays_that_stand_still_is_said_to_be_one(monkeypatch):
    axis = finding("nothing_missing", 0.42, 0.42, 0.39)
    assert "stands still" not in say(monkeypatch, axis)
    still = axis.model_copy(update={"creeping_floor": 0.0964})
    said = say(monkeypatch, still)
    assert "replays that creep there, as the device's sign_width says, leave 0.0964 N.m." in said
    assert "With a smaller sign_width more would show." in said


def test_on_a_test_bench_whose_trials_chose_the_width_no_smaller_one_is_asked_for(monkeypatch):
    axis = finding("nothing_missing", 0.42, 0.42, 0.39)
    still = axis.model_copy(update={"creeping_floor": 0.0964})
    said = say(monkeypatch, still, prescribed=True)
    assert "as the model's sign_width says, leave 0.0964 N.m." in said
    assert "smaller sign_width" not in said
