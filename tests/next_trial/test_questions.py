"""What a diagnosis left open, as a question that a trial can answer."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from bampipe.next_trial.questions import find_ambiguity
from bampipe.trials.folds import Folds
from bampipe.trials.measured import MeasuredTrials


def made_diagnosis(
    scores: dict[str, float], odds: dict[str, float], group: tuple[str, ...]
) -> SimpleNamespace:
    """Of one effect found, the first of ``scores``, and its rivals."""
    name = next(iter(scores))
    return SimpleNamespace(
        selected=(name,),
        contests={
            name: tuple(
                SimpleNamespace(effect=effect, score=score, odds=odds.get(effect, 0.0))
                for effect, score in scores.items()
            )
        },
        ranking=(),
        groups={name: group},
        axes={},
    )


SCORES = {"force_gain:x": 250.0, "inertia_mismatch:yaw": 240.0, "encoder_scale:yaw": 232.0}


def test_what_replays_have_told_apart_is_asked_no_more():
    odds = {"force_gain:x": 0.67, "encoder_scale:yaw": 0.33}
    asked = find_ambiguity(made_diagnosis(SCORES, odds, ("encoder_scale:yaw",)))
    assert asked is not None
    assert asked.odds == pytest.approx(odds)


def test_who_scores_better_than_what_was_found_stays_a_rival_whatever_replays_say():
    odds = {"force_gain:x": 0.67, "encoder_scale:yaw": 0.33}
    better = SCORES | {"inertia_mismatch:yaw": 255.0}
    asked = find_ambiguity(made_diagnosis(better, odds, ("encoder_scale:yaw",)))
    assert asked is not None
    assert set(asked.odds) == set(SCORES)


def test_where_replays_tell_all_apart_those_that_come_close_stay_rivals():
    asked = find_ambiguity(made_diagnosis(SCORES, {"force_gain:x": 1.0}, ()))
    assert asked is not None
    assert set(asked.odds) == set(SCORES)


def test_who_stands_alone_leaves_nothing_to_ask():
    assert (
        find_ambiguity(made_diagnosis({"force_gain:x": 250.0}, {"force_gain:x": 1.0}, ())) is None
    )


def test_effects_are_weighed_by_trials_with_brakes_on_too_but_by_none_held_out():
    names = ("t01", "t02", "t03")
    folds = Folds.of_trials(names, held_out=("t02",), fitted=("t01",))
    assert MeasuredTrials(names, None, None, None, folds).weighed == ["t01", "t03"]
