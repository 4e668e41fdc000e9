"""Ingest over logs as other labs keep them: units, clocks, velocities, dialects."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from independent import joint

from bampipe.data.run_folder import RunFolder
from bampipe.data.store import read_parquet
from bampipe.data.units import unit
from bampipe.errors import InputError
from bampipe.files import read_json
from bampipe.progress import silent
from bampipe.stages import ingest

HEAD = """
schema = "bampipe.session/1"
session_id = "arm"
device = "joint.toml"
sample_rate_hz = {rate}
[time]
{time}
[encoders]
joint = {{ {encoder} }}
[channels]
current = {{ {current} }}
[[trials]]
file = "log.csv"
kind = "free"
"""
RATE = 100.0
RNG = np.random.default_rng(5)
JITTER = np.cumsum(0.01 + RNG.uniform(-0.003, 0.003, 1000))
T = JITTER - JITTER[0]
Q, QD = 0.5 * np.sin(2 * T), np.cos(2 * T)
I = 1.2 * np.sin(3 * T)  # noqa: E741


def ingested(
    folder: Path, text: str, *, time: str, encoder: str, current: str, trial: str = ""
) -> tuple[pd.DataFrame, pd.Series, dict]:
    """Samples, the trial's row and session.json of a session over one log."""
    folder.mkdir(exist_ok=True)
    (folder / "joint.toml").write_text(joint.DEVICE)
    (folder / "log.csv").write_text(text)
    session = HEAD.format(rate=RATE, time=time, encoder=encoder, current=current)
    (folder / "session.toml").write_text(session + trial)
    out = folder / "out"
    ingest.execute(RunFolder(out), out, ingest.Config(session=str(folder)), silent)
    trials = read_parquet(out / "ingest/trials.parquet")
    samples = read_parquet(out / "ingest/samples.parquet")
    return samples, trials.iloc[0], read_json(out / "ingest/session.json")


def log(columns: dict[str, np.ndarray], delimiter=",", decimal=".", form="{:.6f}") -> str:
    rows = [delimiter.join(columns)]
    for cells in zip(*columns.values(), strict=True):
        row = [c if isinstance(c, str) else form.format(c).replace(".", decimal) for c in cells]
        rows.append(delimiter.join(row))
    return "\n".join(rows) + "\n"


PLAIN = {"encoder": 'column = "q", unit = "rad"', "current": 'column = "i", unit = "A"'}


def check(samples: pd.DataFrame, trial: pd.Series) -> None:
    assert trial["status"] == "ok"
    np.testing.assert_allclose(samples["t"], T, atol=2e-6)
    np.testing.assert_allclose(samples["q_joint"], Q, atol=2e-5)
    np.testing.assert_allclose(samples["current"], I, atol=2e-5)


def test_degrees_milliamperes_and_decimal_commas(tmp_path):
    columns = {"zeit [ms]": T * 1e3, "winkel [deg]": np.rad2deg(Q), "strom [mA]": 1e3 * I}
    samples, trial, about = ingested(
        tmp_path,
        log(columns, ";", ","),
        time='column = "zeit [ms]"\nunit = "ms"',
        encoder='column = "winkel [deg]", unit = "deg"',
        current='column = "strom [mA]", unit = "mA"',
    )
    check(samples, trial)
    assert about["channels"]["current"]["unit"] == "A"
    assert "decimal commas" in trial["repairs"]
    assert "time stamps jitter by" in trial["repairs"] and "cubic spline" in trial["repairs"]


@pytest.mark.parametrize(
    ("stamps", "unit"),
    [
        (T, "s"), (1.79e9 + T, "s"), (np.rint(T * 1e9), "ns"),
        (1_790_000_000_000_000 + np.rint(T * 1e6), "us"),
        ([f"2026-10-03T10:12:{t:09.6f}" for t in T], "datetime"),
        ([f"03.10.2026 10:12:{t:09.6f}" for t in T], 'datetime"\nformat = "%d.%m.%Y %H:%M:%S.%f'),
    ],
)  # fmt: skip
def test_clocks(tmp_path, stamps, unit):
    time, text = f'column = "t"\nunit = "{unit}"', log({"t": stamps, "q": Q, "i": I})
    samples, trial, _ = ingested(tmp_path, text, time=time, **PLAIN)
    check(samples, trial)


