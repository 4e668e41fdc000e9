"""What an arm of the independent simulator hides is named, from URDF and logs alone."""

from pathlib import Path

import pytest
from independent import arm

import bampipe
from bampipe.data.run_folder import RunFolder
from bampipe.files import read_json
from bampipe.setup.proposal import propose, write_proposal


def run_arm(
    root: Path, seed: int, kinds: str, effects: dict[str, float], **how: float
) -> RunFolder:
    """Record an arm, let `init` propose the session, and run it up to validate."""
    folder = root / "arm"
    arm.record_logs(folder, seed, kinds, effects, style="joint_states", seconds=8.0, **how)
    proposal = propose(folder)
    assert proposal.fill_in == []
    write_proposal(folder, proposal)
    bampipe.run_session(folder, runs=root / "runs", last="validate")
    return RunFolder(root / "runs" / "arm")


@pytest.mark.long
def test_a_spring_that_the_model_lacks_carries_no_replicate_away(tmp_path: Path) -> None:
    run = run_arm(tmp_path, 31, "ZY", {"return_spring:base_yaw": 4.0})
    axes = read_json(run.path("models/base/validate.json"))["axes"]
    for axis, entry in axes.items():
        over = entry["held_out_rmse"] / entry["noise_floor"]
        assert over > 50.0 if axis == "base_yaw" else 0.8 < over < 1.25


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "strength", "effect"), [(32, 1.0, "drive_delay"), (34, -0.5, "drive_reading_delay")]
)
def test_a_drive_that_is_late_or_read_late_is_named(
    tmp_path: Path, seed: int, strength: float, effect: str
) -> None:
    run = run_arm(tmp_path, seed, "ZY", {"actuator_delay:shoulder": strength})
    bampipe.diagnose(run.root)
    found = read_json(run.path("models/base/diagnose.json"))
    assert found["selected"] == [f"{effect}:torque_shoulder"]
    best = found["ranking"][0]
    truth = read_json(tmp_path / "arm.truth.json")["effects"]["actuator_delay:shoulder"]["delay"]
    fitted = best["parameters"][f"{effect}.torque_shoulder.delay"]
    assert fitted == pytest.approx(abs(truth), rel=0.1)
    shoulder = found["axes"]["shoulder"]
    # Friction jumps between other samples of the log than of the position, in replicates, too.
    assert 0.9 < shoulder["rmse_after"] / shoulder["noise_floor"] < 1.1


@pytest.mark.long
def test_beside_the_delay_of_one_drive_the_others_keep_their_timing(tmp_path: Path) -> None:
    late = dict.fromkeys(("actuator_delay:base_yaw", "actuator_delay:elbow"), 0.1)
    run = run_arm(tmp_path, 36, "ZYY", {"actuator_delay:shoulder": 1.0, **late})
    bampipe.extend(run.root, "drive_delay:torque_shoulder")
    truth = read_json(tmp_path / "arm.truth.json")["effects"]
    clock = truth["actuator_delay:elbow"]["delay"]
    model = "models/base+drive_delay.torque_shoulder"
    found = read_json(run.path(f"{model}/identify.json"))
    assert found["input_timing"]["of_residual"] == pytest.approx(clock, rel=0.1)
    delay = found["parameters"]["drive_delay.torque_shoulder.delay"]["estimate"]
    assert delay == pytest.approx(truth["actuator_delay:shoulder"]["delay"] - clock, rel=0.05)
    for entry in read_json(run.path(f"{model}/validate.json"))["axes"].values():
        assert entry["held_out_rmse"] < 1.2 * entry["noise_floor"]


@pytest.mark.long
def test_joints_that_stick_are_held_against_replicates_that_do(tmp_path: Path) -> None:
    run = run_arm(tmp_path, 33, "ZY", {}, soft_hz=4.0, noise=0.01, rate_hz=250.0)
    found = read_json(run.path("models/base/validate.json"))
    assert {entry["standing"] for entry in found["axes"].values()} == {"at_floor"}


@pytest.mark.long
def test_friction_that_comes_up_gradually_has_one_name_a_joint(tmp_path: Path) -> None:
    """Without that name, each joint had two others."""
    run = run_arm(tmp_path, 35, "ZY", {}, creep=0.05)
    bampipe.diagnose(run.root)
    found = read_json(run.path("models/base/diagnose.json"))
    assert set(found["selected"]) == {
        f"gradual_friction:{joint}" for joint in ("base_yaw", "shoulder")
    }
    for entry in found["ranking"][:2]:
        (speed,) = (v for name, v in entry["parameters"].items() if name.endswith("speed"))
        assert speed == pytest.approx(0.05, rel=0.1)
