"""Trials that the session holds out: seen by no fit and no diagnosis, only by the verdict."""

from pathlib import Path

import pytest
from identified_run import simulated_run

from bampipe.data.run_folder import RunFolder
from bampipe.data.store import read_parquet, write_parquet
from bampipe.files import read_json
from bampipe.physics import Model, compile_model, registry
from bampipe.progress import silent
from bampipe.stages import identify, validate
from bampipe.trials.measured import read_measured_trials
from bampipe.trials.reading import free_trials

SPOILT, KEPT = "t02", ("t00", "t01")


@pytest.fixture(scope="module")
def spoilt(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run whose last trial has three times the force that moved it."""
    run = simulated_run(tmp_path_factory.mktemp("spoilt"), trials=3, seconds=8.0)
    path = run.path("filter/kinematics.parquet")
    frame = read_parquet(path)
    forces = [name for name in frame if name.startswith("force_")]
    frame.loc[frame["trial_id"] == SPOILT, forces] *= 3.0
    write_parquet(path, frame)
    return run


def judged(run: RunFolder, hold_out: bool) -> tuple[dict, dict]:
    """Identify and validate with the spoilt trial held out or not."""
    path: Path = run.path("ingest/trials.parquet")
    trials = read_parquet(path)
    trials["hold_out"] = (trials["trial_id"] == SPOILT) & hold_out
    write_parquet(path, trials)
    identify.execute(run, run.root, identify.Config(method="least-squares"), silent)
    validate.execute(run, run.root, validate.Config(free_run=False), silent)
    names = ("models/base/identify.json", "models/base/validate.json")
    return tuple(read_json(run.path(name)) for name in names)


def test_a_trial_held_out_moves_no_parameter_and_is_what_counts(spoilt: RunFolder) -> None:
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
