"""The command line: what it prints, where, and with which exit code."""

import json
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import install_toys
import pytest
from conftest import Command, Toy, bytes_of
from made_results import filled, write_model, write_result

import bampipe
from bampipe.cli import one_stage, places, show
from bampipe.cli.next_step import after_loop, after_proposal, after_run
from bampipe.errors import InputError
from bampipe.phrases.results import describe_unidentified
from bampipe.results.compare import CompareResult
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.draft import DraftResult
from bampipe.results.identify import EffectEstimate, IdentifyResult
from bampipe.results.ingest import IngestResult
from bampipe.results.next import NextResult
from bampipe.results.validate import ValidateResult
from bampipe.run.events import Event
from bampipe.run.pipeline import load
from bampipe.run.request import Outcome, StepResult
from bampipe.run.status import StepStatus

COMMANDS = [
    "run", "ingest", "filter", "stiffness", "identify", "viscous", "performance", "validate",
    "diagnose", "draft", "next", "extend", "compare", "report", "effects", "simulate", "demo",
    "status", "verify", "version", "init",
]  # fmt: skip


def arguments(toy: Toy) -> tuple[str, ...]:
    return (str(toy.session), *toy.options)


def one_line_error(code: int, out: str, err: str) -> str:
    """The message of a refused command, which must be one line on standard error."""
    assert code == 2
    assert out == ""
    lines = [line for line in err.splitlines() if line.startswith("bampipe: error: ")]
    assert len(lines) == 1
    assert "Traceback" not in err
    return lines[0]


# Help


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_an_example(name: str, command: Command) -> None:
    code, out, _ = command(name, "--help")
    assert code == 0
    assert f"Example: bampipe {name}" in " ".join(out.split())
    assert "--json" in out or name in ("demo", "simulate", "version")


@pytest.mark.parametrize("group", [[], ["device"]])
def test_help_lists_the_commands_and_cuts_no_summary_short(
    group: list[str], command: Command
) -> None:
    _, out, _ = command(*group, "--help")
    assert "..." not in out.partition("Commands:")[2]
    assert group or all(f"  {name} " in out for name in COMMANDS)


def test_wrong_command_gets_a_suggestion_and_version_is_said(command: Command) -> None:
    code, _, err = command("identfy")
    assert code == 2
    assert "identify" in err
    assert command("version") == command("--version") == (0, bampipe.__version__ + "\n", "")


# Run, on toy stages


def test_run_shows_steps_and_what_to_do_next_unless_quiet(toy: Toy, command: Command) -> None:
    code, out, err = command("run", *arguments(toy))
    assert code == 0
    assert "toy_read" in out
    assert "3 numbers" in out
    assert "small enough" in out
    assert out.rstrip().splitlines()[-1].startswith("next: bampipe status ")
    assert "toy_double\n" in err and "never run" not in err
    _, out, err = command("run", *arguments(toy), "--quiet")
    assert err == ""
    assert "next:" not in out


def test_run_json_is_all_there_is_on_standard_output(toy: Toy, command: Command) -> None:
    _, out, _ = command("run", *arguments(toy), "--json")
    session = json.loads(out)["sessions"][0]
    assert session["state"] == "done"
    assert session["steps"]["toy_double"]["summary"]["headline"] == "times 2"
    assert {gate["state"] for gate in session["gates"]} == {"passed"}


def test_failed_gate_is_exit_code_one(toy: Toy, command: Command) -> None:
    (toy.session / "numbers.txt").write_text("1000")
    junit = toy.folder / "out" / "gates.xml"
    code, out, _ = command("run", *arguments(toy), "--junit", junit)
    assert code == 1
    assert "take smaller numbers" in out
    assert ElementTree.parse(junit).getroot()[0].get("failures") == "1"


def test_several_sessions_end_in_a_table(toy: Toy, command: Command) -> None:
    toy.many({"a": "1", "b": "two", "c": "1000"})
    (toy.folder / "many" / "no session").mkdir()
    pattern = str(toy.folder / "many" / "*")
    junit = toy.folder / "gates.xml"
    code, out, _ = command("run", pattern, *toy.options, "--junit", junit)
    assert code == 2
    shown = out.partition("\n\n")[0]
    table = {line.split()[0]: line for line in shown.splitlines() if line.strip()}
    assert "done" in table["a"]
    assert "bad input" in table["b"]
    assert "write whole numbers" in table["b"]
    assert "gate failed" in table["c"]
    suites = {s.get("name"): s for s in ElementTree.parse(junit).getroot()}
    assert suites["b"].get("errors") == "1"
    assert suites["c"].get("failures") == "1"


