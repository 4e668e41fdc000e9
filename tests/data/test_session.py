"""The session file: what is read from it, and any damage ends in one plain line."""

import copy
import json
import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bampipe.data.session import inside, session_from
from bampipe.errors import InputError

TABLE = tomllib.loads("""
schema = "bampipe.session/1"
session_id = "s1"
device = "bam"
recorded_at = 2026-10-03T10:12:00Z
sample_rate_hz = 500.0
[encoders]
yaw = { column = "enc_yaw", counts_per_unit = 200.0, zero_counts = 10, unit = "deg" }
slide = { column = "x", unit = "mm", resolution = 0.5 }
[force]
columns = ["force_x_v", "push_n"]
unit = "V"
calibration_n_per_v = [[12.0, 0.1], [0.1, 11.5]]
zero_v = [0.02, -0.03]
[brakes]
columns = ["brake_slide", "brake_yaw"]
unit = "N, N.m"
[channels.current]
column = "amps"
unit = "A"
scale = 0.5
[[trials]]
file = "a/t1.csv"
kind = "free"
[[trials]]
file = "t2.csv"
kind = "locked"
locked_axis = "slide"
[[trials]]
file = "t3.csv"
kind = "viscous"
viscous_n_s_per_m = 40
""")


def test_a_calibration_may_join_more_columns_than_there_are_components():
    table = copy.deepcopy(TABLE)
    table["force"] |= {"components": ["push"], "calibration_n_per_v": [[12.0, -1.0]]}
    force = session_from(table, Path("here")).force
    assert force.names == ("force_push",) and force.calibration == ((12.0, -1.0),)
    for wrong, words in (
        ({"components": ["x", "y", "z"]}, "found 3 names, expected 2"),
        ({"components": ["x", "y"]}, "expected 2 rows of 2"),
        ({"calibration_n_per_v": [[12.0]]}, "expected 1 rows of 2"),
        ({"zero_v": [0.0]}, "found 1, expected 2"),
        ({"calibration_n_per_v": [[0.0, 0.0]]}, "singular"),
    ):
        damaged = copy.deepcopy(table)
        damaged["force"] |= wrong
        with pytest.raises(InputError, match=words):
            session_from(damaged, Path("here"))
    del table["force"]["calibration_n_per_v"], table["force"]["zero_v"]
    table["force"]["unit"] = "N"
    with pytest.raises(InputError, match="only where unit"):
        session_from(table, Path("here"))


def test_what_is_read():
    session = session_from(TABLE, Path("here"))
    yaw, slide = session.encoders
    assert yaw.unit == "rad" and yaw.counts and yaw.zero == 10
    assert yaw.scale == pytest.approx(3.14159265359 / 180 / 200) == yaw.resolution
    assert slide.unit == "m" and not slide.counts
    assert slide.scale == 1e-3 and slide.resolution == pytest.approx(5e-4)
    assert session.force.names == ("force_x", "force_push") and session.force.unit == "N"
    assert session.force.noise_sd is None
    assert [brake.axis for brake in session.brakes] == ["slide", "yaw"]
    assert session.channels[0].name == "current" and session.channels[0].offset == 0.0
    assert [trial.name for trial in session.trials] == ["t1", "t2", "t3"]
    assert session.trials[2].viscous == 40.0
    assert session.columns == (
        "time_us", "enc_yaw", "x", "brake_slide", "brake_yaw", "amps", "force_x_v", "push_n",
    )  # fmt: skip
    assert session.device_file is None


def test_brakes_follow_the_order_of_the_axes_and_an_error_names_its_field():
    table = copy.deepcopy(TABLE)
    table["brakes"] = {"columns": ["b1", "b2"], "unit": "N.m, N"}
    assert [b.axis for b in session_from(table, Path()).brakes] == ["yaw", "slide"]
    with pytest.raises(InputError) as caught:
        session_from({**TABLE, "sample_rate_hz": "x", "device": 3}, Path())
    assert str(caught.value) == "session.toml: device: found 3, expected text (and 1 more)"


@pytest.mark.parametrize("name", ["a.csv", "sub/a.csv", "./a.csv", "link.csv"])
def test_files_inside_are_found_also_by_links_within_and_to_the_session(tmp_path, name):
    (tmp_path / "real/sub").mkdir(parents=True)
    for path in ("a.csv", "sub/a.csv"):
        (tmp_path / "real" / path).write_text("")
    (tmp_path / "real/link.csv").symlink_to("a.csv")
    (tmp_path / "link").symlink_to("real")
    for root in ("real", "link"):
        assert inside(tmp_path / root, name, "w").is_file()


def record_in(*stretches):
    table = copy.deepcopy(TABLE)
    table["trials"] = [{"file": "r.mat", "kind": "free", **s} for s in stretches]
    return session_from(table, Path("here"))


def test_one_record_gives_several_trials():
    session = record_in({"end_s": 4}, {"start_s": 4, "end_s": 9.5}, {"start_s": 9.5})
    assert [trial.name for trial in session.trials] == ["r", "r_2", "r_3"]
    assert [trial.start_s for trial in session.trials] == [0.0, 4.0, 9.5]
    assert session.trials[2].end_s == float("inf")
    record_in({}, {})  # the same file twice is for ingest to judge


def test_a_file_of_another_ending_is_pointed_out(tmp_path):
    (tmp_path / "A.parquet").write_text("")
    with pytest.raises(InputError, match=r"no such file 'a\.csv'; there is 'A\.parquet'"):
        inside(tmp_path, "a.csv", "w")


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["N", "V", "rad", "free", "locked", "../x", "/x", "a\0b", "yaw", "x" * 999]),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=5,
)


def places(value, path=()):
    yield path
    items = value.items() if isinstance(value, dict) else []
    items = enumerate(value) if isinstance(value, list) else items
    for key, item in items:
        yield from places(item, (*path, key))


@settings(max_examples=300, deadline=None, derandomize=True)
@given(st.sampled_from([p for p in places(TABLE) if p]), VALUES, st.booleans())
def test_any_field_of_any_value_reads_or_is_refused_in_one_line(path, value, rename):
    table = copy.deepcopy(TABLE)
    target = table
    for key in path[:-1]:
        target = target[key]
    if rename and isinstance(target, dict):
        target[json.dumps(value)[:20]] = target.pop(path[-1])
    else:
        target[path[-1]] = value
    try:
        session_from(table, Path("nowhere"))
    except InputError as error:
        assert "\n" not in str(error) and str(error).startswith("session.toml")
