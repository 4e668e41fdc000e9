"""The search over sets: found whole, shapes refined, bounds held, the useless dropped."""

from collections.abc import Iterator

import numpy as np
import pytest
from sessions import TRUTH, bam, fit_from_priors, made

from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.probability import split_evidence
from bampipe.diagnosis.search import Search
from bampipe.diagnosis.select import open_search, select_effects, start_of
from bampipe.diagnosis.session import Session, system_of
from bampipe.diagnosis.set_cost import added_effects, effect_names

HIDDEN = {
    "stribeck.yaw.force": 1.1,
    "stribeck.yaw.speed": 0.05,
    "quadratic_drag.extension.coefficient": 40.0,
    "return_spring.pitch.stiffness": 9.0,
    "return_spring.pitch.offset": 0.5,
}
EFFECTS = ("quadratic_drag:extension", "return_spring:pitch", "stribeck:yaw")
OTHERS = (
    "quadratic_drag:yaw", "shear_thinning:extension", "presliding:yaw", "force_bias:y",
    "upper_stop:pitch", "force_gain:z", "force_gain:x", "force_gain:y",
)  # fmt: skip


@pytest.fixture(scope="module")
def session() -> Session:
    """Trials of the arm with three effects."""
    return Session(made(bam(EFFECTS), HIDDEN), Criteria())


@pytest.fixture(scope="module")
def bare(session: Session):
    """The bare device, fitted."""
    return session.fit(bam(), fit_from_priors(session, bam()).linearisation.p)


@pytest.fixture(scope="module")
def search(session: Session, bare) -> Iterator[Search]:
    with open_search(session, bare, only=(*EFFECTS, *OTHERS)) as opened:
        yield opened


def best_set(search: Search, most: int):
    """The best set that a beam comes to."""
    return min(pair for beam in search.grow_sets(most) for pair in beam)[1]


def test_a_set_of_three_is_found_whole_in_any_order_of_the_candidates(session, bare, search):
    assert effect_names(best_set(search, 4))[-3:] and {*EFFECTS} <= {
        *effect_names(best_set(search, 3))
    }
    with open_search(session, bare, only=(*OTHERS[::-1], *EFFECTS[::-1])) as turned:
        assert best_set(turned, 3) == best_set(search, 3)
    keys = best_set(search, 3)
    assert search.cost(keys) == search.cost(keys[::-1])


def test_strengths_stay_within_bounds_and_a_shape_moves_to_its_truth(search):
    for beam in search.grow_sets(2):
        for _, keys in beam:
            for key, strengths in zip(
                added_effects(keys), search.solve(keys).strengths, strict=True
            ):
                for value, (low, high, _) in zip(
                    strengths, search.dictionary.priors(key[0]), strict=True
                ):
                    assert low - 1e-9 <= value <= high + 1e-9
    others = tuple(key for key in best_set(search, 3) if key[0] != "stribeck:yaw")
    far = ("stribeck:yaw", (0.75,))
    before = search.dictionary.values(far)[0]
    search.ensure([far])
    (moved,) = search.refine([(*others, far)], 8)
    (found,) = [search.dictionary.values(key)[0] for key in moved if key[0] == "stribeck:yaw"]
    assert abs(np.log(before / 0.05)) > 0.5
    assert found == pytest.approx(0.05, rel=0.15)
    assert search.cost(moved) < search.cost((*others, far)) - 5.0


def test_what_is_of_no_use_is_dropped_and_what_is_wrong_is_exchanged(search):
    right = best_set(search, 3)
    useless = ("force_bias:y", ())
    more = tuple(sorted((*right, useless)))
    assert min(search.drop_each(more), key=search.cost) == right or not np.isfinite(
        search.cost(more)
    )
    spring = next(key for key in right if key[0] == "return_spring:pitch")
    wrong = tuple(sorted((*(k for k in right if k != spring), useless)))
    search.least_size, kept = 0.0, search.least_size
    try:
        exchanged = search.list_swaps(wrong, {})
    finally:
        search.least_size = kept
        search._solutions.clear()
    assert {*effect_names(right)} in [{*effect_names(keys)} for keys in exchanged]


def test_what_makes_both_sides_of_the_equation_small_gains_nothing(search):
    """All forces read as nothing leave no error, and explain nothing."""
    gains = tuple((f"force_gain:{c}", ()) for c in "xyz")
    base = best_set(search, 3)
    plain, small = search.solve(base), search.solve((*base, *gains))
    assert not small.cost < plain.cost
    half = search._log_slopes([gains[2]], [np.array([0.5])], np.ones(3))[2]
    assert half == pytest.approx(np.full(half.shape, np.log(0.5)), abs=1e-6)


def test_the_fit_starts_where_the_linear_problem_ends_and_is_the_truth(session, search):
    keys = best_set(search, 3)
    wider = bam(EFFECTS)
    start = start_of(search, keys, wider)
    names_of = [q.name for q in system_of(wider).parameters]
    found = dict(zip(names_of, session.fit(wider, start).linearisation.p, strict=True))
    for name, value in (TRUTH | HIDDEN).items():
        assert found[name] == pytest.approx(value, rel=0.05), name


def test_an_effect_of_the_model_that_is_not_there_is_taken_away(session):
    spec = bam(("quadratic_drag:yaw",))
    start = fit_from_priors(session, spec).linearisation.p
    without = [n for n in session.candidate_names(spec) if n not in (*EFFECTS, *OTHERS)]
    found = select_effects(session, spec, start, without)
    assert {*found.final.spec.effects} == {*EFFECTS}


def test_the_evidence_of_a_fitted_set_comes_from_where_its_fit_gains(search):
    keys = best_set(search, 3)
    promised = split_evidence(search, keys)
    assert promised == pytest.approx(split_evidence(search, keys, search.residual_rows(keys)))
    assert promised.sum() > 100.0
    # A fit that leaves what there was gains nowhere, whatever the linear problem promised.
    left = split_evidence(search, keys, search.residual_rows(()))
    assert np.abs(left).max() < 1e-6