def test_sessions_of_one_id_and_settings_reach_the_run_once(toy: Toy, command: Command) -> None:
    other = install_toys.make_session(toy.folder / "other" / "first")
    code, out, _ = command("run", *arguments(toy), str(other))
    assert code == 2
    assert "session_id 'first' is also that of" in out
    code, out, _ = command("run", *arguments(toy), str(toy.session), "--json")
    assert code == 0
    assert len(json.loads(out)["sessions"]) == 1
    command("run", *arguments(toy), "--set", "toy_double.factor=5")
    assert json.loads((toy.root / "toy/double.json").read_text())["axes"]["n0"]["value"] == 5.0


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--from", "toy_duble"], "did you mean 'toy_double'"),
        (["--until", "ingest"], "no stage 'ingest'"),
        (["--set", "toy_double.factr=5"], "did you mean 'factor'"),
        (["--set", "toy_duble.factor=5"], "did you mean 'toy_double'"),
        (["--set", "factor=5"], "names no stage"),
        (["--set", "nothing"], "write --set name=value"),
        (["--pipeline", "defualt"], "did you mean 'default'"),
        (["--pipeline", "absent.toml"], "no such pipeline file"),
        (["--engine", "cloud"], "choose local or dask"),
        (["--scheduler", "tcp://localhost:1"], "needs --engine dask"),
        (["--model", "bse"], "did you mean 'base'"),
    ],
)
def test_mistakes_are_one_line_and_exit_code_two(
    toy: Toy, command: Command, extra: list[str], message: str
) -> None:
    assert message in one_line_error(*command("run", *arguments(toy), *extra))
    assert not toy.root.exists() or extra[0] == "--model"


@pytest.mark.parametrize(
    ("setting", "said"),
    [("toy_fit.factr=5", "factr"), ("toy_double.factor=many", 'found "many", expected a number')],
)
def test_a_typo_in_a_setting_changes_nothing(
    toy: Toy, command: Command, setting: str, said: str
) -> None:
    assert command("run", *arguments(toy))[0] == 0
    before = bytes_of(toy.root)
    toy.ran()
    code, _, err = command("run", *arguments(toy), "--set", "toy_read.offset=1", "--set", setting)
    assert code == 2 and said in err and toy.ran() == []
    assert bytes_of(toy.root) == before
    assert command("status", toy.root)[1].count("current") == 4


def test_a_session_may_be_named_by_its_file(toy: Toy, command: Command) -> None:
    file = toy.session / "session.toml"
    assert command("run", file, *toy.options)[0] == 0
    assert places.find_run(str(file), toy.runs) == toy.root
    assert places.find_sessions([str(toy.session.parent / "*" / "session.toml")]) == [toy.session]
    with pytest.raises(InputError, match="no session matches"):
        places.find_sessions([str(toy.session / "*")])


def test_off_a_terminal_a_long_stage_prints_a_line_now_and_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]
    monkeypatch.setattr(show.time, "monotonic", lambda: clock[0])
    with show.Watcher(quiet=False) as watcher:
        watcher(Event("s1", "identify", "start"))
        for second in range(1, 31):
            clock[0] = float(second)
            if second <= 20:
                watcher(Event("s1", "identify", "progress", second / 60.0, f"trial {second}"))
            watcher.write_late_lines()  # as it does of itself every second
        watcher(Event("s1", "identify", "done", 1.0))
    assert capsys.readouterr().err.splitlines() == [
        "identify",
        "identify: 17 %, 10 s, trial 10",
        "identify: 33 %, 20 s, trial 20",
        "identify: 33 %, 30 s, trial 20",
    ]


