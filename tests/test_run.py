"""The runner: order, cache by content, whole files, recovery, provenance, gates, batches."""

import json
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import Toy, contents
from made_results import write_model, write_result

from bampipe.cli.one_stage import parse_settings
from bampipe.declarations.pipeline import Gate
from bampipe.errors import InputError
from bampipe.results.compare import CompareResult
from bampipe.results.run import GateVerdict
from bampipe.run import batch, gates, models, record
from bampipe.run import pipeline as pipelines
from bampipe.run.request import Outcome
from bampipe.run.runner import run_session
from bampipe.run.session_name import session_id
from bampipe.run.state import configure
from bampipe.run.status import status, verify

ALL = ["toy_read", "toy_double", "toy_fit:base", "toy_sum"]


def states(outcome: Outcome) -> list[str]:
    return [step.state for step in outcome.steps]


# Cache


@pytest.fixture
def finished(toy: Toy) -> Toy:
    """The toy after a first run."""
    toy.run()
    toy.ran()
    return toy


def test_all_stages_run_once_then_nothing(toy: Toy) -> None:
    assert states(toy.run()) == ["done"] * 4
    assert toy.ran() == ALL
    before = (toy.root / "run.json").read_bytes()
    assert states(toy.run()) == ["unchanged"] * 4
    assert toy.ran() == []
    assert (toy.root / "run.json").read_bytes() == before


def test_same_input_gives_same_bytes_and_record(toy: Toy) -> None:
    toy.run()
    other = replace(toy.request(), root=toy.folder / "elsewhere" / "first")
    run_session(other)
    assert contents(other.root) == toy.files()
    first, second = (json.loads((r / "run.json").read_text()) for r in (toy.root, other.root))
    assert first | {"timings": {}} == second | {"timings": {}}


def test_white_space_and_comments_in_toml_rerun_nothing(finished: Toy) -> None:
    for path in (
        finished.session / "session.toml",
        finished.pipeline_file,
        finished.root / "models/base/model.toml",
    ):
        path.write_text("# a comment\n\n" + path.read_text().replace(" = ", "   =  ") + "\n\n")
    assert states(finished.run()) == ["unchanged"] * 4
    assert finished.ran() == []


def test_changed_trial_reruns_what_depends_on_it(finished: Toy) -> None:
    (finished.session / "numbers.txt").write_text("1 2 4")
    outcome = finished.run()
    assert finished.ran() == ALL
    assert outcome.steps[0].reason == "numbers.txt changed"
    assert outcome.steps[1].reason == "toy/numbers.json changed"
    path = finished.session / "session.toml"
    path.write_text(path.read_text() + 'note = "new"\n')
    outcome = finished.run()
    assert outcome.steps[0].reason == "session.toml changed"
    assert states(outcome) == ["done", "unchanged", "unchanged", "unchanged"]
    assert (finished.root / "toy/parts/2.json").exists()
    (finished.session / "numbers.txt").write_text("1 2")
    finished.run()
    assert not (finished.root / "toy/parts/2.json").exists(), "fewer outputs leave no stale files"


def test_changed_setting_reruns_from_there(finished: Toy) -> None:
    outcome = finished.run(settings={"toy_double": {"factor": 3}})
    assert finished.ran() == ALL[1:]
    assert outcome.steps[1].reason == "settings changed"
    finished.run(settings={"toy_double": {"factor": 3.0}})
    assert finished.ran() == [], "3 and 3.0 are the same factor"
    finished.run(settings={"toy_double": {"factor": 3.0, "label": "new"}})
    assert finished.ran() == ["toy_double"], "its outputs are the same bytes"


@pytest.mark.parametrize("damage", ["change", "truncate", "remove"])
def test_damaged_output_is_noticed_named_and_rebuilt(finished: Toy, damage: str) -> None:
    good = finished.files()
    path = finished.root / "toy/double.json"
    if damage == "remove":
        path.unlink()
    else:
        content = path.read_bytes()
        keep = os.stat(path)
        changed = content.replace(b"2", b"7") if damage == "change" else content[:10]
        path.write_bytes(changed)
        os.utime(path, ns=(keep.st_atime_ns, keep.st_mtime_ns))
    outcome = finished.run()
    assert "toy/double.json" in outcome.steps[1].reason
    assert finished.ran() == ["toy_double"]
    assert finished.files() == good


def test_from_takes_what_is_before_as_it_stands_unless_tampered_with(finished: Toy) -> None:
    (finished.session / "numbers.txt").write_text("5")
    assert states(finished.run(first="toy_double")) == ["unchanged"] * 3
    assert finished.ran() == []
    (finished.root / "toy/numbers.json").write_text('{"numbers": [9]}')
    with pytest.raises(InputError, match=r"toy/numbers\.json was changed since toy_read wrote it"):
        finished.run(first="toy_double")


