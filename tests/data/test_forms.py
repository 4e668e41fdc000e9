"""Logs that are no plain tables: read to the same numbers, or refused with what to do."""

import json
import tomllib
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io

from bampipe.data.names import words
from bampipe.data.quality.encoders import unwrapped
from bampipe.data.readers import columns_of, read_trial
from bampipe.data.recording import describe_spans, read_recording
from bampipe.data.session import TrialEntry
from bampipe.data.session.channels import Clock
from bampipe.data.survey import survey
from bampipe.errors import InputError
from bampipe.setup.proposal import propose

TURN = 2 * np.pi
T = np.arange(60) / 100.0
Q = np.round(np.sin(3 * T), 4)
U = np.round(np.cos(3 * T), 4)


def write(path: Path, head: str, *columns: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=head, comments="")


def lines(form: str, head: str = "") -> str:
    rows = [
        form.format(t=t, q=q, u=u, n=n) for n, (t, q, u) in enumerate(zip(T, Q, U, strict=True), 1)
    ]
    return head + "\n".join(rows) + "\n"


def text_of(form, head="", tail="", swap=("", ""), columns=("t", "q", "u")):
    return (head + lines(form) + tail).replace(*swap), columns


KNOWN_FORMS = tomllib.loads(Path(__file__).with_name("forms.toml").read_text(encoding="utf-8"))
REFUSED = tomllib.loads(Path(__file__).with_name("refused.toml").read_text())
FORMS = {name: text_of(**known) for name, known in KNOWN_FORMS.items()}


@pytest.mark.parametrize("name", FORMS)
def test_texts_that_are_no_plain_tables(tmp_path: Path, name: str):
    text, columns = FORMS[name]
    path = tmp_path / "a.txt"
    path.write_bytes(text.encode().replace(b"Booting", b"Boot\x81\xff"))  # noise of a serial port
    assert set(columns) <= set(columns_of(path))
    assert set(read_trial(path, columns[:1]).columns) == {columns[0]}
    trial = read_trial(path, columns)
    for column, values in zip(columns, (T, Q, U), strict=True):
        values = values + 1000.0 * (name == "apostrophes" and column == "t")
        found = trial.columns[column][-60:]  # a line above may hold the numbers of samples
        known = np.isfinite(found)
        assert known.sum() >= 59
        np.testing.assert_allclose(found[known], values[known], atol=1e-9)


def test_stamps_of_which_a_part_is_not_padded_or_counts_days_and_hexadecimal_numbers(tmp_path):
    path, ms = tmp_path / "a.csv", np.arange(60) * 35
    path.write_text(lines("{t:.3f},0x{n:04X},{u:.4f}", "t,n,u\n"))
    np.testing.assert_array_equal(read_trial(path, ["n"]).columns["n"], np.arange(1.0, 61.0))
    path.write_text("t,q\n" + "".join(f"{n // 1000}.{n % 1000},{n}\n" for n in ms))
    np.testing.assert_allclose(read_trial(path, ("t",)).columns["t"], ms / 1000.0)
    path.write_text("t,q\n" + "".join(f"123:23:59:{n / 1000.0 + 20:06.3f},{n}\n" for n in ms))
    trial = read_trial(path, ("t",), datetimes={"t": ""})
    np.testing.assert_allclose(trial.columns["t"], ms / 1000.0)


def test_the_numbers_of_messages_are_no_positions(tmp_path: Path):
    rows, t = np.arange(600.0), np.arange(600) / 100.0
    write(tmp_path / "1_joint_states.csv", "seq,stamp,q", rows, t, np.sin(5 * t))
    write(tmp_path / "1_wrench.csv", "seq,stamp,torque.x", 4 * rows, t, np.cos(4 * t))
    found = {column.name: column.role for column in survey(tmp_path).columns}
    assert found["joint_states:seq"] == found["wrench:seq"] == ""
    write(tmp_path / "b/a.csv", "time_s,position_mm,force_N", T + 1e-3 * Q, 0.4 * rows[:60], U)
    even = survey(tmp_path / "b").columns
    assert [column.role for column in even] == ["time", "position", "force"]


