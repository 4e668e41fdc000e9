"""The measured positioning axis against what its makers published (see its SOURCE.md).

Published, all samples, friction alike in both directions: M 95.1089 kg, Fv 203.5034 N.s/m,
Fc 20.3935 N, offset -3.1648 N, relative error 4.0834 %; friction by direction: 3.1117 %.
"""

import re
import shutil
from pathlib import Path

import pandas as pd
import pytest
from conftest import misfits
from measured import ROOT, bampipe, estimates, result

SESSION = ROOT / "sample_runs" / "positioning_axis"
PUBLISHED = {
    "mass": 95.1089,
    "viscous.carriage": 203.5034,
    "coulomb.carriage": 20.3935,
    "offset": -3.1648,
}
BY_DIRECTION = "base+asymmetric_coulomb.carriage"


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """The run of the whole record as one trial, with the published filters."""
    folder = tmp_path_factory.mktemp("whole")
    shutil.copytree(SESSION, folder / "session")
    text = (SESSION / "session.toml").read_text()
    head = text[: text.index("[[trials]]")]
    trial = '[[trials]]\nfile = "trials/record.mat"\nkind = "free"\n'
    (folder / "session" / "session.toml").write_text(head + trial)
    runs = ("--runs", folder / "runs")
    bampipe("run", folder / "session", "--pipeline", SESSION / "published.toml", *runs)
    run = folder / "runs" / "positioning_axis"
    bampipe("extend", run, "asymmetric_coulomb:carriage")
    return run


@pytest.fixture(scope="module")
def stretches(tmp_path_factory) -> Path:
    """The run of the session as it ships, defaults throughout."""
    runs = tmp_path_factory.mktemp("stretches")
    bampipe("run", SESSION, "--runs", runs, "--until", "validate")
    return runs / "positioning_axis"


@pytest.mark.long
def test_least_squares_gives_the_published_parameters_and_relative_error(whole):
    assert estimates(whole) == pytest.approx(PUBLISHED, rel=0.01)
    axis = result(whole, "models/base/validate.json")["axes"]["carriage"]
    assert axis["relative_error_percent"] == pytest.approx(4.0834, abs=0.1)


@pytest.mark.long
def test_friction_by_direction_gives_the_published_relative_error(whole):
    axis = result(whole, f"models/{BY_DIRECTION}/validate.json")["axes"]["carriage"]
    assert axis["relative_error_percent"] <= 3.1117
    assert axis["relative_error_percent"] == pytest.approx(3.1117, abs=0.15)
    found = estimates(whole, BY_DIRECTION)
    half = found["asymmetric_coulomb.carriage.viscous_difference"]
    assert found["viscous.carriage"] + half == pytest.approx(166.7061, rel=0.01)
    assert found["viscous.carriage"] - half == pytest.approx(240.4236, rel=0.01)


@pytest.mark.long
def test_free_runs_stay_closer_than_published(whole):
    """Published for the symmetric model in closed loop, relative to the measured quantity:
    position 0.013752 %, velocity 0.22911 %, force 5.848 %."""
    errors = []
    for model in ("base", BY_DIRECTION):
        free = result(whole, f"models/{model}/validate.json")["free_run"]
        assert free["mode"] == "closed_loop"
        axis = free["axes"]["carriage"]
        assert axis["relative_error_percent"] < 0.013752
        assert axis["velocity_relative_error_percent"] < 0.22911
        errors.append(free["forces"]["force_motor"]["relative_error_percent"])
    assert errors[1] < 0.9 * errors[0] < 5.848
    rungs = result(whole, "compare.json")["ladder"]
    assert [rung["free_run_mode"] for rung in rungs] == ["closed_loop", "closed_loop"]


def test_the_filter_agrees_within_its_uncertainty(stretches):
    parameters = result(stretches, "models/base/identify.json")["parameters"]
    for name, published in PUBLISHED.items():
        entry = parameters[name]
        assert abs(entry["estimate"] - published) < 2.0 * entry["sd"], name


@pytest.mark.long
def test_the_diagnosis_finds_friction_by_direction_unaided(stretches):
    few = [f"--set={name}" for name in ("replicates=4", "most_effects=1", "jobs=2")]
    bampipe("diagnose", stretches, *few)
    found = result(stretches, "models/base/diagnose.json")
    assert "asymmetric_coulomb:carriage" in found["selected"]
    (best,) = (r for r in found["ranking"] if r["effect"] == "asymmetric_coulomb:carriage")
    assert best["p_value"] < 0.01
    assert found["axes"]["carriage"]["verdict"] != "nothing_missing"
    assert best["held_out_rmse_after"] < 0.7 * best["held_out_rmse_before"]
    half = best["parameters"]["asymmetric_coulomb.carriage.viscous_difference"]
    # The makers' is of ordinary least squares; the likelihood weighs reversals less.
    assert half == pytest.approx((166.7061 - 240.4236) / 2.0, rel=0.15)
    assert misfits(stretches) == []
    check_that_maps_follow_from_samples(stretches, found["maps"]["carriage"])


def check_that_maps_follow_from_samples(run, maps):
    """The bins of each map, made again in another way from what is stored of every sample."""
    samples = pd.read_parquet(run / "models/base/map_variables.parquet")
    residuals = pd.read_parquet(run / "models/base/residuals.parquet")
    assert samples[["trial_id", "t"]].equals(residuals[["trial_id", "t"]])
    moving = samples[residuals["moving_carriage"]]
    assert set(samples.columns) == {"trial_id", "t", *(f"carriage.{name}" for name in maps)}
    for name, drawn in maps.items():
        values = moving[f"carriage.{name}"]
        few = values.nunique() <= 16
        bins = values if few else pd.qcut(values, 16, duplicates="drop")
        centres = values.groupby(bins, observed=True).mean()
        assert len(drawn["center"]) == len(centres), name
        assert drawn["center"] == pytest.approx(centres.to_numpy(), rel=0.02, abs=0.01), name


def test_every_stretch_is_held_out_once(stretches):
    trials = result(stretches, "models/base/validate.json")["trials"]
    assert len(trials) == len(re.findall(r"\[\[trials\]\]", (SESSION / "session.toml").read_text()))
    assert all(trial["held_out"] for trial in trials.values())
