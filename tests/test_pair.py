"""Two sessions of one device side by side, recorded by the simulators that share no code."""

import json
from pathlib import Path

import independent
import numpy as np
import pytest
from independent import joint
from independent.sensors import Conditions
from independent_runs import STAGES, run_short
from made_results import diagnosis, write_result
from scipy.stats import norm

import bampipe
from bampipe.api.session_pair import correct_p_values
from bampipe.errors import InputError
from bampipe.report.pair_page import build_page
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.pair import PairResult

THICKER = 1.4
RECORDED = Conditions(creep=True, trials=8, seconds=8.0)


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Run folders of one joint: two of it as it is, with more damping, and with Stribeck friction.

    Each has four trials; the first session those that the others do not have.
    """
    root = tmp_path_factory.mktemp("pair")
    found, draw = {}, joint._draw_specimen

    def draw_thicker(*given: object) -> joint.Specimen:
        specimen = draw(*given)
        specimen.law["viscous"] *= THICKER
        return specimen

    for name in ("first", "same", "thick", "stick"):
        effects = {"stribeck:joint": 1.0} if name == "stick" else {}
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(joint, "_draw_specimen", draw_thicker if name == "thick" else draw)
            independent.record("joint", root / name, 5, effects, RECORDED)
        path = root / name / "session.toml"
        head, *trials = path.read_text().split("[[trials]]")
        kept = trials[:4] if name == "first" else trials[4:]
        path.write_text("[[trials]]".join([head, *kept]))
        found[name] = run_short(
            root / name, root, (*STAGES, "compare"), validate={"free_run": False}
        ).root
    return found


@pytest.mark.slow
def test_nothing_changes_between_sessions_of_one_machine(sessions: dict[str, Path]) -> None:
    pair = bampipe.compare_runs(sessions["first"], sessions["same"])
    assert [name for name, one in pair.parameters.items() if one.changed] == []
    assert set(pair.parameters) == {
        "coulomb.joint", "inertia", "moment", "moment_across", "offset", "viscous.joint",
    }  # fmt: skip
    assert sum(state.changed for state in pair.states) == 0
    assert {state.variable for state in pair.states} == {"position", "velocity", "direction"}
    for journey in pair.journeys:
        assert journey.failed == [] and journey.alone == () and journey.together is None
    assert "None of 6 parameters changed beyond chance." in pair.sentences


@pytest.mark.slow
def test_a_parameter_that_changed_is_named_and_makes_the_model_travel(sessions) -> None:
    pair = bampipe.compare_runs(sessions["first"], sessions["thick"])
    assert [name for name, one in pair.parameters.items() if one.changed] == ["viscous.joint"]
    one = pair.parameters["viscous.joint"]
    assert one.second / one.first == pytest.approx(THICKER, abs=0.01)
    there, back = pair.journeys
    for journey, sign in ((there, 1.0), (back, -1.0)):
        assert journey.failed == ["joint"]
        entry = journey.axes["joint"]
        assert entry.error > 5.0 * entry.own_error
        assert journey.together is not None and journey.lacking == {}
        (change,) = journey.together.changes.items()
        assert change == ("viscous.joint", pytest.approx(sign * (one.second - one.first), rel=0.02))
        assert journey.together.travels == ("joint",)
        assert journey.alone[0] == journey.together
        others = [refit.errors["joint"] for refit in journey.alone[1:]]
        assert min(others) > 3.0 * journey.alone[0].errors["joint"]
    velocity = next(state for state in pair.states if state.variable == "velocity")
    assert velocity.changed >= 4
    change = np.subtract(velocity.second.mean, velocity.first.mean)
    slope = np.polyfit(velocity.second.center, change, 1)[0]
    assert abs(slope) == pytest.approx(one.second - one.first, rel=0.1)


@pytest.mark.slow
def test_an_effect_that_was_added_is_named_by_the_diagnosis(
    sessions: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The diagnosis has tests of its own: here it is asked once, of the right session."""
    asked = []

    def diagnose(root: Path, model: str) -> None:
        asked.append((root, model))
        found = diagnosis({"joint": {"verdict": "missing"}}, {("stribeck:joint",): 0.998})
        write_result(root, DiagnoseResult, model=model, **found)

    monkeypatch.setattr("bampipe.api.actions.diagnose", diagnose)
    pair = bampipe.compare_runs(sessions["first"], sessions["stick"])
    assert asked == [(sessions["stick"], "base")]
    there, back = pair.journeys
    entry = there.axes["joint"]
    assert there.failed == ["joint"] and entry.error > 1.2 * (entry.noise_floor or 0.0)
    assert there.together is None or there.together.travels == ()
    assert list(there.lacking) == ["joint"]
    said = "It lacks stribeck:joint (probability > 0.99) there."
    assert any(said in line for line in pair.sentences)
    assert "stribeck" not in " ".join(pair.sentences).split(f"The model of {back.model_of}")[1]


@pytest.mark.slow
def test_the_command_prints_tables_and_writes_json_and_a_page(
    sessions: dict[str, Path], command, tmp_path: Path
) -> None:
    out = tmp_path / "changed.html"
    code, said, errors = command("compare", sessions["first"], sessions["thick"], "-q", "-o", out)
    assert code == 0, errors
    assert "viscous.joint changed by +" in said and "p (Holm)" in said
    assert "Refitted in viscous.joint +" in said
    html = out.read_text()
    assert "The sessions differ" in html and html.count("<table") == 4 and "<svg" in html
    code, said, _ = command("compare", sessions["first"], sessions["thick"], "--json")
    pair = PairResult.model_validate(json.loads(said))
    assert code == 0 and build_page(pair) == html
    code, said, _ = command("compare", sessions["first"])
    assert code == 0 and "ladder" in said


@pytest.mark.slow
def test_sessions_that_cannot_be_compared_are_refused(sessions: dict[str, Path]) -> None:
    first, same = sessions["first"], sessions["same"]
    with pytest.raises(InputError, match="both runs are the same"):
        bampipe.compare_runs(first, first)
    device = same / "ingest/device.toml"
    text = device.read_text()
    device.write_text(text.replace('name = "joint"', 'name = "elbow"'))
    with pytest.raises(InputError, match="device: joint only in first, elbow only in same"):
        bampipe.compare_runs(first, same)
    device.write_text(text.replace("value = 10.0", "value = 11.0"))
    try:
        notes = bampipe.compare_runs(first, same).notes
        assert "The device files differ in constants." in notes
    finally:
        device.write_text(text)


def test_p_values_are_corrected_as_holm_did() -> None:
    z = norm.isf(np.array([0.01, 0.04, 0.03, 0.005]) / 2.0)
    np.testing.assert_allclose(correct_p_values(list(-z)), [0.03, 0.06, 0.06, 0.02], rtol=1e-6)
    assert correct_p_values([]) == []
