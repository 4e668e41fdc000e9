"""The bad-input corpus: every way we know in which a session comes damaged.

Each case damages a small sound session in one way and states what ingest must say: the whole
session is refused (one line, nothing written), one trial is set aside with a reason while the
others are kept, or the trial is repaired and the repair is said. The first two are tried as a user
meets them: exit code, one line, nothing left behind.
"""

import json
import re
import tomllib
from collections.abc import Callable
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Command
from made_session import COLUMNS, Made, free_trial, locked_trial, parquet

from bampipe.data.run_folder import RunFolder
from bampipe.data.store import read_parquet
from bampipe.errors import InputError
from bampipe.progress import silent
from bampipe.stages import ingest

T01 = "trials/t01.csv"
Damage = Callable[[Made], Callable[[Path], None] | None]


def make(damage: Damage, session: Path, made: Made | None = None) -> Path:
    """Write a damaged session."""
    made = made or Made()
    after = damage(made)
    made.write(session)
    if after is not None:
        after(session)
    return session


def run_ingest(made: Made, root: Path, damage: Damage = lambda made: None, **settings: object):
    """Ingest a damaged session; returns the trials table by id, and the output folder."""
    session, out = make(damage, root / "session", made), root / "out"
    out.mkdir()
    config = ingest.Config(session=str(session), **settings)
    ingest.execute(RunFolder(out), out, config, silent)
    return read_parquet(out / "ingest/trials.parquet").set_index("trial_id"), out


# What can be done to a session


def change(path: str, act: Callable[[Any, int | str], object]) -> Damage:
    """Do something to a field of session.toml, given its table and its key."""

    def damage(made):
        *parents, last = (int(part) if part.isdigit() else part for part in path.split("."))
        act(reduce(getitem, parents, made.session), last)

    return damage


def put(path: str, value: object) -> Damage:
    """Set a field of session.toml: ``"trials.0.kind"``."""
    return change(path, lambda table, key: table.__setitem__(key, value))


def drop(path: str) -> Damage:
    """Take a field of session.toml away."""
    return change(path, lambda table, key: table.pop(key))


def file(content: bytes | str, name: str = T01) -> Damage:
    """Put other content in the place of a file."""
    return lambda made: made.files.update({name: content})


def text(change: Callable[[str], str | bytes]) -> Damage:
    """Change the CSV text of the first trial."""
    return lambda made: made.files.update({T01: change(made.text())})


def line(number: int, change: Callable[[str], str]) -> Damage:
    """Change one line (counted from 1) of the first trial."""

    def changed(content):
        lines = content.split("\n")
        lines[number - 1] = change(lines[number - 1])
        return "\n".join(lines)

    return text(changed)


def cell(row: int, column: str, value: str) -> Damage:
    """Change one cell, by its row in the file (the header is row 1)."""

    def changed(content):
        cells = content.split(",")
        cells[COLUMNS.index(column)] = value
        return ",".join(cells)

    return line(row, changed)


def table(change: Callable[[dict[str, np.ndarray]], object], name: str = T01) -> Damage:
    """Change the raw columns of a trial in place, or give others."""

    def damage(made):
        changed = change(made.tables[name])
        if isinstance(changed, dict):
            made.tables[name] = changed

    return damage


def samples(column: str, where: object, value: object) -> Damage:
    return table(lambda t: t[column].__setitem__(where, value))


def both(*damages: Damage) -> Damage:
    def damage(made):
        for one in damages:
            one(made)

    return damage


def rows(which: Callable[[int], np.ndarray]) -> Damage:
    """Keep only some rows of the first trial, in this order."""
    return table(lambda t: {name: values[which(len(values))] for name, values in t.items()})


def as_file(ending: str, content: Callable[[dict[str, np.ndarray]], bytes]) -> Damage:
    """Give the first trial as a file of another kind."""

    def damage(made):
        made.session["trials"][0]["file"] = f"trials/t01{ending}"
        made.files[f"trials/t01{ending}"] = content(made.tables.pop(T01))

    return damage


def renamed(header: str) -> Damage:
    return line(1, lambda _: header)


def swapped(first: str, second: str) -> Damage:
    return renamed(",".join({first: second, second: first}.get(name, name) for name in COLUMNS))


def in_its_place(make: Callable[[Path], object]) -> Callable[[Path], None]:
    """Put something else in the place of the first trial file."""

    def after(root):
        (root / T01).unlink()
        make(root / T01)

    return after


