"""The report of a made-up run: what it says, and that it says nothing that is not stored."""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import pandas as pd
import pytest
import synthetic_run
from conftest import Command
from made_results import diagnosis, write_result

from bampipe.data.store import write_parquet
from bampipe.errors import InputError
from bampipe.report import style, typeset
from bampipe.report.build import Report, build_run_report
from bampipe.report.document import Callout
from bampipe.report.run_results import Results
from bampipe.report.sections import identification, summary, validation
from bampipe.report.wording import break_lines, name_parameter
from bampipe.results.diagnose import DiagnoseResult
from bampipe.results.draft import DraftResult
from bampipe.results.setup import SetupResult
from bampipe.results.validate import ValidateResult


def quiet(fraction: float, message: str) -> None:
    assert 0.0 <= fraction <= 1.0
    assert message


def page_of(root: Path) -> str:
    """The page of a run's report without its figures; those and the print take nearly all time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typeset, "render_pdf", lambda *_: b"")
        patch.setattr(style, "render_svg", lambda _: "<svg></svg>")
        return build_run_report(Results(root), quiet).html


def text_of(page: str) -> str:
    """Return the words of a page without its drawings and marks."""
    body = page[page.index("<main>") :]
    body = re.sub(r"<svg.*?</svg>", " ", body, flags=re.DOTALL)
    body = re.sub(r"<[^>]+>", " ", body.replace("<wbr>", ""))
    return re.sub(r"\s+", " ", html.unescape(body))


def row_of(page: str, *start: str) -> list[str]:
    """Return the cells of the first table row whose first cells read ``start``."""
    for row in re.findall(r"<tr>(.*?)</tr>", page, flags=re.DOTALL):
        cells = [text_of(f"<main>{cell}").strip() for cell in re.findall(r"<td.*?</td>", row)]
        if tuple(cells[: len(start)]) == start:
            return cells
    raise AssertionError(f"no row {start}")


@pytest.fixture(scope="module")
def full_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic_run.write_all(tmp_path_factory.mktemp("runs") / "s01")


@pytest.fixture
def own_run(full_run: Path, tmp_path: Path) -> Path:
    """A copy of the run that a test may change."""
    return Path(shutil.copytree(full_run, tmp_path / "s01"))


@pytest.fixture(scope="module")
def full(full_run: Path) -> Report:
    return build_run_report(Results(full_run), quiet)


def test_sections_stand_in_order_and_the_summary_gives_the_key_numbers(full: Report) -> None:
    assert full.sections[0] == "Summary"
    assert full.sections[-1] == "Provenance"
    headings = re.findall(r"<h2[^>]*>(.*?)</h2>", full.html)
    assert headings == list(full.sections)
    words = text_of(full.html)
    start = words[: words.index("Trials")]
    assert "The model with stribeck:yaw explains this session: nothing is missing" in start
    assert "yaw 0.562 to 0.212 N·m (floor 0.203)" in start
    assert row_of(full.html, "Viscous damping")[1] == "4.17 ± 0.13 N·m·s/rad"
    assert row_of(full.html, "Noise floor")[1:] == ["0.203 N·m", "0.229 N·m", "0.601 N"]
    assert row_of(full.html, "t04_free")[2:] == ["–", "–", "set aside", "force_x frozen"]
    assert row_of(full.html, "t03_free")[-2] == "repaired"
    assert "interpolated" in row_of(full.html, "t03_free")[-1]


@pytest.mark.parametrize(("model", "left"), [(synthetic_run.CHILD, ""), ("base", " Left on yaw.")])
def test_what_the_shown_model_explains_is_no_doubt_of_the_set_up(
    own_run: Path, model: str, left: str
) -> None:
    about = {axis: f"Left on {axis}" for axis in ("yaw", "pitch")}
    given = {"warnings": ["Yaw hardly moves"], "unexplained": about, "axes": {"yaw": {}}}
    write_result(own_run, SetupResult, **given)
    said = Callout("note", "Doubtful set-up", f"Yaw hardly moves.{left}")
    assert next(summary.list_blocks(Results(own_run, model))) == said
    (own_run / f"models/{model}/validate.json").unlink()
    said = Callout("note", "Doubtful set-up", "Yaw hardly moves. Left on yaw. Left on pitch.")
    assert next(summary.list_blocks(Results(own_run, model))) == said


def test_parameters_and_errors_are_the_stored_ones_rounded(full: Report) -> None:
    for name, (value, sd, unit) in synthetic_run.parameters(synthetic_run.CHILD).items():
        shown = row_of(full.html, name_parameter(name), name)
        estimate, spread = float(shown[2].removesuffix(" *")), float(shown[3])
        assert shown[2].endswith("*") == (name == "stribeck.yaw.speed")
        assert float(shown[5]) == pytest.approx(value + 0.4 * sd, abs=0.06 * sd)
        assert estimate == pytest.approx(value, abs=0.06 * sd)
        assert spread == pytest.approx(sd, rel=0.06)
        low, high = (float(part) for part in shown[4].split(" to "))
        assert low == pytest.approx(value - 1.96 * sd, abs=0.06 * sd)
        assert high == pytest.approx(value + 1.96 * sd, abs=0.06 * sd)
        assert shown[6] == unit.replace(".", "·")
    table = full.html[full.html.index("Error of the predicted force") :]
    for axis, error in synthetic_run.held_out(synthetic_run.CHILD).items():
        cells = row_of(table, axis)
        assert float(cells[1]) == pytest.approx(error, rel=3e-3)
        assert float(cells[2]) == pytest.approx(synthetic_run.FLOOR[axis], rel=3e-3)


def test_a_long_remark_of_several_trials_stands_once_below_the_table(own_run: Path) -> None:
    path = own_run / "ingest/trials.parquet"
    trials = pd.read_parquet(path)
    said = "from {} s of the record; time stamps jitter by {} ms: put on a uniform grid by cubics"
    trials.loc[:1, "repairs"] = [said.format(*numbers) for numbers in ((0, 0.9), (15, 1.25))]
    trials.loc[2, "repairs"] = "12 samples missing at 3.2 s"
    write_parquet(path, trials)
    page = page_of(own_run)
    assert [row_of(page, f"t0{n}_free")[-1] for n in (1, 2, 3)] == [
        "from 0 s of the record", "from 15 s of the record", "12 samples missing at 3.2 s",
    ]  # fmt: skip
    below = "Trials t01_free and t02_free: time stamps jitter by 0.9–1.25 ms: put on a uniform"
    assert text_of(page).count("time stamps jitter") == 1 and below in text_of(page)


def test_diagnosis_names_effect_group_and_trial(full: Report) -> None:
    words = text_of(full.html)
    assert row_of(full.html, "stribeck:yaw", "yaw")[2:] == [
        "presliding:yaw", "0.562", "0.212", "N·m", "0.97", "< 0.001",
    ]  # fmt: skip
    assert row_of(full.html, "yaw", "missing stribeck:yaw (0.97)")[2:] == [
        "98.8 %", "0.562", "0.212", "0.183", "0.203", "N·m", "81 %",
    ]  # fmt: skip
    assert "Yaw: stribeck:yaw is missing (probability 0.97); adding it takes the held-out" in words
    assert row_of(full.html, "presliding:yaw", "0.03")
    assert "nothing, the largest gain of any candidate is 1.23 to 4.56 nats" in words
    assert "Move yaw back and forth at 0.02 rad/s" in words
    assert "reversing slowly with the arm extended" in words
    assert "residual-maps-base-yaw" in full.figures
    assert "residual-maps-base-pitch" not in full.figures


def test_each_effect_found_is_explained(full: Report) -> None:
    part = full.html[full.html.index(">Effects</h2>") - 200 :]
    words = text_of(part.replace("<h2", "<main><h2", 1))
    assert "Friction rises as the speed falls. Found: force 1.021 ± 0.064 N·m; speed" in words
    assert "torque = -force*exp(-qd**2)" in words
    assert "Q[θ] = -1.086 sgn(θ') - 4.171 θ'" in text_of(full.html)
    assert "On the machine. Grease the joint." in words
    assert "Its probability is 0.97. Alternatives: presliding:yaw (0.03)." in words
    assert "Right: the worst window of yaw without stribeck:yaw (reversing slowly" in words
    assert "the residual falls from 0.2" in words
    assert {"friction", "effect-stribeck-yaw"} <= full.figures.keys()
    assert "Friction builds up over a distance. torque = -z" in words


def test_a_simulated_session_says_so_and_who_recorded_what(own_run: Path) -> None:
    said = {"simulated": True, "operator": "A. Lee", "device_serial": "B-3", "notes": "warm room"}
    path = own_run / "ingest/session.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **said}))
    words = text_of(page_of(own_run))
    assert "simulated, device bam B-3, recorded 2026-10-03 10:12 UTC, by A. Lee" in words
    assert "Notes: warm room." in words
    assert "It replicates nothing that was measured" in words


def test_the_ladder_the_stiffness_and_the_paper_stand_beside_the_session(full: Report) -> None:
    table = full.html[full.html.index("RMSE on the same held-out trials") :]
    assert row_of(table, "base")[2] == "0.562 (0.203)"
    assert row_of(table, "version 1")[1:3] == ["stribeck:yaw", "0.212 (0.203)"]
    assert "coulomb.yaw fell by 0.21 N·m" in text_of(full.html)
    table = full.html[full.html.index("Stiffness of the locked axes") :]
    assert row_of(table, "yaw")[1:] == [
        "2.304 ± 0.013 kN·m/rad", "3", "5.53 N·m", "197 mJ", "25.1", "4.00",
    ]  # fmt: skip
    assert row_of(full.html, "Viscous damping, yaw", "Table VII")[2:4] == [
        "4.17 ± 0.128", "4.17 ± 0.13",
    ]  # fmt: skip
    assert row_of(full.html, "Stiffness, pitch")[3] == "–"


@pytest.mark.parametrize(
    ("verdict", "sets", "title"),
    [
        ("missing", {("a:yaw", "b:yaw"): 1.0}, "lacks a:yaw (> 0.99) and b:yaw (> 0.99) on yaw"),
        ("unknown_effect", {(): 1.0}, "Something that no known effect explains acts on yaw"),
        ("no_verdict", {(): 1.0}, "No verdict on yaw"),
        (
            "undecided",
            {("a:yaw",): 0.6, ("b:yaw",): 0.4},
            "yaw: either a:yaw (0.60) or b:yaw (0.40)",
        ),
    ],
)
def test_the_verdict_on_the_session_is_that_of_its_diagnosis(
    own_run: Path, verdict: str, sets: dict[tuple[str, ...], float], title: str
) -> None:
    axes = {"pitch": {"verdict": "nothing_missing"}, "yaw": {"verdict": verdict}}
    fields = diagnosis(axes, sets)
    write_result(own_run, DiagnoseResult, model=synthetic_run.CHILD, **fields)
    assert title in text_of(page_of(own_run))


def test_provenance_lists_inputs_versions_and_keys_in_order(full: Report) -> None:
    words = text_of(full.html)
    words = words[words.rindex("Provenance") :]
    assert "bampipe 0.1.0" in words
    assert "aaaaaaaaaaaa" in words
    table = full.html[full.html.rindex("Stages") :]
    assert row_of(table, "filter")[1:] == ["1", "1bcdef012345"]
    places = [table.index(f"<code>{name}<") for name in ("ingest", "filter", "stiffness")]
    assert places == sorted(places)


def test_a_device_of_no_paper_mentions_none(own_run: Path, full: Report) -> None:
    assert "the paper's" in text_of(full.html)
    path = own_run / "ingest/session.json"
    path.write_text(path.read_text().replace('"bam"', '"slider"'))
    assert "the paper's" not in text_of(page_of(own_run))


def test_settings_that_all_models_share_stand_once(own_run: Path) -> None:
    record = json.loads((own_run / "run.json").read_text())
    stages = record["stages"]
    shared = {"seed": 3, "model": "base"}
    stages["identify:base"]["config"] = shared
    stages["identify:other"] = stages["identify:base"] | {"config": shared | {"model": "other"}}
    stages["filter"]["config"] = {"band_hz": 5.0}
    (own_run / "run.json").write_text(json.dumps(record))
    table = page_of(own_run)
    table = table[table.index("Settings of each stage") :]
    assert row_of(table, "identify")[1] == "seed = 3"
    assert row_of(table, "filter")[1] == "band_hz = 5.0"
    assert "identify:other" not in table


def test_results_older_than_their_inputs_are_named_first(full: Report, own_run: Path) -> None:
    assert "older than their inputs" not in full.html
    record = json.loads((own_run / "run.json").read_text())
    # A device file counts by what it says where it is read, by its bytes where it is written.
    record["stages"]["ingest"]["outputs"]["ingest/device.toml"] = "b" * 64
    record["stages"]["identify:base"]["inputs"]["ingest/device.toml"] = "d" * 64
    (own_run / "run.json").write_text(json.dumps(record))
    assert Results(own_run).outdated == ()
    record["stages"]["ingest"]["outputs"]["ingest/x"] = "f" * 64
    (own_run / "run.json").write_text(json.dumps(record))
    assert Results(own_run).outdated == ("filter", "identify:base", "stiffness")
    page = page_of(own_run)
    place = page.index("older than their inputs")
    assert place < page.index("<table") and "identify:base" in page[place:][:400]


def test_figures_are_vectors_and_the_page_is_self_contained(full: Report) -> None:
    assert {
        "stiffness-loops", "error-without-friction", "torques-and-motion", "convergence",
        "force-prediction", "ladder",
    } <= full.figures.keys()  # fmt: skip
    for place in ("Fig. 3", "Fig. 4", "Fig. 6", "Fig. 7", "Fig. 9", "Table I", "Table VI"):
        assert f"the paper's {place}" in text_of(full.html)
    known = {*style.COLOURS.values(), "#ffffff", "#000000"}
    for name, svg in full.figures.items():
        assert "<image" not in svg, name
        assert set(re.findall(r"#[0-9a-f]{6}\b", svg)) <= known, name
        assert "<dc:date>" not in svg
    assert set(re.findall(r'(?:src|href)="(?!#)([^"]*)"', full.html)) == {"explore.html"}
    assert "@import" not in full.html
    ids = re.findall(r'\bid="([^"]+)"', full.html)
    assert len(ids) == len(set(ids))
    targets = set(re.findall(r'(?:href="|url\()#([^")]+)', full.html))
    assert targets <= set(ids)
    assert "prefers-color-scheme: dark" in full.html


def test_what_did_not_run_along_the_data_has_no_picture_of_its_convergence(own_run: Path) -> None:
    path = own_run / "models" / Results(own_run).model / "trace.parquet"
    trace = pd.read_parquet(path)
    for rows, expected in ((trace, True), (trace.groupby("trial_id").tail(1), False)):
        write_parquet(path, rows.reset_index(drop=True))
        blocks = identification.list_blocks(Results(own_run))
        assert ("convergence" in [getattr(b, "name", "") for b in blocks]) is expected


def test_the_drift_of_a_model_is_a_table_and_its_absence_a_sentence(own_run: Path) -> None:
    results = Results(own_run)
    validated = results.read(ValidateResult)
    why = "Within 0.5 s the model drifts farther than the axis moves."
    step = {"horizon_s": 0.1, "median": 0.0012, "quantile_90": 0.0034, "displacement": 0.2}
    drift = {"unit": "rad", "horizons": [step | {"windows": 40}], "reason": why}
    content = validated.model_dump(mode="json") | {"free_run": {"drift": {"yaw": drift}}}
    path = own_run / "models" / results.model / "validate.json"
    path.write_text(json.dumps(content))
    blocks = [*validation.list_blocks(Results(own_run))]
    table = next(b for b in blocks if getattr(b, "caption", "").startswith("Drift"))
    assert list(table.rows) == [("yaw", "1.2", "3.4", "200", "mrad")]
    said = {text for b in blocks if isinstance(b, tuple) for text in b}
    assert f"yaw: {why[:1].lower()}{why[1:]}" in said


def test_pdf_text_and_pages(full: Report, tmp_path: Path) -> None:
    if shutil.which("pdftotext") is None:
        pytest.skip("pdftotext (poppler) is not installed")
    path = tmp_path / "report.pdf"
    path.write_bytes(full.pdf)
    done = subprocess.run(
        ["pdftotext", "-layout", str(path), "-"], capture_output=True, text=True, check=True
    )
    pages = done.stdout.rstrip("\f").split("\f")
    assert 7 <= len(pages) <= 12
    assert "Session s01" in pages[0]
    assert "nothing is missing" in pages[0]
    assert "Provenance" in "".join(pages[-2:])
    assert "4.17 ± 0.13" in pages[0]
    assert "3.526 to 3.578" in done.stdout
    assert all(len(page.split()) > 40 for page in pages)


def test_what_was_not_done_is_said_with_its_command(tmp_path: Path) -> None:
    synthetic_run.write_ingest(tmp_path / "s02")
    bare = build_run_report(Results(tmp_path / "s02"), quiet)
    words = text_of(bare.html)
    for command in ("filter", "stiffness", "identify", "validate", "diagnose"):
        assert f"bampipe {command} s02" in words
    assert "Model versions" not in bare.sections
    assert bare.figures == {}
    assert bare.pdf.startswith(b"%PDF")


def test_validated_above_the_floor_asks_for_a_diagnosis(tmp_path: Path) -> None:
    root = tmp_path / "s03"
    synthetic_run.write_ingest(root)
    synthetic_run.write_model(root, "base")
    synthetic_run.write_validation(root, "base")
    words = text_of(page_of(root))
    assert "leaves something unexplained on yaw" in words
    assert "2.76 × the noise floor" in words
    assert "bampipe diagnose s03" in words


def test_one_model_in_detail_can_be_chosen(full_run: Path) -> None:
    results = Results(full_run, "base")
    assert results.model == "base" and results.effects("base") == ()


def test_missing_and_damaged_results_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"is missing.*bampipe ingest"):
        build_run_report(Results(tmp_path), quiet)
    synthetic_run.write_ingest(tmp_path)
    (tmp_path / "stiffness").mkdir()
    (tmp_path / "stiffness/stiffness.json").write_text("{")
    with pytest.raises(InputError, match=r"stiffness\.json"):
        build_run_report(Results(tmp_path), quiet)
    (tmp_path / "stiffness/stiffness.json").unlink()
    (tmp_path / "ingest/trials.parquet").write_bytes(b"PAR1")
    with pytest.raises(InputError, match=r"trials\.parquet"):
        build_run_report(Results(tmp_path), quiet)


def test_bad_source_date_epoch_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synthetic_run.write_ingest(tmp_path)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "yesterday")
    with pytest.raises(InputError, match=r"SOURCE_DATE_EPOCH"):
        build_run_report(Results(tmp_path), quiet)


def test_green_means_that_no_check_failed(own_run: Path) -> None:
    path = own_run / f"models/{synthetic_run.CHILD}/validate.json"
    content = json.loads(path.read_text())
    assert "callout good" in page_of(own_run)
    content["failed_checks"] = ["yaw, innovations: Not white: 60 % of their variance is left."]
    path.write_text(json.dumps(content))
    page = page_of(own_run)
    start = text_of(page)[:1500]
    assert "nothing is missing, but 1 check failed" in start
    assert "Yaw, innovations: Not white: 60 % of their variance is left." in start
    assert "callout good" not in page


def test_a_draft_is_shown_with_its_curve_its_length_and_its_chance(
    own_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(typeset, "render_pdf", lambda *_: b"")
    name, formula = "bump_by_position:yaw", "height*exp(-((q - place)/width)**2)"
    curve = {
        "variable": "position", "variable_unit": "rad", "at": [-0.1, 0.0, 0.1],
        "mean": [0.0, -1.5, 0.0], "low": [-0.1, -1.6, -0.1], "high": [0.1, -1.4, 0.1],
        "beside": {"extension position": 1.3},
    }  # fmt: skip
    axis = {
        "effects": [name], "chance": [{"gain": 900.0, "gains": [4.0, 6.0, 5.0, 7.0]}],
        "options": [{"held_out_rmse": 0.5}, {"constants": 3, "held_out_rmse": 0.02}],
        "rmse_after": 0.02, "noise_floor": 0.019,
        "nearest": [{"effect": "upper_stop:yaw", "held_out_rmse": 0.48}],
        "sentence": "Yaw: a force on the axis that has a bump at one position.",
    }  # fmt: skip
    effect = {"axis": "yaw", "expression": formula, "acts_as": "force", "curve": curve}
    drafted = {"axes": {"yaw": axis}, "effects": {name: effect}, "selected": [name]}
    write_result(own_run, DraftResult, **drafted)
    report = build_run_report(Results(own_run), quiet)
    assert "Drafts" in report.sections
    words = text_of(report.html)
    assert "Yaw: a force on the axis that has a bump at one position." in words
    assert formula in words
    assert "is drawn, at extension position 1.3." in words
    assert row_of(report.html, "the draft")[1] == "0.0200"
    assert row_of(report.html, "upper_stop:yaw")[1] == "0.480"
    drawn = report.figures["draft-base-yaw"]
    for label in ("constants", "first formula", "draft"):
        assert label in drawn


def test_a_model_that_is_not_there_changes_nothing(own_run: Path, command: Command) -> None:
    before = (own_run / "run.json").read_bytes()
    code, _, err = command("report", own_run, "--model", "bse")
    assert code == 2 and "no results for model 'bse'" in err and "base" in err
    assert (own_run / "run.json").read_bytes() == before and not (own_run / "report").exists()


def test_long_names_break_and_no_figure_is_taller_than_a_page():
    assert style.break_heading("shoulder_pan_joint", 6) == "shoulder_\npan_joint"
    assert style.break_heading("shoulder_pan_joint", 3) == "shoulder_pan_joint"
    assert break_lines("two words, joint_1", 9) == "two\nwords,\njoint_1"
    assert style.label_axis("wrist_1_joint, torque", "N·m", 20) == "wrist_1_joint,\ntorque (N·m)"
    figure, _ = style.make_panels(10, 2, 14.0)
    assert figure.get_figheight() == style.TALLEST
