"""What a lab's continuous integration uses: accepted values, summaries, documented scripts."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import Command
from made_results import write_model, write_result

from bampipe.api.opened import Run
from bampipe.data.run_folder import RunFolder
from bampipe.declarations.pipeline import Gate
from bampipe.errors import InputError
from bampipe.lab.rows import read_run
from bampipe.report.run_results import Results
from bampipe.results.compare import CompareResult
from bampipe.results.floor import compare_with_floor
from bampipe.results.identify import IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.run import GateVerdict
from bampipe.results.validate import ValidateResult
from bampipe.run import accepted, gates, pipeline
from bampipe.run.request import Outcome, Request
from bampipe.run.state import RunState
from bampipe.run.summaries import markdown

ROOT = Path(__file__).parent.parent
CHANGE = Gate(
    name="change",
    result="models/{model}/identify.json",
    value="parameters.*.estimate",
    against="accepted",
    max=5.0,
    optional=True,
)


def write(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def made(root: Path, sd: float = 0.01, **estimates: float) -> Path:
    """A run folder with these parameters; ``viscous__yaw`` stands for ``viscous.yaw``."""
    entries = {
        name.replace("__", "."): {"estimate": value, "sd": sd, "unit": "N.m"}
        for name, value in estimates.items()
    }
    write_result(root, IngestResult, device="bam", axes={"yaw": {}})
    write_result(root, IdentifyResult, parameters=entries)
    write(root / "run.json", {"schema": "bampipe.run/1", "stages": {}, "gates": []})
    return root


def states(root: Path, folder: Path, gate: Gate = CHANGE) -> dict[str, str]:
    return {v.key: v.state for v in gates.judge_gates(gate, root, "base", folder)}


def test_parameters_are_held_against_those_accepted(tmp_path: Path) -> None:
    folder = tmp_path / "accepted"
    old = made(tmp_path / "runs/old", viscous__yaw=4.0, coulomb__yaw=2.0)
    assert states(old, folder) == {"": "absent"}
    path = accepted.accept(old, "base", folder)
    assert path == folder / "bam.json"
    assert states(old, folder) == {"coulomb.yaw": "passed", "viscous.yaw": "passed"}
    new = made(tmp_path / "runs/new", viscous__yaw=4.1, coulomb__yaw=2.2, mass=3.5)
    expected = {"coulomb.yaw": "failed", "viscous.yaw": "passed", "mass": "absent"}
    assert states(new, folder) == expected
    found = gates.judge_gates(CHANGE, new, "base+x", folder)
    verdict = next(v for v in found if v.key == "coulomb.yaw")
    assert verdict.value == pytest.approx(10.0)
    assert (verdict.state, verdict.model) == ("failed", "base"), "the model that was accepted"
    assert "2 to 2.2, +10 % ± 0.71 %, is beyond 5 %" in verdict.message


@pytest.mark.parametrize(
    ("estimate", "sd", "state"),
    [
        (2.58, 0.24, "failed"),  # 29 %, 2.4 standard deviations: less two of them, 5 % were left
        (2.58, 0.40, "warned"),  # 29 %, 1.5 standard deviations: neither a change nor none
        (2.06, 0.01, "passed"),  # 3 %, six standard deviations
    ],
)
def test_a_change_passes_by_its_size_and_fails_where_it_is_sure(
    tmp_path: Path, estimate: float, sd: float, state: str
) -> None:
    folder = tmp_path / "accepted"
    accepted.accept(made(tmp_path / "runs/old", sd=0.0, mass=2.0), "base", folder)
    assert states(made(tmp_path / "runs/a", sd=sd, mass=estimate), folder) == {"mass": state}


def test_accepted_values_of_another_model_do_not_count(tmp_path: Path) -> None:
    folder = tmp_path / "accepted"
    root = made(tmp_path / "runs/old", mass=2.0)
    accepted.accept(root, "base", folder)
    (root / "models/base").rename(root / "models/base+x")
    found = gates.judge_gates(CHANGE, root, "base+x", folder)
    assert [v.state for v in found] == ["warned"]
    assert "of model 'base', which this run does not have" in found[0].message


def test_checks_that_failed_are_counted_and_said(tmp_path: Path) -> None:
    gate = next(g for g in pipeline.load().gates if g.value == "failed_checks")
    write_result(tmp_path, ValidateResult, axes={}, failed_checks=["yaw: not white"])
    found = gates.judge_gates(gate, tmp_path, "base", tmp_path)
    assert [(v.state, v.value, v.model) for v in found] == [("warned", 1.0, "base")]
    assert "yaw: not white" in found[0].message
    write_result(tmp_path, ValidateResult, axes={}, failed_checks=[])
    assert [v.state for v in gates.judge_gates(gate, tmp_path, "base", tmp_path)] == ["passed"]


def test_a_gate_advises_on_what_the_word_says(tmp_path: Path) -> None:
    """Far below its floor an error says nothing of the model: the floor is wrong."""
    for name in ("default", "strict", "diagnose"):
        (gate,) = (g for g in pipeline.load(name).gates if g.judged_by == "axes.*.standing")
        said = {}
        for error, word in ((0.3, "floor_implausible"), (3.0, "above_floor"), (1.0, "at_floor")):
            axis = {"held_out_rmse": error, "noise_floor": 1.0, "standing": word}
            write(tmp_path / "models/base/validate.json", {"axes": {"yaw": axis}})
            (found,) = gates.judge_gates(gate, tmp_path, "base", tmp_path)
            said[word] = found.message
        assert "cannot be judged" in said["floor_implausible"]
        assert "something is missing" not in said["floor_implausible"]
        assert gate.advice in said["above_floor"] and said["at_floor"] == "1, at floor"
    gate = CHANGE.model_copy(update={"advice_on": {"bad": "mend it"}})
    (fault, *_) = gate.cross_faults()
    assert "'advice_on' without 'judged_by'" in str(fault)


def test_every_command_takes_the_best_confirmed_model(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    root = made(tmp_path / "runs/s1", mass=2.0)
    better = "base+stribeck.yaw"
    for name, error in (("base", 0.56), (better, 0.1)):
        write_model(root, name)
        entries = {"mass": {"estimate": 2.0 if name == "base" else 3.0, "sd": 0.1, "unit": "kg"}}
        write_result(root, IdentifyResult, model=name, parameters=entries)
        axis = {"held_out_rmse": error, "noise_floor": 0.1}
        axis["standing"] = compare_with_floor(error, 0.1)
        write_result(root, ValidateResult, model=name, axes={"yaw": axis})
    assert RunFolder(root).default_model() == "base", "nothing has been compared"
    code, out, _ = command("accept", "s1")
    assert code == 0 and "warning: yaw: the error is above the noise floor, 5.6 times" in out
    write_result(root, CompareResult, best=better, ladder=[{"model": "base"}, {"model": better}])
    assert RunFolder(root).default_model() == Run(root).model == Results(root).model == better
    code, out, _ = command("accept", "s1")
    assert code == 0 and f"model {better}" in out and "warning" not in out
    kept = json.loads((tmp_path / "accepted/bam.json").read_text())
    estimates = kept["results"][IdentifyResult.FILE]["parameters"]
    assert kept["model"] == better and estimates["mass"]["estimate"] == 3.0
    code, out, _ = command("accept", "s1", "--model", "base")
    assert code == 0 and "model base" in out
    assert [step.name for step in RunState(Request(root, pipeline.load())).steps("diagnose")] == [
        "diagnose:base",
        f"diagnose:{better}",
    ]
    row = read_run(root)["sessions"][0]
    assert row["counting_model"] == better
    monkeypatch.setattr("bampipe.declarations.export.export_model", lambda run, name, form: name)
    code, out, err = command("export", "s1")
    assert (code, out.strip()) == (0, better) and f"model {better} of s1" in err
    code, out, _ = command("export", "s1", "--model", "base")
    assert (code, out.strip()) == (0, "base")
    for name in ("accept", "export"):
        code, _, err = command(name, "s1", "--model", "bas")
        assert code == 2 and "no model 'bas'; did you mean 'base'?" in err


def test_a_damaged_file_of_accepted_values_is_named(tmp_path: Path) -> None:
    root = made(tmp_path / "runs/old", mass=2.0)
    path = accepted.accept(root, "base", tmp_path / "accepted")
    path.write_text("{")
    with pytest.raises(InputError, match=r"bam\.json"):
        states(root, tmp_path / "accepted")
    path.write_text('{"schema": "bampipe.accepted/1"}')
    with pytest.raises(InputError, match="device"):
        states(root, tmp_path / "accepted")


def test_accept_refuses_what_failed(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    root = made(tmp_path / "runs/s1", mass=2.0)
    failed = {"gate": "error", "key": "", "state": "failed", "message": "", "value": 3.0}
    write(root / "run.json", {"schema": "bampipe.run/1", "stages": {}, "gates": [failed]})
    code, _, err = command("accept", "s1")
    assert code == 2 and "the gate 'error' failed" in err
    code, out, _ = command("accept", "s1", "--force")
    assert code == 0 and "accepted/bam.json" in out
    assert json.loads((tmp_path / "accepted/bam.json").read_text())["session"] == "s1"


def test_the_summary_is_a_table_that_no_text_breaks(tmp_path: Path) -> None:
    message = "2 is above 1.15;\nsee <b>"
    bad = GateVerdict(gate="error | floor", key="yaw", state="failed", value=2.0, message=message)
    root = made(tmp_path / "runs/s1", mass=2.0)
    axes = {"yaw": {"held_out_rmse": 0.2, "noise_floor": 0.1}}
    write_result(root, ValidateResult, axes=axes)
    text = markdown(
        [
            Outcome(root, "done", (), (bad,), model="base"),
            Outcome(tmp_path / "s2", "refused", error="t1.csv, row 3: not a number"),
            Outcome(tmp_path / "s3", "done"),
        ]
    )
    assert text.startswith("## bampipe: 3 sessions, 1 failed a gate, 1 could not be read\n")
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert len(rows) == 2 + 3 + 2 + 1
    for row in rows:
        assert len(re.findall(r"(?<!\\)\|", row)) == 6
    assert "| s1 | **gate failed** | base | yaw 2.00 | gates: 1 failed |" in text
    assert r"error \| floor" in text and r"\<b\>" in text


def blocks(language: str) -> list[str]:
    text = (ROOT / "docs/ci.md").read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, re.S)


def test_the_documented_workflow_and_gate_are_valid(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    head = 'schema = "bampipe.pipeline/1"\nname = "own"\nstages = ["ingest"]\n'
    path.write_text(head + blocks("toml")[0])
    assert pipeline.load(str(path)).gates[0].max == 1.2
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    content = yaml.safe_load(blocks("yaml")[0])
    steps = content["jobs"]["bampipe"]["steps"]
    assert any("bampipe run" in step.get("run", "") for step in steps)
    assert all(("run" in step) != ("uses" in step) for step in steps)


@pytest.mark.long
def test_the_shell_script_runs(tmp_path: Path) -> None:
    """On a sample session: gates passed, then one that cannot be, then a session that is none."""
    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin/bampipe"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m bampipe "$@"\n')
    program.chmod(0o755)
    script = tmp_path / "ci.sh"
    script.write_text(next(block for block in blocks("sh") if block.startswith("#!")))
    lab = tmp_path / "lab-repository"
    (lab / "sessions").mkdir(parents=True)
    (lab / "sessions/first").symlink_to(ROOT / "sample_runs/first")
    own = tmp_path / "own.toml"
    text = (ROOT / "pipelines/default.toml").read_text(encoding="utf-8")
    own.write_text(text.replace('"compare", "report"', '"compare"'))
    settings = {
        "PATH": f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "PIPELINE": str(own),
        "JOBS": "1",
    }

    def run() -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["sh", str(script), str(lab)], env=os.environ | settings, capture_output=True, text=True
        )

    done = run()
    assert done.returncode == 0, done.stderr
    assert "all gates passed" in done.stdout
    assert "## bampipe: 1 session, all gates passed" in done.stdout
    assert (lab / "gates.xml").is_file()
    own.write_text(own.read_text().replace("min = 50.0", "min = 100.5"))
    done = run()
    assert done.returncode == 1
    assert "1 failed a gate" in done.stdout and "a gate failed" in done.stderr
    (lab / "sessions/second").mkdir()
    (lab / "sessions/second/session.toml").write_text("session_id = 'second'\n")
    done = run()
    assert done.returncode == 2
    assert "| second | **bad input** |" in done.stdout
