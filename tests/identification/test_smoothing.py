"""What the smoothed sign of a velocity adds to intervals, on an arm that truly stands still."""

import numpy as np
import pytest
from independent_runs import record_trials
from made_results import write_model

from bampipe.data.run_folder import RunFolder
from bampipe.identification.filter_estimate import _Widths
from bampipe.identification.sensor_noise import choose_tuning_trials
from bampipe.physics.model_spec import ModelSpec
from bampipe.physics.registry import device
from bampipe.progress import silent
from bampipe.results.identify import IdentifyResult
from bampipe.stages import identify

EFFECT = "stribeck:yaw"


def test_widths_change_and_nothing_else() -> None:
    plain = ModelSpec(device("bam").declaration, (EFFECT,), ())
    wider = plain.with_sign_widths(2.0)
    for one, other in zip(
        plain.model().device.coordinates, wider.model().device.coordinates, strict=True
    ):
        assert other.sign_width == 2.0 * one.sign_width
    assert wider.with_sign_widths(0.5).device == plain.device
    assert wider.effects == plain.effects


def widths(likely: dict[tuple[float, int], float]) -> _Widths:
    """With log likelihoods by width and parts of the step; others must not be asked for."""
    compared = _Widths.__new__(_Widths)
    compared.filtered = {key: (value, np.array([key[0]])) for key, value in likely.items()}
    return compared


def test_the_likeliest_width_is_chosen_with_the_longest_step_that_serves() -> None:
    assert widths({(1.0, 2): 0.0, (0.5, 2): -20.0, (0.25, 2): -50.0}).choose() is None
    best = {1.0: 10.0, 0.5: 100.0, 0.25: 200.0, 0.0625: 150.0}
    likely = {(width, parts): best[width] for width in best for parts in (1, 2, 4)}
    chosen = widths(likely | {(0.25, 1): 120.0}).choose()
    assert chosen is not None and (chosen.factor, chosen.parts) == (0.25, 2)
    assert chosen.spread == pytest.approx(0.1875)  # to 0.0625, likelier than half way to the best
    assert widths(likely | {(1.0, 4): 171.0}).choose() is None


def identified(root, **conditions) -> tuple[IdentifyResult, dict[str, float]]:
    """The filter's estimate of the right model of an arm, and the truth."""
    _, _, truth = record_trials(
        root, "bam", 8602, EFFECT, trials=2, seconds=5.0, rate_hz=400.0, **conditions
    )
    run = RunFolder(root / "runs/bam")
    write_model(run.root, "right", EFFECT)
    identify.execute(run, run.root, identify.Config(model="right", method="ukf"), silent)
    return run.read(IdentifyResult, "right"), truth


@pytest.mark.long
def test_intervals_hold_friction_that_truly_stops_the_arm(tmp_path) -> None:
    """At the declared width the force was 6 % off, and eight standard deviations of white noise."""
    result, truth = identified(tmp_path, creep=False)
    found = {name: result.parameters[name] for name in truth}
    for name, entry in found.items():
        assert abs(entry.estimate - truth[name]) < 3.0 * entry.sd, name
    force = found["stribeck.yaw.force"]
    assert force.estimate == pytest.approx(truth["stribeck.yaw.force"], rel=0.02)
    assert force.smoothing_sd > 0.5 * force.sd
    at = result.covariance.names.index("stribeck.yaw.force")
    assert force.sd == np.sqrt(result.covariance.matrix[at][at])
    assert any(note.startswith("The filter smooths the sign") for note in result.notes)
    assert any("stribeck.yaw.force" in note and "may stand still" in note for note in result.notes)


@pytest.mark.long
def test_an_arm_that_creeps_as_the_model_does_has_nothing_added(tmp_path) -> None:
    result, _ = identified(tmp_path, creep=True)
    assert all(entry.smoothing_sd == 0.0 for entry in result.parameters.values())
    assert not any("smooths the sign" in note for note in result.notes)


@pytest.mark.parametrize(
    ("sizes", "places", "samples"),
    [
        ([9000], [0], 3000),
        ([3000, 3000], [0, 1], 1500),
        ([8000] * 11, [0, 2, 4, 6, 8, 10], 500),
        ([400] * 3, [0, 1, 2], 1000),  # all there is
        ([300] * 40, [0, 4, 9, 13, 17, 22, 26, 30, 35, 39], 300),
    ],
)
def test_several_trials_share_the_samples(
    sizes: list[int], places: list[int], samples: int
) -> None:
    assert choose_tuning_trials(sizes) == (places, samples)