def test_units_of_properties_are_heard(tmp_path: Path):
    path = tmp_path / "a.csv"
    rate = lines(";{t:.3f};{q:.4f};{u:.4f}", "Name:;t;q;u\nUnit:;s;°;Nm\nRate:;9 Hz;9 Hz;9 Hz\n")
    below = lines("{n:4d}  {u:8.3f}  {q:8.4f}", "mSec    TORQUE  A (B)\n        FT-LBS  DEG\n")
    for text, units in (
        (
            FORMS["properties of channels"][0],
            {"Time (1)": "", "q": "deg", "Time (2)": "", "u": "Nm"},
        ),
        (FORMS["properties with colons"][0], {"t": "s", "q": "rad", "u": "N*m"}),
        (rate, {"t": "s", "q": "°", "u": "Nm"}),
        (
            lines("{t:.3f};{t:.3f};{q:.4f}", "path;Root/t;Root/q\nunit;s;rad\ntrace_values;;\n"),
            {"Time": "", "Root/t": "s", "Root/q": "rad"},
        ),
        (
            lines("{n};{n};{q:.4f}", "Name;t;q\nUnit;s;Nm\nScale;0.01;0.1\n"),
            {"Name": "", "t": "0.01 s", "q": "0.1 Nm, if not applied"},
        ),
        (below, {"mSec": "", "TORQUE": "FT-LBS", "A (B)": "DEG"}),
        (lines("{q:.4f},{u:.4f}", "x,y\nmrad,mrad\n"), {"x": "mrad", "y": "mrad"}),
        (lines("{t:.3f},{q:.4f}", "t [s],q (6064h)\n"), {"t [s]": "s", "q (6064h)": ""}),
        (lines("{t:.3f};{q:.4f}", "t / s;φ / X\n"), {"t / s": "s", "φ / X": ""}),
    ):
        path.write_text(text)
        assert columns_of(path) == units


def test_words_for_no_reading_are_no_numbers_and_pages_begin_no_recording(tmp_path: Path):
    path = tmp_path / "a.csv"
    text = lines("{t:.3f},{q:.4f},{u:.4f}", "t,q,u\n").split("\n")
    path.write_text("\n".join([*text[:31], text[0], *text[31:]]))
    entry, clock = TrialEntry(file="a.csv", kind="free"), Clock(column="t", unit="s")
    assert len(read_recording(tmp_path, entry, ("t", "q"), clock)) == 60
    text[7], text[9], text[11] = "0.06,#DIV/0!,1", "0.08,OVERLOAD,1", "0.10,1.#QNAN,1"
    path.write_text("\n".join(text))
    trial = read_trial(path, ("t", "q", "u"))
    assert list(np.flatnonzero(np.isnan(trial.columns["q"]))) == [6, 8, 10]
    assert "column 'q' says 'OVERLOAD' from row 10 on: taken as no reading" in trial.notes
    path.write_text("\n".join([*text[:20], "0.19,1.2.3,1", *text[21:]]))
    with pytest.raises(InputError, match=r"row 21, column 'q': found '1.2.3', expected a number"):
        read_trial(path, ("t", "q", "u"))


