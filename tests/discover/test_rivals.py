"""Rivals that come close: what replays of each, scored as the measurement was, say of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from independent_runs import record_trials
from sessions import bam, made

from bampipe.discover.believed import count_new_constants, log_prior
from bampipe.discover.bench import Bench
from bampipe.discover.chance import candidates_of, fit_trials, system_of, workers
from bampipe.discover.insufficient import insufficient_rivals
from bampipe.discover.nested import idle_extensions
from bampipe.discover.polish import FittedSet, comes_close
from bampipe.discover.rivals import (
    _misfit,
    believable,
    plausible,
    unsettled_rivals,
    without_mere_offsets,
)
from bampipe.discover.scorer import Score, Scorer
from bampipe.discover.settings import Settings
from bampipe.results.diagnose import Contender
from bampipe.trials.noise_floor import NoiseFloor

S = Settings()
BLUR = 10.0
# Scores of a delay and of a lag where a lag was hidden, and on replays of either.
MEASURED = np.array([1649.0, 1521.0])
OF_DELAY = np.array([[1694.0, 1297.0], [1711.0, 1306.0], [1677.0, 1288.0], [1690.0, 1299.0]])
OF_LAG = np.array([[1575.0, 1473.0], [1592.0, 1495.0], [1558.0, 1451.0], [1571.0, 1470.0]])


def misfits(measured):
    """Of both, the likest first."""
    found = {
        "delay": _misfit(measured, OF_DELAY, BLUR, S),
        "lag": _misfit(measured, OF_LAG, BLUR, S),
    }
    return dict(sorted(found.items(), key=lambda pair: pair[1]))


def test_the_rival_whose_replays_have_the_measured_pattern_wins_over_the_one_that_fits_best():
    assert plausible(misfits(MEASURED), S) == ["lag"]


@pytest.mark.parametrize("factor", [0.93, 1.07])
def test_what_replays_do_to_all_scores_alike_hides_no_difference(factor):
    assert plausible(misfits(factor * MEASURED), S) == ["lag"]


def test_a_pattern_between_the_two_tells_neither_from_the_other():
    wide = 0.5 * (OF_DELAY + OF_LAG) + np.linspace(-150.0, 150.0, 4)[:, None] * [1.0, -1.0]
    found = {"delay": _misfit(MEASURED, wide, BLUR, S), "lag": _misfit(MEASURED, wide, BLUR, S)}
    assert plausible(found, S) == ["delay", "lag"]


@pytest.mark.parametrize(("delay", "left"), [(3.8, ["lag", "delay"]), (7.0, ["lag"])])
def test_replays_that_are_not_clearly_against_the_best_score_leave_it_beside_theirs(delay, left):
    found = {"lag": 2.1, "delay": delay}
    assert plausible(found, S) == ["lag"]
    assert plausible(found, S, "delay") == left


def test_where_more_is_missing_no_rival_is_plausible():
    assert plausible(misfits(0.3 * MEASURED), S) == []


@pytest.mark.parametrize(
    ("sag", "best", "open_"),
    [(62.0, "load", ["gear"]), (40.0, "load", ["gear", "sag"]), (62.0, "sag", ["gear", "load"])],
)
def test_where_no_replay_resembles_a_rival_far_from_the_likest_is_out(sag, best, open_):
    """But where the best by score is that far itself, nothing is settled."""
    found = {"gear": 26.0 if sag > 50.0 else 28.0, "load": 30.0, "sag": sag}
    assert sorted(unsettled_rivals(found, best, S)) == open_


def contender(score, without_second, without_trial=None):
    return Contender(
        effect="a", axis="joint", held_out_rmse=1.0, score=score, odds=0.0,
        score_without_second=without_second, score_without_trial=without_trial,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("rival", "close"),
    [((95.0, 10.0), True), ((50.0, 46.0), True), ((50.0, 10.0, 72.0), True), ((50.0, 10.0), False)],
)
def test_a_rival_is_close_by_any_score(rival, close):
    assert comes_close(contender(*rival), contender(100.0, 50.0, 80.0), S) is close


def test_a_score_that_gains_nothing_is_no_measure_of_closeness():
    assert not comes_close(contender(0.0, 0.0), contender(137.0, -311.0), S)


@pytest.mark.parametrize(
    ("hidden", "values", "alike"),
    [
        (
            "force_bias:z",
            {"force_bias.z.bias": 1.0},
            ("force_bias:z", "asymmetric_coulomb:extension"),
        ),
        (
            "return_spring:extension",
            {"return_spring.extension.stiffness": 12.0, "return_spring.extension.offset": 12.6},
            ("force_bias:z", "return_spring:extension", "asymmetric_coulomb:extension"),
        ),
    ],
)
def test_a_spring_of_no_stiffness_is_no_rival_of_a_bias(hidden, values, alike):
    session, recipe = made(bam([hidden]), values, trials=2), bam()
    evidence = fit_trials(session, recipe, system_of(recipe).prior)
    names = ["force_bias:z", "return_spring:extension", "asymmetric_coulomb:extension"]
    scores = {c.name: Scorer(evidence).score(c) for c in candidates_of(recipe, names)}
    found = without_mere_offsets(recipe, evidence, scores, names, S)
    assert found == alike


def test_a_rival_that_leaves_an_error_is_none_where_the_effect_found_leaves_none():
    """A stop takes some of a spring's torque; a direction's friction takes all of a bias's."""
    bias, spring, friction, stop = (
        "force_bias:z", "return_spring:yaw", "asymmetric_coulomb:extension", "upper_stop:yaw"
    )  # fmt: skip
    hidden = {
        "force_bias.z.bias": 1.0,
        "return_spring.yaw.stiffness": 12.0,
        "return_spring.yaw.offset": 3.0,
    }
    session = made(bam([bias, spring]), hidden, trials=2)
    recipe = bam([bias, spring])
    with workers(session, 1) as pool:
        bench = Bench(session, Settings(jobs=1), pool, (friction, stop))
        evidence = bench.fit(recipe, system_of(recipe).prior)
        found = FittedSet(recipe, (bias, spring), evidence, session)
        error = evidence.held_out_rmse
        at_floor, above = (NoiseFloor(level, 0.0 * error, 1) for level in (error, 0.5 * error))

        def behind(name: str, axis: int, rival: str, floor: NoiseFloor) -> frozenset[str]:
            return insufficient_rivals(bench, found, name, axis, [rival], floor)

        assert behind(spring, 0, stop, at_floor) == {stop}
        assert behind(bias, 2, friction, at_floor) == set()
        assert behind(spring, 0, stop, above) == set()


