"""The page for exploring: what is packed into it, and what a browser makes of it."""

import base64
import csv
import io
import os
import shutil
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
import synthetic_run
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bampipe.data.store import write_parquet
from bampipe.errors import InputError
from bampipe.files import read_json, toml_text, write_json, write_text
from bampipe.report.explorer.packing import Packer
from bampipe.report.explorer.page import explorer_page
from bampipe.report.run_results import Results
from bampipe.stages.report import write_page_of_two

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def unfold(packer: Packer, block: int, width: int) -> np.ndarray:
    """Undo what packing did to one block, by its description alone."""
    raw = zlib.decompress(base64.b64decode(packer.blocks[block]))
    planes = np.frombuffer(raw, np.uint8).reshape(width, -1).astype(np.int64)
    folded = sum(plane << (8 * place) for place, plane in enumerate(planes))
    return np.where(folded % 2, -(folded + 1) // 2, folded // 2)


def unpack(packer: Packer, column: dict[str, float]) -> np.ndarray:
    codes = unfold(packer, column["block"], 2)
    for _ in range(column["order"]):
        codes = np.cumsum(codes)
    codes %= 2**16
    return np.where(codes == 65535, np.nan, column["low"] + column["step"] * codes)


@given(st.lists(st.floats(-1e9, 1e9, width=32) | st.just(np.nan), max_size=200), st.integers(0, 3))
def test_a_column_comes_back_within_half_a_step(values: list[float], smooth: int) -> None:
    column = np.array(values, dtype=float)
    for _ in range(smooth):
        column = np.cumsum(np.nan_to_num(column)) / 10.0
    packer = Packer()
    packed = packer.pack(column)
    back = unpack(packer, packed)
    assert np.array_equal(np.isnan(back), np.isnan(column))
    span = np.ptp(column[np.isfinite(column)]) if np.isfinite(column).any() else 0.0
    assert np.nanmax(np.abs(back - column), initial=0.0) <= span / 65534 / 2 * 1.001 + 1e-30


def test_times_keep_microseconds_over_gaps_and_hours() -> None:
    times = np.concatenate([np.arange(5000) / 997.0, 600.0 + np.arange(5000) / 311.0, [8000.5]])
    packer = Packer()
    back = np.cumsum(np.cumsum(unfold(packer, packer.pack_times(times), 8)))
    assert np.abs(1e-6 * back - times).max() <= 0.5e-6 + 1e-9


def test_equal_columns_are_packed_once() -> None:
    packer = Packer()
    first, second = packer.pack(np.arange(9.0)), packer.pack(5.0 + 2.0 * np.arange(9.0))
    assert first["block"] == second["block"] and first["low"] != second["low"]
    assert len(packer.blocks) == 1


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic_run.write_all(tmp_path_factory.mktemp("runs") / "s01")


@pytest.fixture
def own_run(run: Path, tmp_path: Path) -> Path:
    """A copy of the run that a test may change."""
    return Path(shutil.copytree(run, tmp_path / "s02"))


def write_page(root: Path) -> Path:
    path = root.parent / "explore.html"
    path.write_text(explorer_page(Results(root), "device bam"), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def page_file(run: Path) -> Path:
    return write_page(run)


def test_the_page_names_no_address_but_the_report(page_file: Path) -> None:
    text = page_file.read_text()
    assert 'href="report.html"' in text
    assert "default-src 'none'" in text
    assert "src=" not in text
    assert "Copyright (c) 2022 Leon Sorokin" in text


def test_text_from_files_cannot_break_the_page(own_run: Path) -> None:
    frame = pd.read_parquet(own_run / "ingest/trials.parquet")
    frame["kind"] = "</script><script>alert(1)</script>"
    write_parquet(own_run / "ingest/trials.parquet", frame)
    assert "<script>alert" not in explorer_page(Results(own_run), "")


def test_a_session_that_was_only_read_has_a_page(tmp_path: Path) -> None:
    synthetic_run.write_ingest(tmp_path)
    assert "position yaw" in explorer_page(Results(tmp_path), "")


def test_the_command_opens_the_page(tmp_path: Path) -> None:
    synthetic_run.write_ingest(tmp_path / "s03")
    (tmp_path / "s03/run.json").write_text('{"schema": "bampipe.run/1", "stages": {}}')
    browser = tmp_path / "browser"
    browser.write_text(f'#!/bin/sh\nprintf %s "$1" > {tmp_path}/opened\n')
    browser.chmod(0o755)
    command = [sys.executable, "-m", "bampipe", "report", str(tmp_path / "s03"), "--open"]
    for program, code in ((str(browser), 0), ("/bin/false", 2)):
        environment = {**os.environ, "BROWSER": program, "PATH": "", "DISPLAY": ""}
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert done.returncode == code, done.stderr
    assert "no browser could be started" in done.stderr
    page = tmp_path / "s03/report/explore.html"
    assert (tmp_path / "opened").read_text() == page.as_uri()


# In a browser.

Opened = Callable[..., Any]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.skip("no browser: install Chromium to test the page for exploring")
    with api.sync_playwright() as driver:
        running = driver.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield running
        running.close()


@pytest.fixture
def opened(browser: Any) -> Iterator[Opened]:
    """Open a page; afterwards it must have complained of nothing and asked for nothing."""
    complaints: list[str] = []
    contexts = []

    def open_page(path: Path, width: int = 1280, scheme: str = "light") -> Any:
        context = browser.new_context(
            viewport={"width": width, "height": 900}, color_scheme=scheme, accept_downloads=True
        )
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))

        def requested(request: Any) -> None:
            if request.url != path.as_uri() and not request.url.startswith("blob:"):
                complaints.append(f"asked for {request.url}")

        page.on("request", requested)
        page.goto(path.as_uri())
        page.wait_for_selector("html[data-complete]")
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert complaints == []