def test_signals_in_rows_of_their_own_are_put_beside_one_another(tmp_path: Path):
    """A log of two rates: what is in between is interpolated, and lost readings stay lost."""
    rows = ["t,q,u"]
    for k in range(600):
        rows.append(f"{0.01 * k:.4f},{0.1 * k:.4f},")
        rows += [f"{0.01 * k + 0.004:.4f},,{k + 0.4:.4f}"] if not 200 < k < 230 else []
    (tmp_path / "a.csv").write_text("\n".join(rows) + "\n")
    entry, clock = TrialEntry(file="a.csv", kind="free"), Clock(column="t", unit="s")
    raw = read_recording(tmp_path, entry, ("t", "q", "u"), clock)
    assert len(raw) == 600 and raw.rows[3] == 8
    k = np.flatnonzero(np.isfinite(raw.columns["u"]))
    np.testing.assert_allclose(raw.columns["u"][k], k, atol=1e-9)
    assert not {*range(202, 229)} & {*k} and len(k) > 560
    assert "'u' stands in rows of its own: interpolated linearly at the ti" in raw.remarks[-1]
    long = ["joint,time,q,u"]
    for k in range(200):
        long += [f"a,{0.01 * k:.3f},{k},1", f"b,{0.01 * k:.3f},{2 * k},2"]
    (tmp_path / "b.csv").write_text("\n".join(long) + "\n")
    entry, clock = TrialEntry(file="b.csv", kind="free"), Clock(column="time", unit="s")
    raw = read_recording(tmp_path, entry, ("time", "a.q", "b.q"), clock)
    np.testing.assert_allclose(raw.columns["b.q"], 2.0 * raw.columns["a.q"])


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Sollposition [°]", ["soll", "position"]), ("Motorstrom", ["motor", "strom"]),
        ("angle mesuré", ["angle", "mesure"]), ("posición", ["posicion"]), ("q_des", ["q", "des"]),
        ("qdes", ["q", "des"]), ("关节角速度(deg/s)", ["velocity"]), ("トルク[Nm]", ["torque"]),
        ("rate", ["rate"]), ("timestamp", ["timestamp"]), ("AIActPos", ["ai", "act", "pos"]),
    ],
)  # fmt: skip
def test_words_of_names_in_other_languages(name: str, said: list[str]):
    assert words(name) == said


@pytest.mark.parametrize(
    ("encoding", "time", "unit"), [("gbk", "时间", "N·m"), ("shift_jis", "時間", "N・m")]
)
def test_encodings_of_chinese_and_japanese(tmp_path: Path, encoding: str, time: str, unit: str):
    path = tmp_path / "a.csv"
    path.write_bytes(lines("{t:.3f},{q:.4f}", f"{time}[s],力矩({unit})\n").encode(encoding))
    assert columns_of(path) == {f"{time}[s]": "s", f"力矩({unit})": unit}
    path.write_bytes(lines("{t:.3f},{q:.4f}", "temps (s),angle mesuré (°)\n").encode("cp1252"))
    assert list(columns_of(path)) == ["temps (s)", "angle mesuré (°)"]


def test_units_are_heard_wherever_they_stand_in_a_name(tmp_path: Path):
    units = {
        "Kraft in N": "N", "force_mN_raw": "mN", "torque_in_lbs": "in.lbs", "push_gf": "gf",
        "pos_0.1mm": "0.1mm", "Winkel / °": "°", "pos µm": "um", "push": "N mm",
    }  # fmt: skip
    (tmp_path / "README.md").write_text("- push: N mm, of the hand\n- pos: 3\n")
    write(tmp_path / "a.csv", ",".join(["t_s", *units]), T, *[Q] * len(units))
    assert {c.name: c.unit for c in survey(tmp_path).columns} == {"t_s": "s", **units}


