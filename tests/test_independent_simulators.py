"""The independent simulators record what they promise, under names that bampipe knows."""

from dataclasses import replace

import independent
import numpy as np
import pandas as pd
import pytest
from conftest import bytes_of
from independent import arm
from independent.sensors import HARD, Conditions
from independent_runs import device_of
from scipy.interpolate import CubicSpline

from bampipe.physics import Model

BRIEF = Conditions(trials=1, seconds=0.8)


@pytest.mark.parametrize(
    "machine",
    [
        pytest.param(name, marks=[pytest.mark.long] * (name not in ("joint", "damper")))
        for name in independent.MACHINES
    ],
)
def test_every_effect_changes_what_is_recorded(tmp_path, machine):
    known = independent.MACHINES[machine]
    free = Conditions(trials=1, seconds=3.0)
    braked = Conditions(trials=1, seconds=1.5, viscous_trials=1)
    bare = {}
    for name, day in (("free", free), ("braked", braked)):
        independent.record(machine, tmp_path / name, 3, conditions=day)
        bare[name] = bytes_of(tmp_path / name)
    for number, effect in enumerate(
        (*known.EFFECTS, *known.UNKNOWN, *getattr(known, "BY_NAME", ()))
    ):
        name, day = ("braked", braked) if effect.startswith("brake") else ("free", free)
        folder = tmp_path / str(number) / name
        independent.record(machine, folder, 3, {effect: 1.0}, day)
        tables = [pd.read_csv(file) for file in sorted(folder.rglob("*.csv"))]
        assert all(np.isfinite(table.to_numpy()).all() for table in tables), effect
        assert bytes_of(folder) != bare[name], effect


@pytest.mark.parametrize("machine", independent.MACHINES)
def test_effects_of_the_library_have_its_names(machine):
    known, device = independent.MACHINES[machine], device_of(machine)
    for effect in known.EFFECTS:
        assert [item.name for item in Model(device, [effect]).effects] == [effect]
    for effect in known.UNKNOWN:
        assert effect.partition(":")[0] in known.OUTSIDE


@pytest.mark.parametrize("machine", independent.MACHINES)
def test_a_seed_gives_the_same_bytes_and_another_seed_others(tmp_path, machine):
    folders = [tmp_path / name / "session" for name in ("one", "two", "other")]
    for folder, seed in zip(folders, (5, 5, 6), strict=True):
        independent.record(machine, folder, seed, conditions=BRIEF)
    one, two, other = map(bytes_of, folders)
    assert one == two
    assert one != other
    truths = [folder.with_name("session.truth.json").read_bytes() for folder in folders]
    assert truths[0] == truths[1] != truths[2]


@pytest.mark.parametrize("day", HARD)
def test_conditions_change_the_recording_and_not_the_machine(tmp_path, day):
    brief = {"trials": 1, "seconds": 4.0}
    truth = independent.record("joint", tmp_path / "bare", 7, {}, Conditions(**brief))
    short = {"trials": 2} if day == "three short trials" else brief
    hard = independent.record("joint", tmp_path / "hard", 7, {}, replace(HARD[day], **short))
    assert bytes_of(tmp_path / "bare") != bytes_of(tmp_path / "hard")
    assert truth["parameters"] == hard["parameters"]


@pytest.mark.parametrize("kinds", ["ZYYX", "ZZzZ", "zYXYZ", "ZYZYZYZ"])
def test_the_arm_carries_what_pinocchio_says(kinds):
    pin = pytest.importorskip("pinocchio")
    specimen = arm.build(kinds, 8)
    model = pin.buildModelFromXML(arm.urdf(specimen))
    q, qd, qdd = np.random.default_rng(0).normal(size=(3, 6, len(kinds)))
    data = model.createData()
    expected = [pin.rnea(model, data, *sample) for sample in zip(q, qd, qdd, strict=True)]
    np.testing.assert_allclose(specimen.rigid(q, qd, qdd), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("effect", arm.EFFECTS)
def test_every_effect_of_the_arm_changes_its_log(tmp_path, effect):
    target = "shoulder-elbow" if effect == "friction_of_sum" else "shoulder"
    for name, effects in (("bare", {}), ("hidden", {f"{effect}:{target}": 1.0})):
        arm.record_logs(tmp_path / name, 8, "ZYY", effects, trials=1, seconds=4.0)
    bare, hidden = (pd.read_csv(tmp_path / name / "log_01.csv") for name in ("bare", "hidden"))
    assert np.isfinite(hidden.to_numpy()).all()
    positions = [column for column in bare if not column.startswith("tau")]
    pd.testing.assert_frame_equal(bare[positions], hidden[positions])
    assert not np.allclose(bare["tau_2 [Nm]"], hidden["tau_2 [Nm]"])


@pytest.mark.long
def test_joints_of_soft_drives_stand_still_within_their_friction():
    specimen = arm.build("ZY", 8)
    t, q, _, drive = arm.measure(specimen, np.random.default_rng(1), 3.0, 250.0, 0.0, soft_hz=4.0)
    still = np.zeros(q.shape, dtype=bool)
    still[2:-2] = (q[4:] == q[2:-2]) & (q[:-4] == q[2:-2])
    assert np.all(np.count_nonzero(still, axis=0) > 5)
    spline = CubicSpline(t, q)
    load, dry = specimen.carried(q, spline(t, 1), spline(t, 2))
    rest = still.all(axis=1)
    assert np.all(np.abs(drive - load)[rest] < 1.02 * dry[rest])
    # Counts of the encoder make accelerations noisy: in the mean the equation holds.
    moving = np.all(np.abs(spline(t, 1)) > 0.05, axis=1)
    off = (drive - specimen.required(q, spline(t, 1), spline(t, 2)))[moving]
    np.testing.assert_allclose(off.mean(axis=0), 0.0, atol=0.05 * specimen.coulomb.min())