def test_status_and_verify(toy: Toy, command: Command) -> None:
    command("run", *arguments(toy))
    code, out, _ = command("status", "first", "--runs", toy.runs)
    assert code == 0
    assert out.count("current") == 4
    assert command("verify", toy.root)[0] == 0
    (toy.root / "sum.json").write_text("{}")
    code, out, _ = command("verify", toy.root)
    assert code == 1 and "sum.json" in out
    code, out, _ = command("status", toy.root, "--json")
    steps = {step["step"]: step for step in json.loads(out)["steps"]}
    assert steps["toy_sum"]["state"] == "stale"
    assert "was changed" in steps["toy_sum"]["reason"]


# Which run is meant


def test_run_is_found_by_name_folder_session_or_not_named(toy: Toy) -> None:
    with pytest.raises(InputError, match="no run yet"):
        places.find_run(None, toy.runs)
    with pytest.raises(InputError, match="has not been run"):
        places.find_run(str(toy.session), toy.runs)
    toy.run()
    for argument in (None, "first", str(toy.root), str(toy.session)):
        assert places.find_run(argument, toy.runs) == toy.root
    with pytest.raises(InputError, match="did you mean 'first'"):
        places.find_run("frist", toy.runs)


def test_a_name_means_the_run_and_a_path_the_folder(
    toy: Toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    toy.run()
    here = tmp_path / "here"
    shutil.copytree(toy.root, here / "first")
    monkeypatch.chdir(here)
    assert places.find_run("first", toy.runs) == toy.root
    assert places.find_run("./first", toy.runs).resolve() == here / "first"
    assert places.find_run("first", here / "no-runs") == Path("first")


# Real stages, no data needed


@pytest.mark.parametrize("name", ["filter", "stiffness", "identify", "validate", "report"])
def test_stage_without_a_run(name: str, command: Command, tmp_path: Path) -> None:
    assert "bampipe run SESSION" in one_line_error(*command(name, "--runs", tmp_path))


def test_settings_and_effects_are_listed(command: Command) -> None:
    code, out, _ = command("filter", "--settings")
    assert code == 0
    assert "cutoff_hz" in out
    from bampipe.physics import registry

    code, out, _ = command("effects")
    assert code == 0
    for name in registry.effect_names():
        assert f"  {name} " in out
    listed = json.loads(command("effects", "--json")[1])
    assert {effect["name"] for effect in listed} == set(registry.effect_names())


def test_an_adopted_effect_stands_beside_the_base_model_of_every_run(
    tmp_path: Path, command: Command
) -> None:
    built_in = "bampipe/physics/effects/stribeck.toml"
    text = (Path(__file__).parent.parent / built_in).read_text(encoding="utf-8")
    mine = tmp_path / "mine.toml"
    mine.write_text(text)
    runs = tmp_path / "runs"
    from bampipe.run import models

    code, _, err = command("effects", "adopt", mine, "--runs", runs)
    assert code == 2
    assert "built-in effect 'stribeck'" in err
    mine.write_text(text.replace('name = "stribeck"', 'name = "our_stribeck"'))
    code, out, _ = command("effects", "adopt", mine, "--runs", runs)
    assert code == 0
    assert "our_stribeck.toml" in out
    models.ensure_base(runs / "s01", "bam", ())
    copy = runs / "s01" / "models" / "base" / "effects" / "our_stribeck.toml"
    assert copy.read_text() == mine.read_text()


def test_one_effect_in_full(command: Command) -> None:
    code, out, _ = command("effects", "stribeck:yaw")
    assert code == 0
    for text in ("torque = ", "N.m", "looks like: ", "source: ", "against yaw velocity", "•"):
        assert text in out


# Printing


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (True, "yes"), (1.2346e-4, "0.0001235"), ([1.0, "a"], "1, a"), ({"a": 1}, "a 1")],
)
def test_cells(value: object, text: str) -> None:
    assert show.format_cell(value) == text