def test_seconds_and_nanoseconds_in_two_columns(tmp_path):
    stamps = 1_790_000_000_250_000_000 + np.rint(T * 1e9).astype(int)
    form = {"sec": [str(s // 10**9) for s in stamps], "nano": [str(s % 10**9) for s in stamps]}
    text = log({**form, "q": Q, "i": I})
    time = 'column = "sec"\nunit = "s"\nnanoseconds = "nano"'
    samples, trial, _ = ingested(tmp_path, text, time=time, **PLAIN)
    check(samples, trial)
    with pytest.raises(InputError, match=r'time\.nanoseconds: only for unit = "s"'):
        ingested(tmp_path, text, time=time.replace('"s"', '"ms"'), **PLAIN)


def test_a_velocity_for_want_of_a_position_is_integrated(tmp_path):
    text = log({"t": T, "w": QD * 60 / (2 * np.pi), "i": I}, form="{:.9f}")
    encoder = 'column = "w", unit = "rev/min"'
    clock, turning = 'column = "t"\nunit = "s"', PLAIN | {"encoder": encoder}
    samples, trial, about = ingested(tmp_path, text, time=clock, **turning)
    np.testing.assert_allclose(samples["q_joint"], Q - Q[0], atol=3e-4)
    assert "position is the integral of the velocity 'w'" in trial["repairs"]
    in_hertz = log({"t": T, "w [Hz]": QD / (2.0 * np.pi), "i": I})
    turning = PLAIN | {"encoder": 'column = "w [Hz]", unit = "rev/s"'}
    found = ingested(tmp_path / "b", in_hertz, time=clock, **turning)[0]
    np.testing.assert_allclose(found["q_joint"], Q - Q[0], atol=3e-4)
    joint = about["axes"]["joint"]
    assert joint["unit"] == "rad" and joint["resolution_stated"] is None
    assert 0.0 < joint["resolution"] < 1e-6
    with pytest.raises(InputError, match="makes the column a velocity; leave it out"):
        turning = PLAIN | {"encoder": f"{encoder}, counts_per_unit = 3"}
        ingested(tmp_path, text, time=clock, **turning)


def test_samples_that_are_counted(tmp_path):
    samples, trial, _ = ingested(tmp_path, log({"q": Q, "i": I}), time='unit = "samples"', **PLAIN)
    np.testing.assert_allclose(samples["t"], np.arange(1000) / RATE, atol=1e-12)
    assert trial["repairs"] == "no time stamps: samples counted at 100 Hz"


@pytest.mark.parametrize(
    ("velocity", "said"),
    [
        ('{ column = "v", unit = "rad/s" }', ""),
        ('{ column = "v", unit = "deg/s" }', "set aside: .*is 0.017.* times the change of 'q'"),
        ('{ column = "i", unit = "rad/s" }', "is used for 2 channels"),
        ('{ column = "w", unit = "rad/s" }', "set aside: .*is -1.* times the change of 'q'"),
        ('{ column = "n", unit = "rad/s" }', "is not the velocity of joint"),
        ('{ column = "v", unit = "m/s" }', 'found "m/s", expected a unit of velocity'),
    ],
)
def test_a_recorded_velocity_checks_the_position(tmp_path, velocity, said):
    noise = RNG.normal(size=1000)
    text = log({"t": T, "q": Q, "v": QD, "w": -QD, "n": noise, "i": I})
    encoder = f'column = "q", unit = "rad", velocity = {velocity}'
    options = {"time": 'column = "t"\nunit = "s"', "encoder": encoder, "current": PLAIN["current"]}
    if said.startswith(("set aside", "is used", "found")):
        with pytest.raises(InputError, match=said.removeprefix("set aside: ")):
            ingested(tmp_path, text, **options)
        return
    samples, trial, _ = ingested(tmp_path, text, **options)
    check(samples, trial)
    assert list(samples) == ["trial_id", "t", "q_joint", "current"]
    assert (said in trial["repairs"]) and ("velocity" in trial["repairs"]) == bool(said)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"encoder": 'column = "q [deg]", unit = "rad"'}, "gives the unit deg, session.toml rad"),
        ({"current": 'column = "i [mA]", unit = "A"'}, "gives the unit mA, session.toml A"),
        ({"time": 'column = "t [s]"\nunit = "ms"'}, "gives the unit s, session.toml ms"),
        ({"current": 'column = "i [mA]", unit = "V"'}, "channels.current.unit: a unit of V, but"),
        ({"time": 'column = "t [s]"\nunit = "samples"'}, "time.column: given although unit"),
        ({"time": 'unit = "s"'}, "time: 'column' is missing"),
        ({"trial": 'units = { "q [deg]" = "s" }'}, "has s, which is not converted to deg"),
        ({"time": 'column = "t [s]"\nunit = "s"\nformat = "%S"'}, 'only for unit = "datetime"'),
        ({"encoder": 'column = "q [deg]", unit = "counts"'}, "expected a unit of rad, m, rad"),
    ],
)
def test_units_that_contradict_the_file_are_refused(tmp_path, change, said):
    text = log({"t [s]": T, "q [deg]": np.rad2deg(Q), "i [mA]": 1e3 * I})
    right = {
        "time": 'column = "t [s]"\nunit = "s"',
        "encoder": 'column = "q [deg]", unit = "deg"',
        "current": 'column = "i [mA]", unit = "mA"',
    }
    check(*ingested(tmp_path / "right", text, **right)[:2])
    usual = {"encoder": 'column = "q [deg]", unit = "rad"', "trial": 'units = {"q [deg]" = "deg"}'}
    check(*ingested(tmp_path / "own", text, **right | usual)[:2])
    with pytest.raises(InputError) as caught:
        ingested(tmp_path / "wrong", text, **{**right, **change})
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "si", "scale"),
    [
        ("Nm", "N.m", 1.0), ("mNm", "N.m", 1e-3), ("N*mm", "N.m", 1e-3), ("kN", "N", 1e3),
        ("mm/s", "m/s", 1e-3), ("°", "rad", np.pi / 180), ("rpm", "rad/s", np.pi / 30),
        ("[deg/s]", "rad/s", np.pi / 180), ("µs", "s", 1e-6), ("mA", "A", 1e-3),
        ("degC", "K", 1.0), ("-", "", 1.0), ("%", "", 0.01), ("m/s²", "m/s2", 1.0),
        ("nm", "m", 1e-9), ("MN", "N", 1e6), ("lbf", "N", 4.4482216152605),
        ("13.5mA", "A", 0.0135), ("[2.69 mA]", "A", 2.69e-3), ("0.5 deg", "rad", np.pi / 360),
        ("Ncm", "N.m", 0.01), ("turns/s", "rad/s", 2 * np.pi), ("in", "m", 0.0254),
        ("lb", "N", 4.4482216152605), ("kip", "N", 4448.2216152605), ("0.1%", "", 1e-3),
        ("N-m", "N.m", 1.0), ("Newton meters", "N.m", 1.0), ("kg.cm", "N.m", 0.0980665),
        ("oz-in", "N.m", 7.0615518e-3), ("ft-lb", "N.m", 1.3558179), ("rad s^-1", "rad/s", 1.0),
        ("degrees per second", "rad/s", np.pi / 180), ("m·s⁻²", "m/s2", 1.0),
        ("0.229rpm", "rad/s", 0.229 * np.pi / 30), ("deg/10", "rad", np.pi / 1800),
        ("U/min", "rad/s", np.pi / 30), ("gon", "rad", np.pi / 200), ("daN", "N", 10.0),
        ("grados", "rad", np.pi / 180), ("10^-3 s", "s", 1e-3), ("NM", "N.m", 1.0),
        ("N・m", "N.m", 1.0), ("ncm", "N.m", 0.01), ("mnm", "N.m", 1e-3),
        ("seconds since 2026-03-01 10:00:00", "s", 1.0), ("microns", "m", 1e-6),
        ("kp", "N", 9.80665), ("kgfcm", "N.m", 0.0980665), ("Grad", "rad", np.pi / 180),
        ("10⁻² N·m", "N.m", 0.01), ("×10⁻³ rad", "rad", 1e-3), ("min⁻¹", "rad/s", np.pi / 30),
    ],
)  # fmt: skip
def test_units_of_logs(text, si, scale):
    found = unit(text)
    assert found.si == si and found.scale == pytest.approx(scale)


@pytest.mark.parametrize(
    "text",
    [
        "counts", "ticks", "furlong", "N.m.s/rad", "q", "m m m", "2", "1/s", "0 mA", "3e",
        "20 degC", "m1", "Nm*1000", "10-2 Nm",
    ],
)  # fmt: skip
def test_units_that_are_not_known(text):
    assert unit(text) is None