def test_channels_go_by_the_names_beside_them(tmp_path: Path):
    """Scopes of Simulink and dSPACE, cells of MATLAB, matrices of HDF5, lists of JSON, NumPy."""
    kind = [("Name", object), ("Data", object), ("Unit", object)]
    y = np.zeros((1, 2), dtype=kind)
    y[0, 0], y[0, 1] = ('Root/"q"', Q[None, :], "rad"), ('Root/"u"', U[None, :], "Nm")
    x = np.zeros((1, 1), dtype=kind)
    x[0, 0] = ("", T[None, :], "s")
    scipy.io.savemat(tmp_path / "a.mat", {"rec7": {"X": x, "Y": y}})
    named = {"X.Data": "s", "Y.Root/q": "rad", "Y.Root/u": "Nm"}
    assert columns_of(tmp_path / "a.mat") == named
    trial = read_trial(tmp_path / "a.mat", ("X.Data", "Y.Root/u", "rec7.X.Data"))
    np.testing.assert_array_equal(trial.columns["Y.Root/u"], U)
    assert trial.units["Y.Root/u"] == "Nm"
    runs = np.empty((1, 2), dtype=object)
    runs[0, 0], runs[0, 1] = {"t": T, "q": Q}, {"t": T, "q": -Q}
    scipy.io.savemat(tmp_path / "b.mat", {"runs": runs})
    joined = read_trial(tmp_path / "b.mat", ("runs[:].t", "runs[:].q"))
    np.testing.assert_array_equal(joined.columns["runs[:].q"], np.concatenate([Q, -Q]))
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file["log"] = np.column_stack([T, Q, U])
        file["log"].attrs["channel_names"] = np.array([b"t", b"q", b"u"])
    assert list(columns_of(tmp_path / "c.h5")) == ["log/t", "log/q", "log/u"]
    trial = read_trial(tmp_path / "c.h5", ("log/t", "log/u"))
    np.testing.assert_array_equal(trial.columns["log/u"], U)
    signals = (("q", Q, "rad"), ("u", U, "Nm"))
    content = {"log": [{"name": n, "values": [*v, *v], "unit": u} for n, v, u in signals]}
    (tmp_path / "d.json").write_text(json.dumps(content | {"meta": {"fs": 100}}))
    assert columns_of(tmp_path / "d.json") == {"log.q": "rad", "log.u": "Nm", "meta.fs": ""}
    runs = [{"names": ["t", "u"], "rows": np.c_[T, v].tolist()} for v in (U, -U)]
    (tmp_path / "d.json").write_text(json.dumps({"runs": runs}))
    assert list(columns_of(tmp_path / "d.json")) == ["runs[:].t", "runs[:].u"]
    (tmp_path / "d.json").write_text(json.dumps([{"q": f"{q:.4f}"} for q in Q]))
    np.testing.assert_array_equal(read_trial(tmp_path / "d.json", ("q",)).columns["q"], Q)
    each = ({"_id": {"$oid": f"a{n}"}, "n": {"$numberLong": str(n)}, "q": n} for n in range(9))
    (tmp_path / "d.json").write_text("\n".join(json.dumps(one, indent=1) for one in each))
    assert columns_of(tmp_path / "d.json") == {"n": "", "q": ""}
    np.testing.assert_array_equal(read_trial(tmp_path / "d.json", ("n",)).columns["n"], range(9))
    heads = np.array(["t", "q", "u"], dtype=object)
    scipy.io.savemat(tmp_path / "g.mat", {"data": np.column_stack([T, Q, U]), "colheaders": heads})
    assert list(columns_of(tmp_path / "g.mat")) == ["data.t", "data.q", "data.u"]
    np.savez(tmp_path / "e.npz", t=T, q=np.column_stack([Q, U]))
    np.testing.assert_array_equal(read_trial(tmp_path / "e.npz", ("q[1]",)).columns["q[1]"], U)
    np.save(tmp_path / "f.npy", np.array([{"t": 1}], dtype=object))
    with pytest.raises(InputError, match=r"pickled Python objects.*; save arrays of numbers"):
        read_trial(tmp_path / "f.npy", ("t",))


def test_counters_wrap_at_any_width_and_go_on():
    angle = np.cumsum(np.full(500, 37.0))
    for bits in (12, 16, 20):
        found, rows, said = unwrapped(np.mod(angle * 2 ** (bits - 12), 2.0**bits), 0.0, True)
        np.testing.assert_allclose(np.diff(found), 37.0 * 2 ** (bits - 12))
        assert len(rows) == 4 and said == f"at {bits} bits"
    assert not len(unwrapped(np.where(np.arange(500) < 250, 0.0, 3000.0), 0.0, True)[1])
    signed = np.rint(-9000.0 * np.cos(angle / 2000.0))  # in a register, seen first below zero
    np.testing.assert_allclose(unwrapped(signed % 65536.0, 0.0, True)[0], signed)
    np.testing.assert_allclose(unwrapped(signed % 65536.0, 0.0, True, 7e4)[0], signed + 65536.0)
    for half, ending in ((12.5, "25 rad"), (4 * np.pi, "four turns")):
        sent = (0.1 * angle / 37.0 + half) % (2 * half) - half
        found, rows, said = unwrapped(sent, TURN, False)
        np.testing.assert_allclose(np.diff(found), 0.1)
        assert len(rows) == 2 and said == f"at {ending}"


