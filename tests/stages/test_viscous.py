"""The viscous field and the performance at the handle, on a simulated session."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from identified_run import identified, recorded_run
from independent_runs import record_run

from bampipe.data.run_folder import RunFolder
from bampipe.data.store import read_parquet, write_parquet
from bampipe.errors import InputError
from bampipe.files import read_json
from bampipe.physics import Model, compile_model, registry
from bampipe.physics.viscous_field import viscous_field
from bampipe.progress import silent
from bampipe.run.state import configure
from bampipe.simulator import simulated_session as simulation
from bampipe.stages import performance, viscous


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunFolder]:
    folder = tmp_path_factory.mktemp("viscous")
    days = {"trials": 2, "viscous_trials": 2, "duration": 10.0}
    config = simulation.Config(seed=31, file_format="parquet", **days)
    simulation.simulate_session(folder / "session", config)
    yield identified(recorded_run(folder / "run", folder / "session"))


def found(run: RunFolder, config: viscous.Config | None = None) -> dict:
    viscous.execute(run, run.root, config or viscous.Config(), silent)
    return read_json(run.path("models/base/viscous.json"))


def test_the_field_is_that_of_the_grip() -> None:
    """J^T K J at the distance r of the grip, one parameter a direction."""
    device = registry.device("bam")
    field = viscous_field(device)
    system = compile_model(Model(device, ["viscous_field"], [field]))
    q, qd = np.array([[0.3, 0.2, 1.2]]), np.array([[0.5, -0.4, 0.3]])
    p, none = system.prior, np.zeros((1, 0))
    bare = system.required(q, qd, 0 * q, none, np.zeros((1, len(system.inputs))), p)
    p[-3:] = 40.0, 50.0, 60.0
    with_field = system.required(q, qd, 0 * q, none, np.zeros((1, len(system.inputs))), p)
    r = 1.2
    expected = np.array([40.0 * (r * np.cos(0.2)) ** 2 * 0.5, 50.0 * r**2 * -0.4, 60.0 * 0.3])
    np.testing.assert_allclose((with_field - bare)[0], expected)
    with pytest.raises(InputError, match="no brakes"):
        viscous_field(registry.device("slider"))


def test_the_damping_rendered_is_found_and_does_not_differ(run: RunFolder) -> None:
    content = found(run)
    assert set(content["directions"]) == {"x", "y", "z"}
    for name, entry in content["directions"].items():
        assert entry["estimate"] == pytest.approx(40.0, rel=0.02), name
        assert entry["commanded"] == 40.0
        assert entry["p_value"] > 0.001, name
        assert entry["felt"] == pytest.approx(entry["estimate"] + entry["own_friction"])
        assert entry["felt_differs"], name
    trace = read_parquet(run.path("models/base/viscous.parquet"))
    assert {"t_total", "damping_x", "damping_x_sd", "damping_z"} <= set(trace)
    assert not any(name.startswith("viscous.") for name in trace)


@pytest.fixture
def trials(run: RunFolder) -> Iterator[pd.DataFrame]:
    """The table of trials, which a test may write otherwise."""
    path = run.path("ingest/trials.parquet")
    kept = read_parquet(path)
    yield kept.copy()
    write_parquet(path, kept)


def test_a_command_that_was_not_kept_is_found(run: RunFolder, trials: pd.DataFrame) -> None:
    trials.loc[trials["kind"] == "viscous", "viscous_n_s_per_m"] = 44.0
    write_parquet(run.path("ingest/trials.parquet"), trials)
    directions = found(run)["directions"]
    assert all(entry["differs"] for entry in directions.values())
    assert "differs from the commanded 44" in directions["x"]["verdict"]


def test_a_session_without_a_field_says_so(run: RunFolder, trials: pd.DataFrame) -> None:
    write_parquet(run.path("ingest/trials.parquet"), trials[trials["kind"] == "free"])
    content = found(run)
    assert content["directions"] == {}
    assert "No trials" in content["headline"]


def test_settings_that_make_no_sense_are_refused() -> None:
    with pytest.raises(InputError, match=r"viscous\.block_s: found 0.0, expected more than 0"):
        configure("viscous", {"block_s": 0.0})
    with pytest.raises(InputError, match=r"performance\.points: found 1, expected 2 or more"):
        configure("performance", {"points": 1})


def test_performance_of_a_damper_is_that_at_its_load_cell(tmp_path: Path) -> None:
    found, _ = record_run(tmp_path, "damper", 4)
    folder = RunFolder(found.root)
    performance.execute(folder, folder.root, performance.Config(), silent)
    said = read_json(folder.path("models/base/performance.json"))["headline"]
    assert re.fullmatch(r"At the load cell: stroke \S+ m, friction \S+ N, inertia \S+ kg", said)


def test_performance_at_the_handle(run: RunFolder) -> None:
    performance.execute(run, run.root, performance.Config(), silent)
    content = read_json(run.path("models/base/performance.json"))
    q = read_parquet(run.path("filter/kinematics.parquet"))
    low, high = q.min(numeric_only=True), q.max(numeric_only=True)
    volume = (
        (high["q_extension"] ** 3 - low["q_extension"] ** 3) / 3.0
        * (np.sin(high["q_pitch"]) - np.sin(low["q_pitch"]))
        * (high["q_yaw"] - low["q_yaw"])
    )  # fmt: skip
    handle = content["handle"]
    assert handle["workspace"]["value"] == pytest.approx(volume, rel=0.01)
    identified = read_json(run.path("models/base/identify.json"))["parameters"]
    top = max(identified["coulomb.extension"]["estimate"],
              identified["coulomb.pitch"]["estimate"] / low["q_extension"])  # fmt: skip
    assert handle["friction"]["upper"] == pytest.approx(top, rel=1e-6)
    # Along the rod the hand moves the rod's mass alone.
    mass = identified["mass"]["estimate"]
    assert handle["inertia"]["lower"] <= mass * 1.001
    assert handle["inertia"]["upper"] >= mass * 0.999
    assert content["constants"]["L"]["source"] == "Table II"
    assert "stiffness" not in handle
