"""Quality rules: what they leave alone, and that nothing unsound comes through."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bampipe.data.quality import CleaningLimits, CleanTrial, clean, thin, thinning_factor
from bampipe.data.quality.clock import rate_of
from bampipe.data.readers.trial import RawTrial
from bampipe.data.session import session_from
from bampipe.errors import InputError

TABLE = {
    "schema": "bampipe.session/1",
    "session_id": "s",
    "device": "any",
    "sample_rate_hz": 500.0,
    "encoders": {
        "yaw": {"column": "yaw", "counts_per_unit": 20000.0, "unit": "rad"},
        "turn": {"column": "turn", "unit": "rad", "resolution": 1e-4},
    },
    "force": {
        "columns": ["force_x"],
        "unit": "V",
        "calibration_n_per_v": [[10.0]],
        "zero_v": [0.5],
    },
    "trials": [
        {"file": "a.csv", "kind": "free"},
        {"file": "b.csv", "kind": "locked", "locked_axis": "yaw"},
    ],
}
SESSION = session_from(TABLE, Path())
N = 1500


def columns(n=N, seed=0):
    rng = np.random.default_rng(seed)
    t = np.arange(n) / 500.0
    return {
        "time_us": np.rint(t * 1e6),
        "yaw": np.rint(10_000 * np.sin(2 * np.pi * t)),
        "turn": 0.5 * np.sin(3 * t),
        "force_x": np.sin(5 * t) + 0.01 * rng.standard_normal(n),
    }


def cleaned(table, kind=0, limits=None, session=SESSION):
    held = {name: np.array(values, dtype=float) for name, values in table.items()}
    raw = RawTrial(held, np.arange(2, 2 + len(held["turn"])))
    return clean(raw, session, session.trials[kind], limits or CleaningLimits())


def test_a_sound_trial_comes_through_untouched():
    table = columns()
    trial = cleaned(table)
    assert trial.repairs == [] and trial.notes == []
    np.testing.assert_allclose(trial.columns["q_yaw"], table["yaw"] / 20000.0)
    np.testing.assert_allclose(trial.columns["force_x"], 10.0 * (table["force_x"] - 0.5))
    assert trial.sample_rate == pytest.approx(500.0)


def test_a_force_of_several_columns_is_their_weighted_sum():
    force = {
        "columns": ["volts", "pulse"], "components": ["motor"], "unit": "V",
        "calibration_n_per_v": [[35.0, 1.0]], "zero_v": [0.1, 0.0],
    }  # fmt: skip
    table = columns()
    table["volts"] = table.pop("force_x")
    table["pulse"] = np.where(np.arange(N) % 200 < 100, 40.0, 0.0)
    trial = cleaned(table, session=session_from({**TABLE, "force": force}, Path()))
    wanted = 35.0 * (table["volts"] - 0.1) + table["pulse"]
    np.testing.assert_allclose(trial.columns["force_motor"], wanted)


def coarse_and_quiet(_):
    noise = 0.0005 * np.random.default_rng(1).normal(size=N)
    return 2e-3 * np.round((0.004 * np.sin(np.arange(N) / 60.0) + noise) / 2e-3)


@pytest.mark.parametrize(
    ("column", "change"),
    [
        ("force_x", coarse_and_quiet),
        ("force_x", lambda x: np.minimum(x, np.sort(x)[-10])),  # clipped for ten samples
        ("yaw", lambda _: 600.0 * np.maximum(np.arange(N) - 1450, 0)),  # after a long rest
    ],
)
def test_what_looks_like_a_rail_or_a_jump_and_is_none_is_left(column, change):
    table = columns()
    assert cleaned(table | {column: change(table[column])}).repairs == []


def test_turns_wraps_and_missing_samples():
    table = columns()
    table["turn"] = np.linspace(0, 14, N)
    wrapped = cleaned({**table, "turn": np.mod(table["turn"] + np.pi, 2 * np.pi) - np.pi})
    assert "wraps at a full turn 2 times" in wrapped.repairs[0]
    np.testing.assert_allclose(wrapped.columns["q_turn"], table["turn"], atol=1e-9)
    table = columns()
    table["yaw"] = np.mod(table["yaw"], 2**16)
    table["yaw"][[0, 375, 376, 1000]] = np.nan
    in_steps = TABLE["encoders"] | {"yaw": {"column": "yaw", "unit": "0.05mrad"}}
    for session in (SESSION, session_from({**TABLE, "encoders": in_steps}, Path())):
        trial = cleaned(table, session=session)
        assert "1 row with missing samples at the ends dropped" in trial.repairs
        assert "column 'yaw': 3 missing samples interpolated" in trial.repairs
        assert np.abs(np.diff(trial.columns["q_yaw"])).max() < 0.01
    table = columns(500)
    assert len(cleaned(table).t) == 500
    with pytest.raises(InputError, match=r"499 samples over 0\.998 s, less than 1 s"):
        cleaned({name: values[:499] for name, values in table.items()})


@pytest.mark.parametrize(("rate_hz", "stamp_s"), [(94.0, 1e-3), (400.0, 1e-3), (4000.0, 1e-4)])
def test_the_rate_is_that_of_the_samples_whatever_stamps_are_rounded_to(rate_hz, stamp_s):
    t = np.rint(np.arange(3000) / rate_hz / stamp_s) * stamp_s
    kept = np.ones(t.size, dtype=bool)
    kept[[700, 1500, 1501]] = False
    assert rate_of(t[kept]) == pytest.approx(rate_hz, rel=1e-3)


def test_a_trial_is_a_stretch_of_a_record():
    table = {**TABLE, "trials": [{"file": "a.csv", "kind": "free", "start_s": 0.5, "end_s": 2.0}]}
    session = session_from(table, Path())
    whole = columns()
    trial = cleaned(columns(), session=session)
    assert len(trial.t) == 750 and trial.t[0] == 0.0 and trial.repairs == []
    np.testing.assert_allclose(trial.columns["q_turn"], whole["turn"][250:1000])
    assert trial.notes == ["from 0.5 to 2 s of the record"]
    table["trials"][0] = {"file": "a.csv", "kind": "free", "start_s": 3.0}
    with pytest.raises(InputError, match=r"after the last sample, at 2\.998 s"):
        cleaned(columns(), session=session_from(table, Path()))


def test_an_unsigned_register_is_read_as_signed():
    channel = {"column": "pwm", "unit": "", "scale": 0.5, "wrap_bits": 16}
    session = session_from({**TABLE, "channels": {"duty": channel}}, Path())
    signed = np.rint(300 * np.sin(np.arange(N) / 40.0))
    raw = columns() | {"pwm": np.where(signed < 0, signed + 65536, signed)}
    raw["pwm"][np.flatnonzero(np.diff(np.sign(signed)))[3]] = np.nan
    trial = cleaned(raw, session=session)
    np.testing.assert_allclose(trial.columns["duty"], 0.5 * signed, atol=3.0)
    with pytest.raises(InputError, match="expected 0 to 65535"):
        cleaned(columns() | {"pwm": signed}, session=session)


def test_limits_and_long_gaps_are_heeded_and_interpolation_follows_the_stamps():
    table = columns()
    table["force_x"][100:107] = np.nan
    with pytest.raises(InputError, match=r"b\.csv, row 102, column 'force_x': 7 samples in a row"):
        cleaned(table, kind=1)  # a locked trial is used as a whole
    assert cleaned(table).dead[0].missing
    lenient = cleaned(table, limits=CleaningLimits(nan_run=7))
    assert "7 missing samples interpolated" in lenient.repairs[0]
    table = columns()
    table["turn"][400:500] = np.nan
    table["force_x"][500:520] = np.nan
    trial = cleaned(table)
    assert [(one.column, one.missing) for one in trial.dead] == [("turn", True), ("force_x", True)]
    assert trial.dead[0].start_s < trial.t[400] - 0.05 and trial.dead[0].end_s > trial.t[499] + 0.05
    assert np.isfinite(trial.columns["q_turn"]).all()
    table["turn"][400:800] = np.nan
    with pytest.raises(InputError, match=r"400 samples in a row are missing.*start_s and end_s"):
        cleaned(table)
    table = columns()
    table["time_us"][500:] += 2000
    table["turn"] = table["time_us"] * 1e-6
    expected = table["turn"].copy()
    table["turn"][499:502] = np.nan
    np.testing.assert_allclose(cleaned(table).columns["q_turn"], expected, atol=1e-12)


def test_a_force_that_is_zeroed_anew_sets_the_trial_aside():
    t = np.arange(N) / 500.0
    q = 0.8 * np.sin(4.0 * t) + 0.3 * np.sin(9.0 * t)
    noise = 0.01 * np.random.default_rng(1).standard_normal(N)
    force = 0.2 * np.gradient(np.gradient(q, t), t) + 2.0 * np.sin(q) + noise
    table = columns() | {"turn": q, "force_x": force}
    assert cleaned(table).repairs == []
    table["force_x"] = force + 0.7 * (t >= 1.2)
    with pytest.raises(InputError, match=r"jumps and stays there.*end_s and start_s = 1\.2 in"):
        cleaned(table)
    table["force_x"] = 0.05 * np.sign(np.sin(40.0 * t)) + 0.7 * (t >= 1.2)  # by commands
    session = session_from({**TABLE, "force": {"columns": ["force_x"], "unit": "N"}}, Path())
    assert cleaned(table, session=session).repairs == []


DAMAGE = st.lists(
    st.tuples(
        st.sampled_from(list(columns(4))),
        st.integers(0, N - 1),
        st.integers(1, 40),
        st.sampled_from(["nan", "inf", "zero", "hold", "jump", "flip", "huge"]),
    ),
    max_size=6,
)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(DAMAGE, st.integers(1, N), st.integers(0, 1))
def test_what_comes_through_is_sound_and_what_changed_is_said(damages, length, kind):
    table = columns()
    for name, start, size, how in damages:
        part = slice(start, start + size)
        values = table[name]
        put = {"nan": np.nan, "inf": np.inf, "zero": 0.0, "hold": values[start], "huge": 1e300}
        if how == "jump":
            values[start:] += 30_000
        else:
            values[part] = put.get(how, values[part][::-1].copy())  # "flip"
    table = {name: values[:length] for name, values in table.items()}
    try:
        trial = cleaned(table, kind)
    except InputError as error:
        assert str(error).startswith(SESSION.trials[kind].file) and "\n" not in str(error)
        return
    assert (np.diff(trial.t) > 0).all() and trial.t[0] == 0 and trial.t[-1] >= 0.99
    for name, values in trial.columns.items():
        assert np.isfinite(values).all() and len(values) == len(trial.t), name
    assert np.abs(np.diff(trial.columns["q_yaw"])).max() < 0.5
    if len(trial.t) != length:
        assert trial.repairs


def test_a_fast_log_is_thinned_without_folding_noise_into_what_is_kept():
    rate, every = 5000.0, 5
    t = np.arange(20_000) / rate
    swing, whistle = np.sin(2 * np.pi * 30 * t), np.sin(2 * np.pi * 1030 * t)
    switched = np.repeat([0.0, 1.0, 0.0, 2.0], 5000)
    fast = CleanTrial(
        t, {"force_x": swing + whistle, "q_yaw": whistle, "current": switched}, rate, ["as it was"]
    )
    slow = thin(fast, every, ())
    assert slow.sample_rate == 1000.0 and slow.repairs == ["as it was"]
    np.testing.assert_array_equal(slow.t, t[::every])
    inner = slice(20, -20)  # a low-pass has no past or future at the ends
    np.testing.assert_allclose(slow.columns["force_x"][inner], swing[::every][inner], atol=3e-3)
    np.testing.assert_array_equal(slow.columns["q_yaw"], whistle[::every])
    np.testing.assert_array_equal(slow.columns["current"], switched[::every])


@pytest.mark.parametrize("every", [2, 5])
def test_white_noise_is_white_after_thinning(every):
    noise = np.random.default_rng(1).normal(size=200_000)
    trial = CleanTrial(np.arange(noise.size) / 2e3, {"force_x": noise}, 2e3)
    thinned = thin(trial, every, ()).columns["force_x"]
    assert thinned.std() == pytest.approx(every**-0.5, rel=0.02)
    for lag in (1, 2, 3):
        assert abs(np.corrcoef(thinned[lag:], thinned[:-lag])[0, 1]) < 0.02


@pytest.mark.parametrize(
    ("announced", "fastest", "every"),
    [(500.0, 1000.0, 1), (1999.0, 1000.0, 1), (2000.0, 1000.0, 2), (5000.0, 0.0, 1)],
)
def test_only_logs_of_twice_the_rate_or_more_are_thinned(announced, fastest, every):
    assert thinning_factor(announced, fastest) == every
