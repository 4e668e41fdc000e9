"""What must not be taken for an effect, each on a session of a simulator that shares no code."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from sessions import bam, diagnose_trials, fit_from_priors, take_timing_off

from bampipe.diagnosis.criteria import Criteria
from bampipe.diagnosis.select import open_search
from bampipe.diagnosis.session import Session, system_of
from bampipe.physics import registry

pytest_plugins = ("recorded",)


def verdicts(found):
    return [axis.verdict for axis in found.axes]


def probabilities(found):
    return {name: p for axis in found.axes for name, p in axis.probabilities.items()}


def moved(trials, change):
    """The trials with the channels that ``change`` gives for each motion and its number."""
    motions = [m.with_channels(change(k, m)) for k, m in enumerate(trials.motions)]
    return replace(trials, motions=tuple(motions))


@pytest.mark.parametrize(
    ("machine", "seed", "conditions"),
    [
        pytest.param("joint", 7, {"creep": True}, marks=pytest.mark.long),
        pytest.param("axis", 58, {"creep": True}, marks=pytest.mark.long),
        ("damper", 57, {"jitter": 0.1, "trials": 1}),  # cut into blocks, jumps between grid points
        pytest.param("wrist", 56, {}, marks=pytest.mark.long),
        pytest.param("bam", 6, {}, marks=pytest.mark.long),
        pytest.param("bam", 6, {"coarse": 8.0}, marks=pytest.mark.long),
        ("axis", 58, {"creep": False}),  # it truly stops: no Stribeck friction, no compliance
        pytest.param("joint", 5, {}, marks=pytest.mark.long),
        ("joint", 70008, {"noise_factor": 5.0}),  # two shifts would make a low-pass of it
    ],
)
def test_nothing_is_missing_where_nothing_was_hidden(record, machine, seed, conditions):
    selection, found = diagnose_trials(*record(machine, seed, **conditions))
    assert {*verdicts(found)} == {"nothing_missing"}
    assert selection.effects == found.selected == ()
    assert found.chance.p_value > 0.01
    for axis in found.axes:
        assert 0.8 < axis.rmse_after / axis.noise_floor < 1.35


@pytest.mark.parametrize("seconds", [pytest.param(0.3, marks=pytest.mark.long), 1.0])
def test_one_event_decides_nothing(record, seconds):
    """Somebody pushes the drive once, for less than a block of time."""
    trials, spec = record("joint", 7)

    def pushed(k, motion):
        force = motion.channels["current"]
        push = 0.3 * force.std() * np.exp(-(((motion.t - 4.0) / (0.5 * seconds)) ** 2))
        return {"current": force + (k == 1) * push}

    _, found = diagnose_trials(moved(trials, pushed), spec)
    assert all(p < 0.9 for p in probabilities(found).values())
    assert verdicts(found) != ["missing"]


LATE = ("actuator_lag:current", "actuator_delay")
# What the whole library leaves beside them takes seven times as long to weigh.
FEW = (*LATE, "loose_load:joint", "position_dependent_friction:joint")


@pytest.mark.parametrize(
    ("seed", "known", "weighed", "seconds"),
    [
        (8, False, FEW, 6.0),
        *(
            pytest.param(*case, (), 8.0, marks=pytest.mark.long)
            for case in product((8, 9, 10), (0, 1))
        ),
    ],
)
def test_a_lag_gains_nothing_by_averaging_noise(record, seed, known, weighed, seconds):
    trials, spec = record("joint", 4, seconds=seconds)
    rng = np.random.default_rng(seed)
    sd = 0.5 * trials.motions[0].channels["current"].std()

    def noisy(_, motion):
        return {"current": motion.channels["current"] + sd * rng.normal(size=motion.t.size)}

    sensors = replace(trials.sensors, force_sd=np.hypot(trials.sensors.force_sd, known * sd))
    shaken = replace(moved(trials, noisy), sensors=sensors)
    _, found = diagnose_trials(shaken, spec, only=weighed)
    assert not {*LATE} & {*probabilities(found)}


@pytest.mark.long
def test_a_lag_of_two_samples_is_neither_a_delay_nor_a_flexible_load(record):
    """It leaves less of the noise of the drive as well, which alone speaks for nothing."""
    trials, spec = record("joint", 6, "actuator_lag:current", creep=True, rate_hz=100.0)
    selection, found = diagnose_trials(trials, spec)
    assert selection.effects == ("actuator_lag:current",)
    assert verdicts(found) == ["missing"]


def test_noise_of_the_current_does_not_make_a_lag_longer(record):
    trials, spec = record("joint", 8, "actuator_lag:current", noise_factor=5.0)
    lagging = replace(spec, effects=("actuator_lag:current",))
    fit = Session(trials, Criteria(replicates=6)).fit(lagging, system_of(lagging).prior)
    (time_constant,) = fit.effect_parameters.values()
    assert time_constant == pytest.approx(0.02944, rel=0.05)


def test_friction_by_load_beside_a_lag_does_not_halve_both_sides(record):
    trials, spec = record("joint", 6, "actuator_lag:current", creep=True, rate_hz=100.0)
    session, name = Session(trials, Criteria()), "load_dependent_presliding:joint"
    lagging = replace(spec, effects=("actuator_lag:current",))
    fit = fit_from_priors(session, lagging)
    with open_search(session, fit, only=(name,)) as search:
        atom = search.make([(name, (0.0,))])[0][1]
    torque_by_current = 10.0
    largest = np.abs(atom.slopes[0][:, 0, :]).max(axis=0)
    assert largest == pytest.approx(np.full(2, torque_by_current), rel=0.1)


def test_a_trial_that_alone_holds_a_parameter_condemns_no_model(record):
    """Its spring shows in one trial; without that nothing is known of it but what the file says."""
    trials, spec = record("joint", 7)
    joint = replace(spec, effects=("return_spring:joint",))
    session = Session(trials, Criteria())
    fit = session.fit(joint, fit_from_priors(session, joint).linearisation.p)
    residual = fit.problem.y[0] / fit.likelihood.root[0]
    assert fit.held_out_rmse[0] < 1.3 * np.sqrt(np.mean(residual**2))


def test_inputs_that_are_read_half_a_sample_late_give_no_delay(record):
    trials, spec = record("joint", 5)
    late_s = 0.4 / trials.band.rate_hz
    late = [motion.with_input_timing(-late_s) for motion in trials.motions]
    again = take_timing_off(replace(trials, motions=tuple(late), late_s=0.0), spec)
    assert again.late_s == pytest.approx(late_s, abs=3e-4)
    for some in (again, replace(trials, motions=tuple(late))):
        _, found = diagnose_trials(some, spec, only=FEW)
        assert not {*LATE} & {*probabilities(found)}


def test_a_delay_that_the_timing_takes_over_only_beyond_its_bounds_has_a_size(record):
    trials, spec = record("joint", 5)
    late = [m.with_input_timing(-1.0 / trials.band.rate_hz) for m in trials.motions]
    session = Session(replace(trials, motions=tuple(late)), Criteria(size=0.003))
    fit = fit_from_priors(session, spec)
    with open_search(session, fit, only=("actuator_delay",)) as search:
        ((cost, _),) = search.rank_additions((), 1)
        assert search.cost(()) - cost > 20.0


TWIN = "other_thinning"
RIVALS = ("stribeck:joint", "quadratic_drag:joint", "presliding:joint")


def test_twins_are_undecided_and_their_probabilities_sum_to_one(record):
    """An effect, and a file of a user's that says the same under another name."""
    trials, spec = record("joint", 41, "shear_thinning:joint")
    declaration = dict(registry.effect("shear_thinning").declaration) | {"name": TWIN}
    both = ("shear_thinning:joint", f"{TWIN}:joint")
    twins = replace(spec, extra=(declaration,))
    selection, found = diagnose_trials(trials, twins, only=(*both, *RIVALS))
    (axis,) = found.axes
    pair = {n: axis.probabilities.get(n, 0.0) for n in both}
    assert axis.verdict == "undecided"
    assert sum(pair.values()) == pytest.approx(1.0, abs=0.05)
    assert min(pair.values()) > 0.3
    (name,) = selection.effects
    row = next(row for row in found.ranking if row.effect == name)
    assert {name, *row.indistinguishable_from} == {*pair}