def test_summary_prints_tables_of_long_names_and_the_ladder(
    capsys: pytest.CaptureFixture[str],
) -> None:
    show.print_summary(
        {
            "headline": "two axes",
            "parameters": {"mass": {"unit": "kg", "estimate": 3.5, "sd": 0.1}},
            "notes": ["mind the gap"],
        }
    )
    out = capsys.readouterr().out
    assert "estimate   sd  unit" in out
    assert "note: mind the gap" in out
    name = "base+asymmetric_coulomb.carriage+thermal_damping.carriage+actuator_delay"
    show.print_table(["model", "rmse", ""], [["base", 2.0, ""], [name, 1.0, "x " * 50]])
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].split()[:2] == [name.removesuffix("actuator_delay"), "1"]
    assert lines[3] == "  actuator_delay" and lines[2].endswith("x x")
    rung = {"held_out_rmse": {"yaw": 0.5}, "noise_floor": {"yaw": 0.25}, "unit": {"yaw": "N.m"}}
    axis = {"mean_absolute": 0.1, "rmse": 0.2, "relative_error_percent": 3.0, "unit": "rad"}
    axis["velocity_relative_error_percent"] = 4.0
    free = {"free_run_mode": "open_loop", "free_run": {"yaw": axis}}
    ladder = [{"model": "base", **rung}, {"model": "base+x", "added": "x", **rung, **free}]
    show.print_summary(filled(CompareResult, {"ladder": ladder}))
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["base", "0.5", "2"] in lines and ["version", "1:", "base+x", "x", "0.5", "2"] in lines
    assert ["version", "1", "open", "loop", "0.100", "3.00"] in lines


@pytest.mark.parametrize("arguments", [["effects"], ["effects", "--json"]])
def test_a_closed_pipe_ends_quietly_and_is_no_failed_gate(arguments: list[str]) -> None:
    command = [sys.executable, "-m", "bampipe", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    _, err = process.communicate()
    assert (process.returncode, err) == (141, b"")


# Extending a model


@pytest.fixture
def ingested(tmp_path: Path) -> Path:
    """A run folder of the BAM in which nothing but ingest has run."""
    root = tmp_path / "runs" / "s"
    write_result(root, IngestResult, device="bam", axes={"yaw": {}})
    (root / "run.json").write_text('{"schema": "bampipe.run/1", "stages": {}}')
    return root


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["stribek:yaw"], "did you mean 'stribeck'"),
        (["stribeck:yow"], "yaw"),
        (["stribeck:yaw", "--model", "bse"], "did you mean 'base'"),
        (["absent.toml:yaw"], "absent.toml: no such file"),
        (["stribeck:yaw", "--auto"], "--auto chooses the effects itself"),
        (["stribeck:yaw"], "is missing"),
        ([], "no effect named"),
    ],
)
def test_a_refused_extension_leaves_nothing(
    ingested: Path, command: Command, arguments: list[str], message: str
) -> None:
    assert message in one_line_error(*command("extend", ingested, *arguments))
    models = {path.name for path in (ingested / "models").glob("*")}
    assert models <= {"base"}


def test_an_effect_is_not_added_twice(ingested: Path, command: Command) -> None:
    write_model(ingested, "base")
    write_model(ingested, "base+stribeck.yaw", "stribeck:yaw")
    extended = ("--model", "base+stribeck.yaw")
    error = one_line_error(*command("extend", ingested, "stribeck:yaw", *extended))
    assert "already has stribeck:yaw" in error


@pytest.mark.parametrize(
    ("verdict", "selected", "after"),
    [
        ("unknown_effect", (), "bampipe draft RUN --model base"),
        ("undecided", (), "bampipe draft RUN --model base"),
        ("nothing_missing", (), "bampipe report RUN --open"),
        ("missing", ("stribeck:yaw",), "bampipe report RUN --open"),
    ],
)
def test_after_the_loop_comes_what_its_last_diagnosis_says(
    ingested: Path, verdict: str, selected: tuple[str, ...], after: str
) -> None:
    assert after_loop(ingested, "base") == "bampipe diagnose RUN"
    other = ingested / "models/base+stribeck.yaw/model.toml"
    other.parent.mkdir(parents=True)
    other.touch()
    assert after_loop(ingested, "base") == "bampipe diagnose RUN --model base"
    axes, command = {"yaw": {"verdict": verdict}}, "bampipe draft RUN --model base"
    write_result(ingested, DiagnoseResult, axes=axes, selected=selected, next=command)
    assert after_loop(ingested, "base") == after


