"""Readers: the three kinds of file give the same numbers, and nothing but InputError."""

import gzip
import io
import os
import tempfile
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bampipe.data.readers import columns_of, read_trial
from bampipe.data.readers import text as text_reader
from bampipe.errors import InputError

TABLE = {
    "time_us": np.arange(0, 40_000, 2000),
    "enc": np.arange(20) - 7,
    "force_v": np.linspace(-1, 1, 20).round(6),
}
QUICK = settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck)
)


def read(path, content, columns=tuple(TABLE), **more):
    path.write_bytes(content)
    return read_trial(path, columns, name=path.name, **more)


def as_csv(table):
    return pd.DataFrame(table).to_csv(index=False).encode()


def as_mat(table, **options):
    stream = io.BytesIO()
    scipy.io.savemat(stream, table, **options)
    return stream.getvalue()


def as_mat73(table, userblock=512):
    stream = io.BytesIO()
    with h5py.File(stream, "w", userblock_size=userblock) as file:
        for name, values in table.items():
            file[name] = values[None, :]
    content = stream.getvalue()
    return b"MATLAB 7.3 MAT-file"[:userblock].ljust(userblock) + content[userblock:]


KINDS = [
    ("a.csv", as_csv(TABLE)), ("A.CSV", as_csv(TABLE)), ("a.csv.gz", gzip.compress(as_csv(TABLE))),
    ("a.parquet", pd.DataFrame(TABLE).to_parquet()),
    ("b.parquet", pd.DataFrame(TABLE).astype("float32").to_parquet()),
    ("a.mat", as_mat(TABLE | {"log": {"q": np.arange(3.0), "who": "x"}}, oned_as="row")),
    ("b.mat", as_mat(TABLE, oned_as="column", do_compression=True)),
    ("c.mat", as_mat73(TABLE)),
    ("d.mat", as_mat73(TABLE, userblock=0)),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content"), KINDS)
def test_all_kinds_of_file_give_the_same_numbers(tmp_path, name, content):
    trial = read(tmp_path / name, content)
    assert list(trial.columns) == list(TABLE) and trial.notes == ()
    assert trial.rows[0] == (2 if "csv" in name.lower() else 1)
    for column, values in TABLE.items():
        assert trial.columns[column].dtype == np.float64
        np.testing.assert_allclose(trial.columns[column], values, atol=1e-7)


def test_empty_cells_and_words_for_missing_are_nan(tmp_path):
    content = b"a,b\n1,\n,2\nNaN,NA\nnull,inf\n5,6\n"
    columns = read(tmp_path / "a.csv", content, ("a", "b")).columns
    np.testing.assert_array_equal(columns["a"], [1, np.nan, np.nan, np.nan, 5])
    np.testing.assert_array_equal(columns["b"], [np.nan, 2, np.nan, np.inf, 6])
    table = pd.DataFrame({"a": pa.array([1, None, 3]).to_pandas(), "b": [1, 2, 3]})
    columns = read(tmp_path / "a.parquet", table.to_parquet(), ("a", "b")).columns
    np.testing.assert_array_equal(columns["a"], [1, np.nan, 3])


def test_many_blocks_are_joined_in_order(tmp_path, monkeypatch):
    monkeypatch.setattr(text_reader, "BLOCK", 1024)
    table = {"a": np.arange(5000), "b": np.arange(5000) * 0.5}
    files = {
        "a.csv": as_csv(table),
        "a.parquet": pd.DataFrame(table).to_parquet(row_group_size=100),
    }
    for name, content in files.items():
        columns = read(tmp_path / name, content, ("b", "a")).columns
        np.testing.assert_array_equal(columns["a"], table["a"])
        np.testing.assert_array_equal(columns["b"], table["b"])


@pytest.mark.parametrize("blank", [0, 3])
def test_a_bad_cell_is_found_in_any_block(tmp_path, monkeypatch, blank):
    monkeypatch.setattr(text_reader, "BLOCK", 1024)
    lines = ["a,b"] + ["1,2"] * 10 + [""] * blank + ["1,2"] * 2000 + ["1,x1"] + ["1,2"] * 2000
    with pytest.raises(InputError, match=f"row {2012 + blank}, column 'b': found 'x1'"):
        read(tmp_path / "a.csv", "\n".join(lines).encode() + b"\n", ("a", "b"))


@pytest.mark.parametrize(
    ("content", "rows", "said"),
    [
        (b"a,b\n1,2.5\n3,4.5\n", 2, False), (b"a,b\n1,2.5\n3,4.5", 2, False),
        (b"a,b\n1,2.5\n3,4", 1, True), (b"a,b\n1,2.5\n3,", 1, True), (b"a,b\n1,2.5\n3", 1, True),
        (b"a,b\n1,2.5\n3\n", 1, True), (b"a,b\n1,2\n3,4", 1, True),
        (b"a,b\r\n1,2.5\r\n3,4.", 1, True), (b"a,b\r\n1,2.5\r\n3,4.5\r\n\r\n", 2, False),
        (b"a,b\n1,2", 1, False), (b"a;b\n1;2,55\n3;4,5", 1, True), (b"a  b\n1  2.5\n3 ", 1, True),
        (b"a,b\n1,2.5\n3,4.5\n" + bytes(9), 2, False),  # space that a logger reserved
        (b"a,b\n1,2.5\n" + b"3,4.5\n" * 20_000 + b"3" + bytes(999), 20_001, True),
    ],
)  # fmt: skip
def test_a_last_line_that_may_be_cut_off_is_dropped_and_said(tmp_path, content, rows, said):
    trial = read(tmp_path / "a.csv", content, ("a", "b"))
    assert len(trial.columns["a"]) == rows
    assert trial.notes == (("last line is cut off: 1 row dropped",) if said else ())


@pytest.mark.parametrize(("name", "content"), KINDS)
def test_a_trial_that_is_too_large_is_refused(tmp_path, name, content):
    with pytest.raises(InputError, match="are more than the 0 MB allowed"):
        read(tmp_path / name, content, largest_bytes=100)


CELLS = st.one_of(st.floats().map(str), st.integers().map(str), st.text(max_size=6))


@QUICK
@given(st.lists(st.lists(CELLS, min_size=1, max_size=4), max_size=8), st.sampled_from(",;\t"))
def test_any_table_of_text_reads_or_is_refused_in_one_line(rows, delimiter):
    content = "\n".join(["a,b", *(delimiter.join(row) for row in rows)])
    check_reads_or_refuses("a.csv", content.encode("utf-8", "surrogatepass"), ("a", "b"))


@QUICK
@given(st.binary(max_size=300), st.sampled_from([".csv", ".parquet", ".mat"]))
def test_any_bytes_are_refused_in_one_line(content, ending):
    check_reads_or_refuses(f"a{ending}", content, ("a", "b"))


@settings(QUICK, max_examples=600)
@given(st.sampled_from(KINDS), st.data())
def test_a_file_with_bytes_changed_reads_or_is_refused_in_one_line(kind, data):
    name, content = kind[0], bytearray(kind[1])
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(content) - 1))
        content[place] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content))) :]
    check_reads_or_refuses(name, bytes(content), tuple(TABLE))