@pytest.mark.parametrize("by_speed", [0.0, 6.0])
def test_what_holds_an_effect_and_more_has_no_odds_beside_it_unless_it_fits_better(by_speed):
    """A bias along an axis is friction that differs by direction, at all speeds alike."""
    bias, friction, spring = (
        "force_bias:z", "asymmetric_coulomb:extension", "return_spring:extension"
    )  # fmt: skip
    hidden = {
        "asymmetric_coulomb.extension.difference": 1.0,
        "asymmetric_coulomb.extension.viscous_difference": by_speed,
    }
    session, recipe = made(bam([friction]), hidden, trials=2), bam([bias])
    with workers(session, 1) as pool:
        bench = Bench(session, Settings(jobs=1), pool, (friction, spring))
        evidence = bench.fit(recipe, system_of(recipe).prior)
        found = FittedSet(recipe, (bias,), evidence, session)
        # A delay has no strength of its own, so that there is nothing for it to contain.
        others = {"upper_stop:extension", "force_delay"}
        idle = idle_extensions(bench, found, bias, 2, {friction, spring, *others})
    assert idle == ({spring} if by_speed else {friction, spring})


def test_a_cable_that_curves_no_more_than_by_chance_is_its_spring(tmp_path):
    spring, cable = "return_spring:joint", "cable_torque:joint"
    session, recipe, _ = record_trials(tmp_path, "joint", 4, spring)
    recipe = replace(recipe, effects=(spring,))
    with workers(session, 1) as pool:
        bench = Bench(session, Settings(jobs=1), pool, (cable,))
        evidence = bench.fit(recipe, system_of(recipe).prior)
        found = FittedSet(recipe, (spring,), evidence, session)
        assert idle_extensions(bench, found, spring, 0, {cable}) == {cable}


def test_an_offset_that_the_model_has_is_no_further_number_of_a_spring(tmp_path):
    """Of a joint with weight and an offset, a spring adds one number and a cable three."""
    joint, recipe, _ = record_trials(tmp_path, "joint", 4, "return_spring:joint")
    evidence = fit_trials(joint, recipe, system_of(recipe).prior)
    names = ("return_spring:joint", "cable_torque:joint", "encoder_scale:joint")
    items = candidates_of(recipe, names)
    scores = [Scorer(evidence).score(item) for item in items]
    new = [count_new_constants(evidence, *pair) for pair in zip(items, scores, strict=True)]
    assert new == [1, 3, 1]
    assert [item.n_constants for item in items] == [2, 4, 1]


@pytest.mark.parametrize(("error", "known"), [(0.02, 0.0), (-0.12, -7.5), (0.12, -7.5)])
def test_how_wrong_counts_are_is_known_of_every_machine_how_strong_a_spring_is_of_none(
    error, known
):
    scale, spring = candidates_of(bam(), ("encoder_scale:yaw", "return_spring:yaw"))
    nothing = np.zeros(3)
    wrong = Score(scale.name, nothing, np.array([error]), nothing, nothing)
    strong = Score(spring.name, nothing, np.array([500.0, 20.0]), nothing, nothing)
    assert log_prior(scale, wrong) == pytest.approx(known)
    assert log_prior(spring, strong) == 0.0


@pytest.mark.parametrize(
    ("scale", "kept"), [(181.0, ["spring"]), (250.0, ["encoder_scale", "spring"])]
)
def test_what_is_hard_to_believe_is_no_rival_of_what_fits_about_as_well(scale, kept):
    totals, known = (
        {"encoder_scale": scale, "spring": 170.0},
        {"encoder_scale": -5.0, "spring": 0.0},
    )
    assert believable(list(totals), totals, known, S) == kept
