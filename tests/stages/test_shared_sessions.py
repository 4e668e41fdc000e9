"""The sessions of a folder beside the source, where there is one: raw logs and their truth."""

from pathlib import Path

import pytest

import bampipe
from bampipe.files import read_json

pytestmark = pytest.mark.long

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "sessions"
AXES = ("yaw", "pitch", "extension")
TOLERANCE = {"viscous": 0.03, "coulomb": 0.05, "mass": 0.01}
PIPELINE = """schema = "bampipe.pipeline/1"
name = "shared"
stages = ["ingest", "filter", "stiffness", "identify", "viscous", "validate"]
[settings.identify]
longest_step_s = 2e-3
method = "{}"
"""


@pytest.mark.parametrize(
    ("name", "method", "missing", "last"),
    [
        ("open-01", "auto", None, "identify"),
        ("open-02", "least-squares", "yaw", "validate"),
        ("open-09", "auto", None, "validate"),
    ],
)
def test_a_session_agrees_with_its_truth(
    tmp_path: Path, name: str, method: str, missing: str | None, last: str
) -> None:
    if not (FOLDER / name).is_dir():
        pytest.skip(f"{FOLDER / name} is not here")
    truth = read_json(FOLDER / f"{name}.truth.json")
    pipeline = tmp_path / "shared.toml"
    pipeline.write_text(PIPELINE.format(method))
    run = bampipe.run_session(FOLDER / name, runs=tmp_path, pipeline=str(pipeline), last=last)
    assert (run.trials["status"] == "ok").all() and (run.trials["repairs"] == "").all()
    assert run.trials["sample_rate_hz"].to_numpy() == pytest.approx(500.0)
    found = {path.stem: read_json(path) for path in run.root.rglob("*.json")}
    assert missing or set(found["stiffness"]["axes"]) == set(AXES)
    for axis, entry in found["stiffness"]["axes"].items():
        stiffness = truth["stiffness"][AXES.index(axis)]
        assert entry["stiffness"] == pytest.approx(stiffness, rel=0.01) and entry["yielded"]
    if last == "validate":
        for entry in found["viscous"]["directions"].values():
            assert entry["estimate"] == pytest.approx(40.0, rel=0.01) and not entry["differs"]
        for axis, entry in found["validate"]["axes"].items():
            ratio = entry["held_out_rmse"] / entry["noise_floor"]
            # Of the floors of machines that creep or stop at a turn, the nearest to the error.
            assert ratio > 2.0 if axis == missing else ratio < 1.5, (axis, ratio)
    if missing is None:
        known = {"mass": truth["mass"]}
        for i, axis in enumerate(AXES):
            known |= {f"viscous.{axis}": truth["kd"][i], f"coulomb.{axis}": truth["fc"][i]}
        for parameter, value in known.items():
            entry = found["identify"]["parameters"][parameter]
            share = TOLERANCE[parameter.partition(".")[0]]
            assert entry["estimate"] == pytest.approx(value, rel=share), parameter
            assert abs(entry["estimate"] - value) < 6.0 * entry["sd"], parameter
        assert found["identify"]["convergence"]["converged"]
        assert 0.7 < found["identify"]["nis"]["mean"] < 1.4
