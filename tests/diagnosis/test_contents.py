"""Candidates belong to the content of a device, not to its name or to what a process did before."""

import copy

import numpy as np
import pytest
from sessions import BAND, KINEMATICS, SENSORS, folds, made

from bampipe.diagnosis.session import candidates_of, system_of
from bampipe.diagnosis.shape import worst_windows
from bampipe.physics import registry
from bampipe.physics.recipe import Recipe
from bampipe.results.floor import compare_with_floor
from bampipe.trials.evidence import gather_evidence
from bampipe.trials.measured import MeasuredTrials


def bam_with_force(factor: float) -> Recipe:
    """The BAM whose applied force along the extension is ``factor`` times what the device says."""
    declaration = copy.deepcopy(dict(registry.device("bam").declaration))
    applied = dict(declaration["applied"])
    applied["extension"] = f"{factor}*({applied['extension']})"
    return Recipe(declaration | {"applied": applied}, (), ())


def column_size(recipe: Recipe, trials: MeasuredTrials) -> float:
    """Size of what a wrong gain of the force along the extension adds to its equation."""
    system = system_of(recipe)
    evidence = gather_evidence(system, trials.motions, BAND, system.prior, trials.folds)
    (item,) = candidates_of(recipe, ["force_gain:z"])
    u = trials.motions[0].inputs(item.system.inputs)
    motion = trials.motions[0]
    p = np.append(evidence.p, 1.0)
    z = item.system.memory(motion.q, motion.qd, motion.qdd, u, p, motion.t)
    column = item.system.contribution(motion.q, motion.qd, motion.qdd, z, u, p)
    return float(np.linalg.norm(column[:, 2]))


def test_two_devices_of_one_name_have_their_own_candidates():
    trials = made(bam_with_force(1.0), {}, trials=2, seconds=4.0)
    once = column_size(bam_with_force(1.0), trials)
    thrice = column_size(bam_with_force(3.0), trials)
    assert thrice == pytest.approx(3.0 * once, rel=1e-9)
    assert column_size(bam_with_force(1.0), trials) == once


@pytest.mark.parametrize(
    ("error", "floor", "sd", "expected"),
    [
        (1.0, 1.0, 0.0, "at_floor"),
        (1.25, 1.0, 0.0, "above_floor"),
        (1.25, 1.0, 0.02, "at_floor"),
        (0.5, 1.0, 0.0, "floor_implausible"),
        (0.5, 0.0, 0.0, "floor_missing"),
        (0.5, None, 0.0, "floor_missing"),
        (0.5, float("nan"), 0.0, "floor_missing"),
    ],
)
def test_one_judgement_of_at_the_floor(error, floor, sd, expected):
    assert compare_with_floor(error, floor, sd) == expected


def test_every_axis_has_its_worst_window():
    trials = made(bam_with_force(1.0), {}, trials=2, seconds=4.0)
    system = system_of(bam_with_force(1.0))
    evidence = gather_evidence(system, trials.motions, BAND, system.prior, folds(2))
    found = worst_windows(evidence, count=1)
    assert sorted(window.axis for window in found) == sorted(system.coordinates)
    for window in found:
        alike = [w.rmse for w in worst_windows(evidence, count=1000) if w.axis == window.axis]
        assert window.rmse == max(alike) and len(alike) > 3


def test_the_filters_of_a_session_keep_the_order_of_its_model():
    assert tuple(KINEMATICS.axes) == ("yaw", "pitch", "extension")
    assert SENSORS.scatter_sd.tolist() == [0.0, 0.0, 0.0]
