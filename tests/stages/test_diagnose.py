"""The stage diagnose: what it writes, and what it is asked to leave out."""

import json

import pytest
from independent_runs import record_run

import bampipe
from bampipe.errors import InputError
from bampipe.physics import registry
from bampipe.physics.model_spec import ModelSpec
from bampipe.results.diagnose import DiagnoseResult
from bampipe.stages.diagnose import _require_known


def test_what_is_no_effect_cannot_be_left_out() -> None:
    spec = ModelSpec(registry.device("slider").declaration, (), ())
    _require_known(("stribeck:carriage",), spec, "without")
    with pytest.raises(InputError, match=r"has no effect 'stribek:.*', did you mean 'stribeck:"):
        _require_known(("stribek:carriage",), spec, "also")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> bampipe.Run:
    """A run of a joint with thinning grease, identified and validated."""
    return record_run(tmp_path_factory.mktemp("joint"), "joint", 41, "shear_thinning:joint")[0]


def written(run: bampipe.Run, jobs: int, seed: int = 0) -> bytes:
    """The file that the diagnosis writes."""
    path = run.root / DiagnoseResult.file("base")
    path.unlink(missing_ok=True)
    bampipe.diagnose(run, "base", jobs=jobs, seed=seed)
    return path.read_bytes()


@pytest.fixture(scope="module")
def one(run: bampipe.Run) -> bytes:
    """What one process writes."""
    return written(run, jobs=1)


def test_the_file_is_the_same_byte_for_byte_with_one_process_or_two(
    run: bampipe.Run, one: bytes
) -> None:
    assert one == written(run, jobs=2)
    assert one != written(run, jobs=1, seed=1)


def test_what_other_programs_read_is_there_and_true(one: bytes) -> None:
    found = json.loads(one)
    axis = found["axes"]["joint"]
    assert axis["verdict"] == "missing" and axis["effects"] == ["shear_thinning:joint"]
    assert 0.9 < axis["explainable_share"] <= 1.0 and axis["remains"] is False
    assert axis["rmse_after"] < 0.5 * axis["rmse_before"]
    assert found["selected"] == ["shear_thinning:joint"] and found["suggested_trial"] is None
    first, *others = found["ranking"]
    assert first["effect"] == "shear_thinning:joint" and first["probability"] > 0.9
    assert first["p_value"] < 0.01 and first["indistinguishable_from"] == []
    assert first["held_out_rmse_after"] == axis["rmse_after"]
    assert first["held_out_rmse_before"] > axis["rmse_after"]
    assert all(row["probability"] < 0.1 for row in others)
    assert sum(one["probability"] for one in found["sets"]) == pytest.approx(1.0, abs=0.01)
    assert found["chance"]["p_value"] > 0.01
    assert len(found["chance"]["largest"]) == found["chance"]["replicates"]