def check_reads_or_refuses(name, content, columns):
    with tempfile.TemporaryDirectory() as folder:
        try:
            trial = read(Path(folder) / name, content, columns, largest_bytes=1 << 20)
        except InputError as error:
            assert "\n" not in str(error) and str(error).startswith(name)
        else:
            lengths = {len(values) for values in trial.columns.values()}
            assert len(lengths) == 1 and lengths.pop() > 0


def read_json(tmp_path, text, columns=("t", "x"), name="a.json"):
    (tmp_path / name).write_text(text)
    return read_trial(tmp_path / name, columns, name=name)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ('[{"t": 0, "x": 1.5}, {"t": 1, "x": null}]', "a.json"),
        ('{"gain": 2, "log": [{"t": 0, "x": 1.5}, {"x": null, "t": 1}]}', "a.json"),
        ('{"t": 0, "x": 1.5}\n\n{"t": 1, "x": null}\n', "a.jsonl"),
    ],
)
def test_samples_that_are_json_objects(tmp_path, text, name):
    trial = read_json(tmp_path, text, name=name)
    np.testing.assert_array_equal(trial.columns["t"], [0.0, 1.0])
    np.testing.assert_array_equal(trial.columns["x"], [1.5, np.nan])
    text = '{"gain": 2, "who": "a", "log": [{"on": true}, {"on": false}]}'
    trial = read_json(tmp_path, text, ("on", "gain"))
    np.testing.assert_array_equal(trial.columns["on"], [1.0, 0.0])
    np.testing.assert_array_equal(trial.columns["gain"], [2.0, 2.0])
    text = '{"e": "start", "t": 0}\n{"t": 1, "q": {"x": 2}}\n'  # records of several kinds
    trial = read_json(tmp_path, text, ("t", "q.x"), "b.jsonl")
    np.testing.assert_array_equal(trial.columns["q.x"], [np.nan, 2.0])
    assert list(columns_of(tmp_path / "b.jsonl")) == ["t", "q.x"]


def test_a_log_that_is_no_regular_file(tmp_path):
    os.mkfifo(tmp_path / "a.csv")
    with pytest.raises(InputError, match="not a regular file"):
        read_trial(tmp_path / "a.csv", ("t", "x"), name="a.csv")
