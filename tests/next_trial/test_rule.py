"""Next and its table judge as the diagnosis does: by its search, its record and its criteria."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis.sessions import TRUTH, bam, made

from bampipe.diagnosis.criteria import Criteria, cap_probability
from bampipe.diagnosis.dictionary import Dictionary, Key
from bampipe.diagnosis.probability import compute_p_value, find_required_gain
from bampipe.diagnosis.ranges import MachineScale
from bampipe.diagnosis.search import Search
from bampipe.diagnosis.select import make_columns
from bampipe.diagnosis.session import Fit, Session, candidates_of, system_of
from bampipe.diagnosis.set_cost import log_prior
from bampipe.next_trial.sensitivity import find_detectability
from bampipe.next_trial.suggestion import compare_alternatives, find_ambiguity, suggest_trial
from bampipe.trials.folds import Folds
from bampipe.trials.linear_problem import pose_problem
from bampipe.trials.measured import MeasuredTrials

NAMES = ("quadratic_drag:yaw", "return_spring:pitch", "force_bias:z", "shear_thinning:yaw")
CRITERIA = Criteria()


@pytest.fixture(scope="module")
def session() -> Session:
    return Session(made(bam(), {}, trials=3, seconds=6.0), CRITERIA)


@pytest.fixture(scope="module")
def fit(session) -> Fit:
    return session.fit(bam(), np.array(list(TRUTH.values())))


def search_beside(fit: Fit, residual, known: Search | None = None) -> Search:
    """The search of a diagnosis over `NAMES` alone, on a residual in place of the measured one."""
    candidates = {item.name: item for item in candidates_of(fit.spec, NAMES)}
    scale = MachineScale.of_trials(fit.linearisation)
    dictionary = Dictionary(fit.linearisation, fit.likelihood.samples, candidates, scale)
    y = tuple(r * root for r, root in zip(residual, fit.likelihood.root, strict=True))
    problem = replace(pose_problem(fit.likelihood, fit.linearisation), y=y)
    atoms = known.atoms if known is not None else {}
    return Search(
        problem, dictionary, partial(make_columns, dictionary=dictionary), CRITERIA, atoms
    )


def key_of(dictionary: Dictionary, name: str, values) -> Key:
    """The key of a candidate whose shapes are nearest to given values."""
    item, shape = dictionary.candidates[name], []
    shares = np.linspace(0.0, 1.0, 401)
    for limits, place in zip(dictionary.ranges[name], item.searched_indices, strict=True):
        at = np.array([limits.value_at(limits.interpolate(share)) for share in shares])
        shape.append(float(shares[np.argmin(np.abs(at - values[place]))]))
    return name, tuple(shape)


def test_the_search_finds_an_effect_at_the_smallest_strength_and_not_at_half_of_it(
    session, fit, monkeypatch
):
    """Every effect of the library at one of its targets: on other axes it is the same."""
    every = session.candidate_names(fit.spec)
    once = {name.partition(":")[0]: name for name in reversed(every)}
    weighed = tuple(name for name in every if name in (*NAMES, *once.values()))
    monkeypatch.setattr(Session, "candidate_names", lambda *_: weighed)
    detectability = find_detectability(session, fit)
    found = {one.alternative.name: one for one in detectability.limits}
    assert detectability.needed == find_required_gain(CRITERIA, ()) - log_prior(
        CRITERIA, len(weighed)
    )
    noise, scale = fit.likelihood.noise, detectability.comparison.scale
    plain = search_beside(fit, noise.bias)
    # Of the whole library each is less probable beforehand than of these few.
    enough = detectability.needed + plain.log_prior
    for name in NAMES:
        one = found[name]
        values = one.alternative.values[0]
        key = key_of(plain.dictionary, name, values)
        plain.ensure([key])
        atom = plain.atoms[key]
        strength = values[list(one.item.linear_indices)] * one.factor
        shares = []
        for share in (0.5, 1.3):
            is_found = []
            for replicate in range(CRITERIA.replicates):
                residual = [
                    bias
                    + np.sqrt(scale[axis]) * (noise.residuals[axis][replicate] - bias)
                    - share * (atom.columns[axis] @ strength if axis in atom.columns else 0.0)
                    for axis, bias in enumerate(noise.bias)
                ]
                search = search_beside(fit, residual, plain)
                is_found.append(search.cost(()) - search.cost((key,)) > enough)
            shares.append(np.mean(is_found))
        assert shares[0] <= 0.1, name
        assert shares[1] >= 0.9, name


@pytest.mark.parametrize("count", [12, 400])
def test_what_is_needed_is_what_the_rule_of_the_diagnosis_takes(count):
    by_chance = np.random.default_rng(0).gumbel(-3.0, 2.0, count)
    least = find_required_gain(CRITERIA, by_chance)
    for gain, is_missing in ((least - 0.01, False), (least + 0.01, True)):
        surely = cap_probability(compute_p_value(gain, by_chance)) >= CRITERIA.probability
        assert (surely and gain > np.log(9.0)) == is_missing
    assert find_required_gain(CRITERIA) == pytest.approx(np.log(9.0))
    # No dozen of replicates makes anything that sure.
    assert find_required_gain(Criteria(probability=0.9999), by_chance) == np.inf


def made_diagnosis(sets, verdict="undecided") -> SimpleNamespace:
    return SimpleNamespace(
        axes={"yaw": SimpleNamespace(verdict=verdict)},
        sets=tuple(SimpleNamespace(effects=e, probability=p) for e, p in sets),
    )


def test_rivals_are_the_effects_in_which_the_most_probable_sets_differ():
    sets = [(("lag", "a"), 0.5), (("lag", "b", "c"), 0.3), (("lag",), 0.15), (("lag", "d"), 0.05)]
    odds = find_ambiguity(made_diagnosis(sets), CRITERIA)
    total = 0.95
    expected = {("a",): 0.5 / total, ("b", "c"): 0.3 / total, (): 0.15 / total}
    assert odds == pytest.approx(expected)
    assert find_ambiguity(made_diagnosis(sets, "missing"), CRITERIA) is None
    assert find_ambiguity(made_diagnosis([(("a",), 0.95), ((), 0.05)]), CRITERIA) is None
    # The same effects, once with one of the model's own taken away, are no question for a trial.
    assert find_ambiguity(made_diagnosis([(("a",), 0.5), (("a",), 0.45)]), CRITERIA) is None


def test_a_trial_is_suggested_that_tells_apart_what_small_motion_does_not():
    values = {"quadratic_drag.yaw.coefficient": 0.6}
    spec = bam(["quadratic_drag:yaw"])
    trials = made(spec, values, trials=2, seconds=6.0)
    session = Session(trials, CRITERIA)
    final = session.fit(spec, np.array([*TRUTH.values(), 0.6]))
    asked = made_diagnosis([(("quadratic_drag:yaw",), 0.6), (("stribeck:yaw",), 0.4)])
    comparison = compare_alternatives(session, final, find_ambiguity(asked, CRITERIA))
    assert [alternative.name for alternative in comparison.alternatives] == [
        "quadratic_drag:yaw",
        "stribeck:yaw",
    ]
    assert comparison.confusions(comparison.contrasts_now) == {(0, 1): pytest.approx(0.4)}
    # Twice the trials at hand leave twice the distance: nothing else is in a likelihood.
    twice = comparison.contrasts(comparison.sums_now.scale_by(2.0))[0, 1].distance
    assert twice == pytest.approx(2.0 * comparison.contrasts_now[0, 1].distance, rel=0.05)
    found = suggest_trial(session, final, asked)
    assert found.axis == "yaw"
    assert found.design.startswith("Move yaw")
    assert found.confusion < 0.1 < found.confusion_now == pytest.approx(0.4)
    assert "fall from 40 % to" in found.sentence
    assert suggest_trial(session, final, made_diagnosis([(("quadratic_drag:yaw",), 1.0)])) is None


def test_where_both_alternatives_fit_badly_a_trial_tells_no_more_than_the_diagnosis_counts():
    """What both lack comes back with the motion: sample after sample says the same thing."""
    values = {"quadratic_drag.yaw.coefficient": 0.6, "return_spring.yaw.stiffness": 3.0}
    trials = made(bam(["quadratic_drag:yaw", "return_spring:yaw"]), values, trials=2, seconds=6.0)
    session, distances = Session(trials, CRITERIA), []
    asked = made_diagnosis([(("quadratic_drag:yaw",), 0.6), (("stribeck:yaw",), 0.4)])
    for more in ((), ("return_spring:yaw",)):
        spec = bam(["quadratic_drag:yaw", *more])
        start = [(TRUTH | values).get(q.name, q.prior) for q in system_of(spec).parameters]
        final = session.fit(spec, np.array(start))
        comparison = compare_alternatives(session, final, find_ambiguity(asked, CRITERIA))
        counted = [here.independent for here in final.count_independent(CRITERIA)]
        assert comparison.sums_now.independent == pytest.approx(counted)
        # A new trial is counted as those at hand are.
        again = comparison.sums(final.linearisation.motions)
        assert again.independent == pytest.approx(counted)
        distances.append((comparison.contrasts_now[0, 1].distance, comparison.scale[0], counted[0]))
    (distance, scale, count), (complete, scale_then, count_then) = distances
    assert scale > 4.0 * scale_then
    assert count < 0.7 * count_then
    assert distance < 0.01 * complete


def test_effects_are_weighed_by_trials_with_brakes_on_too_but_by_none_held_out():
    names = ("t01", "t02", "t03")
    folds = Folds.of_trials(names, held_out=("t02",), fitted=("t01",))
    assert MeasuredTrials(names, None, None, None, folds).weighed == ["t01", "t03"]
