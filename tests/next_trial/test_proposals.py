"""Proposals, followed by somebody on machines whose simulators share no code with the product."""

import json
from dataclasses import replace
from pathlib import Path

import independent
import pytest
from independent.person import Task
from independent_runs import SHORT, record_run, run_short

import bampipe
from bampipe.errors import InputError
from bampipe.phrases.forecast_outcome import compare_forecast, compare_forecasts, read_forecasts
from bampipe.results.identify import IdentifyResult
from bampipe.results.next import NextResult

pytestmark = pytest.mark.slow

LONG = {"trials": 4, "seconds": 12.0}


def propose(run: bampipe.Run, **settings) -> tuple[NextResult, Path]:
    bampipe.run_stage(run, "next", **settings)
    path = run.root / NextResult.file("base")
    return NextResult.read(path), path


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("now")


@pytest.fixture(scope="module")
def run(root) -> bampipe.Run:
    return record_run(root, "joint", 922, **LONG)[0]


def test_bad_requests_are_refused_in_one_line(run):
    with pytest.raises(InputError, match=r"coulomb\.join'.*coulomb\.joint"):
        bampipe.run_stage(run, "next", purpose="coulomb.join")
    with pytest.raises(InputError, match=r"no diagnosis yet.*bampipe diagnose"):
        bampipe.run_stage(run, "next", purpose="decision")
    content = json.loads((run.root / "run.json").read_text())
    assert "next:base" not in content["stages"]


def test_a_plan_reaches_what_is_asked_in_few_trials_and_says_what_came(root, run):
    names = ("coulomb.joint", "viscous.joint", "inertia", "moment")
    found, path = propose(run, purpose="coulomb.joint", seconds=12.0, plan=True, sd=0.002)
    sheet = (path.parent / "protocol.pdf").read_bytes()
    assert sheet.startswith(b"%PDF")
    assert found.plan.seconds == sum(one.times * one.seconds for one in found.plan.trials)
    assert all(found.plan.sd[n].after < found.plan.sd[n].before for n in names)
    easy, _ = propose(run, purpose="coulomb.joint", seconds=12.0, plan=True, sd=0.9)
    assert easy.plan.is_enough and easy.plan.trials == ()
    # Another question leaves the first forecast as it was, until its trial has come.
    other, _ = propose(run, purpose="viscous.joint", seconds=12.0)
    assert read_forecasts(run.root, "base") == (other, easy)
    # The same run folder, the session with the proposed trial in it.
    independent.record(
        "joint", root / "joint", 922, {},
        replace(SHORT["joint"], **LONG, tasks=Task.read(path)),
    )  # fmt: skip
    again = run_short(root / "joint", root)
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
