"""Sessions made by the simulator: the raw-log format, the truth beside it, the physics inside."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import bytes_of, misfits
from scipy.optimize import least_squares
from scipy.signal import butter, sosfiltfilt

import bampipe
from bampipe.data.session import read_session
from bampipe.errors import InputError
from bampipe.physics import Model, compile_model, registry
from bampipe.simulator.simulated_session import Config, simulate_session
from bampipe.trials.motion import Motion

AXES = ("yaw", "pitch", "extension")
SAMPLES = Path(__file__).parents[2] / "sample_runs"


def make(tmp_path, **options):
    out = tmp_path / "made"
    summary = simulate_session(out, Config.read(options))
    return out, json.loads((tmp_path / "made.truth.json").read_text()), summary


def read(out, number):
    """One trial in SI units: its entry, t, q, force, brake."""
    session = tomllib.loads((out / "session.toml").read_text())
    entry = session["trials"][number]
    path = out / entry["file"]
    frame = pd.read_parquet(path) if path.suffix == ".parquet" else pd.read_csv(path)
    t = frame["time_us"].to_numpy() * 1e-6
    q = np.column_stack(
        [
            (frame[e["column"]] - e["zero_counts"]) / e["counts_per_unit"]
            for e in session["encoders"].values()
        ]
    )
    volts = frame[session["force"]["columns"]].to_numpy() - session["force"]["zero_v"]
    force = volts @ np.array(session["force"]["calibration_n_per_v"]).T
    return entry, t, q, force, frame[session["brakes"]["columns"]].to_numpy()


def test_a_session_that_ingest_accepts(tmp_path):
    out, _, summary = make(tmp_path, duration=1.0, trials=2, viscous_trials=1, locked_trials=True)
    session = read_session(out)
    assert session.session_id == "made" and session.device == "bam"
    assert [t.kind for t in session.trials] == ["free"] * 2 + ["viscous"] + ["locked"] * 3
    assert session.trials[2].viscous == 40.0
    assert [t.locked_axis for t in session.trials[3:]] == list(AXES)
    assert all((out / name).is_file() for name in summary["trials"])
    assert session.force.noise_sd == 0.05


@pytest.mark.parametrize("device", registry.device_names())
def test_every_built_in_device_is_ingested_or_refused(tmp_path, device):
    try:
        out, *_ = make(tmp_path, device=device, duration=1.0, trials=1)
    except InputError as refusal:
        assert device in refusal.what
        return
    bampipe.run_session(out, runs=tmp_path / "runs", last="ingest")
    assert (tmp_path / "runs/made/ingest/samples.parquet").exists()


def test_same_seed_same_bytes_other_seed_other_motion(tmp_path):
    for name, seed in (("a", 4), ("b", 4), ("c", 5)):
        config = Config(effects=("force_bias:x",), duration=1.0, trials=1, seed=seed)
        simulate_session(tmp_path / name / "made", config)
    assert bytes_of(tmp_path / "a") == bytes_of(tmp_path / "b")
    assert bytes_of(tmp_path / "a") != bytes_of(tmp_path / "c")


def test_truth_is_beside_and_never_inside(tmp_path):
    out, truth, _ = make(tmp_path, effects=("stribeck:yaw=0.5",), duration=1.0, trials=1)
    assert truth["effects"] == {"stribeck:yaw": 0.5}
    assert misfits(tmp_path) == []
    assert truth["parameters"]["stribeck.yaw.force"] == pytest.approx(0.6)
    assert not any(b"stribeck" in content for content in bytes_of(out).values())


def test_human_like_motion(tmp_path):
    out, _, _ = make(tmp_path, seed=3)
    for number in range(5):
        _, t, q, force, brake = read(out, number)
        assert len(t) == 8000 and t[1] == pytest.approx(0.002)
        assert (np.ptp(q, axis=0) > [0.6, 0.4, 0.2]).all()
        limits = np.array([registry.device("bam").limits[a] for a in AXES])
        assert (q > limits[:, 0]).all() and (q < limits[:, 1]).all()
        assert np.abs(force).max() < 120 and np.abs(force).std(axis=0).min() > 1
        assert not brake.any()
        power = np.abs(np.fft.rfft(force - force.mean(axis=0), axis=0)) ** 2
        frequency = np.fft.rfftfreq(len(t), 0.002)
        assert (power[frequency < 2.5].sum(axis=0) > 0.9 * power.sum(axis=0)).all()


def test_sensor_noise_and_quantisation(tmp_path):
    """The force noise is the one asked for; the encoders write whole counts."""
    out, _, _ = make(tmp_path, duration=4.0, trials=1, force_noise=0.2)
    _, _, _, force, _ = read(out, 0)
    third = np.diff(force, n=3, axis=0)  # leaves the noise of a smooth force, variance times 20
    assert third.std(axis=0) / np.sqrt(20) == pytest.approx([0.2] * 3, rel=0.1)
    frame = pd.read_csv(out / "trials" / "t01_free.csv")
    assert all(frame[f"enc_{a}"].dtype == np.int64 for a in AXES)


def test_viscous_field_is_that_of_the_pose(tmp_path):
    """Brake commands are J^T K J times the speed, a controller's lag of 10 ms behind it."""
    out, _, _ = make(tmp_path, duration=6.0, trials=0, viscous_trials=1, seed=2)
    entry, t, q, _, brake = read(out, 0)
    assert entry["viscous_n_s_per_m"] == 40.0
    sos = butter(2, 20, fs=500, output="sos")
    rate = np.gradient(sosfiltfilt(sos, q, axis=0), t, axis=0)
    rate = np.column_stack([np.interp(t - 0.011, t, column) for column in rate.T])
    r, pitch = q[:, 2], q[:, 1]
    damping = 40.0 * np.column_stack([(r * np.cos(pitch)) ** 2, r**2, np.ones_like(r)])
    expected = damping * np.abs(rate)
    error = np.sqrt(((brake - expected)[50:-50] ** 2).mean(axis=0))
    assert (error < 0.03 * brake.max(axis=0)).all()


