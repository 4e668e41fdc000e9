"""Designs, how people follow them, and what they are worth: without a session."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bampipe.estimate.low_pass import Band
from bampipe.next_trial.discrimination import Contest, Rival, Sums
from bampipe.next_trial.motion import Rehearsal, stroke_path
from bampipe.next_trial.precision import Precision
from bampipe.next_trial.primitives import (
    Envelope,
    Primitive,
    Stroke,
    list_primitives,
    vary_surroundings,
)
from bampipe.next_trial.words import describe
from bampipe.physics import registry

SEEN = Envelope(
    low=np.array([-0.7, -0.4, 0.8]),
    high=np.array([0.7, 0.5, 1.4]),
    usual=np.array([0.0, 0.05, 1.1]),
    speed=np.array([2.5, 1.6, 0.9]),
    acceleration=np.array([12.0, 9.0, 4.0]),
    field=np.array([40.0, 40.0, 40.0]),
    levels={},
)


def every_design() -> list[Primitive]:
    first = list_primitives(SEEN, 20.0, [0, 1, 2], with_rests=True)
    return [*first, *(other for one in first for other in vary_surroundings(SEEN, one))]


def test_no_design_leaves_what_the_trials_have_shown():
    designs = every_design()
    assert len(designs) > 100
    for design in designs:
        for axis, stroke in design.strokes.items():
            assert SEEN.low[axis] <= stroke.low < stroke.high <= SEEN.high[axis]
            assert 0.0 < stroke.slow <= stroke.fast <= SEEN.speed[axis]
            hardest = 5.7735 * stroke.fast**2 / 1.875**2 / (stroke.high - stroke.low)
            assert hardest <= SEEN.acceleration[axis]
        assert 0.0 <= design.field <= 1.0


def test_no_axis_rests_unless_the_design_says_so():
    for design in list_primitives(SEEN, 20.0, [0, 1, 2], with_rests=False):
        assert set(design.strokes) == {0, 1, 2}
        assert all(stroke.rest_s == 0.0 for stroke in design.strokes.values())


def test_a_path_has_the_velocity_and_acceleration_that_it_says():
    t = np.arange(20000) / 1000.0
    stroke = Stroke(-0.4, 0.3, 0.1, 0.9, rest_s=0.5)
    q, qd, qdd = stroke_path(stroke, t, np.random.default_rng(0), 0.1)
    assert q.min() >= -0.4
    assert q.max() <= 0.3
    assert np.abs(qd).max() <= 0.9 * (1.0 + 1e-9)
    np.testing.assert_allclose(np.gradient(q, t)[1:-1], qd[1:-1], atol=2e-3)
    assert np.abs(np.gradient(qd, t) - qdd)[1:-1].mean() < 0.02 * np.abs(qdd).mean()


def test_a_robot_gets_a_trajectory_within_what_has_been_seen_that_starts_at_rest():
    system = SimpleNamespace(coordinates=("a", "b", "c"))
    rehearsal = Rehearsal(system, np.zeros(0), None, None, SEEN, 0)
    for design in list_primitives(SEEN, 20.0, [0], with_rests=False)[:8]:
        t, q = rehearsal.trajectory(design)
        assert q.shape == (2000, 3)
        assert np.all(q >= SEEN.low - 1e-9)
        assert np.all(q <= SEEN.high + 1e-9)
        speed = np.abs(np.gradient(q, t, axis=0))
        assert np.all(speed[0] < 0.05 * SEEN.speed)
        assert np.all(speed.max(axis=0) <= SEEN.speed)


def test_a_sentence_says_where_how_fast_and_how_long():
    design = list_primitives(SEEN, 20.0, [0], with_rests=False)[6]
    said = describe(design, SEEN, registry.device("bam"))
    assert said.startswith("Move yaw slowly back and forth between")
    stroke = design.strokes[0]
    assert f"{np.degrees(stroke.high):.0f}°" in said
    assert f"to {stroke.high:.2f} rad)" in said
    assert "-" not in said.replace("back and forth", "")
    assert "for 20 s" in said
    assert "keep pitch and extension moving gently" in said
    assert " mm" in said


def made_precision(sd: float, formal: float, blocks: int) -> Precision:
    information = np.diag([1.0 / formal**2, 1.0])
    return Precision(
        ("mass",), np.array([sd]), np.array([formal]), np.zeros(1), blocks, information, lambda m: m
    )


def test_twice_the_information_narrows_an_uncertainty_by_the_root_of_two():
    known = made_precision(0.01, 0.01, 10_000)
    after = known.sd_with(known.information, 20.0)
    assert after[0] == pytest.approx(0.01 / np.sqrt(2.0), rel=1e-3)
    assert known.gain(known.information) == pytest.approx(0.5 * np.log(2.0))


def test_what_few_blocks_widen_goes_with_more_of_them():
    few = made_precision(0.01 * np.sqrt(6 / 4), 0.01, 6)
    nothing = np.zeros((2, 2))
    assert few.sd_with(nothing, 0.0)[0] < few.sd[0]
    assert few.sd_with(nothing, 1000.0)[0] == pytest.approx(0.01, rel=0.02)


def contest_of(odds: list[float], floor: float = 1.0) -> Contest:
    rivals = tuple(Rival(None, np.zeros(0), share) for share in odds)
    return Contest(None, np.zeros(0), rivals, Band(100.0, (8.0,)), np.array([floor]))


def test_pairs_weigh_by_the_product_of_their_odds():
    weights = contest_of([0.6, 0.3, 0.1]).weights()
    assert weights[0, 1] == pytest.approx(0.18 / 0.27)
    assert sum(weights.values()) == pytest.approx(1.0)


def test_confusion_falls_with_what_the_wrong_one_leaves():
    contest = contest_of([0.5, 0.5])
    sums = Sums(np.zeros((1, 1, 1)), np.array([1000.0]))
    nothing, chances = np.array([2000.0]), []
    for left in (0.0, 10.0, 100.0, 1000.0):
        distance, chance = contest._compare(sums, nothing, np.array([left]))
        assert distance == pytest.approx(
            0.5 * 1000.0 * contest.band.independent_share[0] * np.log1p(left / 1000.0)
        )
        chances.append(chance)
    assert chances[0] == 0.5
    assert chances == sorted(chances, reverse=True)
    assert chances[-1] < 0.01