def test_a_stage_asked_for_too_early_is_no_failure_of_the_run(toy: Toy) -> None:
    toy.run(last="toy_read", judge=False)
    (step,) = [s for s in ALL if s.startswith("toy_fit")]
    with pytest.raises(InputError, match="is missing"):
        toy.run(first=step.partition(":")[0], judge=False)
    assert record.read(toy.root).failures == {}


def test_until_and_force_choose_the_steps(toy: Toy) -> None:
    toy.run(last="toy_double", judge=False)
    assert toy.ran() == ALL[:2]
    toy.run()
    assert toy.ran() == ALL[2:]
    with pytest.raises(InputError, match="comes after"):
        toy.run(first="toy_sum", last="toy_read")
    toy.run(first="toy_double", last="toy_fit", force=True)
    assert toy.ran() == ["toy_double", "toy_fit:base"]


# Faults


def test_a_session_that_is_refused_and_its_status_change_nothing(toy: Toy) -> None:
    toy.run()
    good, written = toy.files(), (toy.root / record.FILE).read_bytes()
    (toy.session / "numbers.txt").write_text("1 two")
    with pytest.raises(InputError, match="write whole numbers"):
        toy.run()
    pipeline = toy.request().pipeline
    found = status(toy.root, pipeline)
    assert [step.state for step in found] == ["stale"] * 4
    assert found[0].reason == "numbers.txt changed"
    assert toy.files() == good
    assert (toy.root / record.FILE).read_bytes() == written
    (toy.session / "numbers.txt").write_text("1 2 3")
    assert states(toy.run()) == ["unchanged"] * 4
    assert [s.state for s in status(toy.root, pipeline)] == ["current"] * 4


