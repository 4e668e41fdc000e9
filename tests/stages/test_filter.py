"""The filter stage on simulated sessions."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from run_folders import write_ingested

from bampipe.data.run_folder import RunFolder
from bampipe.data.store import read_parquet
from bampipe.errors import InputError
from bampipe.estimate import butterworth
from bampipe.files import read_json
from bampipe.progress import silent
from bampipe.results.setup import AxisSetup, SetupResult
from bampipe.run.state import configure
from bampipe.stages import filter as stage

AXES = {
    "yaw": {"unit": "rad", "resolution": 5e-5},
    "extension": {"unit": "m", "resolution": 3e-5},
    "pitch": {"unit": "rad", "resolution": 5e-5},
}
KINEMATIC = ("q", "qd", "qdd", "q_sd", "qd_sd", "qdd_sd")


def free_trial(seed: int = 0, seconds: float = 6.0) -> tuple[pd.DataFrame, dict[str, np.ndarray]]:
    """Return a trial as ingested and the true velocities and accelerations on its samples."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * 500)) / 500.0
    frame, truth = pd.DataFrame({"t": t}), {}
    for number, (axis, entry) in enumerate(AXES.items()):
        w = 2 * np.pi * (0.7, 1.1, 0.9)[number]
        phase = rng.uniform(0, 6)
        angle = w * t + phase + 0.5 * np.sin(1.7 * w * t)
        rate, bend = w + 0.85 * w * np.cos(1.7 * w * t), -1.445 * w**2 * np.sin(1.7 * w * t)
        x = 0.2 * np.sin(angle)
        truth[f"q_{axis}"] = x
        truth[f"qd_{axis}"] = 0.2 * np.cos(angle) * rate
        truth[f"qdd_{axis}"] = 0.2 * (np.cos(angle) * bend - np.sin(angle) * rate**2)
        frame[f"q_{axis}"] = np.floor(x / entry["resolution"]) * entry["resolution"]
    truth["force_x"] = 10 * np.sin(2 * np.pi * 1.3 * t)
    truth["force_rate_x"] = 10 * 2 * np.pi * 1.3 * np.cos(2 * np.pi * 1.3 * t)
    frame["force_x"] = truth["force_x"] + 0.05 * rng.standard_normal(len(t))
    frame["force_y"], frame["force_z"] = frame["force_x"], frame["force_x"]
    frame["brake_yaw"] = np.where(t > 3.0, 2.0, 0.0)
    return frame, truth


def run_stage(run: RunFolder, **settings: object) -> tuple[dict, pd.DataFrame]:
    """Execute the stage in the run folder; return filter.json and the kinematics."""
    stage.execute(run, run.root, configure("filter", settings), silent)
    content = read_json(run.path("filter/filter.json"))
    return content, read_parquet(run.path("filter/kinematics.parquet"))


