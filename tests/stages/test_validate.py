"""The validate stage on simulated sessions, and trials that a session holds out."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import schema_misfits
from identified_run import SQUARES, identified, recorded_run, simulated_run
from made_results import write_model

from bampipe.data.run_folder import RunFolder
from bampipe.data.store import read_parquet, write_parquet
from bampipe.errors import InputError
from bampipe.files import read_json, write_json
from bampipe.physics import Model, compile_model, registry
from bampipe.progress import silent
from bampipe.run.state import configure
from bampipe.simulator import simulated_session as simulation
from bampipe.stages import identify, validate
from bampipe.trials.measured import read_measured_trials
from bampipe.trials.reading import free_trials


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunFolder]:
    yield identified(simulated_run(tmp_path_factory.mktemp("simulated")))


def validated(run: RunFolder, config: validate.Config | None = None) -> dict:
    """Execute the stage in the run folder; return validate.json, checked."""
    config = config or validate.Config()
    validate.execute(run, run.root, config, silent)
    content = read_json(run.path(f"models/{config.model}/validate.json"))
    assert schema_misfits(content, "validate") == []
    return content


def test_a_sound_model_is_at_its_noise_floor(simulated: RunFolder) -> None:
    content = validated(simulated)
    for axis, entry in content["axes"].items():
        assert entry["held_out_rmse"] < 1.5 * entry["noise_floor"], axis
        assert entry["rmse_without_friction"] > 10.0 * entry["rmse"], axis
        assert entry["fit_percent"] > 95.0, axis
    assert content["notes"] == []


def test_each_term_takes_the_force_that_its_formula_says(simulated: RunFolder) -> None:
    validated(simulated)
    content = read_json(simulated.path("models/base/terms.json"))
    assert schema_misfits(content, "terms") == []
    found = read_json(simulated.path("models/base/identify.json"))
    covariance, names = np.array(found["covariance"]["matrix"]), found["covariance"]["names"]
    terms = {term["name"]: term for term in content["terms"]}
    assert set(terms) == {"friction:yaw", "friction:pitch", "friction:extension"}
    for name, term in terms.items():
        axis = name.partition(":")[2]
        [curve] = term["curves"]
        assert (curve["axis"], curve["variable"]) == (axis, "velocity")
        assert term["parameters"] == [f"viscous.{axis}", f"coulomb.{axis}"]
        speed, mean = np.array(curve["center"]), np.array(curve["mean"])
        fast = np.abs(speed) > 0.4 * np.abs(speed).max()  # slower, the low-pass rounds the step
        slope, step = (found["parameters"][item]["estimate"] for item in term["parameters"])
        assert mean[fast] == pytest.approx((slope * speed + step * np.sign(speed))[fast], rel=0.04)
        rows = [names.index(item) for item in term["parameters"]]
        column = np.column_stack([speed, np.sign(speed)])[fast]
        variance = np.einsum("bi,ij,bj->b", column, covariance[np.ix_(rows, rows)], column)
        half = (np.array(curve["high"]) - mean)[fast]
        assert half == pytest.approx(1.96 * np.sqrt(variance), rel=0.1)
    mass = found["parameters"]["mass"]["estimate"]
    assert f"M[r,r] = {mass:.4g}" in content["equations"]
    assert not any("viscous." in line or "mass " in line for line in content["equations"][:7])


def test_what_brakes_do_is_judged_in_the_trials_in_which_they_act(tmp_path: Path) -> None:
    """A lag of the brakes: free trials know nothing of it, and must not suffer from it."""
    days = {"trials": 2, "viscous_trials": 2, "duration": 5}
    hidden = simulation.Config(effects=("brake_lag",), seed=5, file_format="parquet", **days)
    truth = simulation.simulate_session(tmp_path / "session", hidden)
    run = recorded_run(tmp_path / "run", tmp_path / "session")
    ratios = {}
    for name, effects in (("base", ()), ("lag", ("brake_lag",))):
        write_model(run.root, name, *effects)
        identify.execute(run, run.root, replace(SQUARES, model=name), silent)
        content = validated(run, validate.Config(model=name, repeats=3))
        ratios[name] = {
            axis: entry["held_out_rmse"] / entry["noise_floor"]
            for axis, entry in content["axes"].items()
        }
        for trial, axes in content["trials"].items():
            if "free" in trial:
                assert axes["yaw"]["held_out_rmse"] < 0.1, (name, trial)
    assert min(ratios["base"].values()) > 5.0, ratios
    assert max(ratios["lag"].values()) < 1.5, ratios
    found = read_json(run.path("models/lag/identify.json"))["parameters"]["brake_lag.time_constant"]
    hidden_value = read_json(Path(str(truth["truth"])))["parameters"]["brake_lag.time_constant"]
    assert found["estimate"] == pytest.approx(hidden_value, rel=0.01)
    assert found["sd"] < 0.01 * hidden_value


def test_wrong_parameters_show(simulated: RunFolder) -> None:
    content = read_json(simulated.path("models/base/identify.json"))
    content["parameters"]["coulomb.yaw"]["estimate"] *= 1.5
    config = validate.Config(noise_floor=False)
    right = validated(simulated, config)["axes"]
    write_json(simulated.path("models/base/identify.json"), content)
    wrong = validated(simulated, config)["axes"]
    identified(simulated)
    for error in ("rmse", "held_out_rmse"):
        assert wrong["yaw"][error] > 5.0 * right["yaw"][error]
        assert wrong["pitch"][error] == pytest.approx(right["pitch"][error])


def test_parameters_are_judged_with_the_timing_that_they_were_found_with(tmp_path: Path) -> None:
    """Forces a sample off: the timing ends at half of that, and is part of what is published."""
    run = identified(simulated_run(tmp_path, late=1))
    content = validated(run)
    assert any("input timing" in check for check in content["failed_checks"])
    path = run.path("models/base/identify.json")
    published = read_json(path)
    published["input_timing"]["estimate"] = 0.0
    write_json(path, published)
    without = validated(run)
    for axis, entry in content["axes"].items():
        assert entry["held_out_rmse"] < 0.9 * without["axes"][axis]["held_out_rmse"], axis


def test_residuals_add_up(simulated: RunFolder, tmp_path: Path) -> None:
    validate.execute(simulated, tmp_path, validate.Config(noise_floor=False), silent)
    table = read_parquet(tmp_path / "models/base/residuals.parquet")
    assert table["held_out"].all()
    for axis in ("yaw", "pitch", "extension"):
        left = table[f"torque_measured_{axis}"] - table[f"torque_predicted_{axis}"]
        np.testing.assert_allclose(left, table[f"residual_{axis}"], atol=1e-9)
        assert f"torque_predicted_without_friction_{axis}" in table
    assert {"force_measured_x", "force_predicted_x"} <= set(table.columns)
    share = (table["force_measured_z"] - table["force_predicted_z"]).std()
    assert share < 0.2 * table["force_measured_z"].std()


def test_one_short_trial_holds_nothing_out(tmp_path: Path) -> None:
    run = identified(simulated_run(tmp_path / "one", trials=1, seconds=5.0))
    content = validated(run)
    assert "nothing is held out" in content["notes"][0]
    assert content["headline"].startswith("fit on the trials it was fitted to")
    assert not content["trials"]["t00"]["held_out"]
    assert not read_parquet(run.path("models/base/residuals.parquet"))["held_out"].any()


def test_one_long_trial_is_left_out_in_blocks(tmp_path: Path) -> None:
    run = identified(simulated_run(tmp_path / "one", trials=1, seconds=12.0))
    content = validated(run)
    assert content["notes"][0].startswith("There is one trial: it is predicted in")
    assert content["headline"].startswith("fit on held-out trials")
    assert all(entry["held_out"] for entry in content["trials"].values())
    table = read_parquet(run.path("models/base/residuals.parquet"))
    assert table["held_out"].all()
    assert set(table["trial_id"]) == {"t00"}
    assert (table["t"].diff().dropna() > 0.0).all()  # blocks do not overlap
    assert 10.0 < table["t"].iloc[-1] < 12.0


def test_two_replicates_give_a_floor_and_one_is_refused(simulated: RunFolder) -> None:
    """A long session takes three, fewer than a diagnosis wants."""
    content = validated(simulated, validate.Config(repeats=2))
    assert content["floor_replays"] == 2
    assert all(axis["noise_floor"] > 0.0 for axis in content["axes"].values())
    with pytest.raises(InputError, match="one replicate has no scatter"):
        validated(simulated, validate.Config(repeats=1))


def test_mistakes_are_told(simulated: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"repeats: found -1, expected 0 or more"):
        configure("validate", {"repeats": -1})
    bare = simulated_run(tmp_path / "bare", trials=1, seconds=3.0)
    with pytest.raises(InputError, match="bampipe identify"):
        validated(bare)
    content = read_json(simulated.path("models/base/identify.json"))
    saved = dict(content["parameters"])
    del content["parameters"]["mass"]
    write_json(simulated.path("models/base/identify.json"), content)
    with pytest.raises(InputError, match="no parameter 'mass'"):
        validated(simulated)
    write_json(simulated.path("models/base/identify.json"), content | {"parameters": saved})


SPOILT, KEPT = "t02", ("t00", "t01")


def judged(run: RunFolder, hold_out: bool) -> tuple[dict, dict]:
    """Identify and validate with the spoilt trial held out or not."""
    path: Path = run.path("ingest/trials.parquet")
    trials = read_parquet(path)
    trials["hold_out"] = (trials["trial_id"] == SPOILT) & hold_out
    write_parquet(path, trials)
    identified(run)
    validate.execute(run, run.root, validate.Config(free_run=False), silent)
    names = ("models/base/identify.json", "models/base/validate.json")
    return tuple(read_json(run.path(name)) for name in names)


def test_a_trial_held_out_moves_no_parameter_and_is_what_counts(tmp_path: Path) -> None:
    """The last of three trials has three times the force that moved it."""
    spoilt = simulated_run(tmp_path, trials=3, seconds=8.0)
    path = spoilt.path("filter/kinematics.parquet")
    frame = read_parquet(path)
    forces = [name for name in frame if name.startswith("force_")]
    frame.loc[frame["trial_id"] == SPOILT, forces] *= 3.0
    write_parquet(path, frame)
    seen, _ = judged(spoilt, False)
    assert seen["parameters"]["mass"]["estimate"] > 3.9
    unseen, verdict = judged(spoilt, True)
    assert unseen["parameters"]["mass"]["estimate"] == pytest.approx(3.5, rel=0.03)
    assert unseen["trials"] == list(KEPT)
    assert [verdict["trials"][name]["held_out"] for name in (*KEPT, SPOILT)] == [False, False, True]
    for axis, entry in verdict["axes"].items():
        alone = verdict["trials"][SPOILT][axis]
        assert entry["held_out_rmse"] == pytest.approx(alone["held_out_rmse"]), axis
        assert entry["held_out_rmse"] > 5.0 * verdict["trials"]["t00"][axis]["held_out_rmse"]
        assert entry["noise_floor"] < 0.2 * entry["held_out_rmse"]
    table = read_parquet(spoilt.path("models/base/residuals.parquet"))
    assert set(table.loc[table["held_out"], "trial_id"]) == {SPOILT}
    assert free_trials(spoilt, fitted=True) == KEPT
    assert free_trials(spoilt) == (*KEPT, SPOILT)
    trials = read_measured_trials(spoilt, compile_model(Model(registry.device("bam"))))
    names = [motion.trial_id for motion in trials.motions]
    assert [names[k] for k in trials.folds.fitted_trials] == list(KEPT)
    assert [n for n, counts in zip(names, trials.folds.judged, strict=True) if counts] == [SPOILT]
