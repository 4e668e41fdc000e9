"""The identify stage on simulated sessions."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import schema_misfits
from identified_run import RESOLUTION, TRUTH, simulated_run
from made_results import write_model

from bampipe.data.run_folder import RunFolder
from bampipe.data.store import read_parquet
from bampipe.errors import InputError
from bampipe.files import read_json
from bampipe.identification.filter_run import MotionLost
from bampipe.progress import silent
from bampipe.run.state import configure
from bampipe.stages import identify

TOLERANCE = {"viscous": 0.03, "coulomb": 0.05, "mass": 0.01}
FAST = identify.Config(longest_step_s=2e-3)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunFolder]:
    yield simulated_run(tmp_path_factory.mktemp("simulated"))


def identified(run: RunFolder, config: identify.Config = FAST, out: Path | None = None) -> dict:
    """Execute the stage in ``out``, or in the run folder; return identify.json, checked."""
    identify.execute(run, out or run.root, config, silent)
    content = read_json((out or run.root) / f"models/{config.model}/identify.json")
    assert schema_misfits(content, "identify") == []
    return content


@pytest.fixture(scope="module")
def published(simulated: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """What is published of the simulated run, and where its tables are."""
    out = tmp_path_factory.mktemp("published")
    return out, identified(simulated, replace(FAST, trace_rows=300), out)


@pytest.fixture(scope="module")
def squares(simulated: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """The same by least squares."""
    out = tmp_path_factory.mktemp("squares")
    return out, identified(simulated, replace(FAST, method="least-squares"), out)


def assert_recovered(content: dict, most_z: float = np.inf, typical_z: float = np.inf) -> None:
    """Estimates are near the truth, also in standard deviations."""
    z = []
    for name, value in TRUTH.items():
        found = content["parameters"][name]
        assert found["estimate"] == pytest.approx(value, rel=TOLERANCE[name.split(".")[0]]), name
        z.append((found["estimate"] - value) / found["sd"])
    assert np.max(np.abs(z)) < most_z and np.sqrt(np.mean(np.square(z))) < typical_z


def test_intervals_hold_on_a_simulated_session(published: tuple[Path, dict]) -> None:
    _, content = published
    assert_recovered(content, 4.0, 2.0)
    assert content["repeats"] == 0  # linear in its parameters: one pass is enough
    for name in ("viscous.yaw", "coulomb.yaw", "viscous.extension", "coulomb.extension"):
        entry = content["parameters"][name]
        assert 0.75 < entry["filter_sd"] / entry["bound_sd"] < 1.5, name


def test_least_squares_stand_in_where_the_filter_loses_the_motion(
    simulated: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(*_: object) -> None:
        raise MotionLost("the predicted motion grew without bound", remedy="try least squares")

    monkeypatch.setattr(identify, "estimate_by_filter", lost)
    content = identified(simulated)
    assert content["method"] == "least-squares"
    assert content["notes"][0] == (
        "Published by least squares, not by the unscented filter: the predicted motion grew without"
        " bound."
    )
    assert content["methods"]["ukf"] == {"doubts": ["the predicted motion grew without bound"]}
    assert_recovered(content)
    with pytest.raises(InputError, match="grew without bound; try least squares"):
        identified(simulated, replace(FAST, method="ukf"))


@pytest.mark.long
def test_velocity_may_be_measured_too(simulated: RunFolder) -> None:
    """Filtered velocities are neither white nor unbiased: why positions alone are the default."""
    content = identified(simulated, replace(FAST, measure="position_velocity"))
    for name, value in TRUTH.items():
        assert content["parameters"][name]["estimate"] == pytest.approx(value, rel=0.1), name


def test_tables_have_the_rows_that_are_asked_for(published: tuple[Path, dict]) -> None:
    out, _ = published
    states = read_parquet(out / "models/base/states.parquet")
    assert states["trial_id"].unique().tolist() == ["t00", "t01"]
    assert states.groupby("trial_id").size().max() <= 300
    trace = read_parquet(out / "models/base/trace.parquet")
    assert (np.diff(trace["t_total"]) >= 0.0).all()
    assert {"mass", "mass_sd", "viscous.yaw", "coulomb.extension_sd"} <= set(trace.columns)
    assert np.isfinite(trace.drop(columns="trial_id").to_numpy(dtype=float)).all()
    balanced = 3.56 * 9.81 * (states["q_extension"] - 0.461) * np.cos(states["q_pitch"])
    np.testing.assert_allclose(states["torque_gravity_pitch"], balanced, atol=0.02)
    assert not {"torque_gravity_yaw", "torque_gravity_extension"} & set(states)


@pytest.mark.long
def test_filterpy_gives_the_same_numbers(tmp_path: Path) -> None:
    run = simulated_run(tmp_path / "short", trials=1, seconds=0.8)
    numbers = []
    for engine in ("compiled", "filterpy"):
        content = identified(run, replace(FAST, engine=engine, block_s=0.1))
        numbers.append([entry["estimate"] for entry in content["parameters"].values()])
    np.testing.assert_allclose(numbers[0], numbers[1], rtol=1e-8)


def test_mistakes_are_told(simulated: RunFolder, tmp_path: Path) -> None:
    for settings, words in (
        ({"method": "magic"}, r'identify\.method: found "magic", expected "auto" or "ukf" or'),
        ({"engine": "filterpi"}, "engine: .* did you mean 'filterpy'"),
        ({"block_s": 0.0}, r"identify\.block_s: found 0.0, expected more than 0"),
        ({"random_walk": -1.0}, r"identify\.random_walk: found -1.0, expected 0 or more"),
    ):
        with pytest.raises(InputError, match=words):
            configure("identify", settings)
    with pytest.raises(InputError, match="missing"):
        identified(simulated, replace(FAST, model="base+none"))


@pytest.mark.long
def test_a_motion_that_no_noise_explains_is_refused(tmp_path: Path) -> None:
    """Force channels that have nothing to do with the motion, and noise that may not grow."""
    run = simulated_run(tmp_path / "wrong", scramble=True)
    with pytest.raises(InputError, match=r"does not follow trial|lost the motion"):
        identified(run, replace(FAST, method="ukf", force_noise=1e-4))
    content = identified(run, replace(FAST, method="auto", force_noise=1e-4))
    assert content["method"] == "least-squares"
    said = "Published by least squares, not by the unscented filter"
    assert any(note.startswith(said) for note in content["notes"])


def test_a_model_with_a_delay_gets_no_timing_of_its_own(simulated: RunFolder) -> None:
    """The two shift the forces alike: together neither would be known."""
    write_model(simulated.root, "base+force_delay", "force_delay")
    settings = replace(FAST, model="base+force_delay", method="least-squares")
    content = identified(simulated, settings)
    assert content["input_timing"] == {"estimate": 0.0, "sd": 0.0, "unit": "s"}
    delay = content["parameters"]["force_delay.delay"]
    assert abs(delay["estimate"]) < 2e-4
    assert_recovered(content)


def test_the_force_noise_moves_the_encoder_of_an_axis_that_winds_up(tmp_path: Path) -> None:
    """Without that in the noise of the readings, the filter gave the friction as 14 for 4.2."""
    name = "transmission_compliance.yaw.compliance"
    wound = {"effect": "transmission_compliance:yaw", "hidden": {name: 2e-3}}
    run = simulated_run(tmp_path, seconds=4.0, **wound)
    write_model(run.root, "base", "transmission_compliance:yaw")
    content = identified(run, replace(FAST, method="ukf"))
    assert_recovered(content)
    assert content["parameters"][name]["estimate"] == pytest.approx(2e-3, rel=5e-3)
    noise = content["noise"]
    assert noise["process_sd"]["force_x"] < 5.0 * noise["sensor_sd"]["force_x"]
    assert noise["reading_sd"]["yaw"] > 2.0 * RESOLUTION["yaw"] / np.sqrt(12.0)


@pytest.mark.long
def test_friction_that_falls_within_a_step(tmp_path: Path) -> None:
    """Stribeck friction gone at 17 mm/s, which an axis passes in a few samples.

    Least squares, their bias taken off where the fit was and not where it led to, gave no force
    at all.
    """
    hidden = {"stribeck.extension.force": 3.5, "stribeck.extension.speed": 0.017}
    run = simulated_run(tmp_path, effect="stribeck:extension", hidden=hidden)
    write_model(run.root, "base", "stribeck:extension")
    squares = identified(run, replace(FAST, method="least-squares"))["parameters"]
    for name, value in hidden.items():
        assert abs(squares[name]["estimate"] - value) < 2.0 * squares[name]["sd"], name
    assert squares["stribeck.extension.force"]["estimate"] == pytest.approx(3.5, rel=0.3)


def test_least_squares_intervals_hold_once_its_bias_is_off(squares: tuple[Path, dict]) -> None:
    """Filtered motions move what it fits; the replay says by how much."""
    out, content = squares
    assert_recovered(content, 3.5, 1.8)
    assert len(read_parquet(out / "models/base/trace.parquet")) == 2
    assert all(e["bound_sd"] < 1.5 * e["sd"] for e in content["parameters"].values())
    # A wider filter biases less: some parameters are moved by about their interval, none is by ten.
    bias = [abs(e["least_squares_bias"]) / e["sd"] for e in content["parameters"].values()]
    assert 0.5 < max(bias) < 10.0


def test_what_cannot_be_identified_is_said(squares: tuple[Path, dict]) -> None:
    _, content = squares
    said = content["identifiability"]
    assert "N" in said["together"][0]["members"]
    assert any("no motion separates them" in line for line in content["notes"])
    assert set(said["trials"]) == {"t00", "t01"}
    assert min(entry["growth"] for entry in said["trials"].values()) > 0.05
    lever = next(number for number in said["numbers"] if number["name"] == "L")
    assert abs(lever["moves_percent"]["viscous.pitch"]) > 0.3


@pytest.mark.long
def test_two_terms_of_one_shape_are_said_to_move_together(simulated: RunFolder) -> None:
    """Friction that grows with the rod's load and Coulomb friction: nearly the same here."""
    write_model(simulated.root, "two", "gravity_compensator_mistuned", "base_tilt")
    content = identified(simulated, replace(FAST, method="least-squares", model="two"))
    weak = content["identifiability"]["weak_directions"]
    assert any("mass" in direction["members"] for direction in weak), weak
    assert any("move together here" in line for line in content["notes"])


def test_innovations_of_the_right_model_pass_and_those_of_a_late_force_do_not(
    published: tuple[Path, dict], tmp_path: Path
) -> None:
    _, content = published
    for axis, entry in content["innovations"].items():
        assert entry["whiteness"]["white"], (axis, entry)
        assert entry["inputs"]["independent"], (axis, entry)
    late = simulated_run(tmp_path / "late", late=10)
    content = identified(late)
    note = next(note for note in content["notes"] if "input delay" in note)
    assert "at its limit of half a sample (1 ms earlier than logged" in note
    assert "or the model lacks something that shifts the force in time" in note
    innovations = content["innovations"]
    assert not innovations["yaw"]["inputs"]["independent"]
    assert "Not independent of the inputs" in innovations["yaw"]["sentence"]