@pytest.mark.parametrize("header", REFUSED["units"])
def test_a_unit_that_is_not_known_is_asked_for(tmp_path: Path, header: str):
    t = np.arange(2000) / 200.0
    q = 57.3 * (np.sin(2 * t) + 0.3 * np.sin(5 * t))
    u = 0.3 * np.gradient(np.gradient(q, t), t) + 40.0 * np.sin(q / 57.3)
    write(tmp_path / "a.csv", header, t, q, u)
    assert any(REFUSED["units"][header] in line for line in propose(tmp_path).fill_in)


@pytest.mark.parametrize("order", [np.arange(2000)[::-1], np.arange(2000) * 1237 % 2000])
def test_a_log_out_of_order_is_refused(tmp_path: Path, order: np.ndarray):
    t = order / 200.0
    write(tmp_path / "a.csv", "time_s,q,torque", t, np.sin(3 * t), np.cos(3 * t))
    with pytest.raises(InputError, match=r"time_s falls from row to row.*sort its rows"):
        propose(tmp_path)


def test_data_of_other_kinds_are_named_with_what_to_do(tmp_path: Path):
    (tmp_path / "b.db").write_bytes(b"")
    with pytest.raises(InputError, match=r"but b.db; \*.db is not read: export its table as CSV"):
        survey(tmp_path)
    (tmp_path / "b.db").rename(tmp_path / "a.xls")
    with pytest.raises(InputError, match=r"but a.xls; \*.xls is not read: save the sheet as .xlsx"):
        survey(tmp_path)
    wide = "\n".join(",".join(f"{v:.3f}" for v in np.tile(row, 20)) for row in (T, Q, U))
    (tmp_path / "b.csv").write_text(wide + "\n")
    with pytest.raises(InputError, match="3 rows of 1200 columns are no log; has it a channel"):
        survey(tmp_path)
    (tmp_path / "a.xls").unlink()
    np.savez(tmp_path / "c.npz", trials=np.zeros((3, 60, 2)))
    for it in REFUSED["kinds"]:
        (tmp_path / "b.csv").write_text(it.get("head", "") + it["line"] * 9)
        with pytest.raises(InputError, match=f"b.csv: .*{it['said']}"):
            survey(tmp_path)
    (tmp_path / "b.csv").unlink()
    with pytest.raises(InputError, match=r"c.npz: 'trials' is a 3 by 60 by 2 array.*save each"):
        survey(tmp_path)


@pytest.mark.parametrize(
    "cell", ['"1,234.5"', "1 234,5", "1\u202f234,5", "1'234.5", "1.234,5", "-1,234.5"]
)
def test_digits_in_thousands(tmp_path: Path, cell: str):
    sep, path = "," if '"' in cell else ";", tmp_path / "a.csv"
    path.write_text(f"n{sep}x\n" + "".join(f"{n}{sep}{cell}\n" for n in range(9)))
    assert set(np.abs(read_trial(path, ("n", "x")).columns["x"])) == {1234.5}
    with path.open("a") as file:  # nothing that could be read in two ways is
        file.write("".join(f"{n}{sep}{other}\n" for n, other in enumerate(("12,5", "12.5") * 3)))
    with pytest.raises(InputError):
        read_trial(path, ("n", "x"))