def test_locked_trials_hold_the_stiffness(tmp_path):
    out, truth, _ = make(tmp_path, trials=0, locked_trials=True, seed=6)
    for number, axis in enumerate(AXES):
        entry, _, q, force, brake = read(out, number)
        assert entry["locked_axis"] == axis
        assert (brake[:, number] == 200).all()
        r, pitch = q[:, 2], q[:, 1]
        load = force * np.column_stack([r * np.cos(pitch), r, np.ones_like(r)])
        slope, _ = np.polyfit(q[:, number], load[:, number], 1)
        assert slope == pytest.approx(truth["stiffness"][axis], rel=0.15)
        width = load[:, number] - truth["stiffness"][axis] * (q[:, number] - q[:, number].mean())
        assert np.ptp(width) > 2 * truth["parameters"][f"coulomb.{axis}"]  # a loop, not a line


def fit(out, effects, start):
    """Least squares of a model on the free trials, both sides low-passed alike."""
    system = compile_model(Model(registry.device("bam"), effects))
    sos25, sos8 = (butter(2, f, fs=500, output="sos") for f in (25, 8))
    trials = []
    for number in range(3):
        _, t, q, force, _ = read(out, number)
        q, force = (sosfiltfilt(sos25, a, axis=0) for a in (q, force))
        qd = np.gradient(q, t, axis=0)
        rate = np.gradient(force, t, axis=0)
        columns = {"t": t} | {f"brake_{a}": 0 * t for a in AXES}
        for j, c in enumerate("xyz"):
            columns[f"force_{c}"], columns[f"force_rate_{c}"] = force[:, j], rate[:, j]
            slope = rate[:, j]
            for order in ("curvature", "third", "fourth", "fifth", "sixth"):
                slope = np.gradient(slope, t)
                columns[f"force_{order}_{c}"] = slope
        u = np.column_stack([columns[name] for name in system.inputs])
        trials.append((q, qd, np.gradient(qd, t, axis=0), u, t))

    def misfit(p):
        parts = []
        for q, qd, qdd, u, t in trials:
            read = Motion("read", t, q, qd, qdd, np.zeros_like(q), {})
            at = read.of_mechanism(system, u, p).kinematics
            z = system.memory(*at, u, p, t)
            r = system.applied(*at, z, u, p) - system.required(*at, z, u, p)
            parts.append(sosfiltfilt(sos8, r, axis=0)[100:-100:8])
        return np.concatenate(parts).ravel()

    names = [p.name for p in system.parameters]
    guess = np.array([start.get(p.name, p.prior) for p in system.parameters])
    found = least_squares(misfit, guess, x_scale="jac")
    return dict(zip(names, found.x, strict=True)), np.sqrt(np.mean(found.fun**2))


@pytest.mark.parametrize(
    ("effect", "parameter", "guess", "tolerance"),
    [
        ("quadratic_drag:yaw", "coefficient", 0.3, 0.1),
        ("gravity_compensator_lag", "time_constant", 0.1, 0.05),
        ("force_delay", "delay", 0.005, 0.08),
        ("encoder_scale:yaw", "error", 0.01, 0.15),
        pytest.param("force_gain:x", "error", 0.0, 0.15, marks=pytest.mark.long),
        pytest.param("force_bias:y", "bias", 0.0, 0.1, marks=pytest.mark.long),
        pytest.param("force_drift:z", "rate", 0.0, 0.15, marks=pytest.mark.long),
        pytest.param("handle_payload", "payload", 0.1, 0.1, marks=pytest.mark.long),
    ],
)
def test_hidden_effect_comes_back_through_the_sensors(
    tmp_path, effect, parameter, guess, tolerance
):
    """Also the inverse of what a model's input and measurement expressions say."""
    out, truth, _ = make(tmp_path, effects=(effect,), trials=3, seed=8)
    name = f"{effect.replace(':', '.')}.{parameter}"
    found, error = fit(out, [effect], {name: guess})
    assert found[name] == pytest.approx(truth["parameters"][name], rel=tolerance)
    _, without = fit(out, [], {})
    assert error < 0.8 * without