@pytest.fixture
def page(opened: Opened, page_file: Path) -> Any:
    """The page of the run, opened."""
    return opened(page_file)


def figure(page: Any, title: str) -> Any:
    return page.locator("figure.plot").filter(has_text=title).first


def saved(page: Any, title: str, kind: str) -> str:
    with page.expect_download() as download:
        page.get_by_role("button", name=f"{title}: {kind}", exact=True).click()
    return Path(download.value.path()).read_text(encoding="utf-8")


def csv_of(page: Any, title: str) -> pd.DataFrame:
    return pd.read_csv(io.StringIO(saved(page, title, "CSV")))


def drag(page: Any, title: str, start: tuple[float, float], stop: tuple[float, float]) -> None:
    """Drag from one place to another of a figure's plotting area, given in shares of it."""
    area = figure(page, title).locator(".u-over")
    area.scroll_into_view_if_needed()
    box = area.bounding_box()
    places = [(box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in (start, stop)]
    page.mouse.move(*places[0])
    page.mouse.down()
    page.mouse.move(*places[1], steps=5)
    page.mouse.up()


def test_traces_hold_every_sample_of_every_trial(page: Any, run: Path) -> None:
    shown = csv_of(page, "torque yaw")
    stored = pd.read_parquet(run / "models/base/residuals.parquet")
    assert shown["trial"].tolist() == stored["trial_id"].tolist()
    assert shown["t (s)"].to_numpy() == pytest.approx(stored["t"].to_numpy(), abs=1e-6)
    for column, name in (("measured", "torque_measured_yaw"), ("base", "torque_predicted_yaw")):
        values = stored[name].to_numpy()
        step = np.ptp(values) / 65534
        assert shown[f"{column} (N·m)"].to_numpy() == pytest.approx(values, abs=0.51 * step + 1e-6)
    assert "version 1 (N·m)" in shown


def test_one_zoom_moves_all_traces_and_reset_shows_all(page: Any) -> None:
    everything = len(csv_of(page, "velocity yaw"))
    drag(page, "torque yaw", (0.1, 0.5), (0.2, 0.5))
    parts = [csv_of(page, title) for title in ("torque yaw", "residual yaw", "velocity yaw")]
    spans = [(*part["trial"].unique(), part["t (s)"].min(), part["t (s)"].max()) for part in parts]
    assert spans[0] == spans[1] == spans[2]
    assert 0 < len(parts[2]) < 0.15 * everything
    page.get_by_role("button", name="Show all").click()
    assert len(csv_of(page, "velocity yaw")) == everything


def test_versions_are_shown_and_hidden(page: Any, run: Path) -> None:
    counts = page.locator(".counts").inner_text()
    assert counts.startswith("base is") == (Results(run).model == "base")
    assert "base" in figure(page, "residual yaw").locator(".key").inner_text()
    page.get_by_label("base", exact=True).uncheck()
    assert "base" not in figure(page, "residual yaw").locator(".key").inner_text()
    assert "base (N·m)" not in csv_of(page, "torque yaw")


def test_a_region_of_a_map_marks_its_samples_and_a_view_shows_in_maps(page: Any, run: Path) -> None:
    drag(page, "residual yaw by velocity", (0.6, 0.05), (0.8, 0.95))
    words = page.locator("#marked").inner_text()
    count = int(words.split()[0])
    marked = csv_of(page, "residual yaw by velocity")
    stored = pd.read_parquet(run / "models/base/map_variables.parquet")["yaw.velocity"]
    assert marked["velocity"].to_numpy() == pytest.approx(stored.to_numpy(), abs=1e-3)
    chosen = marked[marked["marked"] == 1]
    assert len(chosen) == count > 20
    between = marked["velocity"].between(chosen["velocity"].min(), chosen["velocity"].max())
    tall, within = marked["residual version 1"], chosen["residual version 1"]
    assert (between & tall.between(within.min(), within.max())).sum() == count
    before = figure(page, "residual yaw ").first.locator("canvas").screenshot()
    page.get_by_role("button", name="Remove the mark").click()
    assert not page.locator("#marked").is_visible()
    assert figure(page, "residual yaw ").first.locator("canvas").screenshot() != before
    canvas = figure(page, "residual yaw by velocity").locator("canvas")
    everything = canvas.screenshot()
    drag(page, "torque yaw", (0.1, 0.5), (0.2, 0.5))
    page.wait_for_timeout(400)
    assert canvas.screenshot() != everything


def test_a_strip_of_a_map_is_marked_by_keyboard(page: Any) -> None:
    canvas = figure(page, "residual yaw by velocity").locator(".canvas")

    def marked_velocities() -> pd.Series:
        found = csv_of(page, "residual yaw by velocity")
        return found["velocity"][found["marked"] == 1]

    for _ in range(5):
        canvas.press("ArrowRight")
    near = marked_velocities()
    canvas.press("ArrowRight")
    far = marked_velocities()
    assert len(near) > 5 and far.mean() > near.mean()
    canvas.press("Shift+ArrowRight")
    wide = marked_velocities()
    assert len(wide) > len(far) and np.ptp(wide) > np.ptp(far)
    canvas.press("Escape")
    assert not page.locator("#marked").is_visible()


def test_a_worst_window_is_one_choice_away(page: Any) -> None:
    page.get_by_role("button", name="Next worst window").click()
    part = csv_of(page, "torque yaw")
    assert part["trial"].unique().tolist() == [synthetic_run.FREE[1]]
    assert part["t (s)"].min() < 3.2 and part["t (s)"].max() > 3.7
    assert np.ptp(part["t (s)"]) < 3.0


def test_keys_move_view_and_cursor_and_the_reading_is_said(page: Any) -> None:
    canvas = page.locator(".canvas").first
    canvas.press("PageDown")
    assert csv_of(page, "torque yaw")["trial"].unique().tolist() == [synthetic_run.FREE[0]]
    canvas.press("ArrowRight")
    said = page.locator("#reading").inner_text()
    assert said.startswith(f"{synthetic_run.FREE[0]}, 8.")
    assert "torque yaw: measured" in said and "version 1" in said
    canvas.press("+")
    canvas.press("+")
    assert np.ptp(csv_of(page, "torque yaw")["t (s)"]) < 4.1


def test_another_axis_brings_its_traces_and_maps(page: Any) -> None:
    page.get_by_label("pitch", exact=True).check()
    page.wait_for_selector("text=residual pitch by velocity")
    assert figure(page, "torque pitch").count() == 1
    assert figure(page, "torque yaw").count() == 0
    assert figure(page, "velocity pitch").count() == 1
    assert figure(page, "velocity yaw").count() == 0


def test_tables_sort_and_search(page: Any) -> None:
    table = page.get_by_role("region", name="Candidate effects, base")
    table.get_by_role("button", name="With", exact=True).click()
    table.get_by_role("button", name="With", exact=True).click()
    assert table.locator("tbody tr td").first.inner_text() == "asymmetric_coulomb:yaw"
    trials = page.get_by_label("Search in Pairs of estimates, version 1")
    trials.fill("stribeck mass")
    rows = page.get_by_role("region", name="Pairs of estimates, version 1").locator("tbody tr")
    visible = [row for row in rows.all() if row.is_visible()]
    assert 0 < len(visible) < rows.count()
    assert all("stribeck" in row.inner_text() and "mass" in row.inner_text() for row in visible)


def test_every_figure_is_saved_as_svg_and_csv(page: Any) -> None:
    names = [
        button.get_attribute("aria-label").removesuffix(": SVG")
        for button in page.locator('button[aria-label$=": SVG"]').all()
    ]
    assert len(names) >= 10
    for name in names:
        page.wait_for_timeout(250)  # a browser saves ten files a second at most
        drawing = ElementTree.fromstring(saved(page, name, "SVG"))
        assert len(list(drawing.iter("{http://www.w3.org/2000/svg}path"))) > 3, name
        rows = list(csv.reader(io.StringIO(saved(page, name, "CSV"))))
        assert len(rows) > 1 and len({len(row) for row in rows}) == 1, name


@pytest.mark.parametrize("width", [390, 2560])
def test_the_page_fits_the_window_in_either_scheme(
    opened: Opened, page_file: Path, width: int
) -> None:
    papers = set()
    for scheme in ("light", "dark"):
        page = opened(page_file, width, scheme)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        papers.add(page.evaluate("getComputedStyle(document.body).backgroundColor"))
    assert len(papers) == 2


def test_the_spectrum_shows_the_wave_of_the_residual(page: Any) -> None:
    found = csv_of(page, "power spectrum yaw")
    peak = found.loc[found["residual, version 1"].idxmax(), "frequency (Hz)"]
    assert peak == pytest.approx(7.0 / (2.0 * np.pi), abs=0.13)
    lags = csv_of(page, "autocorrelation of the residual yaw")
    half = lags.loc[(lags["lag (s)"] - np.pi / 7.0).abs().idxmin(), "version 1"]
    assert half == pytest.approx(-1.0, abs=0.05)


@pytest.mark.parametrize("empty", [False, True])
def test_a_session_without_results_opens(opened: Opened, tmp_path: Path, empty: bool) -> None:
    root = tmp_path / "s04"
    synthetic_run.write_ingest(root)
    if empty:
        path = root / "ingest/samples.parquet"
        write_parquet(path, pd.read_parquet(path).iloc[:0])
    page = opened(write_page(root))
    assert (page.locator("#plots figure").count() == 0) == empty
    if empty:
        assert "No trial of this session could be used" in page.locator("#plots").inner_text()
        assert page.get_by_role("region", name="Trials").locator("tbody tr").count() == 5
    else:
        page.get_by_role("button", name="Zoom in").click()
        page.get_by_role("button", name="Trial after").click()


@pytest.mark.parametrize("diagnosed", [True, False])
def test_correlations_come_with_the_variables_of_a_diagnosis(
    opened: Opened, own_run: Path, diagnosed: bool
) -> None:
    if not diagnosed:
        for path in own_run.glob("models/*/*"):
            if path.name in ("diagnose.json", "map_variables.parquet"):
                path.unlink()
    page = opened(write_page(own_run))
    assert figure(page, "autocorrelation of the residual").count() == 1
    drawn = page.locator("figure.plot").filter(has_text="correlation with motion and load")
    assert drawn.count() == int(diagnosed)
    assert page.get_by_text("No diagnosis of").count() == int(not diagnosed)


def test_a_bar_opens_the_evidence_of_an_effect(page: Any, run: Path) -> None:
    found = read_json(run / "models/base/diagnose.json")
    share = found["axes"]["yaw"]["probabilities"]["stribeck:yaw"]
    verdict = page.locator(".verdict").filter(has_text="yaw, base")
    button = verdict.locator(".bar").filter(has_text="stribeck:yaw")
    assert button.locator(".share").inner_text() == f"{100 * share:.0f} %"
    width, whole = (one.bounding_box()["width"] for one in (button.locator(".fill"), button))
    assert width / whole == pytest.approx(share, abs=0.02)
    assert verdict.locator(".evidence").inner_text() == ""
    button.click()
    said = verdict.locator(".evidence").inner_text()
    (row,) = [one for one in found["ranking"] if one["effect"] == "stribeck:yaw"]
    for number in (row["held_out_rmse_before"], row["held_out_rmse_after"]):
        assert f"{number:.3g} N·m with" in said
    verdict.locator(".bar").filter(has_text="presliding:yaw").click()
    said = verdict.locator(".evidence").inner_text()
    text = found["descriptions"]["presliding"]
    assert text["looks_like"] in said and "presliding:yaw: 3 %" in said
    page.get_by_role("button", name="Residual maps of yaw").click()
    assert page.locator("text=residual yaw by velocity").first.is_visible()
    verdict.locator(".bar").filter(has_text="presliding:yaw").click()
    assert verdict.locator(".evidence").inner_text() == ""


# A joint that turns about y, one that slides along its x, one that follows the first.
JOINTS = {
    "yaw": {"kind": "revolute", "position": [0.0, 0.0, 0.4], "axis": [0.0, 1.0, 0.0]},
    "extension": {"kind": "prismatic", "after": "yaw", "rotation": [0.0, 0.3, 0.0],
                  "axis": [1, 0, 0], "position": [0.3, 0.0, 0.0], "center": [0.1, 0.0, 0.2]},
}  # fmt: skip


def test_the_pose_is_that_at_the_cursor(opened: Opened, own_run: Path) -> None:
    """Ends of links in the drawing against rotations by SciPy; axes as scales of other devices."""
    page = opened(write_page(own_run))
    assert page.locator("#pose circle.dial").count() == 2
    page.context.close()
    write_text(own_run / "ingest/device.toml", toml_text({"robot": {"joints": JOINTS}}))
    page = opened(write_page(own_run))
    samples = pd.read_parquet(own_run / "ingest/samples.parquet")
    trial = samples[samples["trial_id"] == synthetic_run.FREE[0]].reset_index(drop=True)
    drawn, canvas = [], page.locator(".canvas").first
    canvas.press("PageDown")
    for _ in range(4):
        for _ in range(12):
            canvas.press("ArrowRight")
        words = page.locator("#pose figcaption").inner_text()
        assert words.startswith(f"Pose in {synthetic_run.FREE[0]} at ")
        at = float(words.removesuffix(" s").rpartition(" ")[2])
        row = trial.iloc[(trial["t"] - at).abs().argmin()]
        turn = Rotation.from_euler("y", row["q_yaw"])
        inner = turn * Rotation.from_euler("y", 0.3)
        base = np.array([0.0, 0.0, 0.4])
        joint = base + turn.apply([0.3, 0.0, 0.0]) + inner.apply([row["q_extension"], 0.0, 0.0])
        end = joint + inner.apply([0.1, 0.0, 0.2])
        lines = page.locator("#pose polyline").all()
        ends = [lines[k].get_attribute("points").split() for k in (0, 1)]
        pixels = [ends[0][0], ends[0][1], ends[1][1], ends[1][2]]
        points = [[float(value) for value in one.split(",")] for one in pixels]
        # From the side: x to the right, z upwards, one scale; the base stands still.
        drawn.append((np.array(points), np.array([np.zeros(3), base, joint, end])[:, [0, 2]]))
    offsets = np.array([(pixel - pixel[0]) * [1.0, -1.0] for pixel, _ in drawn])
    truth = np.array([true for _, true in drawn])
    scale = float(np.sum(offsets * truth) / np.sum(truth**2))
    assert scale > 10.0
    np.testing.assert_allclose(offsets, scale * truth, atol=0.2)
    assert np.ptp([true[3, 0] for _, true in drawn]) > 5.0 / scale


def test_two_sessions_stand_on_one_page(opened: Opened, run: Path, tmp_path: Path) -> None:
    roots = [tmp_path / name for name in ("s07", "s08")]
    for root in roots:
        shutil.copytree(run, root)
        session = read_json(root / "ingest/session.json") | {"session_id": root.name}
        write_json(root / "ingest/session.json", session)
    found = read_json(roots[1] / "models/base/identify.json")
    found["parameters"]["mass"]["estimate"] = 123.0
    write_json(roots[1] / "models/base/identify.json", found)
    page = opened(write_page_of_two(*roots))
    assert page.locator("h1").inner_text() == "Sessions s07 and s08"
    assert page.locator(".callout .title").count() == 2
    shown = csv_of(page, "torque yaw")
    stored = pd.read_parquet(run / "models/base/residuals.parquet")
    names = [f"{root.name} {trial}" for root in roots for trial in stored["trial_id"]]
    assert shown["trial"].tolist() == names
    assert shown["t (s)"].to_numpy() == pytest.approx(np.tile(stored["t"], 2), abs=1e-6)
    # Each session is predicted by its own models.
    own = shown["trial"].str.startswith("s07")
    for name, rows in (("s07 base (N·m)", own), ("s08 base (N·m)", ~own)):
        assert shown[name][rows].notna().all() and shown[name][~rows].isna().all()
    assert shown["measured (N·m)"].notna().all()
    table = csv_of(page, "Parameter map").set_index("parameter")
    assert table.loc["mass", "s08 base"] == 123.0 != table.loc["mass", "s07 base"]
    session = read_json(roots[1] / "ingest/session.json") | {"device": "x"}
    write_json(roots[1] / "ingest/session.json", session)
    with pytest.raises(InputError, match="two runs of one device"):
        write_page_of_two(*roots)


@pytest.mark.long
def test_a_zoom_into_three_channels_of_a_million_samples_takes_a_moment(
    opened: Opened, tmp_path: Path
) -> None:
    """Less than 82 ms for the quickest of ten zooms, in a page below 5.3 MB."""
    root, count = tmp_path / "large", 10**6
    synthetic_run.write_ingest(root)
    t = np.arange(count) / 1000.0
    columns: dict[str, object] = {"trial_id": synthetic_run.FREE[0], "t": t}
    for number, axis in enumerate(synthetic_run.AXES):
        noise = 0.02 * np.random.default_rng(number).standard_normal(count)
        columns[f"q_{axis}"] = 10.0 * np.sin((1.3 + 0.6 * number) * t) + noise
    write_parquet(root / "ingest/samples.parquet", pd.DataFrame(columns))
    path = write_page(root)
    assert path.stat().st_size < 5.3e6
    page = opened(path)
    for key in "++++++----":
        page.locator(".canvas").first.press(key)
    measured = "performance.getEntriesByType('measure').map((one) => one.duration)"
    assert 0.0 < float(np.min(page.evaluate(measured))) < 82.0