def test_trials_in_one_file_are_told_apart(tmp_path: Path):
    """By groups that are called trials, by a column that numbers them, and without empty rows."""
    t, u = np.arange(400) / 100.0, np.cos(np.arange(400) / 50.0)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for n in (1, 2, 3):
            for name, values in (("t", t), ("q", np.sin(n * t)), ("u", u), ("pair", np.c_[u, t])):
                file[f"trial_{n:02d}/{name}"] = values
    assert [trial.recording for trial in survey(tmp_path).trials] == [1, 2, 3]
    (tmp_path / "a.h5").unlink()
    frame = pd.DataFrame({"q": np.tile(u, 3), "u": 0.0}, pd.to_timedelta(np.tile(t, 3), unit="s"))
    frame.reset_index(names="elapsed").to_feather(tmp_path / "a.feather")
    assert [trial.recording for trial in survey(tmp_path).trials] == [1, 2, 3]
    (tmp_path / "a.feather").unlink()
    number = np.repeat([1, 2, 3], 400)
    table = np.c_[np.arange(1200) / 100.0, np.tile(np.sin(3 * t), 3), np.tile(u, 3), number]
    head = "time_s,angle_rad,torque_Nm,trial"
    write(tmp_path / "b.csv", head, table)
    session = propose(tmp_path).session
    assert "end_s = 3.995" in session and "start_s = 7.995" in session
    table = np.r_[table, np.zeros((50, 4))]
    write(tmp_path / "b.csv", head, table)
    clock, entry = Clock(column="time_s", unit="s"), TrialEntry(file="b.csv", kind="free")
    raw = read_recording(tmp_path, entry, ("time_s", "angle_rad"), clock)
    assert len(raw) == 1200 and "50 rows from row 1202 on were never filled" in raw.notes[0]


def test_a_drive_with_the_sign_of_the_reaction_is_turned(tmp_path: Path):
    t = np.arange(2000) / 200.0
    q, v = np.sin(2 * t) + 0.3 * np.sin(5 * t), 2 * np.cos(2 * t) + 1.5 * np.cos(5 * t)
    u = 0.3 * np.gradient(v, t) + 0.5 * np.tanh(v / 1e-2) + 0.4 * v
    write(tmp_path / "a.csv", "time_s,angle_rad,torque_Nm", t, q, -u)
    assert "reaction = true  # guess" in propose(tmp_path).session


def test_a_trial_in_another_unit_is_said(tmp_path: Path):
    spans = {"a": {"q": 1.2}, "b": {"q": 71.0}, "c": {"q": 1.0}, "d": {"q": 1.4}}
    (said,) = describe_spans(spans)
    assert said.startswith("b: q goes 59.2 times as far as in the others")
    write(tmp_path / "a.csv", "time_s,pos_mm,force\ns,mm,N", T, 1e3 * Q, U)
    write(tmp_path / "b.csv", "time_s,pos_m,force\ns,m,kN", T, Q, U)
    session, own = propose(tmp_path).session, 'units = { "pos_mm" = "m", "force" = "kN" }'
    assert f'file = "b.csv"\nkind = "free"\ncolumns = {{ "pos_mm" = "pos_m" }}\n{own}' in session


def test_a_clock_without_its_last_digits_is_said_and_a_note_gives_the_rate(tmp_path: Path):
    write(tmp_path / "a.csv", "time,q_rad,tau_Nm", np.full(60, 1.76451e9), Q, U)
    assert "time is 1.76451e+09 in all rows; were its last" in str(propose(tmp_path).check)
    (tmp_path / "README.txt").write_text("Sampling rate: 100 Hz\n")
    assert "sample_rate_hz = 100" in propose(tmp_path).session


HEAD = "LabVIEW Measurement\nSeparator\tTab\n***End_of_Header***\n\n"
SEGMENT = "Channels\t2\nSamples\t60\t60\nY_Unit_Label\tDegrees\tNm\nDelta_X\t0.01\t0.01\n" + (
    "***End_of_Header***\nX_Value\tAngle\tTorque\tComment\n"
)