def test_what_a_diagnosis_found_comes_before_a_trial_for_the_parameters(ingested: Path) -> None:
    recorded, command = "record that trial", "bampipe extend RUN stribeck:yaw --model base"
    write_result(ingested, NextResult, purpose="precision")
    assert after_proposal(ingested, "base").startswith(recorded)
    axes = {"yaw": {"verdict": "missing"}}
    write_result(ingested, DiagnoseResult, axes=axes, selected=("stribeck:yaw",), next=command)
    assert after_proposal(ingested, "base") == command
    write_result(ingested, NextResult, purpose="decision")
    assert after_proposal(ingested, "base").startswith(recorded)


def test_a_diagnosis_is_asked_for_where_none_is_or_none_knows_the_new_trial(ingested: Path) -> None:
    diagnose = "bampipe diagnose RUN"
    write_result(ingested, NextResult, purpose="precision")
    write_result(ingested, ValidateResult, axes={"yaw": {"standing": "above_floor"}})
    assert after_proposal(ingested, "base") == diagnose
    axes, command = {"yaw": {"verdict": "undecided"}}, "bampipe next RUN --model base"
    write_result(ingested, DiagnoseResult, axes=axes, trials=("t01",), next=command)
    write_result(ingested, IdentifyResult, trials=("t01",))
    assert after_run(ingested, "base") == command
    write_result(ingested, IdentifyResult, trials=("t01", "t02"))
    assert after_run(ingested, "base") == diagnose


def test_what_has_been_drafted_is_not_asked_for_again(ingested: Path) -> None:
    axes, command = {"yaw": {"verdict": "unknown_effect"}}, "bampipe draft RUN --model base"
    write_result(ingested, DiagnoseResult, axes=axes, next=command)
    write_result(ingested, DraftResult, axes={"yaw": {"chance": [{}]}}, next="record more trials")
    for after in (after_loop, after_run):
        assert after(ingested, "base") == "record more trials"


@pytest.mark.parametrize("option", [["--set", "sigmas=2"], ["--pipeline", "strict"], ["--force"]])
def test_two_runs_are_compared_as_they_are(command: Command, option: list[str]) -> None:
    said = one_line_error(*command("compare", "s01", "s02", *option))
    assert f"{option[0]} has no effect for two runs" in said


def test_a_diagnosis_that_is_older_than_its_inputs_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stands(reason: str) -> list[StepStatus]:
        return [
            StepStatus("identify:base", "current", "", "", 1.0),
            StepStatus("diagnose:base", "stale" if reason else "current", reason, "", 1.0),
        ]

    for reason in ("", "settings changed", "models/base/identify.json changed"):
        monkeypatch.setattr("bampipe.run.status.status", lambda *_, reason=reason: stands(reason))
        one_stage._say_if_outdated(Path("runs/s01"), load("default"), "base")
        said = capsys.readouterr().out
        assert ("bampipe diagnose runs/s01" in said) == ("identify.json" in said)
        assert bool(said) == ("identify.json" in reason)


def step(name: str, **summary: object) -> StepResult:
    return StepResult(name, "done", "", 1.0, summary)


def test_notes_of_the_logs_and_a_second_that_stands_out_are_said(
    capsys: pytest.CaptureFixture[str],
) -> None:
    said = {"sentence": "The second from 5.1 s of trial t02 on moves `mass`."}
    steps = (
        step("ingest", notes=["a force in counts"]),
        step("filter", notes=["t02: not used: 20 sound samples"]),
        step("identify:base", notes=["in the report"], influence={"worst_second": said}),
        step("identify:more", influence={"worst_second": {"sentence": ""}}),
    )
    show.print_outcome(Outcome(Path("s1"), "done", steps))
    printed = capsys.readouterr()
    notes = [line for line in (printed.out + printed.err).splitlines() if line.startswith("note:")]
    assert notes == [
        "note: a force in counts",
        "note: t02: not used: 20 sound samples",
        "note: The second from 5.1 s of trial t02 on moves `mass`.",
    ]


def test_an_effect_that_is_not_identified_is_said() -> None:
    why = "`stribeck.joint.force` is 18 \u00b1 46 N.m, an interval larger than itself"
    found = EffectEstimate(identified=False, reasons=(why,))
    said = f"`stribeck:joint` does not count as identified: {why}."
    assert describe_unidentified("stribeck:joint", found) == said
    assert describe_unidentified("play:joint", EffectEstimate(identified=True)) == ""