def link_out(root: Path) -> None:
    outside = root.parent / "secret.csv"
    outside.write_text((root / T01).read_text())
    (root / T01).unlink()
    (root / T01).symlink_to(outside)


def link_folder_out(root: Path) -> None:
    (root / "trials").rename(root.parent / "elsewhere")
    (root / "trials").symlink_to(root.parent / "elsewhere")


WITHOUT_PITCH = both(
    drop("encoders.pitch"),
    put("brakes.columns", ["brake_yaw", "brake_extension"]),
    put("brakes.unit", "N.m, N"),
)
VISCOUS = both(put("trials.0.kind", "viscous"), put("trials.0.viscous_n_s_per_m", 40))
FIELDS = tomllib.loads(Path(__file__).with_name("refused_fields.toml").read_text())
# name: (damage, what the one line must say)
REFUSED: dict[str, tuple[Damage, str]] = {
    **{name: (put(it["field"], it["value"]), it["said"]) for name, it in FIELDS.items()},
    "no session file": (
        lambda made: lambda root: (root / "session.toml").unlink(),
        "no session.toml",
    ),
    "device file is broken": (
        both(put("device", "my.toml"), file("nonsense", "my.toml")),
        "my.toml, line 1: not TOML",
    ),
    "axis missing": (WITHOUT_PITCH, "no encoder for axis 'pitch'"),
    "calibration missing": (drop("force.calibration_n_per_v"), "'calibration_n_per_v' is missing"),
    "an input of the device missing": (drop("force"), "no channel for input 'force_x'"),
    "trial folder linked out of the session": (
        lambda made: link_folder_out,
        "none of the 3 trials .* outside the session folder",
    ),
    "no trial is sound": (
        lambda made: made.files.update(dict.fromkeys(made.tables, "")),
        "none of the 3 trials is sound; trials/t01.csv",
    ),
}

