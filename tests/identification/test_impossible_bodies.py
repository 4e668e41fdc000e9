"""Numbers that no body has: the nearest possible ones, unless these err far more."""

import numpy as np
import pytest

from bampipe.estimate.low_pass import Band
from bampipe.estimate.possible_bodies import is_possible
from bampipe.identification.bodies import make_possible
from bampipe.identification.least_squares_estimate import fit_squares
from bampipe.physics import Model, compile_model
from bampipe.physics.model_spec import ModelSpec
from bampipe.physics.registry import device_from
from bampipe.trials.folds import Folds
from bampipe.trials.kinematics import Kinematics
from bampipe.trials.measured import MeasuredTrials
from bampipe.trials.motion import Motion
from bampipe.trials.sensors import Sensors

RATE, SIZES = 100.0, np.array([0.15, 0.7])
LIFT = {
    "name": "lift",
    "coordinates": {"lift": {"kind": "linear"}, "bend": {"kind": "rotary"}},
    "robot": {
        "joints": {
            "lift": {"kind": "prismatic", "mass": 2.0, "center": [0.0, 0.0, 0.1]},
            "bend": {"kind": "revolute", "after": "lift", "axis": [0.0, 1.0, 0.0], "mass": 1.0,
                     "center": [0.3, 0.0, 0.0]},
        }
    },
    "inputs": {"force": ["a", "b"], "force_unit": "N.m", "drive": True},
    "applied": {"lift": "a", "bend": "b"},
}  # fmt: skip


@pytest.mark.parametrize(("lifted", "possible"), [(0.0, True), (1.2, False)])
def test_a_counterbalance_that_the_model_lacks_is_not_forced_into_bodies(
    lifted: float, possible: bool
) -> None:
    """It lifts more than both bodies weigh, as negative masses would; without it, a point mass has
    an inertia that is too small by noise.
    """
    system, rng = compile_model(Model(device_from(LIFT))), np.random.default_rng(4)
    t, weight = np.arange(0.0, 12.0, 1.0 / RATE), 3.0 * 9.81
    motions = []
    for name in ("t1", "t2", "t3"):
        rates, phases = rng.uniform(0.5, 4.0, (2, 4, 1, 2))
        angle = rates * t[:, None] + phases
        q = SIZES * np.sin(angle).mean(axis=0)
        qd = SIZES * (rates * np.cos(angle)).mean(axis=0)
        qdd = -SIZES * (rates**2 * np.sin(angle)).mean(axis=0)
        u, z = np.zeros((len(t), len(system.inputs))), np.zeros((len(t), 0))
        torque = system.required(q, qd, qdd, z, u, system.prior) - [lifted * weight, 0.0]
        torque += rng.normal(0.0, 0.02, torque.shape)
        channels = dict(zip("ab", torque.T, strict=True))
        motions.append(Motion(name, t, q, qd, qdd, np.full_like(q, 1e-4), channels))
    names, each = [motion.trial_id for motion in motions], np.full(2, 1e-5)
    trials = MeasuredTrials(
        motions, Sensors(RATE, each, each, np.full(2, 0.02)), Kinematics("kalman", RATE, {}, 20.0),
        Band(RATE, (10.0, 10.0)), Folds.of_trials(names, (), names),
    )  # fmt: skip
    fit = fit_squares(trials, ModelSpec(LIFT, (), ()), system, system.prior, 2.0, remove_bias=False)
    given, (note,) = make_possible(system, fit)
    places = [system.index(q.name) for q in system.model.device.robot.parameters]
    assert all(map(is_possible, given.p[places].reshape(-1, 10))) == possible
    assert ("ones are published" in note) == possible
