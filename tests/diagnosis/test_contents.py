"""What a diagnosis holds of candidates, axes, windows and doubt."""

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from sessions import AXIS, KINEMATICS, SENSORS, fit_trials, made

from bampipe.diagnosis.candidates import build_candidate_model, compile_candidate
from bampipe.diagnosis.dictionary import Dictionary
from bampipe.diagnosis.probability import _find_shares
from bampipe.diagnosis.session import candidates_of
from bampipe.diagnosis.shape import _size, worst_windows
from bampipe.physics import registry
from bampipe.physics.model_spec import ModelSpec
from bampipe.results.floor import compare_with_floor
from bampipe.stages.diagnose import _map_variables
from bampipe.trials.measured import MeasuredTrials


def bam_with_force(factor: float) -> ModelSpec:
    """The BAM whose applied force along the extension is ``factor`` times what the device says."""
    declaration = copy.deepcopy(dict(registry.device("bam").declaration))
    applied = dict(declaration["applied"])
    applied["extension"] = f"{factor}*({applied['extension']})"
    return ModelSpec(declaration | {"applied": applied}, (), ())


def column_size(spec: ModelSpec, trials: MeasuredTrials) -> float:
    """Size of what a wrong gain of the force along the extension adds to its equation."""
    (item,) = candidates_of(spec, ["force_gain:z"])
    motion = trials.motions[0]
    u, p = motion.inputs(item.system.inputs), np.append(fit_trials(trials, spec).p, 1.0)
    z = item.system.memory(*motion.kinematics, u, p, motion.t)
    return float(np.linalg.norm(item.system.contribution(*motion.kinematics, z, u, p)[:, 2]))


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


def test_every_axis_has_its_worst_window_and_filters_keep_their_order():
    trials = made(bam_with_force(1.0), {}, trials=2, seconds=4.0)
    linearisation = fit_trials(trials, bam_with_force(1.0))
    found = worst_windows(linearisation, count=1)
    assert sorted(window.axis for window in found) == sorted(linearisation.system.coordinates)
    for window in found:
        alike = [w.rmse for w in worst_windows(linearisation, count=1000) if w.axis == window.axis]
        assert window.rmse == max(alike) and len(alike) > 3
    assert tuple(KINEMATICS.axes) == ("yaw", "pitch", "extension")
    assert SENSORS.scatter_sd.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("value", "unit", "words"),
    [
        (-2e-5, "m", "-0.02 mm"),
        (-1e-9, "m", "0 mm"),
        (0.0996, "m", "99.6 mm"),
        (0.25, "m", "0.25 m"),
        (-0.001, "rad", "0.00 rad"),
        (1.554, "rad", "1.55 rad"),
    ],
)
def test_a_small_stroke_is_given_in_millimetres_and_no_zero_has_a_sign(
    value: float, unit: str, words: str
) -> None:
    assert _size(value, unit) == words


def test_blocks_of_one_trial_are_mapped_under_its_name() -> None:
    """As residuals.parquet has them: the page for exploring joins the two."""
    motions = [SimpleNamespace(trial_id=f"t1@{k}.0s", t=np.arange(k, k + 3.0)) for k in (0, 4)]
    initial = SimpleNamespace(
        motions=motions,
        band=SimpleNamespace(thinned_rows=lambda n: np.arange(n)),
        system=SimpleNamespace(coordinates=()),
    )
    found = _map_variables(initial)  # type: ignore[arg-type]
    assert set(found["trial_id"]) == {"t1"}
    assert found["t"].tolist() == [0.0, 1.0, 2.0, 4.0, 5.0, 6.0]


@pytest.mark.parametrize(
    ("without", "share"),
    [
        ((30.0, 1.0), 1.0 - np.sqrt(300.0 / 800.0)),  # only the axis that is far shows it
        ((30.0, 1.5), 1.0),  # the other one does, by 40 nats
        ((20.2, 1.1), 1.0),  # the other one does, if by less than 14, by more than the far one
    ],
)
def test_what_only_an_axis_far_above_the_noise_shows_is_as_sure_as_its_share(without, share):
    """The share is that of what exceeds the noise, which an unknown function leaves."""
    rows = {(): (20.0, 1.0), (("-stribeck:yaw", ()),): without}
    search = SimpleNamespace(
        problem=SimpleNamespace(independent=np.array([100.0, 100.0]), count=np.array([5e3, 50.0])),
        residual_rows=lambda keys: [np.full(50, level) for level in rows[keys]],
    )
    unknown = SimpleNamespace(residual=(np.full(50, 10.0), np.ones(50)))
    found = _find_shares(search, ["stribeck:yaw"], (unknown, None), np.array([True, False]))
    assert found == {"stribeck:yaw": pytest.approx(share)}


@pytest.mark.parametrize("name", ["loose_load:carriage", "loose_drive:carriage"])
def test_a_grid_over_several_shapes_covers_each_of_their_ranges(name):
    item = compile_candidate(build_candidate_model(registry.device("slider"), name))
    grid = Dictionary(None, (), {name: item}, replace(AXIS, band_hz=(16.0,))).grid(name)
    assert len(set(grid)) == len(grid) <= 300
    values = [sorted({shape[k] for _, shape in grid}) for k in range(len(grid[0][1]))]
    own = [item.parameters[i].name.rpartition(".")[2] for i in item.searched_indices]
    assert len(values[own.index("gap")]) == max(map(len, values)) >= 9
    for each in values:
        assert len(each) >= 3
        assert each[0] <= 0.2 and each[-1] >= 0.8
