"""A lab's data set, its verdicts and its report, from run folders of known content."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import Command, bytes_of, misfits
from made_results import diagnosis, write_result
from made_runs import Made

from bampipe.cli import lab as lab_command
from bampipe.data import lab_tables
from bampipe.errors import InputError
from bampipe.files import digest_file
from bampipe.lab.collect import collect
from bampipe.lab.folders import is_current
from bampipe.phrases import lab as phrases
from bampipe.report import style, typeset
from bampipe.results.compare import CompareResult
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.run import RunResult
from bampipe.run.accepted import accept

ROOT = Path(__file__).parent.parent.parent
CLEAN = {"yaw": ("nothing_missing", ()), "pitch": ("nothing_missing", ())}
MISSING = {"yaw": ("missing", ["stribeck:yaw"]), "pitch": ("nothing_missing", ())}
NAMES = ("viscous.yaw", "coulomb.yaw", "viscous.pitch", "mass")


def estimates(number: int, **changes: float) -> dict[str, float]:
    draws = np.random.default_rng(number).normal(size=len(NAMES))
    found = {name: 4.0 + 0.02 * float(draw) for name, draw in zip(NAMES, draws, strict=True)}
    return found | {name.replace("__", "."): value for name, value in changes.items()}


def made(number: int, parameters: dict[str, float], **more: object) -> Made:
    """A run; recorded in the order of numbers."""
    when = f"2026-09-{number:02d}T09:30:00+00:00"
    return Made(f"s{number:02d}", when, parameters, **more)  # type: ignore[arg-type]


def make_lab(folder: Path, *changed: Made, sessions: int = 9) -> Path:
    """Runs of a lab, all in order but those that ``changed``."""
    for number in range(1, sessions + 1):
        stiffness = 2300.0 + number
        made(number, estimates(number), verdicts=CLEAN, stiffness=stiffness).write(folder / "runs")
    for one in changed:
        shutil.rmtree(folder / "runs" / one.name, ignore_errors=True)
        one.write(folder / "runs")
    return folder / "runs"


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without figures and print, which take most of their time, until a test undoes it."""
    monkeypatch.setattr(typeset, "render_pdf", lambda *_: b"")
    monkeypatch.setattr(style, "render_svg", lambda _: "<svg></svg>")


DRIFTED = made(5, estimates(5, coulomb__yaw=4.9), verdicts=CLEAN)


def verdicts(runs: Path) -> dict[str, dict[str, object]]:
    found, _ = collect(runs, runs.parent / "lab")
    return {one["session"]: one for one in found.model_dump()["sessions"]}


@pytest.mark.parametrize(
    ("with_effect", "verdict"),
    [(4.01, "missing effect"), (4.8, "device drifted, and missing effect")],
)
def test_a_parameter_that_stays_out_with_the_effect_is_the_device_too(
    tmp_path: Path, with_effect: float, verdict: str
) -> None:
    child = ("stribeck:yaw", estimates(7, coulomb__yaw=with_effect))
    parameters = estimates(7, coulomb__yaw=4.9)
    runs = make_lab(tmp_path, made(7, parameters, verdicts=MISSING, child=child))
    one = verdicts(runs)["s07"]
    assert one["verdict"] == verdict
    assert ("back within the limits" in str(one["sentence"])) == (with_effect < 4.1)


def test_an_effect_on_another_axis_does_not_account_for_a_parameter(tmp_path: Path) -> None:
    other = made(7, estimates(7, viscous__pitch=4.9), verdicts=MISSING)
    one = verdicts(make_lab(tmp_path, other))["s07"]
    assert one["verdict"] == "device drifted, and missing effect"
    made(7, estimates(7, viscous__yaw=4.9), verdicts=MISSING).write(tmp_path / "runs")
    one = verdicts(tmp_path / "runs")["s07"]
    assert one["verdict"] == "missing effect"
    assert one["remedy"] == "bampipe extend s07 --auto, then bampipe lab"


def test_what_is_undecided_or_has_no_verdict_is_said(tmp_path: Path) -> None:
    runs = make_lab(tmp_path)
    first, second = ("stribeck:yaw",), ("presliding:yaw",)
    for number, verdict, sets in (
        (4, "undecided", {first: 0.6, second: 0.4}),
        (5, "undecided", {(): 0.6, first: 0.4}),
        (6, "undecided", {(*first, *second): 0.7, first: 0.3}),
        (7, "missing", {first: 0.995, (): 0.005}),
        (8, "no_verdict", {(): 1.0}),
    ):
        fields = diagnosis({"yaw": {"verdict": verdict}}, sets)
        write_result(runs / f"s0{number}", DiagnoseResult, model="base", **fields)
    found = verdicts(runs)
    within = "; no parameter is beyond its limits"
    assert {number: found[f"s0{number}"]["sentence"] for number in range(4, 9)} == {
        4: f"lacks either stribeck:yaw (0.60) or presliding:yaw (0.40){within}",
        5: f"lacks either nothing (0.60) or stribeck:yaw (0.40){within}",
        6: "lacks stribeck:yaw (> 0.99), and either presliding:yaw (0.70) or nothing more (0.30)"
        + within,
        7: f"lacks stribeck:yaw{within}",
        8: "no verdict on yaw",
    }
    assert found["s08"]["verdict"] == "not diagnosed"