def test_a_second_table_in_a_file_and_a_segment_of_labview(tmp_path):
    table = lines("{t:.3f},{q:.4f},{u:.4f}", "t,q,u\n")
    (tmp_path / "a.csv").write_text(table + "\nModel Outputs\n200\nFrame,X\n1,2\n")
    with pytest.raises(InputError, match="row 64: another table begins; save each table"):
        read_trial(tmp_path / "a.csv", ["t", "q"], name="a.csv")
    for time in ("{t:.3f}", ""):  # with a column of times, and without
        text = HEAD + 2 * lines(f"{time}\t{{q:.4f}}\t{{u:.4f}}", SEGMENT)
        (tmp_path / "a.lvm").write_text(text.replace(".", ","))
        raw = read_trial(tmp_path / "a.lvm", ["X_Value", "Angle [Degrees]"], name="a.lvm")
        assert raw.begun == (60,)
        np.testing.assert_allclose(raw.columns["X_Value"], [*T, *T], atol=1e-9)
        np.testing.assert_array_equal(raw.columns["Angle [Degrees]"], [*Q, *Q])
    blocks = [lines("{t:.3f}\t{q:.4f}", f"Block\t\tAt\t{k}\ts\nt\tq\nSec\tmm\n") for k in "12"]
    (tmp_path / "a.dat").write_text("\n".join(blocks))
    assert read_trial(tmp_path / "a.dat", ["t", "q"]).begun == (60,)


def test_axes_in_turn_copies_and_whole_seconds(tmp_path):
    t = np.arange(900) / 100.0
    q, u = np.sin(3 * t), np.sign(np.cos(3 * t)) + np.cos(3 * t)
    both = [np.column_stack([x, x + 2.0]).ravel() for x in (q, u)]
    write(tmp_path / "a/a.csv", "t,id,q_rad,tau_Nm", np.repeat(t, 2), np.tile([1, 2], 900), *both)
    for name, values in {"position": both[0], "torque": both[1], "time": t}.items():
        write(tmp_path / f"c/{name}.txt", "", np.sort(values))
    rows = "".join(f"{j},{a},{b},{b}\n" for j in ("hip", "knee") for a, b in zip(t, q, strict=True))
    (tmp_path / "f").mkdir()
    (tmp_path / "f/f.csv").write_text(f"joint,time_s,q_rad,tau_Nm\n{rows}")
    write(tmp_path / "e/e.csv", "t_s,q_rad,tau_Nm,volt", t, q, u, np.round(40 * q + 1, 3))
    values = np.rint(1e3 * np.column_stack([q, u]).ravel())
    write(tmp_path / "b/b.csv", "stamp,ID,value", np.repeat(t, 2), np.tile([385, 641], 900), values)
    for name, said in (
        ("a", "q_rad is of another axis in each row"),
        ("b", "value is of another axis or signal in each row; write a file for each"),
        ("c", "2 rows for each time in time"),
        ("f", "column 'joint': recordings of several axes are in turn: hip and knee"),
    ):
        with pytest.raises(InputError, match=said):
            propose(tmp_path / name)
    assert any(line.startswith("volt repeats q_rad") for line in propose(tmp_path / "e").check)
    write(tmp_path / "d/angle.csv", "time,q_rad", 1e3 * t, q)
    write(tmp_path / "d/torque.csv", "time,tau_Nm", np.arange(10.0), u[::90])
    assert [p.time_unit for p in survey(tmp_path / "d").trials[0].parts] == ["s"]


def test_codes_for_no_reading_are_taken_for_none_and_hours_pass(tmp_path):
    text = ""
    for n, (q, u) in enumerate(zip(Q, U, strict=True)):
        second, reading = 3599.7 + 0.01 * n, -9999.0 if n in (7, 30, 31) else u
        q, reading = (0.0, 0.0) if n in (20, 25, 26) else (q, reading)
        text += f"{int(second // 60) % 60:02d}:{second % 60:06.3f},{q},{reading}\n"
    (tmp_path / "a.csv").write_text("Time,q,u\n" + text)
    entry, clock = TrialEntry(file="a.csv", kind="free"), Clock(column="Time", unit="datetime")
    raw = read_recording(tmp_path, entry, ["Time", "q", "u"], clock)
    assert len(raw) == 57 and {22, 27, 28}.isdisjoint(raw.rows)
    assert raw.rows[np.isnan(raw.columns["u"])].tolist() == [9, 32, 33]
    assert "column 'u': 3 readings of -9999 are taken for none" in raw.notes
    np.testing.assert_allclose(raw.columns["Time"], np.delete(T, [20, 25, 26]), atol=2e-3)


