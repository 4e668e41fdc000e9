"""Designs, how people follow them, and what they are worth: without a session."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bampipe.next_trial.design_sentence import describe_design
from bampipe.next_trial.discrimination import Alternative, Comparison, chance_of_confusion
from bampipe.next_trial.forecast import Forecast
from bampipe.next_trial.plan import Goal, _find_shortest, choose_trials
from bampipe.next_trial.precision import Precision
from bampipe.next_trial.primitives import (
    Envelope,
    Primitive,
    Stroke,
    find_beyond,
    imitate_trials,
    list_primitives,
    vary_surroundings,
)
from bampipe.next_trial.ranking import DesignSpace, RankedDesign, find_best_of_each, rank_designs
from bampipe.next_trial.rehearsal import HASTY, Rehearsal, example_path, follow_roughly, stroke_path
from bampipe.phrases.forecast_outcome import compare_forecast, read_forecasts
from bampipe.phrases.proposal import explain_proposal, find_shown
from bampipe.physics import Model, compile_model, registry
from bampipe.results.next import Detectable, ExpectedConfusion, ExpectedSd, NextResult, Proposal
from bampipe.trials.motion import Motion

SEEN = Envelope(
    low=np.array([-0.7, -0.4, 0.8]),
    high=np.array([0.7, 0.5, 1.4]),
    usual=np.array([0.0, 0.05, 1.1]),
    speed=np.array([2.5, 1.6, 0.9]),
    acceleration=np.array([12.0, 9.0, 4.0]),
    field=np.array([40.0, 40.0, 40.0]),
    levels={},
)
LIMITS = np.array([[-2.0, 2.0], [-1.2, 1.2], [0.75, 1.45]])
TIMID = replace(
    SEEN,
    low=np.array([0.1, 0.0, 0.8]),
    high=np.array([0.4, 0.2, 1.4]),
    usual=np.array([0.25, 0.05, 1.1]),
)


def every_design(seen: Envelope) -> list[Primitive]:
    first = list_primitives(seen, 20.0, [0, 1, 2], with_rests=True)
    return [*first, *(other for one in first for other in vary_surroundings(seen, one))]


def test_where_the_device_states_nothing_no_design_leaves_what_the_trials_have_shown():
    assert SEEN.widen(np.tile([-np.inf, np.inf], (3, 1)), np.full(3, np.nan)) is SEEN
    designs = every_design(SEEN)
    assert len(designs) > 100
    for design in designs:
        for axis, stroke in design.strokes.items():
            assert SEEN.low[axis] <= stroke.low < stroke.high <= SEEN.high[axis]
            assert 0.0 < stroke.slow <= stroke.fast <= SEEN.speed[axis]
            hardest = 5.7735 * stroke.fast**2 / 1.875**2 / (stroke.high - stroke.low)
            assert hardest <= SEEN.acceleration[axis]
        assert 0.0 <= design.field <= 1.0


def test_designs_go_beyond_as_far_as_the_device_allows_and_no_farther():
    speeds = np.array([20.0, 1.0, np.nan])
    seen = TIMID.widen(LIMITS, speeds)
    designs = every_design(seen)
    fastest = np.zeros(3)
    for design in designs:
        for axis, stroke in design.strokes.items():
            low, high = LIMITS[axis]
            margin = 0.05 * (high - low) - 1e-9
            assert min(low + margin, seen.low[axis]) <= stroke.low < stroke.high
            assert stroke.high <= max(high - margin, seen.high[axis])
            hardest = 5.7735 * stroke.fast**2 / 1.875**2 / (stroke.high - stroke.low)
            assert hardest <= 1.001 * seen.acceleration[axis]
            fastest[axis] = max(fastest[axis], stroke.fast)
        farther, faster = find_beyond(design, seen)
        # An axis whose range is nearly seen, and whose speed nobody states, stays as it was.
        assert 2 not in (*farther, *faster)
    # Twice what was seen of yaw; half of what is stated of pitch is less than was seen of it.
    assert seen.speed[0] < fastest[0] <= 2.0 * seen.speed[0]
    assert fastest[1] == pytest.approx(0.6 * seen.speed[1])
    assert fastest[2] == pytest.approx(0.6 * seen.speed[2])
    inside = list_primitives(TIMID, 20.0, [0, 1, 2], with_rests=True)
    assert list_primitives(seen, 20.0, [0, 1, 2], with_rests=True)[: len(inside)] == inside


@pytest.mark.parametrize(("pays", "first_is_beyond"), [(1.5, True), (1.02, False)])
def test_going_beyond_what_has_been_seen_has_to_pay(pays, first_is_beyond):
    seen = TIMID.widen(LIMITS, np.full(3, 20.0))

    def worth(recorded: tuple[Primitive, int]) -> float:
        return pays if any(find_beyond(recorded[0], seen)) else 1.0

    space = DesignSpace(made_rehearsal(seen), 20.0, [0, 1, 2], with_rests=True, with_brakes=True)
    ranked = rank_designs(space, worth)
    are_beyond = [any(find_beyond(one.design, seen)) for one in ranked]
    assert are_beyond[0] is first_is_beyond
    # Who does not want to go there finds another one.
    assert not all(are_beyond)
    assert next(one.utility for one in ranked if any(find_beyond(one.design, seen))) == pays


def made_rehearsal(seen: Envelope) -> SimpleNamespace:
    return SimpleNamespace(
        seen=seen,
        sensors=SimpleNamespace(rate_hz=10.0),
        system=SimpleNamespace(parameters=("mass",)),
        record=lambda design, version: (design, version),
    )


def test_what_is_worth_little_to_somebody_hasty_does_not_win():
    def worth(recorded: tuple[Primitive, int]) -> float:
        design, version = recorded
        wide = design.strokes[0].high > 0.6
        exact = 1.0 + 0.01 * design.seconds
        return (3.0 * exact if version != HASTY else 0.0) if wide else exact

    ranked = rank_designs(DesignSpace(made_rehearsal(SEEN), 20.0, [0], with_brakes=True), worth)
    assert ranked[0].design.strokes[0].high <= 0.6
    assert ranked[0].utility == pytest.approx(1.2)


def test_each_parameter_gets_the_design_that_is_best_for_it():
    recorded = []

    def inform(one: tuple[Primitive, int]) -> np.ndarray:
        recorded.append(one)
        return np.array([[float(one[0].strokes[0].fast)], [-float(one[0].strokes[0].fast)]])

    fast, slow = find_best_of_each(
        DesignSpace(made_rehearsal(SEEN), 20.0, [0]), inform, [lambda v: v[0, 0], lambda v: v[1, 0]]
    )
    assert fast.design.strokes[0].fast == pytest.approx(0.6 * SEEN.speed[0])
    assert slow.design.strokes[0].fast < 0.1 * SEEN.speed[0]
    designs = list_primitives(SEEN, 20.0, [0], with_rests=False)
    assert len(recorded) == len(designs) + 20  # two of each are followed by five people


def test_what_leaves_what_has_been_seen_is_recorded_in_two_trials():
    seen = TIMID.widen(LIMITS, np.full(3, 20.0))
    beyond = [design for design in every_design(seen) if any(find_beyond(design, seen))]
    assert {design.parts for design in beyond} == {2}
    for design in list_primitives(seen, 20.0, [0], with_rests=False):
        stroke = design.strokes[0]
        # Each of them has room for three strokes.
        longest = 1.875 * (stroke.high - stroke.low) / np.sqrt(stroke.slow * stroke.fast)
        assert design.parts == 1 or 3.0 * longest < 1.01 * design.part_s
    said = describe_design(beyond[0], seen, registry.device("bam"))
    assert ", for 20 s in 2 trials of 10 s; " in said
    assert all(d.parts == 1 for d in every_design(seen) if not any(find_beyond(d, seen)))
    assert all(d.parts == 1 for d in list_primitives(seen, 6.0, [0], with_rests=False))


def made_motion(name: str, rate: float) -> Motion:
    t = np.arange(12000) / 1000.0
    w = rate * np.array([1.0, 1.3, 0.0])
    q = SEEN.usual + 0.2 * np.sin(w * t[:, None])
    qd, qdd = 0.2 * w * np.cos(w * t[:, None]), -0.2 * w**2 * np.sin(w * t[:, None])
    return Motion(name, t, q, qd, qdd, np.zeros_like(q), {})


def test_a_trial_that_is_imitated_goes_on_smoothly_and_stays_where_it_was():
    seen = [made_motion("t02@0.0s", 1.0), made_motion("t01", 2.0)]
    first, second = imitate_trials(seen, SEEN, 30.0)
    assert [first.example.trial, second.example.trial] == ["t01", "t02"]
    t = np.arange(30000) / 1000.0
    q, qd, qdd = example_path(first.example, t)
    np.testing.assert_allclose(q[:10000], first.example.motion.q[:10000], atol=1e-9)
    # Its end is far from its beginning: were they joined, it would be faster than the trial.
    assert np.all(np.abs(qd).max(axis=0) <= np.abs(first.example.motion.qd).max(axis=0) + 1e-9)
    np.testing.assert_allclose(np.gradient(q, t, axis=0)[1:-1], qd[1:-1], atol=2e-3)
    np.testing.assert_allclose(np.gradient(qd, t, axis=0)[1:-1], qdd[1:-1], atol=2e-2)
    assert np.all(np.abs(q - SEEN.usual) <= 0.2 + 1e-9)
    hasty = follow_roughly(first, SEEN, np.random.default_rng(0), True)
    q, qd, _ = example_path(hasty.example, t)
    assert np.ptp(q[:, 0]) == pytest.approx(0.2, rel=0.02)
    assert np.abs(qd[1000:2500, 0]).max() == pytest.approx(0.8, rel=0.01)
    said = describe_design(first, SEEN, registry.device("bam"))
    assert said == (
        "Move yaw and pitch as in trial t01, yaw between −11° and 11° (−0.20 to 0.20 rad) at up to"
        " 23°/s, pitch between −9° and 14° (−0.15 to 0.25 rad) at up to 30°/s, over and over for"
        " 30 s."
    )


def test_who_follows_roughly_stays_within_the_device_too():
    system = SimpleNamespace(coordinates=("a", "b", "c"))
    seen = TIMID.widen(LIMITS, np.full(3, np.nan))
    rehearsal = Rehearsal(system, np.zeros(0), None, None, seen, 0)
    for design in list_primitives(seen, 20.0, [0], with_rests=False)[-8:]:
        for version in range(1, 9):
            followed = follow_roughly(design, rehearsal.seen, np.random.default_rng(version), False)
            for axis, stroke in followed.strokes.items():
                low, high = seen.wider.low[axis], seen.wider.high[axis]
                assert low <= stroke.low < stroke.high <= high


def test_a_hand_moves_no_faster_than_hands_do():
    system = compile_model(Model(registry.device("bam")))
    t = np.arange(500) / 100.0
    slow = 0.1 * np.sin(t)
    q = np.column_stack([slow, slow, 1.0 + slow])
    qd = np.column_stack([0.3 * np.cos(t), 3.0 * np.cos(t), 0.1 * np.cos(t)])
    channels = {"t": t} | {
        name: np.zeros(t.size)
        for name in system.inputs
        if name != "t" and name not in system.coordinates
    }
    motion = Motion("t01", t, q, qd, np.ones_like(q), np.zeros_like(q), channels)
    seen = Envelope.of_trials([motion], system, system.prior)
    highest = 0.6 * seen.wider.speed
    # At the end of a rod of 1.1 m, half a metre a second.
    assert highest[0] == pytest.approx(0.5 / 1.1, rel=0.02)
    # Twice what was seen, where that is less; and what was seen, where that is more.
    assert highest[2] == pytest.approx(0.2, rel=0.01)
    assert seen.wider.speed[1] == seen.speed[1]


@pytest.mark.parametrize("axes", [[0], [0, 1, 2]])
def test_no_design_is_tried_twice(axes):
    for seen in (SEEN, SEEN.widen(LIMITS, np.full(3, 3.0))):
        listed = list_primitives(seen, 20.0, axes, with_rests=True)
        said = [
            (design.parts, [(axis, f"{stroke}") for axis, stroke in design.strokes.items()])
            for design in listed
        ]
        assert all(one not in said[:k] for k, one in enumerate(said))
    one = replace(SEEN, **{name: getattr(SEEN, name)[:1] for name in (
        "low", "high", "usual", "speed", "acceleration", "field")})  # fmt: skip
    slow = [d for d in list_primitives(one, 20.0, [0], True) if d.strokes[0].fast < 0.3]
    # All of the range, its middle and a few per cent of it are the same strokes at that speed.
    assert len({round(d.strokes[0].low + d.strokes[0].high, 6) for d in slow}) == len(slow)


def test_a_path_has_the_velocity_and_acceleration_that_it_says():
    t = np.arange(20000) / 1000.0
    stroke = Stroke(-0.4, 0.3, 0.1, 0.9, rest_s=0.5)
    q, qd, qdd = stroke_path(stroke, t, np.random.default_rng(0), 0.1)
    assert q.min() >= -0.4
    assert q.max() <= 0.3
    assert np.abs(qd).max() <= 0.9 * (1.0 + 1e-9)
    np.testing.assert_allclose(np.gradient(q, t)[1:-1], qd[1:-1], atol=2e-3)
    assert np.abs(np.gradient(qd, t) - qdd)[1:-1].mean() < 0.02 * np.abs(qdd).mean()


def test_a_sentence_says_what_goes_beyond_the_trials_at_hand():
    device, seen = registry.device("bam"), TIMID.widen(LIMITS, np.full(3, 20.0))
    far, fast = Stroke(-1.0, 1.0, 0.5, 1.0), Stroke(0.1, 0.4, 3.0, 4.0)
    gentle = {1: Stroke(0.05, 0.1, 0.1, 0.2, gentle=True), 2: Stroke(0.9, 1.0, 0.1, 0.2)}
    for stroke, ending in (
        (far, "; this takes yaw farther than so far: try the way slowly first."),
        (fast, "; this takes yaw faster than so far."),
        (replace(far, fast=4.0), "; this takes yaw farther and faster than so far: try the way"),
    ):
        design = Primitive({0: stroke, **gentle}, seen.usual, 20.0)
        assert ending in describe_design(design, seen, device)
    both = Primitive({0: fast, 1: Stroke(-0.9, -0.5, 0.1, 0.2, gentle=True)}, seen.usual, 20.0)
    said = describe_design(both, seen, device)
    assert "this takes pitch farther and yaw faster than so far: try the way slowly first" in said
    assert re.search(r"keep pitch moving gently, −40° ± 11° in [0-9.]+ s each way", said)
    near = list_primitives(TIMID, 20.0, [0], with_rests=False)[6]
    assert "than so far" not in describe_design(near, seen, device)


def made_proposal(after: float) -> Proposal:
    pair = ExpectedConfusion(
        between=("force_gain:x", "base_tilt"), weight=1.0, before=0.4, after=after,
        left={"yaw": 1.0},
    )  # fmt: skip
    return Proposal(
        sentence="Move yaw.", seconds=20.0, moves={}, pose={}, worth=-after, information_gain=0.0,
        confusion=(pair,),
    )  # fmt: skip


WIDE = ExpectedSd(before=0.05, after=0.005, low=0.002, high=0.01, unit="kg")
SHARP = ExpectedSd(before=0.05, after=0.005, low=0.0045, high=0.006, unit="kg")


def made_result(best: Proposal, purpose: str = "precision", **more) -> NextResult:
    return NextResult(
        model="base", purpose=purpose, trials=("t1",), sentence=best.sentence, why="", expected="",
        proposals=(best,), **more,
    )  # fmt: skip


def explain(purpose, best, table=(), lacking=(), missing=(), unbraked=(), unpromised=()):
    """Why the best proposal is made, and what it is expected to give."""
    found = made_result(best, purpose, sensitivity=dict(table), unpromised=unpromised)
    return explain_proposal(found, (), lacking, missing, unbraked)


def detectable(name: str, smallest: float | None, then: float | None = None) -> Detectable:
    return Detectable(
        parameter=name, smallest=smallest, typical=1.0, unit="N", axis="x", with_proposal=then
    )


def test_a_forecast_in_the_terms_of_another_version_does_not_stop_a_new_proposal(tmp_path):
    found = made_result(made_proposal(0.1).model_copy(update={"sd": {"mass": WIDE}}))
    path = tmp_path / NextResult.file("base")
    found.write(tmp_path)
    assert read_forecasts(tmp_path, "base") == (found,)
    path.write_text(path.read_text().replace('"low"', '"after_at_worst"'))
    assert read_forecasts(tmp_path, "base") == ()


def test_what_a_model_lacks_is_said_to_count_as_noise():
    best = made_proposal(0.1).model_copy(update={"sd": {"mass": WIDE, "moment": SHARP}})
    _, said = explain("precision", best)
    assert said == (
        "Expected: `mass` ± 0.002 to 0.01 kg, now ± 0.05; `moment` ± 0.005 kg, now ± 0.05"
        " (eight cases in ten)."
    )
    _, said = explain("precision", best, lacking=("yaw", "pitch"))
    assert "The error of yaw and pitch is above the noise floor" in said
    # What the diagnosis found comes before any trial; where effects compete, nothing need be said.
    why, said = explain("precision", best, lacking=("yaw",), missing=["lag:x"])
    assert why.startswith("According to the diagnosis, the model lacks lag:x. Ext")
    assert said.endswith("of a model that lacks something.") and "noise floor" not in said
    why, _ = explain("precision", best, lacking=("yaw",), missing=None)
    assert why.startswith("The error of yaw is above the noise floor: find the missing effect")
    assert "noise floor" not in explain("decision", made_proposal(0.01), lacking=("yaw",))[1]


def test_effects_of_brakes_are_said_to_need_viscous_trials():
    best = made_proposal(0.1)
    table = {"brake_lag": detectable("brake_lag.time_constant", None)}
    why, _ = explain("sensitivity", best, table, unbraked=["brake_lag"])
    assert "every other effect of the library at its typical size. Effects of brakes" in why
    assert "(brake_lag) show in viscous trials only, and there are none" in why
    assert "invisible" not in why and "No size" not in why
    why, _ = explain("sensitivity", best, unpromised=["stribeck:yaw"])
    assert "of the library at its typical size. No size is given for stri" in why
    braked = best.model_copy(update={"brakes": 1.0})
    why, _ = explain("sensitivity", braked, table)
    assert why.endswith("Add it to session.toml as a viscous trial.")


def test_what_the_trial_would_show_is_named_first():
    table = {f"far:{k}": detectable("p", 50.0 + k, 50.0 + k) for k in range(3)}
    table["drag:x"] = detectable("p", 3.0, 1.0)
    why, expected = explain("sensitivity", made_proposal(0.1), table)
    assert why.startswith("These trials would not have shown drag:x below 3 N, far:2")
    assert expected.startswith("It would show drag:x from 1 N on")


def made_precision(sd: float, formal: float, blocks: int, lasting: float = 0.0) -> Precision:
    information = np.diag([1.0 / formal**2, 1.0])
    return Precision(
        ("mass",), np.array([sd]), np.array([formal]), np.array([lasting]),
        blocks, information, np.zeros(2), lambda m: m,
    )  # fmt: skip


def test_information_narrows_an_uncertainty_by_its_root_and_blocks_widen_it():
    known = made_precision(0.01, 0.01, 10_000)
    after = known.expect(known.information, 20.0).median
    assert after[0] == pytest.approx(0.01 / np.sqrt(2.0), rel=1e-3)
    assert known.gain(known.information) == pytest.approx(0.5 * np.log(2.0))
    # For one parameter, trials are worth the fall of the logarithm of its uncertainty.
    much = 3.0 * known.information
    assert known.utility(much, 20.0, "mass") == pytest.approx(np.log(2.0), rel=1e-3)
    assert known.utility(much, 20.0) == known.gain(much)
    few = made_precision(0.01 * np.sqrt(6 / 4), 0.01, 6)
    nothing = np.zeros((2, 2))
    assert few.expect(nothing, 0.0).median[0] < few.sd[0]
    assert few.expect(nothing, 1000.0).median[0] == pytest.approx(0.01, rel=0.02)
    known = made_precision(np.hypot(0.01, 0.02), 0.01, 10_000, 0.02)
    nothing, much = np.zeros((2, 2)), 1e6 * known.information
    assert known.expect(nothing, 0.0).median[0] == pytest.approx(known.sd[0], rel=1e-3)
    assert known.expect(much, 20.0).median[0] == pytest.approx(0.02, rel=1e-3)
    threefold = known.expect(3.0 * known.information, 20.0)
    assert threefold.median[0] ** 2 == pytest.approx(0.01**2 / 4.0 + 0.02**2, rel=1e-3)


def test_a_forecast_is_a_number_after_many_blocks_and_a_range_after_few():
    much = np.diag([1e6, 0.0])
    for blocks, is_sharp in ((5000, True), (24, False)):
        known = made_precision(0.01, 0.01, blocks)
        found = known.expect(much / blocks, 16.0 if blocks < 100 else 1e4)
        forecast = ExpectedSd(
            before=0.01, after=found.median[0], low=found.low[0], high=found.high[0], unit="kg"
        )
        assert forecast.is_sharp == is_sharp
        assert (" to " in forecast.number) != is_sharp


def test_what_is_known_beforehand_does_not_grow_with_the_scatter_of_the_trials():
    # Of two parameters one is known from trials that scatter ten times as much as they believe.
    trials, weighed = np.diag([1e4, 1e-6]), np.array([0.0, 4.0])
    information = trials + np.diag(weighed)
    known = Precision(
        ("coulomb", "mass"), np.array([0.1, 0.5]), 1.0 / np.sqrt(np.diag(information)),
        np.zeros(2), 30, information, weighed, lambda m: m,
    )  # fmt: skip
    found = known.expect(trials, 60.0)
    assert found.median == pytest.approx([0.1 / np.sqrt(2.0), 0.5], rel=0.05)
    assert found.high[1] < 0.6


def test_a_plan_is_not_stalled_by_an_uncertainty_that_was_small_by_luck():
    # Trials would hardly give 0.01 of the others again: they share the scatter of the first.
    names, information = ("a", "b", "c", "d", "e"), 1e4 * np.eye(5)
    sd = np.array([0.1, 0.01, 0.01, 0.01, 0.01])
    known = Precision(
        names, sd, np.full(5, 0.01), np.zeros(5), 8, information, np.zeros(5),
        lambda m: m,
    )  # fmt: skip
    design = Primitive({0: Stroke(-0.5, 0.5, 1.0, 1.0)}, np.zeros(1), 20.0)
    forecast = SimpleNamespace(
        precision=known, comparison=None, added_by=lambda ranked: list(ranked.expected_motions)
    )
    ranked = RankedDesign(design, 1.0, (information, information))
    goal = Goal(np.array([0.2, 0.004, 0.004, 0.004, 0.004]), 0.05)
    chosen, is_full = choose_trials(forecast, [ranked], goal)
    assert chosen and not is_full
    # What is reached as published needs no trial.
    assert choose_trials(forecast, [ranked], Goal(2.0 * sd, 0.05)) == ([], False)


def test_a_trial_that_is_not_fitted_adds_nothing_on_the_parameters():
    known = made_precision(0.01, 0.01, 50)
    for is_braked, added in ((True, 1e4), (False, 0.0)):
        rehearsal = SimpleNamespace(system=SimpleNamespace(braked=is_braked))
        forecast = Forecast(rehearsal, known)
        design = Primitive({}, np.zeros(1), 20.0, field=0.5)
        found = forecast.added_by(RankedDesign(design, 1.0, (known.information, known.information)))
        assert found[0][0, 0] == pytest.approx(added)


def test_a_planned_trial_is_shortened_no_further_than_its_strokes_allow():
    quick = Stroke(-0.5, 0.5, 2.0, 2.0)
    slow = replace(quick, slow=0.5, fast=0.5)
    one = Primitive({0: quick}, np.zeros(1), 20.0)
    assert _find_shortest(one) == 5.0
    assert _find_shortest(replace(one, strokes={0: slow})) == pytest.approx(3 * 1.875 / 0.5)
    assert _find_shortest(replace(one, parts=2)) == 10.0
    # Of a trial of 12 s, what is shorter does not cover what it covers.
    (like,) = imitate_trials([made_motion("t01", 2.0)], SEEN, 20.0)
    assert _find_shortest(like) == pytest.approx(12.0, abs=0.01)
    assert _find_shortest(replace(like, seconds=8.0)) == 8.0


@pytest.mark.parametrize(
    ("came", "said"),
    [
        (0.004, "within the forecast range."),
        (0.001, "less than forecast."),
        (0.02, "more than forecast."),
    ],
)
def test_what_came_is_held_against_a_range(came, said):
    proposed = made_result(made_proposal(0.1).model_copy(update={"sd": {"mass": WIDE}}))
    identified = SimpleNamespace(trials=("t1", "t2"), parameters={"mass": SimpleNamespace(sd=came)})
    line = compare_forecast(proposed, identified, None)[0]
    assert line.startswith("`mass`: ± 0.002 to 0.01 kg was forecast with trial t2, ± 0.0")
    assert line.endswith(said)


@pytest.mark.parametrize(
    ("weighed", "selected", "said"),
    [
        (("t1",), ("drag:x",), "`bampipe diagnose RUN` tells whether it is there."),
        (("t1", "t2", "t3"), ("drag:x",), "it is there."),
        (("t1", "t2", "t3"), (), "the diagnosis does not find it, so that it is hardly larger."),
    ],
)
def test_what_a_trial_was_to_show_is_held_against_the_diagnosis_that_knows_it(
    weighed, selected, said
):
    best = made_proposal(0.1).model_copy(update={"sd": {"mass": SHARP}, "confusion": ()})
    table = {"drag:x": detectable("drag.x.size", 5.0, 0.9)}
    proposed = made_result(best, "sensitivity", sensitivity=table, shows=find_shown(table))
    mass = SimpleNamespace(sd=0.005)
    identified = SimpleNamespace(trials=("t1", "t2", "t3"), parameters={"mass": mass})
    diagnosed = SimpleNamespace(trials=weighed, selected=selected, axes={})
    first, second = compare_forecast(proposed, identified, diagnosed)
    assert "was forecast with trials t2 and t3, ± 0.005 resulted" in first
    assert second == f"it was to reveal drag:x from 0.9 N on; {said}"


def test_confusion_is_that_of_a_choice_by_the_odds_that_further_trials_leave():
    alternatives = tuple(Alternative((), (), share) for share in (0.6, 0.3, 0.1))
    weights = Comparison(None, None, None, alternatives).weights()
    assert weights[0, 1] == pytest.approx(0.18 / 0.27)
    assert sum(weights.values()) == pytest.approx(1.0)
    assert chance_of_confusion(0.6, 0.2, 0.0) == pytest.approx(0.25)
    rng, gained = np.random.default_rng(0), 2.0
    scatter = rng.normal(gained, np.sqrt(2.0 * gained), 200_000)
    # Wrong where the ratio by the trials falls short of what was believed beforehand.
    wrong = 0.75 * np.mean(scatter < -np.log(3.0)) + 0.25 * np.mean(scatter < np.log(3.0))
    assert chance_of_confusion(0.6, 0.2, gained) == pytest.approx(wrong, abs=0.003)
    chances = [chance_of_confusion(0.2, 0.6, nats) for nats in (0.1, 1.0, 10.0, 30.0)]
    assert chances == sorted(chances, reverse=True)
    assert chances[-1] < 1e-3


@pytest.mark.parametrize(
    ("selected", "undecided", "said"),
    [
        (("a:x", "b:x"), (), "it is a:x + b:x"),
        (("a:x",), (), "it is a:x"),
        ((), (), "neither is found"),
        (("a:x", "b:x"), ("a:x", "b:x"), "still do not distinguish them"),
    ],
)
def test_sets_that_were_to_be_told_apart_are_held_against_the_diagnosis(selected, undecided, said):
    pair = made_proposal(0.02).confusion[0].model_copy(update={"between": ("a:x", "a:x + b:x")})
    best = made_proposal(0.02).model_copy(update={"confusion": (pair,)})
    proposed = made_result(best, "decision")
    identified = SimpleNamespace(trials=("t1", "t2"), parameters={})
    axis = SimpleNamespace(verdict="undecided", probabilities=dict.fromkeys(undecided, 0.5))
    diagnosed = SimpleNamespace(trials=("t2",), selected=selected, axes={"x": axis})
    (line,) = compare_forecast(proposed, identified, diagnosed)
    assert line.startswith("a:x or a:x + b:x: the forecast chance of confusion was 2 %; ")
    assert line.endswith(f"{said}.")