def test_what_was_not_diagnosed_is_said(tmp_path: Path) -> None:
    unasked = made(3, estimates(3, mass=5.0))
    above = made(4, estimates(4), error={"yaw": 3.0, "pitch": 1.0})
    found = verdicts(make_lab(tmp_path, unasked, above))
    assert found["s03"]["verdict"] == found["s04"]["verdict"] == "not diagnosed"
    assert found["s04"]["remedy"] == "bampipe diagnose s04 --model base"


def test_a_session_is_judged_by_its_best_confirmed_model(tmp_path: Path) -> None:
    name, high = "base+stribeck.yaw", {"yaw": 3.0, "pitch": 1.0}
    child = ("stribeck:yaw", estimates(4))
    extended = made(4, estimates(4), error=high, verdicts=MISSING, child=child)
    runs = make_lab(tmp_path, extended)
    before = verdicts(runs)["s04"]
    assert (before["model"], before["above_floor"]) == ("base", True)
    assert before["verdict"] == "missing effect"
    ladder = [{"model": "base"}, {"model": name, "parent": "base"}]
    write_result(runs / "s04", CompareResult, best=name, ladder=ladder)
    after = verdicts(runs)["s04"]
    assert (after["model"], after["above_floor"], after["verdict"]) == (name, False, "in control")
    assert after["worst"] == (1.0, "yaw")


@pytest.mark.parametrize("sessions", [2, 9])
def test_its_json_files_are_as_their_schemas_say(tmp_path: Path, sessions: int) -> None:
    drifted = made(2, estimates(2, coulomb__yaw=4.9), verdicts=MISSING)
    collect(make_lab(tmp_path, drifted, sessions=sessions), tmp_path / "lab")
    written = {path.name for path in (tmp_path / "lab").glob("*.json")}
    assert written == {"lab.json", "trends.json"}
    assert misfits(tmp_path / "lab") == []


def test_every_table_in_one_line(tmp_path: Path) -> None:
    lab = tmp_path / "lab"
    collect(make_lab(tmp_path), lab)
    for table, columns in lab_tables.TABLES.items():
        frame = pd.read_parquet(lab / table)
        assert list(frame.columns) == [*columns, "device"]
    frame = pd.read_parquet(lab / "parameters")
    assert len(frame) == 9 * len(NAMES)
    assert ((frame["upper"] - frame["lower"]) / frame["sd"]).to_numpy() == pytest.approx(3.92, 1e-3)
    assert set(frame[frame["parameter"] == "coulomb.yaw"]["axis"]) == {"yaw"}
    assert frame[frame["parameter"] == "mass"]["axis"].isna().all()
    quality = pd.read_parquet(lab / "quality")
    assert quality["status"].tolist() == ["ok", "set_aside"] * 9