@pytest.mark.parametrize(
    ("files", "kept", "said"),
    [
        (("1_measured", "1_desired", "2_desired"), ("1_measured", "2_desired"), "asked for"),
        (("a", "a_sim"), ("a",), "simulated"),
        (("motor_1/a", "motor_2/a", "motor_2/b"), ("motor_2/a", "motor_2/b"), "not of motor_2"),
    ],
)
def test_a_folder_may_hold_more_than_one_mechanism(tmp_path, files, kept, said):
    for name in files:
        write(tmp_path / f"{name}.csv", "t_s,q_rad,tau_Nm", T, Q, U)
    found = survey(tmp_path)
    assert [trial.file for trial in found.trials] == [f"{name}.csv" for name in kept]
    assert len(found.passed) == len(files) - len(kept)
    assert all(said in why for _, why in found.passed)


def test_logs_with_their_time_come_first_and_unnamed_columns_are_alike_in_number(tmp_path):
    write(tmp_path / "a/a.csv", "t_s,q_rad,tau_Nm", T, Q, U)
    write(tmp_path / "a/b.csv", "q_rad,tau_Nm", Q[:40], U[:40])
    assert "t_s" in [column.name for column in survey(tmp_path / "a").columns]
    for n in (1, 2):  # all joints in each, whichever of them moved: trials, and no parts
        write(tmp_path / f"c/joint_{n}.csv", "t_s,q1_rad,q2_rad,tau1_Nm,tau2_Nm", T, Q, U, U, Q)
    assert [len(trial.parts) for trial in survey(tmp_path / "c").trials] == [0, 0]
    write(tmp_path / "b/a.csv", "", T, Q, 3.0 * U)
    write(tmp_path / "b/b.csv", "", Q[:20], U[:20])
    found = survey(tmp_path / "b")
    assert [trial.file for trial in found.trials] == ["a.csv"] and len(found.columns) == 3
    assert found.passed == (("b.csv", "other columns, for another session, without column_3"),)


def test_speeds_in_hertz_commands_and_one_reading_in_two_units(tmp_path):
    names = "time [s],velocity [Hz],force [Nm],motor current [A]"
    write(tmp_path / "a/a.csv", names, T, U, np.cos(9 * T), U)
    proposal = propose(tmp_path / "a")
    assert 'unit = "rev/s"' in proposal.session and "coil_current" not in proposal.device
    names = "time [s],commanded angle [rad],a1 position [rad],c1 position [rev],a1 torque [Nm]"
    write(tmp_path / "b/b.csv", names, T, np.roll(Q, -3), Q, Q / TURN, U)
    assert 'column = "a1 position [rad]"' in propose(tmp_path / "b").session
    for drive, length in (("load_lbf", "in"), ("load_N", "m")):
        write(tmp_path / "e/a.csv", f"t [s],stroke_in,{drive}", T, Q, U)
        assert f'column = "stroke_in", unit = "{length}"' in propose(tmp_path / "e").session
    (tmp_path / "d").mkdir()
    table = np.c_[T, Q, U, 3.0 * U].tolist()
    rows = {"force units": "kip", "displacement units": "in", "data": table}
    (tmp_path / "d/a.json").write_text(json.dumps(rows))
    units, device = [c.unit for c in survey(tmp_path / "d").columns], propose(tmp_path / "d").device
    assert units == ["", "in", "", "kip"] and "drive = true" not in device
    (tmp_path / "c.json").write_text(json.dumps({"data": [{"t": [*T, *T], "q": [*Q, *Q]}]}))
    assert set(columns_of(tmp_path / "c.json")) == {"data[0].t", "data[0].q"}