@pytest.fixture(autouse=True)
def sound_setup(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pass over the set-up: the forces here have nothing to do with the motion.

    `tests/setup` tests its inspection, which would look for a mistake that explains them.
    """
    nothing = SetupResult(
        headline="", mistakes=(), warnings=(), tested=1,
        axes=dict.fromkeys(AXES, AxisSetup(state="sound", error_percent=1.0, moving_share=1.0)),
    )  # fmt: skip
    monkeypatch.setattr(stage, "inspect_setup", lambda *_: nothing)


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    """A run folder with a free, a viscous and a locked trial."""
    frames = {name: free_trial(seed)[0] for seed, name in enumerate("abc")}
    kinds = {"a": ("free", None), "b": ("viscous", None), "c": ("locked", "yaw")}
    return write_ingested(tmp_path / "run", frames, kinds, AXES)


@pytest.mark.parametrize("method", ["auto", "kalman", "butterworth"])
def test_motion_is_recovered(run: RunFolder, method: str) -> None:
    content, kinematics = run_stage(run, method=method)
    assert set(kinematics["trial_id"]) == {"a", "b"}
    for seed, trial in enumerate("ab"):
        rows = kinematics[kinematics["trial_id"] == trial]
        truth = free_trial(seed)[1]
        for axis, entry in AXES.items():
            assert np.std(rows[f"qd_{axis}"] - truth[f"qd_{axis}"]) < 60 * entry["resolution"]
            error = rows[f"qdd_{axis}"] - truth[f"qdd_{axis}"]
            assert np.std(error) < 0.05 * np.std(truth[f"qdd_{axis}"])
        assert np.std(rows["force_rate_x"] - truth["force_rate_x"]) < 2.0
    for axis, entry in content["axes"].items():
        assert 20.0 <= entry["bandwidth_hz"] <= 100.0, axis
        assert entry["measurement_noise_sd"] >= 0.999 * entry["resolution"] / np.sqrt(12.0)


def test_columns_and_bands_and_a_force_that_is_not_filtered(run: RunFolder) -> None:
    _, kinematics = run_stage(run)
    expected = {f"{kind}_{axis}" for kind in KINEMATIC for axis in AXES}
    expected |= {"trial_id", "t", "bridged", "stamp_offset", "brake_yaw"}
    expected |= {f"force_{c}" for c in "xyz"}
    orders = ("rate", "curvature", "third", "fourth", "fifth", "sixth")
    expected |= {f"force_{order}_{c}" for order in orders for c in "xyz"}
    assert set(kinematics.columns) == expected
    assert kinematics.notna().all(axis=None)
    rows, truth = kinematics[kinematics["trial_id"] == "a"], free_trial(0)[1]
    for axis in AXES:
        for kind in ("qd", "qdd"):
            error = np.abs(rows[f"{kind}_{axis}"] - truth[f"{kind}_{axis}"])
            assert np.mean(error < 2.0 * rows[f"{kind}_sd_{axis}"]) > 0.9
    np.testing.assert_array_equal(rows["force_x"], free_trial(0)[0]["force_x"])


def test_jitter_and_gaps(tmp_path: Path) -> None:
    frame, truth = free_trial(0)
    grid = frame["t"].to_numpy().copy()
    frame = frame.drop(index=range(1000, 1030)).reset_index(drop=True)
    frame.loc[2000:2004, "force_x"] = np.nan
    run = write_ingested(tmp_path / "run", {"a": frame}, {"a": ("free", None)}, AXES)
    content, rows = run_stage(run)
    np.testing.assert_allclose(rows["t"], grid, atol=1e-9)
    assert 28 <= rows["bridged"].iloc[995:1035].sum() <= 30
    assert 3 <= rows["bridged"].iloc[1100:].sum() <= 5
    assert content["bridged_fraction"]["a"] == pytest.approx(rows["bridged"].mean())
    inside = rows["qdd_sd_yaw"].iloc[1015]
    assert inside > 2.0 * rows["qdd_sd_yaw"].median()
    error = np.abs(rows["qd_yaw"] - truth["qd_yaw"]) / rows["qd_sd_yaw"]
    assert np.max(error) < 6.0


def test_cut_off_and_minimum_of_the_user(run: RunFolder) -> None:
    content, _ = run_stage(run, cutoff_hz=33.0)
    assert {entry["bandwidth_hz"] for entry in content["axes"].values()} == {33.0}
    assert {entry["bandwidth_reason"] for entry in content["axes"].values()} == {"set by the user"}
    content, _ = run_stage(run, minimum_bandwidth_hz=48.0)
    for entry in content["axes"].values():
        assert entry["bandwidth_hz"] == pytest.approx(48.0)
        assert "minimum" in entry["bandwidth_reason"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"method": "spline"}, "spline"),
        ({"cutoff_hz": 400.0}, "half the sampling rate"),
        ({"cutoff_hz": -1.0}, r"filter\.cutoff_hz: found -1.0, expected 0 or more"),
        ({"force_cutoff_hz": -1.0}, "expected 0 or more"),
        ({"tuning_samples": 1}, "1000"),
    ],
)
def test_settings_that_make_no_sense(
    run: RunFolder, settings: dict[str, object], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        run_stage(run, **settings)


@pytest.mark.parametrize(
    ("settings", "cutoff_hz"),
    [({}, 25.0), ({"band_hz": 12.0}, 48.0), ({"band_hz": 12.0, "force_cutoff_hz": 30.0}, 30.0)],
)
def test_derivatives_of_the_force_reach_beyond_the_band(
    run: RunFolder, settings: dict[str, object], cutoff_hz: float
) -> None:
    content, kinematics = run_stage(run, **settings)
    assert content["force"]["derivative_cutoff_hz"] == cutoff_hz
    force = next(c for c in kinematics if c.startswith("force_") and "rate" not in c)
    values = kinematics[kinematics["trial_id"] == kinematics["trial_id"].iloc[0]]
    (rate, *_) = butterworth.rates(
        values[force].to_numpy(), content["sample_rate_hz"], cutoff_hz, 2
    )
    component = force.removeprefix("force_")
    np.testing.assert_allclose(values[f"force_rate_{component}"], rate, rtol=1e-9, atol=1e-9)


def test_motion_that_outruns_its_log_is_told_from_a_coarse_encoder() -> None:
    rng, t = np.random.default_rng(1), np.arange(1000) / 100.0
    assert stage._outruns(np.cumsum(rng.normal(0.0, 1e-3, t.size)), 1e-6)
    assert not stage._outruns(1e-2 * np.sin(20.0 * t), 1e-7)
    assert not stage._outruns(1e-4 * np.sin(t) + rng.normal(0.0, 1e-5, t.size), 1e-5)


def test_trials_that_are_too_few_or_too_short_are_said_with_their_size(tmp_path: Path) -> None:
    frames = {"a": free_trial(0)[0]}
    run = write_ingested(tmp_path / "run", frames, {"a": ("locked", "yaw")}, AXES)
    with pytest.raises(InputError, match=r'no free or viscous trial among 1: .*kind = "free"'):
        run_stage(run)
    whole = free_trial(0)[0]
    frames = {"a": whole.head(20), "b": whole.head(31)}
    run = write_ingested(tmp_path / "run", frames, dict.fromkeys(frames, ("free", "")), AXES)
    said = "none of the 2 free and viscous trials is long enough: a has 20 sound samples, of which"
    with pytest.raises(InputError, match=said):
        run_stage(run)
    frames = {"a": whole, "b": whole.head(31)}
    run = write_ingested(tmp_path / "run", frames, dict.fromkeys(frames, ("free", "")), AXES)
    summary = stage.execute(run, run.root, configure("filter", {}), silent)
    assert summary["notes"] == ["b: not used: 31 sound samples, of which 32 are needed"]


def test_of_very_many_trials_some_choose_the_bandwidth(tmp_path: Path) -> None:
    """Those are spread over the session; where none of them will do, another one does."""
    names = "abcde"
    frames = {name: free_trial(seed)[0] for seed, name in enumerate(names)}
    run = write_ingested(tmp_path / "long", frames, {n: ("free", None) for n in names}, AXES)
    path = run.path("ingest/samples.parquet")

    def chosen(path: Path, budget: int) -> list[list[float]]:
        found, _ = stage._tuning_records(path, names, tuple(AXES), 500.0, budget)
        records = found["yaw"]
        assert all(x.base is None and seen.base is None for x, seen in records), "whole trials kept"
        assert all(len(x) == budget // len(records) for x, _ in records)
        return [[float(x[0]), float(x[1])] for x, _ in records]

    first = {name: frame["q_yaw"].to_list()[:2] for name, frame in frames.items()}
    assert chosen(path, 4000) == [first["a"], first["e"]]
    assert chosen(path, 10_000) == list(first.values())
    frames |= {name: frames[name][:20] for name in "ae"}
    short = write_ingested(tmp_path / "short", frames, {n: ("free", None) for n in names}, AXES)
    found, refused = stage._tuning_records(
        short.path("ingest/samples.parquet"), names, tuple(AXES), 500.0, 4000
    )
    assert [x[:2].tolist() for x, _ in found["yaw"]] == [first["b"]]
    assert set(refused) == {"a", "e"}
