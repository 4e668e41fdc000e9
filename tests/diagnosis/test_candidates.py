"""Candidates: on what effects of the model leave, and among rivals on data of other simulators."""

from dataclasses import replace

import numpy as np
import pytest
from independent_runs import record_trials
from sessions import fit_from_priors

from bampipe.diagnosis.candidates import build_candidate_model, compile_candidate, list_candidates
from bampipe.diagnosis.columns import compute_added_residual
from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.select import open_search, start_of
from bampipe.diagnosis.session import Session, acting_axes, candidates_of, system_of
from bampipe.diagnosis.start import search_start
from bampipe.physics import registry
from bampipe.physics.model_spec import ModelSpec
from bampipe.trials.residuals import ModelOnTrial

DAMPER = registry.device("magnetic_damper")
LAG, SATURATION = "channel_lag:current", "channel_saturation:current"


@pytest.mark.parametrize(
    ("effect", "axes"),
    [
        ("stribeck:pitch", (1,)),
        ("force_delay", (0, 1, 2)),
        ("friction_by_pose:yaw-extension", (0,)),
    ],
)
def test_an_effect_has_the_axes_whose_equation_it_changes(effect, axes):
    for effects in ((), (effect,)):
        spec = ModelSpec(registry.device("bam").declaration, effects, ())
        assert acting_axes(spec, effect) == axes


def test_beside_a_gear_that_loses_of_its_load_a_spring_is_scored_as_part_of_that_load():
    slider, gear = registry.device("slider"), "gear_loss:carriage"
    beside = compile_candidate(build_candidate_model(slider, "return_spring:carriage", (), (gear,)))
    alone = compile_candidate(build_candidate_model(slider, "return_spring:carriage"))
    assert beside.is_joint and not alone.is_joint
    assert beside.linear_indices == alone.linear_indices == (0, 1)


@pytest.fixture(scope="module")
def trials(tmp_path_factory):
    """A damper whose coil lags and whose field saturates with the lagged current."""
    return record_trials(tmp_path_factory.mktemp("coil"), "damper", 3, LAG, SATURATION)[0]


@pytest.mark.parametrize(("first", "second"), [(LAG, SATURATION), (SATURATION, LAG)])
def test_what_a_candidate_adds_beside_others_is_what_the_whole_residual_changes_by(
    trials, first, second
):
    spec = ModelSpec(DAMPER.declaration, (first,), ())
    session = Session(trials, Criteria())
    base = session.linearise(spec, search_start(trials, spec)).fitted[0]
    item = compile_candidate(build_candidate_model(DAMPER, second, (), spec.effects))
    p = np.concatenate([base.p, 0.3 + np.array([q.prior for q in item.parameters])])
    whole = ModelOnTrial(item.system, p, [base.motion]).residual
    added = compute_added_residual(item, p, base)
    np.testing.assert_allclose(added, whole - base.residual, atol=1e-9)


def test_only_effects_that_meet_are_taken_together():
    def names(candidate_name, *present, device="slider"):
        model = build_candidate_model(registry.device(device), candidate_name, (), present)
        return [e.name for e in model.effects]

    assert names("load_dependent_friction:carriage", "actuator_lag:motor") == [
        "actuator_lag:motor",
        "load_dependent_friction:carriage",
    ]
    assert names("stribeck:carriage", "actuator_lag:motor") == ["stribeck:carriage"]
    assert names("stribeck:carriage", "force_bias:motor") == ["stribeck:carriage"]
    both = ["transmission_compliance:yaw", "encoder_scale:yaw"]
    assert names(*reversed(both), device="bam") == both
    assert names("stribeck:yaw", "transmission_compliance:yaw", device="bam") == ["stribeck:yaw"]


NAMED = [
    ("joint", 43, "maxwell_slip:joint", ("presliding:joint", "stribeck:joint")),
    ("joint", 45, "presliding:joint", ("maxwell_slip:joint", "stribeck:joint")),
    ("wrist", 56, "unbalance:a", ("force_bias:a", "torque_ripple:a", "return_spring:a")),
    ("damper", 57, "upper_stop:piston", ("return_spring:piston", "quadratic_drag:piston")),
    ("bam", 59, "backlash:yaw", ("presliding:yaw", "maxwell_slip:yaw")),
    ("joint", 41, "loose_drive:joint", ("loose_load:joint", "presliding:joint")),
    pytest.param(
        "axis", 58, "maxwell_slip:carriage", ("presliding:carriage", "stribeck:carriage"),
        marks=pytest.mark.long,
    ),
    pytest.param(
        "joint", 41, "shear_thinning:joint", ("stribeck:joint", "quadratic_drag:joint"),
        marks=pytest.mark.long,
    ),
]  # fmt: skip


@pytest.mark.parametrize(("machine", "seed", "effect", "rivals"), NAMED)
def test_the_right_effect_explains_most_and_has_the_true_size(
    tmp_path, machine, seed, effect, rivals
):
    trials, spec, truth = record_trials(tmp_path, machine, seed, effect)
    session = Session(trials, Criteria())
    fit = fit_from_priors(session, spec)
    wider = replace(spec, effects=(effect,))
    with open_search(session, fit, only=(effect, *rivals)) as search:
        best = search.refine([(key,) for _, key in search.rank_additions((), 4)], 8)
        gains = {keys[0][0]: search.cost(()) - search.cost(keys) for keys in best}
        (right,) = [keys for keys in best if keys[0][0] == effect]
        start = start_of(search, right, wider)
    found = dict(zip((q.name for q in system_of(wider).parameters), start, strict=True))
    gain = gains.pop(effect)
    # The error falls to less than 0.35 of what it was, on one axis at least.
    assert gain > np.log(1.0 / 0.35) * fit.problem.independent.min()
    assert all(gain > 1.2 * other for other in gains.values())
    for parameter in candidates_of(spec, (effect,))[0].parameters:
        if parameter.name in truth and parameter.searched:
            value = found[parameter.name]
            assert value == pytest.approx(truth[parameter.name], rel=0.12), parameter.name


def test_an_effect_on_request_is_a_candidate_only_where_it_is_asked_for():
    device, named = registry.device("slider"), "asked_for:carriage"
    declared = dict(registry.effect("stribeck").declaration) | {"name": "asked_for"}
    own = [registry.effect_from(declared | {"on_request": True})]
    assert named not in list_candidates(device, (), own)
    assert named in list_candidates(device, (), own, on_request=True)
    assert named not in list_candidates(device, (named,), own, on_request=True)
