"""What the smoothed sign of a velocity adds to intervals, on an arm that truly stands still."""

import numpy as np
import pytest
from independent_runs import record_trials

from bampipe.data.run_folder import RunFolder
from bampipe.files import write_text
from bampipe.physics.recipe import Recipe
from bampipe.physics.registry import device
from bampipe.progress import silent
from bampipe.results.identify import IdentifyResult
from bampipe.stages import identify

EFFECT = "stribeck:yaw"
MODEL = """schema = "bampipe.model/1"
name = "right"
device = "bam"
effects = ["stribeck:yaw"]
"""


def test_widths_change_and_nothing_else() -> None:
    plain = Recipe(device("bam").declaration, (EFFECT,), ())
    wider = plain.with_sign_widths(2.0)
    for one, other in zip(
        plain.model().device.coordinates, wider.model().device.coordinates, strict=True
    ):
        assert other.sign_width == 2.0 * one.sign_width
    assert wider.with_sign_widths(0.5).device == plain.device
    assert wider.effects == plain.effects


def identified(root, **conditions) -> tuple[IdentifyResult, dict[str, float]]:
    """The filter's estimate of the right model of an arm, and the truth."""
    _, _, truth = record_trials(
        root, "bam", 8602, EFFECT, trials=2, seconds=5.0, rate_hz=400.0, **conditions
    )
    run = RunFolder(root / "run")
    write_text(run.path("models/right/model.toml"), MODEL)
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
    assert any("`stribeck.yaw.force`" in note and "stands still" in note for note in result.notes)


@pytest.mark.long
def test_an_arm_that_creeps_as_the_model_does_has_nothing_added(tmp_path) -> None:
    result, _ = identified(tmp_path, creep=True)
    assert all(entry.smoothing_sd == 0.0 for entry in result.parameters.values())
    assert not any("smooths the sign" in note for note in result.notes)