def test_the_lines_in_the_documents_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every Python line of docs/lab.md runs on a lab, and finds rows."""
    make_lab(tmp_path)
    collect(tmp_path / "runs", tmp_path / "lab")
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs/lab.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.S)
    assert len(blocks) == 2
    for block in blocks:
        if "duckdb" in block:
            pytest.importorskip("duckdb", reason="duckdb is not installed")
        scope: dict[str, object] = {}
        exec(block, scope)
        assert len(scope["found"]) > 0  # type: ignore[arg-type]


def test_the_same_runs_give_the_same_bytes_and_a_lost_device_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    runs = make_lab(tmp_path, sessions=3)
    made(10, {"mass": 1.0}, device="rail/2").write(runs)
    lab = tmp_path / "lab"
    collect(runs, lab)
    first = bytes_of(lab)
    assert "parameters/device=rail%2F2/data.parquet" in first
    assert set(pd.read_parquet(lab / "sessions")["device"]) == {"bam", "rail/2"}
    collect(runs, lab)
    assert bytes_of(lab) == first
    (runs / "s10" / "run.json").unlink()
    collect(runs, lab)
    assert not list(lab.glob("*/device=rail*"))


def test_sessions_without_a_date_come_first_and_a_damaged_run_is_named(tmp_path: Path) -> None:
    runs = make_lab(tmp_path, sessions=3)
    Made("undated", None, estimates(4)).write(runs)
    (runs / "s02" / "models/base/identify.json").write_text("{")
    _, found = collect(runs, tmp_path / "lab")
    assert found.sessions == ("undated", "s01", "s03")
    (skipped,) = found.skipped
    assert re.match(r"s02: .*identify\.json, line 1: not JSON", skipped)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("stiffness/stiffness.json", {"axes": None}),
        ("models/base/identify.json", {"parameters": {"mass": 3}}),
        ("models/base/validate.json", []),
        ("models/base/diagnose.json", {"axes": {"yaw": {}}}),
        ("ingest/session.json", {"device": "bam", "axes": 3}),
    ],
)
def test_a_result_of_another_form_leaves_its_run_out(
    tmp_path: Path, name: str, content: object
) -> None:
    runs = make_lab(tmp_path, sessions=2)
    (runs / "s01" / name).write_text(json.dumps(content))
    _, found = collect(runs, tmp_path / "lab")
    assert found.sessions == ("s02",)
    (skipped,) = found.skipped
    assert skipped.startswith("s01: ") and "\n" not in skipped


def test_a_result_that_was_edited_leaves_its_run_out(tmp_path: Path) -> None:
    runs = make_lab(tmp_path, sessions=2)
    path = runs / "s01/models/base/identify.json"
    outputs = {"models/base/identify.json": digest_file(path)}
    step = {"key": "0" * 64, "code": "0" * 64, "outputs": outputs}
    write_result(runs / "s01", RunResult, stages={"identify:base": step})
    assert collect(runs, tmp_path / "lab")[1].skipped == ()
    path.write_text(path.read_text().replace("4.", "5.", 1))
    (skipped,) = collect(runs, tmp_path / "lab")[1].skipped
    assert "models/base/identify.json was changed since identify:base wrote it" in skipped
    with pytest.raises(InputError, match="was changed since"):
        accept(runs / "s01", "base", tmp_path / "accepted")


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    runs = make_lab(tmp_path, sessions=2)
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="holds other files"):
        collect(runs, tmp_path / "lab")
    with pytest.raises(InputError, match="no run in"):
        collect(tmp_path / "lab", tmp_path / "other")
    assert [path.name for path in (tmp_path / "lab").iterdir()] == ["notes.txt"]


def test_current_until_a_run_changes(tmp_path: Path) -> None:
    runs, lab = make_lab(tmp_path), tmp_path / "lab"
    assert not is_current(runs, lab)
    collect(runs, lab)
    assert is_current(runs, lab)
    made(11, estimates(11)).write(runs)
    assert not is_current(runs, lab)


def test_the_report_says_what_the_trends_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    collect(make_lab(tmp_path, DRIFTED), tmp_path / "lab")
    page = (tmp_path / "lab/report.html").read_text(encoding="utf-8")
    assert "s05: device drifted" in page
    assert "t2.csv, row 7" in page
    assert (tmp_path / "lab/report.pdf").read_bytes().startswith(b"%PDF")
    assert (tmp_path / "lab/figures/charts-1.svg").is_file()


@pytest.mark.parametrize(("sessions", "limits"), [(9, True), (3, False)])
def test_words_about_limits_are_true_of_the_charts(
    tmp_path: Path, sessions: int, limits: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    trends, about = collect(make_lab(tmp_path, sessions=sessions), tmp_path / "lab")
    page = (tmp_path / "lab/report.html").read_text(encoding="utf-8")
    assert all(chart.has_limits is limits for chart in trends.series)
    said = "in control" if limits else "no limits yet"
    assert {phrases.verdict(trends, one) for one in trends.sessions} == {said}
    assert ("The band is the control limits" in page) is limits
    assert ("Control limits need 6 sessions of this device" in page) is not limits
    lab_command.table(tmp_path / "lab", trends, about)
    assert ("no control limits yet" in capsys.readouterr().out) is not limits


def test_after_several_sessions_the_page_that_links_them_comes_next(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = make_lab(tmp_path, sessions=3)
    lab_command.refresh(runs, several=True, quiet=False)
    said = capsys.readouterr().out.splitlines()[-1]
    assert said == f"next: open {tmp_path / 'lab/report.html'}, which links every session"


def test_the_page_links_the_pages_of_every_session(tmp_path: Path) -> None:
    runs = make_lab(tmp_path, sessions=5)
    for name in ("report.html", "explore.html"):
        target = runs / "s05" / "report" / name
        target.parent.mkdir(exist_ok=True)
        target.write_text("")
    collect(runs, tmp_path / "out" / "lab")
    page = (tmp_path / "out/lab/report.html").read_text(encoding="utf-8")
    targets = re.findall(r'href="([^"#]+)"', page)
    assert targets == [f"../../runs/s05/report/{n}.html" for n in ("report", "explore")]
    assert all((tmp_path / "out/lab" / target).is_file() for target in targets)


def test_the_command(tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    make_lab(tmp_path, DRIFTED)
    monkeypatch.chdir(tmp_path)
    code, out, _ = command("lab")
    assert code == 0
    assert "lab: 9 sessions, 1 stands out" in out
    assert re.search(r"s05 .*device drifted +coulomb\.yaw \+2\d %", out)
    code, out, _ = command("lab", "runs", "--out", "elsewhere", "--json")
    assert code == 0
    content = json.loads(out)
    assert content["sessions"][4]["verdict"] == "device drifted"
    assert (tmp_path / "elsewhere/parameters").is_dir()
    monkeypatch.chdir(tmp_path.parent)
    code, named, _ = command("lab", "--runs", tmp_path / "runs", "--json")
    assert code == 0 and json.loads(named)["sessions"] == content["sessions"]
    code, _, err = command("lab", "nowhere")
    assert code == 2 and "no such folder of runs" in err