# name: (damage of the first trial, what its reason must say)
ASIDE: dict[str, tuple[Damage, str]] = {
    "empty file": (file(""), r"^trials/t01.csv: the file is empty$"),
    "blank lines only": (file("\n  \n\n"), "the file holds no text"),
    "header only": (text(lambda s: s.split("\n")[0] + "\n"), "a header but no samples"),
    "binary garbage": (file(np.random.default_rng(0).bytes(5000)), "binary data, not text"),
    "garbage in the middle": (
        text(lambda s: s[:70000].encode() + b"\xff\xfe\x00\x01" * 20 + s[70000:].encode()),
        "row ",
    ),
    "UTF-16, cut in a character": (text(lambda s: s.encode("utf-16")[:-1]), "not sound UTF-16"),
    "quoted decimal commas": (
        cell(700, "force_x_v", '"0,5"'),
        "row 700, column 'force_x_v': found '0,5', expected a number; .*decimal sign",
    ),
    "column missing": (renamed(",".join(COLUMNS).replace("enc_yaw", "x")), "no column 'enc_yaw'"),
    "column twice": (
        renamed(",".join(COLUMNS).replace("enc_pitch", "enc_yaw")),
        r"row 1: no column 'enc_yaw', did you mean 'enc_yaw \(2\)'\?",
    ),
    "encoder and force swapped": (swapped("enc_yaw", "force_x_v"), "columns swapped"),
    "time and encoder swapped": (swapped("time_us", "enc_yaw"), "column 'time_us'"),
    "text in a cell": (
        cell(30, "enc_pitch", "x1"),
        r"^trials/t01.csv, row 30, column 'enc_pitch': found 'x1', expected a number; "
        r'if that means no reading, say missing = \["x1"\] under \[csv\]$',
    ),
    "two lines in one": (
        text(lambda s: "\n".join(s.split("\n")[:400]) + "".join(s.split("\n")[400:])),
        r"row 400: \d+ cells|far too long",
    ),
    "quotation mark left open": (cell(50, "time_us", '"98000'), "row "),
    "a spreadsheet": (
        lambda made: (
            put("trials.0.file", "trials/t01.xlsx")(made)
            or file(b"PK\x03\x04" + bytes(99), "trials/t01.xlsx")(made)
        ),
        "not a sound workbook of Excel; save it again, or export the sheet as CSV",
    ),
    "file missing": (lambda made: lambda root: (root / T01).unlink(), "no such file 'trials/t01"),
    "a folder in its place": (
        lambda made: in_its_place(lambda path: path.mkdir()),
        "'trials/t01.csv' is not a file",
    ),
    "a link out of the session": (lambda made: link_out, "outside the session folder"),
    "a link to itself": (
        lambda made: in_its_place(lambda path: path.symlink_to(path)),
        "cannot be used|no such file",
    ),
    "time missing": (samples("time_us", slice(100, 200), np.nan), "100 time stamps are missing"),
    "time stands still": (samples("time_us", slice(None), 5.0), "time stands still"),
    "time backwards": (rows(lambda n: np.arange(n)[::-1]), "time runs backwards throughout"),
    "two recordings in one file": (
        rows(lambda n: np.r_[0:n, 0:n]),
        "row 1002: time starts again: 2 recordings in one file; give each a",
    ),
    "many repeated stamps": (
        table(lambda t: t["time_us"].__setitem__(slice(200, 300), t["time_us"][200])),
        "99 of 1000 time stamps are repeated",
    ),
    "unit of time out of all proportion": (
        table(lambda t: t["time_us"].__imul__(40)),
        "does not fit sample_rate_hz = 500",
    ),
    "a long gap in the middle": (
        table(lambda t: t["time_us"].__setitem__(slice(500, None), t["time_us"][500:] + 1e6)),
        "1 gap of up to 1 s in the time stamps, and the longest stretch .* holds 50%",
    ),
    "counter reset": (
        table(lambda t: t["enc_yaw"].__setitem__(slice(500, None), t["enc_yaw"][500:] - 20_000)),
        "column 'enc_yaw': jumps by 0.9.* rad .*counter was reset",
    ),
    "fractional counts": (cell(9, "enc_yaw", "100.5"), "'enc_yaw': found 100.5, expected whole"),
    "a column of NaN": (samples("enc_pitch", slice(None), np.nan), "holds no number at all"),
    "force frozen": (samples("force_z_v", slice(200, 800), 0.25), "reads 0.25 without a change"),
    "force out of this world": (samples("force_z_v", 300, 1e9), "which no such machine does"),
    "encoder stuck": (samples("enc_pitch", slice(None), 77.0), "never changes while other axes"),
    "free trial that never moves": (
        table(lambda t: [t[f"enc_{a}"].fill(500.0) for a in ("yaw", "pitch", "extension")]),
        "declared free, but never moves",
    ),
    "free trial with brakes": (
        samples("brake_pitch", slice(None), 50.0),
        "declared free, but .* commanded up to 50 N.m",
    ),
    "viscous trial without brakes": (
        VISCOUS,
        "declared viscous, but no brake is ever commanded",
    ),
    "viscous trial whose brakes were not recorded": (
        both(VISCOUS, drop("brakes")),
        "declared viscous, but no brake command is recorded",
    ),
    "locked trial that moves": (
        both(
            put("trials.0.kind", "locked"),
            put("trials.0.locked_axis", "extension"),
            table(lambda t: free_trial(5) | {"brake_extension": np.full(1000, 200.0)}),
        ),
        "extension is declared locked, but moves by 0.4.* m",
    ),
    "locked on the wrong axis": (
        both(
            put("trials.0.kind", "locked"),
            put("trials.0.locked_axis", "yaw"),
            table(lambda t: locked_trial("pitch", seed=3)),
        ),
        "locked yaw deflects by 0 encoder steps only",
    ),
    "Parquet with text": (
        as_file(".parquet", lambda t: parquet({**t, "enc_yaw": t["enc_yaw"].astype(str)})),
        "column 'enc_yaw': not numbers, but dates and times or text; is it the time",
    ),
}

# name: (damage of the first trial, what must be said of it)
REPAIRED: dict[str, tuple[Damage, str]] = {
    "time in seconds": (
        text(lambda s: re.sub(r"(?m)^(\d+),", lambda m: f"{int(m[1]) * 1e-6:.3f},", s)),
        "time stamps are in s, not us, by the nominal rate: converted",
    ),
    "a clock set back": (
        table(lambda t: t["time_us"].__setitem__(slice(500, None), t["time_us"][500:] - 3e5)),
        "the clock is set back by 0.3 s at row 502: bridged",
    ),
    "two queues, one late": (
        rows(
            lambda n: np.r_[
                0:200, np.ravel(np.column_stack([np.r_[250:300], np.r_[200:250]])), 300:n
            ]
        ),
        "100 rows written out of order sorted by time",
    ),
    "a few repeated stamps": (
        samples("time_us", [100, 200], [198_000, 398_000]),
        "2 rows with a repeated time stamp dropped",
    ),
    "a stamp that leaps ahead": (samples("time_us", 100, 1e9), "1 row with a wild stamp dropped"),
    "a stamp missing": (cell(60, "time_us", ""), "1 row without a time stamp dropped"),
    "a gap near the end": (
        table(lambda t: t["time_us"].__setitem__(slice(800, None), t["time_us"][800:] + 1e6)),
        "1 gap of up to 1 s in the time stamps: rows 2 to 801 kept, 200 rows dropped",
    ),
    "a wild encoder reading": (
        table(lambda t: np.add.at(t["enc_yaw"], 400, 40_000)),
        "column 'enc_yaw': 1 wild reading taken out.*1 missing sample interpolated",
    ),
    "first reading is zero": (samples("enc_yaw", 0, -90_000.0), "1 wild reading taken out"),
    "a few NaN": (
        samples("force_x_v", [50, 51, 700], np.nan),
        "column 'force_x_v': 3 missing samples interpolated",
    ),
}

