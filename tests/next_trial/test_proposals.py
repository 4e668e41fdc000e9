"""Proposals, followed by somebody on machines whose simulators share no code with the product."""

import json
from dataclasses import replace
from pathlib import Path

import independent
import pytest
from independent.person import Task
from independent_runs import SHORT, diagnose, record_run

import bampipe
from bampipe.errors import InputError
from bampipe.phrases.forecast_outcome import compare_forecast, compare_forecasts, read_forecasts
from bampipe.results.identify import IdentifyResult
from bampipe.results.next import NextResult

pytestmark = pytest.mark.slow

FASTEST = 2.4  # of the joint, rad/s
LONG = {"trials": 4, "seconds": 12.0}


def propose(run: bampipe.Run, **settings) -> tuple[NextResult, Path]:
    bampipe.run_stage(run, "next", **settings)
    path = run.root / NextResult.file("base")
    return NextResult.read(path), path


def information_on(run: bampipe.Run, name: str) -> float:
    found = IdentifyResult.read(run.root / IdentifyResult.file("base")).parameters[name].bound_sd
    assert found is not None
    return found**-2


@pytest.mark.long
def test_the_uncertainty_forecast_is_the_one_that_comes(tmp_path):
    run, _ = record_run(tmp_path / "now", "joint", 922, **LONG)
    found, path = propose(run, purpose="coulomb.joint", seconds=12.0)
    assert found.purpose == "precision"
    forecast = found.proposals[0].sd
    after, _ = record_run(tmp_path / "after", "joint", 922, **LONG, tasks=Task.read(path))
    more, _ = record_run(tmp_path / "more", "joint", 922, **LONG | {"trials": 5})
    came = after.parameters("base").sd
    names = ("coulomb.joint", "viscous.joint", "moment", "inertia")
    # By the bound, which no scatter of blocks blurs, what was asked for comes as forecast.
    asked = forecast["coulomb.joint"]
    left = (information_on(run, "coulomb.joint") / information_on(after, "coulomb.joint")) ** 0.5
    assert asked.after / asked.before == pytest.approx(left, rel=0.1)
    # What blocks of time scatter is itself known to a tenth or two: eight of ten come as expected.
    expected = [forecast[name].low < came[name] < forecast[name].high for name in names]
    assert sum(expected) >= 3
    sloppy = Task.read(path, reach=0.5, haste=2.0)
    rough, _ = record_run(tmp_path / "rough", "joint", 922, **LONG, tasks=sloppy)
    # By the Cramer-Rao bound: the scatter of blocks of time is itself known to a tenth.
    gained, by_chance, roughly = (
        information_on(one, "coulomb.joint") - information_on(run, "coulomb.joint")
        for one in (after, more, rough)
    )
    assert gained > 1.5 * by_chance
    assert roughly > 0.7 * gained
    # Coulomb friction shows in slow motion.
    assert found.proposals[0].moves["joint"].fast < 0.1 * FASTEST


def test_bad_requests_are_refused_in_one_line(tmp_path):
    run, _ = record_run(tmp_path, "joint", 5)
    with pytest.raises(InputError, match=r"coulomb\.join'.*coulomb\.joint"):
        bampipe.run_stage(run, "next", purpose="coulomb.join")
    with pytest.raises(InputError, match=r"no diagnosis yet.*bampipe diagnose"):
        bampipe.run_stage(run, "next", purpose="decision")
    content = json.loads((run.root / "run.json").read_text())
    assert "next:base" not in content["stages"]


@pytest.mark.long
def test_effects_are_found_from_the_strength_on_that_the_trials_would_have_shown(tmp_path):
    run, _ = record_run(tmp_path / "clean", "joint", 931)
    found, _ = propose(run, purpose="sensitivity")
    entry = found.sensitivity["quadratic_drag:joint"]
    assert entry.parameter == "quadratic_drag.joint.coefficient"
    assert entry.smallest is not None
    truth = record_at(tmp_path / "size", 1.0)["quadratic_drag.joint.coefficient"]
    for share, selected in ((0.4, []), (1.25, ["quadratic_drag:joint"])):
        folder = tmp_path / f"{share}"
        hidden = record_at(folder, share * entry.smallest / truth)
        assert hidden[entry.parameter] == pytest.approx(share * entry.smallest, rel=1e-6)
        pipeline = tmp_path / "clean" / "short.toml"
        again = bampipe.run_session(folder, runs=tmp_path / "runs", pipeline=str(pipeline))
        assert diagnose(again)["selected"] == selected, share
    # An offset of the motor is one to the data with the device's own.
    assert found.sensitivity["force_bias:current"].smallest is None
    # At 94 Hz it shows from a size on at which the joint sticks where it did not.
    assert found.unpromised == ("stribeck:joint",)
    assert "stribeck:joint" not in found.sensitivity


def record_at(folder: Path, strength: float) -> dict[str, float]:
    """Record a joint with a drag of some strength; its true parameters."""
    hidden = {"quadratic_drag:joint": strength}
    return independent.record("joint", folder, 931, hidden, SHORT["joint"])["parameters"]


def test_a_plan_reaches_what_is_asked_in_few_trials_and_says_what_came(tmp_path):
    run, _ = record_run(tmp_path / "now", "joint", 922, **LONG)
    names = ("coulomb.joint", "viscous.joint", "inertia", "moment")
    found, path = propose(run, purpose="coulomb.joint", seconds=12.0, plan=True, sd=0.002)
    assert found.plan is not None
    sheet = (path.parent / "protocol.pdf").read_bytes()
    assert sheet.startswith(b"%PDF")
    assert found.plan.seconds == sum(one.times * one.seconds for one in found.plan.trials)
    assert all(found.plan.sd[n].after < found.plan.sd[n].before for n in names)
    easy, _ = propose(run, purpose="coulomb.joint", seconds=12.0, plan=True, sd=0.9)
    assert easy.plan is not None
    assert easy.plan.is_enough
    assert easy.plan.trials == ()
    # Another question leaves the first forecast as it was, until its trial has come.
    other, _ = propose(run, purpose="viscous.joint", seconds=12.0)
    assert read_forecasts(run.root, "base") == (other, easy)
    # The same run folder, the session with the proposed trial in it.
    independent.record(
        "joint", tmp_path / "now" / "joint", 922, {},
        replace(SHORT["joint"], **LONG, tasks=Task.read(path)),
    )  # fmt: skip
    again = bampipe.run_session(
        tmp_path / "now" / "joint",
        runs=tmp_path / "now" / "runs",
        pipeline=str(tmp_path / "now" / "short.toml"),
    )
    identified = IdentifyResult.read(again.root / IdentifyResult.file("base"))
    (said,) = compare_forecast(easy, identified, None)
    came = identified.parameters["coulomb.joint"].sd
    assert said.startswith("`coulomb.joint`: ±")
    assert f"± {came:.2g} resulted" in said
    assert compare_forecast(easy, identified.model_copy(update={"trials": easy.trials}), None) == ()
    lines = compare_forecasts(read_forecasts(again.root, "base"), identified, None)
    assert [line.partition(",")[0] for line in lines] == ["viscous.joint", "coulomb.joint"]
    assert lines[1] == f"coulomb.joint, 12 s: {said}"
    assert read_forecasts(again.root, "base") == (other, easy)
    now, _ = propose(again, purpose="coulomb.joint", seconds=12.0)
    assert read_forecasts(again.root, "base") == (now,)