@pytest.mark.parametrize(
    ("machine", "effect", "doubt"),
    [
        pytest.param("bam", "detent:yaw", set(), marks=pytest.mark.long),
        ("axis", "rough_patch:carriage", {"position_dependent_friction:carriage"}),
        pytest.param("joint", "detent:joint", set(), marks=pytest.mark.long),
    ],
)
def test_what_no_effect_of_the_library_is_is_called_unknown(record, machine, effect, doubt):
    axis, (_, found) = 0, diagnose_trials(*record(machine, 12, effect))
    here = found.axes[axis]
    assert here.verdict == "unknown_effect" and here.remains and here.unknown > 0.9
    assert sum(one.probability for one in found.sets if one.unknown is not None) > 0.9
    assert {*here.effects, *found.selected} <= doubt
    assert max(here.probabilities.values(), default=0.0) < 0.9
    assert {v for k, v in enumerate(verdicts(found)) if k != axis} <= {"nothing_missing"}


def test_a_vibration_that_depends_on_time_alone_is_called_unknown(record):
    """Half a per cent of the force, in no state of the machine; another phase in each trial."""
    trials, spec = record("axis", 41)
    motions = [
        replace(m, channels={**m.channels, "force_motor": m.channels["force_motor"] + shake})
        for k, m in enumerate(trials.motions)
        for shake in [0.35 * np.sin(2.0 * np.pi * 3.1 * m.t + k)]
    ]
    _, found = diagnose_trials(replace(trials, motions=tuple(motions)), spec)
    (axis,) = found.axes
    assert axis.verdict == "unknown_effect" and axis.unknown > 0.9 and not found.selected


def test_the_numbers_that_decide_are_those_that_are_given(record):
    """A dozen replicates make nobody surer than one in ten thousand; half the force nothing is.

    By the usual ones the effect is missing: `stages/test_diagnose.py`.
    """
    trials, spec = record("joint", 41, "shear_thinning:joint")
    for criteria in ({"size": 0.5}, {"probability": 0.99999}):
        _, found = diagnose_trials(trials, spec, only=("shear_thinning:joint", *RIVALS), **criteria)
        assert verdicts(found) != ["missing"]
        assert (found.selected == ()) == ("size" in criteria)


@pytest.mark.parametrize(
    ("weighed", "conditions"),
    [(("handle_payload", "force_gain:y"), {}), (("backlash:yaw",), {"coarse": 8.0})],
)
def test_the_pose_and_the_counts_of_an_arm_are_no_reason_to_doubt_it(record, weighed, conditions):
    """A weight in the hand is the mass of the arm to any trial; play would explain counts."""
    trials, _ = record("bam", 6, **conditions)
    _, found = diagnose_trials(trials, bam(), only=weighed)
    assert found.selected == ()
