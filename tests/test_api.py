"""The Python interface: light to import, read-only, one line for a mistake."""

import inspect
import re
from pathlib import Path

import pandas as pd
import pytest

import bampipe

ROOT = Path(__file__).resolve().parents[1]
SESSION = ROOT / "sample_runs" / "positioning_axis"


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> bampipe.Run:
    """A measured axis, identified by least squares."""
    runs = tmp_path_factory.mktemp("runs")
    made = bampipe.ingest(SESSION, runs=runs)
    bampipe.filter(made)
    bampipe.identify(made, method="least-squares")
    bampipe.validate(made, noise_floor=False, free_run=False)
    return bampipe.open_run(made.root)


def test_everything_exported_is_there_and_documented():
    text = (ROOT / "docs/api.md").read_text(encoding="utf-8")
    for name in bampipe.__all__:
        thing = getattr(bampipe, name)
        assert inspect.getdoc(thing), name
        assert name in dir(bampipe)
        assert name == "Picture" or f"{name}(" in text or f"bampipe.{name}" in text, name
    for name, thing in vars(bampipe.Run).items():
        if not name.startswith("_"):
            assert f".{name}" in text, name
            assert inspect.getdoc(thing), name
    with pytest.raises(AttributeError, match="no attribute 'identfy'"):
        _ = bampipe.identfy


def test_a_run_gives_tables_and_records(run):
    assert run.name == "positioning_axis" and run.models == ("base",) and run.model == "base"
    assert run.session["axes"]["carriage"]["unit"] == "m"
    assert len(run.trials) == 4 and set(run.samples["trial_id"]) == set(run.trials["trial_id"])
    assert {"q_carriage", "qd_carriage", "qdd_sd_carriage"} <= set(run.kinematics)
    parameters = run.parameters()
    assert list(parameters.columns[:3]) == ["estimate", "sd", "unit"]
    assert parameters.loc["mass", "estimate"] == pytest.approx(95.1, rel=0.02)
    assert list(run.covariance("base").columns) == list(run.covariance("base").index)
    assert run.validation().loc["carriage", "unit"] == "N"
    assert {"trial_id", "t", "residual_carriage"} <= set(run.residuals())
    assert run.effects() == () and run.free_run() == {}
    assert isinstance(bampipe.compare(run.root), pd.DataFrame)
    ladder = bampipe.open_run(run.root).ladder
    assert list(ladder.index) == ["base"] and "held_out_rmse.carriage" in ladder
    assert run.figures == {}


def test_reading_changes_nothing(run):
    before = {p: p.stat().st_mtime_ns for p in run.root.rglob("*")}
    again = bampipe.open_run(str(run.root))
    for name in ("trials", "samples", "kinematics", "session", "models", "figures"):
        getattr(again, name)
    again.parameters(), again.residuals(), again.validation()
    assert {p: p.stat().st_mtime_ns for p in run.root.rglob("*")} == before


def test_a_run_is_found_by_its_name(run, monkeypatch, tmp_path):
    (tmp_path / "runs").symlink_to(run.root.parent)
    monkeypatch.chdir(tmp_path)
    assert bampipe.open_run(run.name).root == Path("runs") / run.name
    assert repr(bampipe.Run(run.root)) == f"Run({str(run.root)!r})"


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda run: run.diagnosis(), "base/diagnose.json does not exist yet.*bampipe diagno"),
        (lambda run: run.stiffness, "stiffness.json does not exist yet"),
        (lambda run: run.parameters("bose"), "no results for model 'bose'; choose from base"),
        (lambda run: bampipe.open_run(run.root / "none"), "no run here; make one"),
        (lambda run: bampipe.run_session("nowhere"), "nowhere: no such session folder"),
        (lambda run: bampipe.identify(run, methd="ukf"), "methd"),
        (lambda run: bampipe.extend(run, "stribek:carriage"), "did you mean 'stribeck'"),
        (lambda run: bampipe.diagnose(run, replicates=1), "replicates: found 1, expected 4"),
    ],
)
def test_mistakes_are_one_line(run, ask, said):
    with pytest.raises(bampipe.InputError) as caught:
        ask(run)
    assert re.search(said, str(caught.value)) and "\n" not in str(caught.value)


def test_any_stage_runs_by_its_name(run):
    found = bampipe.run_stage(run, "compare")
    assert [rung["model"] for rung in found["ladder"]] == ["base"]
    with pytest.raises(bampipe.InputError, match="no stage 'comper'; did you mean 'compare'"):
        bampipe.run_stage(run, "comper")