def test_own_effect_file(tmp_path):
    """A lag of the force sensor, written by a user: simulated by the same inversion."""
    own = tmp_path / "sensor_lag.toml"
    own.write_text(
        'name = "sensor_lag"\nsummary = "lag"\nscope = "force_component"\nkind = "input"\n'
        'input = "f + time_constant*f_rate"\nlooks_like = "late"\nsource = "2020"\n'
        '[parameters.time_constant]\nunit = "s"\nprior = 0.0\nsd = 0.05\nstrength = true\n'
        "lower = 0.0\ntypical = 0.05\n"
    )
    options = {"duration": 4.0, "trials": 1, "force_noise": 0.0, "seed": 1}
    simulate_session(tmp_path / "plain", Config(**options))
    lagging = Config(effects=("sensor_lag:z",), effect_files=(str(own),), **options)
    simulate_session(tmp_path / "lag", lagging)
    _, t, _, true, _ = read(tmp_path / "plain", 0)
    _, _, _, seen, _ = read(tmp_path / "lag", 0)
    np.testing.assert_allclose(seen[:, :2], true[:, :2], atol=1e-3)
    rebuilt = seen[:, 2] + 0.05 * np.gradient(seen[:, 2], t)
    assert np.sqrt(np.mean((rebuilt - true[:, 2])[10:] ** 2)) < 0.05 * true[:, 2].std()
    assert np.sqrt(np.mean((seen - true)[:, 2] ** 2)) > 0.05 * true[:, 2].std()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"effects": ("stribek:yaw",)}, "did you mean 'stribeck'"),
        ({"effects": ("stribeck:yaww",)}, "stribeck:yaw"),
        ({"effects": ("stribeck:yaw", "stribeck:yaw=2")}, "named twice"),
        ({"effects": ("stribeck:yaw=much",)}, "not a number"),
        ({"effects": ("stribeck:yaw=-1",)}, "must not be negative"),
        ({"device": "bamm"}, "no built-in device 'bamm', did you mean 'bam'"),
        ({"device": "magnetic_damper"}, "it takes current, and only forces are simulated"),
        ({"device": "servo_pendulum"}, "it takes duty and supply, and only forces"),
        ({"trials": 0}, "nothing to simulate"),
        ({"duration": 0.0}, "duration: found 0.0, expected more than 0"),
        ({"duration": 0.001}, "fewer than 10 samples"),
        ({"amplitude": 3.0}, "amplitude: found 3.0, expected 1 or less"),
        ({"strength": -1.0}, "strength: found -1.0, expected 0 or more"),
        ({"file_format": "xls"}, 'found "xls", expected "csv" or "parquet"'),
        ({"parameters": {"viscos.yaw": 3.0}}, "no parameter 'viscos.yaw'"),
        ({"effect_files": ("nowhere.toml",)}, "nowhere.toml"),
    ],
)
def test_mistakes_are_one_clear_line(tmp_path, options, message):
    with pytest.raises(InputError, match=message) as caught:
        make(tmp_path, **options)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("name", ["demo", "first"])
def test_sample_sessions_are_what_their_truth_says(tmp_path, name):
    truth = json.loads((SAMPLES / f"{name}.truth.json").read_text())
    lists = {key: tuple(truth["configuration"][key]) for key in ("effects", "effect_files")}
    options = truth["configuration"] | lists
    simulate_session(tmp_path / name, Config(**options))
    assert json.loads((tmp_path / f"{name}.truth.json").read_text()) == truth
    count = len(tomllib.loads((SAMPLES / name / "session.toml").read_text())["trials"])
    for number in range(count):
        shipped, made = read(SAMPLES / name, number), read(tmp_path / name, number)
        assert shipped[0] == made[0]
        for left, right in zip(shipped[1:], made[1:], strict=True):
            np.testing.assert_allclose(left, right, atol=2e-3)  # other processors round otherwise


def test_names_and_folders_that_no_session_can_have(tmp_path):
    with pytest.raises(InputError, match="cannot name a session"):
        simulate_session(tmp_path / "two words", Config())
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write"):
        simulate_session(tmp_path / "file" / "inside", Config(duration=1.0))
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "precious.txt").write_text("x")
    with pytest.raises(InputError, match="not an empty folder"):
        make(tmp_path, duration=1.0)
