"""Text tables as labs write them: the same numbers, or one line that says what to decide."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from bampipe.data.readers import columns_of, read_trial
from bampipe.data.readers.trial import Dialect
from bampipe.errors import InputError

REFUSED = tomllib.loads(Path(__file__).with_name("refused.toml").read_text())
T = np.arange(40) / 100.0
X = np.round(np.sin(3 * T), 4)
N = np.arange(40) - 20


def table(delimiter=",", decimal=".", header="t,x,n", end="\n", row=None):
    """Lines of a table with three columns."""
    lines = [header.replace(",", delimiter)] if header else []
    for t, x, n in zip(T, X, N, strict=True):
        cells = [f"{t:.3f}", f"{x:.4f}", str(n)]
        cells = [cell.replace(".", decimal) for cell in cells]
        lines.append(row(cells) if row else delimiter.join(cells))
    return end.join(lines) + end


def read(tmp_path, text, columns=("t", "x", "n"), ending=".csv", encoding="utf-8", **options):
    path = tmp_path / f"a{ending}"
    path.write_bytes(text.encode(encoding))
    return read_trial(path, columns, name=path.name, **options)


def check(trial, columns=("t", "x", "n")):
    for column, values in zip(columns, (T, X, N), strict=True):
        np.testing.assert_array_equal(
            trial.columns[column], np.round(values, 4) if column != "n" else values
        )


PREAMBLE = "LabVIEW Measurement\nOperator;A. B.\n\n"
WRITTEN = {
    "plain": table(), "semicolons": table(";"), "semicolons, decimal commas": table(";", ","),
    "tabs, decimal commas": table("\t", ","), "bars": table("|"), "blanks": table(" "),
    "several blanks": table(" ", row=lambda c: "  " + "   ".join(c) + " "),
    "blanks, decimal commas": table(" ", ","),
    "blanks and tabs": table(" ", row=" \t ".join),
    "quoted decimal commas": table(row=lambda c: ",".join(f'"{x.replace(".", ",")}"' for x in c)),
    "Windows line ends": table(";", ",", end="\r\n"),
    "blanks, Windows line ends": table(" ", end="\r\n", row=lambda c: " ".join(c) + " "),
    "byte order mark": "\ufeff" + table(";", ","),
    "remarks above": "# logger 7\n# 2026-10-03\n" + table(),
    "other lines above": PREAMBLE + table(";", ","),
    "header in a remark": "# " + table(" "),
    "MATLAB remark": "% made by hand\n" + table("\t"),
    "lines that end in semicolons": "%log\n%t,x,n\n%[#],[deg],[1]\n"
    + table(header="", row=lambda c: ",".join(c) + ";").removeprefix("\n"),
    "header with commas above blanks": "% t, x, n\n" + table(" ", header=""),
    "chatter": table().replace("\n0.200,", "\nLogging to: LD0029.CSV\n\n[INFO]: t, x, n!\n0.200,"),
    "unit row": table().replace("t,x,n\n", "t,x,n\ns,deg,1\n"),
    "unit row in brackets": table(";", ",").replace("t;x;n\n", "t;x;n\n[s];[mm];[-]\n"),
    "unit row, blanks": table("\t").replace("t\tx\tn\n", "t\tx\tn\ns\tN.m\t\n"),
    "delimiter at the end of lines": table(";", row=lambda c: ";".join(c) + ";"),
    "behind the last name alone": table(";", header="t,x,n,"),
    "same, header too": table(";", header="t,x,n,", row=lambda c: ";".join(c) + ";"),
    "exponents": table(row=lambda c: ",".join(f"{float(x):.6E}" for x in c)),
    "a column of text with commas": table(
        ";", header="t,x,n,note", row=lambda c: ";".join([*c, "slow, 1,5 turns"])
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRITTEN)
def test_tables_as_labs_write_them(tmp_path, name):
    check(read(tmp_path, WRITTEN[name]))


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-8-sig"])
def test_encodings_that_show_themselves(tmp_path, encoding):
    check(read(tmp_path, table(";", ","), encoding=encoding))


@pytest.mark.parametrize("name", WRITTEN)
def test_columns_are_found_without_being_asked_for(tmp_path, name):
    for ending in ("csv", "txt", "dat", "tsv", "asc", "log"):
        (tmp_path / f"a.{ending}").write_text(WRITTEN[name], newline="")
        assert list(columns_of(tmp_path / f"a.{ending}")) == ["t", "x", "n"]


def test_units_of_names_and_of_the_line_below_are_taken_and_what_was_found_is_said(tmp_path):
    text = table(";", header="t [s],x (mm),n")
    assert read(tmp_path, text, ("t [s]", "x (mm)", "n")).units == {"t [s]": "s", "x (mm)": "mm"}
    trial = read(tmp_path, WRITTEN["unit row in brackets"])
    assert trial.units == {"t": "s", "x": "mm", "n": "-"}
    assert trial.rows[0] == 3 and "row 2 gives units" in trial.remarks
    assert read(tmp_path, "t,x,n\ns,mm,-\n\n0,1,2\n1,2,3\n").rows[0] == 4
    trial = read(tmp_path, PREAMBLE + table(";", ","))
    assert trial.remarks == (
        "columns are separated by semicolons",
        "2 lines above the header passed over",
        "decimal commas",
    )
    assert trial.rows[0] == 5 and trial.notes == ()


@pytest.mark.parametrize(
    ("text", "said", "ending"),
    [
        *((it["text"], it["said"], it.get("ending", ".csv")) for it in REFUSED["texts"]),
        (table(";", ",") + "0,41;1.5;3\n0,42;1,5;3\n", "'1.5' in row 42 a point", ".csv"),
        (table(";") + "0.41;1,5;3\n0.42;1.5;3\n", "'1,5' in row 42 has a decimal comma", ".csv"),
        (table(" ") + "  0.4  x1  9\n" * 2, "row 42, column 'x': found 'x1', expected a", ".csv"),
        ("[" * 100_000, "not sound JSON", ".json"),
        ('[{"t": 0, "x": 1' + "0" * 400 + ', "n": 1}]', "beyond all range", ".json"),
    ],
)  # fmt: skip
def test_what_is_no_table_or_can_be_read_in_two_ways_is_refused(tmp_path, text, said, ending):
    with pytest.raises(InputError) as caught:
        read(tmp_path, text, ending=ending)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_sign_that_changes_far_below_is_refused_not_read(tmp_path):
    text = "t;x;n\n" + "1;2;3\n" * 20_000 + "4;5,5;6\n" + "1;2;3\n" * 20_000
    with pytest.raises(InputError, match=r"row 20002, column 'x': found '5,5', expected a number"):
        read(tmp_path, text)


def test_the_session_decides_what_the_file_leaves_open(tmp_path):
    text = "t;x;n\n1,234;2;3\n1,235;2;3\n"
    trial = read(tmp_path, text, dialect=Dialect(decimal=","))
    np.testing.assert_array_equal(trial.columns["t"], [1.234, 1.235])
    trial = read(tmp_path, "0 1,5 2\n1 2,5 3\n", dialect=Dialect(names=("t", "x", "n")))
    np.testing.assert_array_equal(trial.columns["x"], [1.5, 2.5])
    assert trial.rows[0] == 1
    trial = read(tmp_path, "Weg,\xb5\nm,\xb0\n1,2\n3,4\n", ("Weg",), encoding="latin-1")
    np.testing.assert_array_equal(trial.columns["Weg"], [1.0, 3.0])
    assert trial.units == {"Weg": "m"} and "not UTF-8" in trial.remarks[0]
    text = "gr\x81\xdfe,t,x,n\n1,2,3,4\n"  # a byte that Windows-1252 does not have
    with pytest.raises(InputError, match='say encoding = "latin-1" under'):
        read(tmp_path, text, encoding="latin-1")
    text = "gr\xf6\xdfe,t,x,n\n1,2,3,4\n"
    trial = read(tmp_path, text, encoding="latin-1", dialect=Dialect(encoding="latin-1"))
    np.testing.assert_array_equal(trial.columns["n"], [4.0])
    text = table().replace("0.010,0.0300", "0.010,ovf").replace("0.020,0.0600", "0.020,n/a")
    trial = read(tmp_path, text, dialect=Dialect(missing=("ovf",)))
    assert np.isnan(trial.columns["x"][1:3]).all() and np.isfinite(trial.columns["x"][3:]).all()


@pytest.mark.parametrize(
    ("stamps", "form"),
    [
        ("2026-10-03T10:12:0{0:.3f}", ""), ("2026-10-03 10:12:0{0:.3f}+02:00", ""),
        ("03.10.2026 10:12:0{0:.3f}", "%d.%m.%Y %H:%M:%S.%f"), ("10:12:0{0:.3f}", "%H:%M:%S.%f"),
        ("13.10.2026 14:00:0{:.3f}", ""), ("10/13/2026 2:00:0{:.3f} PM", ""),
        ("13-Oct-2026 14:00:0{:.3f}", ""), ("2:00:0{:.3f} pm", ""), ("00:0{:.3f}", ""),
        ("0 days 00:00:0{:.3f}", ""),
    ],
)  # fmt: skip
def test_dates_and_times_become_seconds(tmp_path, stamps, form):
    lines = ["when;x", *(f"{stamps.format(t)};{x}" for t, x in zip(T, X, strict=True))]
    trial = read(tmp_path, "\n".join(lines) + "\n", ("when", "x"), datetimes={"when": form})
    np.testing.assert_allclose(trial.columns["when"], T, atol=1e-9)
    assert form or columns_of(tmp_path / "a.csv") == {"when": "datetime", "x": ""}


def test_what_could_be_two_dates_is_refused_and_times_of_day_pass_midnight(tmp_path):
    text = "when,x\n03/10/2026 10:12,1\n04/10/2026 10:12,1\n"
    with pytest.raises(InputError, match=r"row 2: found '03/10/2026 10:12'.*give its form"):
        read(tmp_path, text, ("when", "x"), datetimes={"when": ""})
    stamps = ["9:59:59,990", "10:00:00,010", "23:59:59,990", "", "0:00:00,010"]
    text = "when;q\n" + "".join(f"{stamp};{n}\n" for n, stamp in enumerate(stamps))
    trial = read(tmp_path, text, ("when", "q"), datetimes={"when": ""})
    expected = [0.0, 0.02, 50400.0, np.nan, 50400.02]
    np.testing.assert_allclose(trial.columns["when"], expected, rtol=1e-12)
    assert columns_of(tmp_path / "a.csv", name="a.csv") == {"when": "datetime", "q": ""}


def test_the_first_rows_may_lack_cells(tmp_path):
    """What is logged before all sensors have answered is no header."""
    rows = "2026-05-04T09:30:00.{:03}Z,{},{}"
    lines = ["timestamp,pos (1),pos (2)", *(f"2026-05-04T09:29:59.99{k}Z,," for k in (0, 5))]
    lines += [rows.format(10 * k, k, 2 * k) for k in range(30)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines) + "\n")
    assert columns_of(path) == {"timestamp": "datetime", "pos (1)": "", "pos (2)": ""}
    trial = read_trial(path, ("timestamp", "pos (2)"), datetimes={"timestamp": ""})
    np.testing.assert_array_equal(trial.columns["pos (2)"][:4], [np.nan, np.nan, 0.0, 2.0])
    assert trial.columns["timestamp"][2] == pytest.approx(0.01) and trial.rows[0] == 2


def test_columns_without_a_header_have_numbers(tmp_path):
    trial = read(tmp_path, table("\t", header="").lstrip(), ("column_1", "column_2", "column_3"))
    check(trial, ("column_1", "column_2", "column_3"))
    with pytest.raises(InputError, match="without names, the columns are column_1 to column_3"):
        read(tmp_path, table("\t", header="").lstrip())


def test_recordings_and_chatter_are_found_with_their_rows(tmp_path):
    text = table() + "Logging to: B.CSV\n" + table()
    trial = read(tmp_path, text)
    assert len(trial) == 80 and trial.begun == (40,)
    assert trial.notes == ("row 42 is text and no sample: left out",)
    np.testing.assert_array_equal(trial.rows[[0, 39, 40, 79]], [2, 41, 44, 83])
    second = trial.between(40, 80)
    check(second)
    assert second.rows[0] == 44 and second.begun == ()
    trial = read(tmp_path, table() + "0.400,1.0,2,reset alarm, door\n" + "0.410,1.0,2\n")
    assert len(trial) == 41 and trial.notes == ("row 42 ends in words: left out",)
    with pytest.raises(InputError, match="50 lines hold text and no sample, and there are more"):
        read(tmp_path, table() + "oops\n0,1,2\n" * 60)
    with pytest.raises(InputError, match=r"row 42: 2 cells, where the header has 3; the line is"):
        read(tmp_path, table() + "1.0,2.0\n" + "0.4,1.0,2\n")


def test_joints_of_rostopic_echo_have_their_names(tmp_path):
    """`rostopic echo -p`: the names of the joints stand in columns of their own."""
    head = "%time,field.header.frame_id,field.name0,field.name1,field.position0,field.position1"
    rows = [f"{1700000000000000000 + 10**7 * k},base,elbow,wrist,{X[k]},{N[k]}" for k in range(40)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([head, *rows]) + "\n")
    names = ("time", "field.position[elbow]", "field.position[wrist]")
    assert tuple(columns_of(path)) == names
    trial = read_trial(path, names)
    np.testing.assert_allclose(np.diff(trial.columns["time"]), 1e7, atol=300.0)
    np.testing.assert_array_equal(trial.columns["field.position[wrist]"], N)


@pytest.mark.parametrize(("said", "angle"), [("inDegrees=yes\n", "deg"), ("inDegrees=no\n", "rad")])
def test_motion_files_of_opensim_say_their_angles(tmp_path, said: str, angle: str):
    head = f"knee\nversion=1\nnRows=40\nnColumns=4\n{said}endheader\n"
    names = ("time", "knee_angle_r", "knee_angle_r_speed", "pelvis_tx", "knee_moment")
    rows = ["\t".join(f"{v:.4f}" for v in (t, x, x, x, x)) for t, x in zip(T, X, strict=True)]
    path = tmp_path / "a.mot"
    path.write_text(head + "\t".join(names) + "\n" + "\n".join(rows) + "\n")
    units = ("s", angle, f"{angle}/s", "", "")
    assert columns_of(path) == dict(zip(names, units, strict=True))
