"""Uncertainty of sensors and drawings reaches the intervals, and is said apart from statistics."""

from pathlib import Path

import independent
import numpy as np
import pytest
from independent.sensors import Conditions
from independent_runs import STAGES, run_short
from mistakes import scale_column, set_text

from bampipe.results.identify import IdentifyResult, ParameterEstimate
from bampipe.results.stiffness import StiffnessResult

SHARE = 0.02


def parameters_of(root: Path, *changes) -> dict[str, ParameterEstimate]:
    """Parameters of a joint's session, changed by ``changes`` before it is read."""
    folder = root / "joint"
    independent.record("joint", folder, 41, {}, Conditions(creep=True, trials=3, seconds=8.0))
    for change in changes:
        change(folder)
    run = run_short(folder, root, STAGES[:-1], identify={"method": "least-squares"})
    return dict(IdentifyResult.read(run.root / "models/base/identify.json").parameters)


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ParameterEstimate]:
    return parameters_of(tmp_path_factory.mktemp("bare"))


@pytest.mark.parametrize(
    ("pattern", "new", "file"),
    [
        ('unit = "A" }', f'unit = "A", scale_sd = {SHARE} }}', "session.toml"),
        ('source = "data sheet"', f'source = "data sheet", sd = {10.0 * SHARE}', "joint.toml"),
    ],
    ids=["sensor", "constant"],
)
def test_what_scales_the_input_scales_all(tmp_path, bare, pattern, new, file) -> None:
    """Torque is a constant times current: an error of either is one of every parameter."""
    found = parameters_of(tmp_path, set_text(pattern, new, file))
    for name, entry in found.items():
        # Of least squares as it stands: its bias is taken off what is published.
        part, share = entry.calibration_sd, SHARE * abs(entry.estimate)
        assert part == pytest.approx(share, rel=0.02, abs=0.1 * entry.statistical_sd), name
        assert entry.statistical_sd == pytest.approx(bare[name].statistical_sd, rel=1e-6)
        total = np.hypot(entry.statistical_sd, entry.calibration_sd)
        assert entry.sd == pytest.approx(total, rel=1e-6)


def test_the_scale_of_an_encoder_and_the_truth_of_a_sensor_that_errs(tmp_path, bare) -> None:
    """Friction follows the speed, dry friction does not, and gravity is found at other angles."""
    found = parameters_of(tmp_path, set_text('unit = "rad",', f'unit = "rad", scale_sd = {SHARE},'))
    expected = {"viscous.joint": 1.0, "inertia": 1.0, "coulomb.joint": 0.0}
    for name, share in expected.items():
        part = found[name].calibration_sd / found[name].estimate
        assert part == pytest.approx(share * SHARE, abs=0.35 * SHARE), name
    changed = parameters_of(tmp_path / "changed", scale_column("q", 1.0 + SHARE))
    for name, entry in found.items():
        moved = abs(changed[name].estimate - bare[name].estimate)
        assert moved == pytest.approx(entry.calibration_sd, rel=0.15, abs=2.0 * bare[name].sd), name
    off = scale_column("i", 1.0 + SHARE)
    stated = set_text('unit = "A" }', f'unit = "A", scale_sd = {SHARE} }}')
    for name, entry in parameters_of(tmp_path, off, stated).items():
        assert abs(entry.estimate - bare[name].estimate) < 1.3 * entry.sd, name
    assert all(entry.calibration_sd < 0.1 * entry.sd for entry in bare.values())


def test_the_zero_of_an_encoder_is_known_to_a_step(tmp_path) -> None:
    """It turns gravity: the moments across and along the zero move as the arm's angle does."""
    step = 2e-3
    found = parameters_of(tmp_path, set_text("resolution = 5e-05", f"resolution = {step}"))
    turned = step / np.sqrt(3.0)
    across, moment = found["moment_across"], found["moment"]
    assert across.calibration_sd == pytest.approx(abs(moment.estimate) * turned, rel=0.05)
    share = abs(across.estimate) * turned
    assert moment.calibration_sd == pytest.approx(share, abs=0.1 * moment.sd)
    for name in ("inertia", "viscous.joint", "coulomb.joint"):
        assert found[name].calibration_sd < 0.1 * found[name].sd, name


def test_a_stiffness_is_as_uncertain_as_its_force(tmp_path) -> None:
    conditions = Conditions(trials=1, seconds=3.0, locked_trials=True)
    independent.record("bam", tmp_path / "bam", 41, {}, conditions)
    set_text("noise_sd_n", "gain_sd = 0.01\nnoise_sd_n")(tmp_path / "bam")
    run = run_short(tmp_path / "bam", tmp_path, ("ingest", "filter", "stiffness"))
    axes = StiffnessResult.read(run.root / "stiffness/stiffness.json").axes
    for entry in axes.values():
        assert entry.calibration_sd == pytest.approx(0.01 * entry.stiffness, rel=0.02)
        parts = (entry.standard_error, entry.systematic, entry.calibration_sd)
        assert entry.sd == pytest.approx(np.linalg.norm(parts))