# name: (damage of the first trial, what is noted; "" for nothing): sound all the same
SOUND: dict[str, tuple[Damage, str]] = {
    "nothing": (lambda made: None, ""),
    "blanks after commas": (text(lambda s: s.replace(",", ", ")), ""),
    "quoted names": (renamed(",".join(f'"{name}"' for name in COLUMNS)), ""),
    "samples lost here and there": (
        rows(lambda n: np.delete(np.arange(n), [100, 300, 301])),
        "2 small gaps in the time stamps, about 3 samples missing",
    ),
    "jitter": (
        table(
            lambda t: t["time_us"].__iadd__(
                np.rint(np.random.default_rng(0).uniform(-500, 500, len(t["time_us"])))
            )
        ),
        "time stamps jitter by 0.4.* ms",
    ),
    "another rate than announced": (
        table(lambda t: t["time_us"].__imul__(2)),
        "sampled at 250 Hz, announced 500 Hz",
    ),
    "negative counts per unit": (put("encoders.yaw.counts_per_unit", -21333.3333), ""),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_session_is_refused_by_a_line_a_fault(
    name: str, tmp_path: Path, command: Command
) -> None:
    damage, message = REFUSED[name]
    session = make(damage, tmp_path / "session")
    code, out, err = command("ingest", session, "--runs", tmp_path / "runs")
    assert (code, out) == (2, "")
    lines = [line for line in err.splitlines() if line.startswith("bampipe: error: ")]
    assert lines and err.endswith("\n".join(lines) + "\n") and "Traceback" not in err, err
    assert all(str(session) in line for line in lines), "a line a fault"
    assert re.search(message, err)
    assert not list((tmp_path / "runs").glob("*")), "a refused session leaves no run folder"


@pytest.mark.parametrize("name", ASIDE)
def test_a_trial_is_set_aside_in_one_line(name: str, tmp_path: Path, command: Command) -> None:
    damage, message = ASIDE[name]
    session = make(damage, tmp_path / "session")
    code, out, err = command("ingest", session, "--runs", tmp_path / "runs", "--quiet")
    assert (code, err) == (0, "")
    assert "3 trials: 2 sound, 1 set aside" in out
    (line,) = [line for line in out.splitlines() if line.startswith("set aside: ")]
    assert line.startswith("set aside: t01: trials/t01.")
    assert re.search(message, line.removeprefix("set aside: t01: ")), line
    (samples,) = (tmp_path / "runs").glob("*/ingest/samples.parquet")
    assert set(read_parquet(samples).trial_id) == {"t02", "t03"}


def test_a_repair_is_said_in_one_line(tmp_path: Path, command: Command) -> None:
    damage, message = REPAIRED["a few NaN"]
    session = make(damage, tmp_path / "session")
    code, out, err = command("ingest", session, "--runs", tmp_path / "runs", "--quiet")
    assert (code, err) == (0, "")
    (line,) = [line for line in out.splitlines() if line.startswith("note: t01: ")]
    assert re.search(message, line), line


def test_a_byte_order_mark_hides_no_change(tmp_path: Path, command: Command) -> None:
    """A session file saved by an editor that puts a mark first: its trials are watched too."""
    session = make(lambda made: None, tmp_path / "session")
    path = session / "session.toml"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    arguments = ("ingest", session, "--runs", tmp_path / "runs", "--json", "--quiet")
    assert json.loads(command(*arguments)[1])["set_aside"] == []
    (session / T01).write_text("")
    assert [row["trial_id"] for row in json.loads(command(*arguments)[1])["set_aside"]] == ["t01"]


def test_all_that_is_wrong_is_said_at_once_and_each_reason_once(tmp_path):
    for_its_device = both(WITHOUT_PITCH, put("force.components", ["x", "y", "q"]))

    def every_trial(made):
        made.files.update({"trials/t01.csv": "", "trials/t02.parquet": b"\xfe\xff"})
        put("trials.2.file", "trials/t99.csv")(made)

    none_sound = "none of the 3 trials is sound; trials/t01.csv: the file is empty"
    for damage, count, first, last in (
        (for_its_device, 2, "no encoder for axis 'pitch'", "no channel for input 'force_z'"),
        (every_trial, 3, none_sound, "trials/t99.csv: no such file"),
    ):
        with pytest.raises(InputError) as caught:
            run_ingest(Made(), tmp_path / str(count), damage)
        said = caught.value.lines()
        assert len(said) == count and first in said[0] and last in said[-1]


@pytest.mark.parametrize("name", REPAIRED)
def test_trial_repaired_and_said(name, tmp_path):
    damage, message = REPAIRED[name]
    trials, out = run_ingest(Made(), tmp_path, damage)
    assert trials.status.tolist() == ["repaired", "ok", "ok"], trials.T
    assert re.search(message, trials.repairs["t01"]), trials.repairs["t01"]
    check_samples(out, "t01")


@pytest.mark.parametrize("name", SOUND)
def test_sound_trial_is_left_alone(name, tmp_path):
    damage, message = SOUND[name]
    trials, out = run_ingest(Made(), tmp_path, damage)
    assert trials.status.tolist() == ["ok", "ok", "ok"], trials.T
    assert re.fullmatch(f"{message}.*" if message else "", trials.repairs["t01"])
    check_samples(out, "t01")


def check_samples(out: Path, trial: str) -> None:
    """The repaired trial follows the undamaged motion, in SI units."""
    frame = read_parquet(out / "ingest/samples.parquet", trial=trial)
    values = frame.drop(columns="trial_id").to_numpy()
    assert np.isfinite(values).all()
    assert (np.diff(frame.t) > 0).all() and frame.t[0] == 0
    assert 0.9 <= np.ptp(frame.q_yaw) <= 1.01 or len(frame) < 990
    assert np.abs(np.diff(frame.q_yaw)).max() < 0.05


@pytest.mark.parametrize(
    ("name", "what"), [("./trials/t01.csv", "file"), ("trials/copy.csv", "content")]
)
def test_the_same_file_or_a_copy_of_it_is_used_once(tmp_path, name, what):
    made = Made()
    made.session["trials"].append({"file": name, "kind": "free"})
    made.files["trials/copy.csv"] = made.text()
    trials, _ = run_ingest(made, tmp_path)
    assert trials.status.tolist() == ["ok", "ok", "ok", "set_aside"]
    reason = f"{name.removeprefix('./')}: the same {what} as trial t01: used once"
    assert trials.reason.iloc[3] == reason


def test_one_file_declared_as_two_kinds_is_not_used(tmp_path):
    made = Made()
    made.session["trials"].append({"file": T01, "kind": "locked", "locked_axis": "yaw"})
    trials, _ = run_ingest(made, tmp_path)
    assert trials.status.tolist() == ["set_aside", "ok", "ok", "set_aside"]
    assert "which is declared locked" in trials.reason["t01"]


def test_a_trial_over_the_memory_allowed(tmp_path):
    made = Made()
    made.tables[T01] = free_trial(1, seconds=40.0)
    trials, _ = run_ingest(made, tmp_path, largest_trial_mb=1)
    assert trials.status.tolist() == ["set_aside", "ok", "ok"]
    assert "columns are more than the 1 MB allowed" in trials.reason["t01"]


def test_no_session_folder(tmp_path):
    config = ingest.Config(session=str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match="nowhere: no such session folder"):
        ingest.execute(RunFolder(tmp_path), tmp_path, config, silent)


@pytest.mark.parametrize(
    ("offset", "factor", "said"),
    [(1e18, 1.0, "are rounded to 128"), (0.0, 1e18, "which is more than a year")],
)
def test_time_stamps_beyond_all_clocks_are_refused(tmp_path, offset, factor, said):
    def damage(made):
        made.session["sample_rate_hz"] /= factor
        for table in made.tables.values():
            table["time_us"] = offset + factor * table["time_us"]

    with pytest.raises(InputError, match=said):
        run_ingest(Made(), tmp_path, damage)