def test_stage_must_write_what_it_declares(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    from bampipe.stages import toy_sum  # type: ignore[attr-defined]

    monkeypatch.setattr(toy_sum, "OUTPUTS", ("other.json",))
    with pytest.raises(RuntimeError, match=r"did not write other\.json"):
        toy.run()
    monkeypatch.setattr(toy_sum, "OUTPUTS", ())
    with pytest.raises(RuntimeError, match=r"wrote sum\.json, which it does not declare"):
        toy.run()


def test_kill_between_stage_and_commit_is_completed(
    toy: Toy, monkeypatch: pytest.MonkeyPatch
) -> None:
    toy.run()
    good = toy.files()
    (toy.session / "numbers.txt").write_text("4 5 6")
    moves = 0
    real = Path.replace

    def replace_twice(self: Path, target: Path) -> Path:
        nonlocal moves
        moves += "staging" in self.parts and not self.name.startswith(".")  # drafts
        if moves > 1:
            raise KeyboardInterrupt
        return real(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", replace_twice)
        with pytest.raises(KeyboardInterrupt):
            toy.run(last="toy_read")
    toy.ran()
    toy.run()
    assert "toy_read" not in toy.ran(), "the stage had finished: its outputs count"
    (toy.session / "numbers.txt").write_text("1 2 3")
    toy.run()
    assert toy.files() == good


def test_kill_in_mid_stage_leaves_the_previous_result(toy: Toy) -> None:
    toy.run()
    good = toy.files()
    (toy.session / "numbers.txt").write_text("7 8 9")
    process = toy.start(str(toy.session), pause=5.0)
    staged = toy.root / ".bampipe" / "staging" / "toy_double" / "toy" / "parts" / "0.json"
    deadline = time.monotonic() + 20.0
    while not staged.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert staged.exists()
    process.send_signal(signal.SIGKILL)
    process.communicate()
    doubled = [name for name in good if "double" in name or "parts" in name]
    left = toy.files()
    assert [left[name] for name in doubled] == [good[name] for name in doubled]
    assert states(toy.run()) == ["unchanged", "done", "done", "done"]
    fresh = replace(toy.request(), root=toy.folder / "fresh" / "first")
    run_session(fresh)
    assert toy.files() == contents(fresh.root)
    assert not list((toy.root / ".bampipe" / "staging").iterdir())


def test_second_run_waits_or_refuses(toy: Toy) -> None:
    process = toy.start(str(toy.session), pause=0.5)
    while not (toy.root / ".bampipe" / "staging" / "toy_double").exists():
        time.sleep(0.02)
    with pytest.raises(InputError, match="another bampipe is at work"):
        toy.run(wait=False)
    outcome = toy.run()
    assert [step.reason for step in outcome.steps] == [""] * 4
    assert any(event.kind == "waiting" for event in toy.events)
    process.communicate()
    assert process.returncode == 0


# Models


def add_child(toy: Toy) -> str:
    """Write a child of the base model and return its name."""
    name = models.child_name("base", ("stribeck:yaw",))
    device = models.read(toy.root, "base").device
    write_model(toy.root, name, "stribeck:yaw", parent="base", device=device)
    return name


def test_children_are_refreshed_once_they_were_run(finished: Toy) -> None:
    name = add_child(finished)
    assert name == "base+stribeck.yaw"
    many = tuple(f"position_dependent_friction:axis_{k}" for k in range(9))
    assert models.child_name(name, many).startswith(f"{name}+9_effects_")
    finished.run()
    assert finished.ran() == [], "nobody has asked for the child yet"
    finished.run(first="toy_fit", last="toy_fit", model=name, judge=False)
    assert finished.ran() == [f"toy_fit:{name}"]
    finished.run()
    assert finished.ran() == ["toy_sum"]
    (finished.session / "numbers.txt").write_text("2 3")
    finished.run()
    assert finished.ran() == [*ALL[:3], f"toy_fit:{name}", "toy_sum"]
    assert models.read(finished.root, name).effects == ("stribeck:yaw",)


def test_gates_judge_the_best_confirmed_model_and_its_stages_run(toy: Toy) -> None:
    with toy.pipeline_file.open("a") as file:
        file.write(
            '\n[[gates]]\nname = "fits"\nresult = "models/{model}/fit.json"\n'
            'value = "total"\nmax = 1e9\n'
        )
    assert [verdict.model for verdict in toy.run().verdicts if verdict.gate == "fits"] == ["base"]
    child = add_child(toy)
    write_result(toy.root, CompareResult, best=child, ladder=[{"model": "base"}, {"model": child}])
    toy.ran()
    outcome = toy.run()
    assert toy.ran() == [f"toy_fit:{child}", "toy_sum"]
    assert outcome.model == child
    rows = [(verdict.gate, verdict.model, verdict.state) for verdict in outcome.verdicts]
    assert ("fits", child, "passed") in rows
    assert {model for gate, model, _ in rows if gate == "small enough"} == {""}
    assert toy.run(model="base").model == "base"


def test_a_new_effect_file_reruns_its_model(finished: Toy) -> None:
    (finished.root / "models/base/effects").mkdir()
    (finished.root / "models/base/effects/own.toml").write_text('name = "own"\n')
    finished.run()
    assert finished.ran() == ["toy_fit:base"]


# Provenance


def test_record_says_what_was_run_on_what(toy: Toy) -> None:
    toy.run()
    content = json.loads((toy.root / "run.json").read_text())
    assert content["schema"] == "bampipe.run/1"
    stages = content["stages"]
    assert list(stages) == sorted(ALL)
    read, double = stages["toy_read"], stages["toy_double"]
    assert set(read["inputs"]) == {"session:session.toml", "session:numbers.txt"}
    assert "session" not in read["config"]
    assert double["config"] == {"factor": 2.0, "label": ""}
    assert double["inputs"]["toy/numbers.json"] == read["outputs"]["toy/numbers.json"]
    assert {"bampipe", "python", "numpy", "scipy", "numba"} <= set(double["versions"])
    assert set(content["timings"]) == set(ALL)


def test_verify_says_what_was_touched(toy: Toy) -> None:
    toy.run()
    assert verify(toy.root) == []
    (toy.root / "toy/parts/1.json").write_text("{}")
    (toy.root / "sum.json").unlink()
    (toy.root / "notes.txt").write_text("mine")
    (toy.session / "numbers.txt").write_text("9")
    with (toy.root / "models/base/model.toml").open("a") as stream:
        stream.write("# only a comment\n")
    assert verify(toy.root) == [
        ("notes.txt", "unknown"),
        ("session:numbers.txt", "changed"),
        ("sum.json", "gone"),
        ("toy/parts/1.json", "changed"),
    ]


def test_a_stage_outside_the_pipeline_makes_no_later_one_stale(toy: Toy) -> None:
    toy.run()
    pipeline, settings = toy.request().pipeline, {"toy_double": {"factor": 3}}
    without = tuple(stage for stage in pipeline.stages if stage != "toy_double")
    for stages, last in ((pipeline.stages, "stale"), (without, "current")):
        found = status(
            toy.root, pipeline.model_copy(update={"stages": stages, "settings": settings})
        )
        assert [step.state for step in found[1::2]] == ["stale", last]


# Session identity


@pytest.mark.parametrize("name", ["../up", "a/b", "", ".hidden", "x" * 200, "a b"])
def test_session_id_must_be_a_name(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "session"
    folder.mkdir()
    (folder / "session.toml").write_text(f"session_id = {json.dumps(name)}\n")
    with pytest.raises(InputError, match="session_id"):
        session_id(folder)
    with pytest.raises(InputError, match="folder of sessions"):
        session_id(tmp_path)


# Gates


def gate(**changes: object) -> Gate:
    limit = Gate(name="limit", result="models/{model}/v.json", value="axes.*.a", max=2.0)
    return limit.model_copy(update=changes)


def judged(tmp_path: Path, content: object, **changes: object) -> list[GateVerdict]:
    path = tmp_path / "models" / "base" / "v.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(content))
    return gates.judge_gates(gate(**changes), tmp_path, "base", tmp_path / "accepted")


def test_gate_judges_each_axis(tmp_path: Path) -> None:
    found = judged(tmp_path, {"axes": {"yaw": {"a": 1.0}, "pitch": {"a": 3}}})
    assert [(v.key, v.state) for v in found] == [("pitch", "failed"), ("yaw", "passed")]
    assert found[0].message == "3 is above 2"


def test_gate_divides(tmp_path: Path) -> None:
    content = {"axes": {"yaw": {"a": 3.0, "b": 2.0}, "pitch": {"a": 1.0, "b": 0.0}}}
    found = judged(tmp_path, content, divide_by="axes.*.b", level="warn")
    assert [(v.key, v.state, v.value) for v in found] == [
        ("pitch", "warned", None),
        ("yaw", "passed", 1.5),
    ]


@pytest.mark.parametrize("optional", [True, False])
@pytest.mark.parametrize("content", [{}, {"axes": {"yaw": {"a": None}}}, {"axes": [1]}])
def test_gate_without_a_number(tmp_path: Path, content: object, optional: bool) -> None:
    found = judged(tmp_path, content, optional=optional)
    assert [v.state for v in found] == ["absent" if optional else "failed"]


# Pipelines


@pytest.mark.parametrize("name", pipelines.names())
def test_shipped_pipelines_are_sound(name: str) -> None:
    loaded = pipelines.load(name)
    assert loaded.name == name
    for stage, settings in loaded.settings.items():
        configure(stage, settings)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"toy_sum"]', '"toy_smu"]', "did you mean 'toy_sum'"),
        ('"toy_read", "toy_double"', '"toy_double", "toy_read"', "in order"),
        ("max = 100.0", 'max = "high"', "gates"),
        ("max = 100.0", "maximum = 100.0", "maximum"),
        ('name = "toy"', "name = 3", "name"),
        ("stages =", "stage =", "stage"),
        ('schema = "bampipe.pipeline/1"', "schema = ", "not TOML"),
        ('value = "axes.*.value"', 'value = "*.*"', "value"),
        ('result = "toy/double.json"', 'result = "/etc/x.json"', "result"),
        ("[[gates]]", "[settings.toy_duble]\nfactor = 3\n[[gates]]", "did you mean 'toy_double'"),
    ],
)
def test_wrong_pipelines_are_refused(toy: Toy, old: str, new: str, message: str) -> None:
    text = toy.pipeline_file.read_text()
    assert old in text
    toy.pipeline_file.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message):
        pipelines.load(str(toy.pipeline_file))


