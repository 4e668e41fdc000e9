import os
import stat

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from bampipe import files
from bampipe.data import store
from bampipe.errors import InputError
from bampipe.files import atomic_writer, digest_file, digest_input, read_json, read_toml, write_json


def frame(trial="t01", rows=5):
    return pd.DataFrame({"trial_id": [trial] * rows, "t": np.arange(rows) * 0.002})


def test_json_is_sorted_exact_and_finite(tmp_path):
    path = tmp_path / "a" / "x.json"
    value = {"b": 0.1, "a": [3, None, [1.5, 2.0]], "c": True}
    write_json(path, value)
    assert path.read_text() == '{\n "a": [\n  3,\n  null,\n  [\n   1.5,\n   2.0\n  ]\n ],' + (
        '\n "b": 0.1,\n "c": true\n}\n'
    )
    assert read_json(path) == {"a": [3, None, [1.5, 2.0]], "b": 0.1, "c": True}
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path.with_name("y.json"), {"axes": {"yaw": [1.0, float("nan")]}})
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize(
    ("read", "content", "said"),
    [
        *((read_json, x, "(not JSON|nested too deeply)") for x in (b"[" * 100_000, b"9" * 5000)),
        (read_json, b"\xff", "not JSON"), (read_json, b"", "not JSON"),
        (read_json, b'{"a": 1,\n oops}', "line 2"), (read_toml, b"a = 1\nb = = 2\n", "line 2"),
        (read_toml, b"a = 1\n\xff = 2\n", "line 2: not UTF-8"),
        (read_toml, b"a = 2026-13-45\n", "line 1: not TOML"),
        (read_toml, b"a = " + b"9" * 5000, "not TOML"),
        (read_toml, "a = 1\n".encode("utf-16"), "UTF-16"),
        (read_toml, b"a = " + b"[" * 50_000, "nested too deeply"),
        (read_toml, b".".join([b"a"] * 5_000) + b" = 1", "nested too deeply"),
        (read_toml, b"#" * (files.LARGEST_TOML_BYTES + 1), "larger than 4 MB"),
    ],
)  # fmt: skip
def test_a_broken_file_is_named_with_its_line(tmp_path, read, content, said):
    (tmp_path / "x.y").write_bytes(content)
    with pytest.raises(InputError, match=rf"x\.y.*{said}"):
        read(tmp_path / "x.y")


def test_errors_of_files_and_folders_are_plain_and_leave_what_was(tmp_path):
    path = tmp_path / "x.json"
    write_json(path, {"old": 1})
    with pytest.raises(RuntimeError), atomic_writer(path) as stream:
        stream.write(b"half")
        raise RuntimeError
    assert read_json(path) == {"old": 1}
    assert list(tmp_path.iterdir()) == [path]
    for read in (read_json, read_toml, store.read_parquet):
        with pytest.raises(InputError, match=r"nowhere.*: no such file"):
            read(tmp_path / "nowhere")
    (tmp_path / "run").write_text("")
    with pytest.raises(InputError, match="cannot write"):
        write_json(tmp_path / "run" / "x.json", {})


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_a_read_only_folder_is_a_plain_error(tmp_path):
    tmp_path.chmod(stat.S_IREAD | stat.S_IEXEC)
    with pytest.raises(InputError, match="permission denied"):
        write_json(tmp_path / "x.json", {})


def test_a_full_disk_is_a_plain_error(tmp_path):
    if not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full here")
    with (
        pytest.raises(InputError, match="the disk is full"),
        atomic_writer(tmp_path / "x"),
        open("/dev/full", "wb", buffering=0) as full,
    ):
        full.write(b"x")
    assert list(tmp_path.iterdir()) == []


def test_parquet_has_a_row_group_a_trial_and_reads_one_of_them(tmp_path):
    path = tmp_path / "x.parquet"
    with store.ParquetAppender(path) as out:
        out.append(frame("t01", 5))
        out.append({"trial_id": pa.array(["t02"] * 3).dictionary_encode(), "t": np.arange(3.0)})
        assert not path.exists()
    assert pq.ParquetFile(path).num_row_groups == 2
    assert store.read_parquet(path, trial="t02")["t"].tolist() == [0.0, 1.0, 2.0]
    assert list(store.read_parquet(path, columns=["t"], trial="t01")) == ["t"]
    assert store.read_parquet(path)["trial_id"].tolist() == ["t01"] * 5 + ["t02"] * 3
    with pytest.raises(InputError, match="no trial 't09'"):
        store.read_parquet(path, trial="t09")
    with pytest.raises(InputError, match="no column 'q'"):
        store.read_parquet(path, columns=["q"])


def test_a_whole_frame_gets_the_same_bytes_as_its_trials_appended(tmp_path):
    with store.ParquetAppender(tmp_path / "a") as out:
        out.append(frame("t01"))
        out.append(frame("t02"))
    store.write_parquet(tmp_path / "b", pd.concat([frame("t01"), frame("t02")]))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_absent_text_and_empty_frames_survive(tmp_path):
    table = pd.DataFrame({"trial_id": ["t01"], "locked_axis": [None], "n": [3]})
    store.write_parquet(tmp_path / "x", table)
    assert store.read_parquet(tmp_path / "x")["locked_axis"].isna().all()
    store.write_parquet(tmp_path / "y", table.iloc[:0])
    assert list(store.read_parquet(tmp_path / "y")) == list(table)


def test_an_error_while_appending_leaves_no_file(tmp_path):
    with pytest.raises(RuntimeError), store.ParquetAppender(tmp_path / "x") as out:
        out.append(frame())
        raise RuntimeError
    with pytest.raises(ValueError, match="no frame"), store.ParquetAppender(tmp_path / "x"):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("damage", [b"", b"garbage" * 40, "cut", "flip"])
def test_a_damaged_parquet_file_is_named(tmp_path, damage):
    path = tmp_path / "x.parquet"
    store.write_parquet(path, frame(rows=4000))
    whole = path.read_bytes()
    if damage == "cut":
        path.write_bytes(whole[: len(whole) // 2])
    elif damage == "flip":
        path.write_bytes(whole[:40] + bytes(200) + whole[240:])
    else:
        path.write_bytes(damage)
    with pytest.raises(InputError, match=r"x\.parquet: not a sound Parquet file"):
        store.read_parquet(path)


def test_a_toml_file_counts_by_what_it_says_and_others_by_their_bytes(tmp_path):
    first, second, third = (tmp_path / f"{name}.toml" for name in "abc")
    first.write_text("a = 1\n[t]\nb = 2026-01-01\n")
    second.write_text("# note\na  =  1\n t = { b = 2026-01-01 }\n")
    third.write_text("a = 1.0\n[t]\nb = 2026-01-01\n")
    assert digest_input(first) == digest_input(second)
    assert digest_input(first) != digest_input(third)
    raw = tmp_path / "x.csv"
    raw.write_bytes(b"abc")
    assert digest_input(raw) == digest_file(raw)
    assert digest_file(raw).startswith("ba7816bf")
