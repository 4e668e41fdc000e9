"""The trials of a test bench choose the width of the smoothed sign; what follows has it."""

import pytest
from independent_runs import record_run, record_trials

from bampipe.data.run_folder import RunFolder
from bampipe.declarations.model_file import load_model
from bampipe.diagnosis.start import choose_sign_width
from bampipe.progress import silent
from bampipe.results.identify import IdentifyResult
from bampipe.stages import identify

DECLARED = 2e-3


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run of a damper whose friction truly stops it, and its truth."""
    folder = tmp_path_factory.mktemp("stopped")
    run, truth = record_run(folder, "damper", 12201, stop=True, pace=0.3)
    return RunFolder(run.root), truth


def width_of(model):
    (axis,) = model.device.coordinates
    return axis.sign_width


def test_a_damper_that_truly_stops_is_given_a_narrower_sign(stopped):
    run, truth = stopped
    found = run.read(IdentifyResult, "base")
    assert found.sign_width_factor <= 0.125
    (said,) = [note for note in found.notes if "sign_width" in note]
    assert said.startswith("piston: ") and "falls from" in said
    assert f"`sign_width = {DECLARED * found.sign_width_factor:.2g}`" in said
    coulomb = found.parameters["coulomb.piston"]
    assert abs(coulomb.estimate - truth["coulomb.piston"]) < 3.0 * coulomb.sd
    width = DECLARED * found.sign_width_factor
    assert width_of(load_model(run, "base")) == pytest.approx(width)
    assert width_of(load_model(run, "base", as_declared=True)) == DECLARED


def test_the_declared_width_stays_where_that_is_asked_for(stopped, tmp_path):
    run, _ = stopped
    config = identify.Config(choose_sign_width=False, method="least-squares")
    identify.execute(run, tmp_path, config, silent)
    declared = RunFolder(tmp_path).read(IdentifyResult, "base")
    assert declared.sign_width_factor == 1.0
    assert not any("sign_width" in note for note in declared.notes)
    narrow = run.read(IdentifyResult, "base").methods["least-squares"]
    assert declared.methods["least-squares"].held_out_rmse["piston"] > (
        1.2 * narrow.held_out_rmse["piston"]
    )


@pytest.mark.parametrize("hidden", [(), ("stribeck:piston",), ("quadratic_drag:piston",)])
def test_a_damper_that_yields_keeps_its_width_whatever_it_lacks(tmp_path, hidden):
    trials, spec, _ = record_trials(tmp_path, "damper", 12202, *hidden, pace=0.3)
    assert choose_sign_width(trials, spec).factor == 1.0