def test_assignment() -> None:
    given = {"a": 1, "b": [1, 2], "c": "least-squares"}
    assert parse_settings(["a=1", "b=[1, 2]", "c=least-squares"]) == given
    with pytest.raises(InputError, match="not a setting"):
        parse_settings(["a"])


# Several sessions


def test_one_failing_session_stops_no_other(toy: Toy) -> None:
    given = toy.many({"a": "1", "b": "two", "c": "crash", "d": "5000", "e": "4"})
    outcomes = batch.run_sessions(given, 1, toy.events.append)
    assert [outcome.exit_code for outcome in outcomes] == [0, 2, 3, 1, 0]
    assert "ZeroDivisionError" in outcomes[2].error
    assert "Traceback" in outcomes[2].traceback


@pytest.mark.slow
def test_worker_processes_survive_a_death_and_give_the_same_bytes(toy: Toy) -> None:
    given = toy.many({"a": "1", "b": "two", "c": "die", "d": "4", "e": "5 6"})
    process = toy.start(str(toy.folder / "many" / "*"), "--jobs", "2", "--json")
    out, _ = process.communicate()
    found = {Path(item["run"]).name: item["state"] for item in json.loads(out)["sessions"]}
    assert found == {"a": "done", "b": "refused", "c": "crashed", "d": "done", "e": "done"}
    assert process.returncode == 3
    for request in (given[0], *given[3:]):
        alone = replace(request, root=toy.folder / "serial" / request.root.name)
        run_session(alone)
        assert contents(alone.root) == contents(request.root)


def test_lock_is_free_after_a_crash(toy: Toy) -> None:
    (toy.session / "numbers.txt").write_text("crash")
    with pytest.raises(ZeroDivisionError):
        toy.run()
    (toy.session / "numbers.txt").write_text("1")
    assert states(toy.run(wait=False)) == ["done"] * 4
    assert record.read(toy.root).failures == {}
