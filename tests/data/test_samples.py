"""Samples as loggers store them: held rows, coarse and rolling clocks, sign bits, rails."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bampipe.data.guesses import find_register, find_turning
from bampipe.data.quality import CleaningLimits, CleanTrial, clean
from bampipe.data.quality.clock import find_fresh_rows, spread_stamps, unroll
from bampipe.data.readers.trial import RawTrial
from bampipe.data.session import session_from

RATE, N = 500.0, 6000
T = np.arange(N) / RATE


def moved(t: np.ndarray) -> np.ndarray:
    return 0.9 * np.sin(2.1 * t) + 0.4 * np.sin(5.3 * t + 1.0)


def torque(t: np.ndarray) -> np.ndarray:
    """Of a pendulum with friction on that motion, N.m, with noise of 0.01."""
    q = moved(t)
    qd = np.gradient(q, t)
    noise = np.random.default_rng(3).normal(0.0, 0.01, len(t))
    friction = 0.3 * np.tanh(qd / 0.01) + 0.2 * qd
    return 0.05 * np.gradient(qd, t) + friction + 2.0 * np.sin(q) + noise


def cleaned(columns: dict[str, np.ndarray], **tables: Any) -> CleanTrial:
    """Clean a trial of the columns t, q and u; ``tables`` replace those of the session file."""
    session = session_from(
        {
            "schema": "bampipe.session/1", "session_id": "s", "device": "any",
            "sample_rate_hz": RATE, "time": {"column": "t", "unit": "s"},
            "encoders": {"joint": {"column": "q", "unit": "rad"}},
            "force": {"columns": ["u"], "components": ["drive"], "unit": "N.m"},
            "trials": [{"file": "a.csv", "kind": "free"}],
        }
        | tables,
        Path(),
    )  # fmt: skip
    held = {name: np.array(values, dtype=float) for name, values in columns.items()}
    raw = RawTrial(held, np.arange(2, 2 + len(held["q"])))
    return clean(raw, session, session.trials[0], CleaningLimits())


@pytest.mark.parametrize(
    ("where", "scale", "period"),
    [
        ("32 bits", 1.0, 2.0**32), ("32 bits", 1e-3, 1e-3 * 2.0**32), ("24 bits", 1.0, 2.0**24),
        ("16 bits", 1.0, 2.0**16), ("midnight", 1e-3, 86_400.0),
    ],
)  # fmt: skip
def test_a_clock_that_rolls_over_goes_on(where: str, scale: float, period: float):
    t = scale * (np.arange(4000) * 37.0 + np.random.default_rng(1).integers(0, 9, 4000))
    rolled = np.mod(t + period - t[2000], period)
    found, of, rows = unroll(rolled)
    assert of == where and 2000 in rows and len(rows) == int(np.sum(np.diff(rolled) < 0.0))
    np.testing.assert_allclose(np.diff(found), np.diff(t), atol=1e-3 * scale)
    # A recording that starts anew is no counter.
    assert unroll(np.tile(np.arange(2000) * 5000.0 * scale, 2))[1] == ""


@pytest.mark.parametrize("rounding", [0.001, 0.01, 0.5, 1.0])
def test_stamps_of_too_few_digits_are_spread_to_the_true_times(rounding: float):
    t = 17.3 + np.arange(4000) / 483.0
    found, of = spread_stamps(np.floor(t / rounding) * rounding)
    assert of == pytest.approx(rounding, rel=1e-6)
    assert np.ptp(found - t) < max(0.1 * rounding, 2e-4)


@pytest.mark.parametrize("damage", ["lost", "jitter", "twice", "one step"])
def test_stamps_that_are_fine_enough_stand(damage: str):
    rng, rows = np.random.default_rng(2), np.arange(4000)
    if damage == "lost":
        rows = np.delete(rows, rng.integers(1, 3999, 40))
    t = rows / 500.0
    if damage == "jitter":
        t = t + rng.uniform(0.0, 1e-3, len(t))
    if damage == "twice":
        t[100] = t[99]
    if damage == "one step":  # fits any rate
        t = np.floor(t / 5.0)
    found, of = spread_stamps(t)
    assert of == 0.0 and found is t


def test_lost_rows_of_coarse_stamps_stay_lost():
    t = np.delete(np.arange(8000), slice(3000, 3600)) / 1000.0
    found, of = spread_stamps(np.floor(t / 0.01) * 0.01)
    assert of > 0.0 and np.abs(found - t).max() < 0.01


@pytest.mark.parametrize(("every", "rests"), [(5, False), (5, True), (8, False), (1.28, False)])
def test_held_rows_are_taken_at_the_true_rate(every: float, rests: bool):
    t = np.arange(8000) / 1000.0
    taken = np.floor(np.floor(np.arange(8000) / every) * every) / 1000.0
    q = moved(np.minimum(taken, 5.0) if rests else taken)
    kept = find_fresh_rows([q])
    assert kept is not None and len(kept) == pytest.approx(8000 / every, rel=0.01)
    trial = cleaned({"t": t, "q": q, "u": torque(t)})
    assert trial.sample_rate == pytest.approx(1000.0 / every, rel=0.01)
    assert f"{1 - 1 / every:.0%} of the rows repeat the positions" in trial.repairs[0]
    expected = moved(np.minimum(trial.t, 5.0) if rests else trial.t)
    np.testing.assert_allclose(trial.columns["q_joint"], expected, atol=5e-3 if every < 2 else 1e-9)


@pytest.mark.parametrize("step", [1e-5, 2e-3, 2e-2])
def test_an_encoder_that_moves_slowly_is_not_held(step: float):
    q = step * np.rint(moved(0.3 * T) / step)
    assert find_fresh_rows([q]) is None


def test_sign_and_magnitude_is_seen_and_read():
    counts = np.rint(650.0 * moved(T)).astype(int)
    for bit in (10, 15):
        load = np.where(counts < 0, 2**bit - counts, counts).astype(float)
        register = find_register(load)
        assert register is not None and register.sign_bit == bit and not register.bits
        np.testing.assert_array_equal(register.signed(load), counts)
    two = find_register(np.mod(counts, 65536.0))
    assert two is not None and two.bits == 16
    for plain in (counts - counts.min(), np.mod(counts - counts.min(), 4096), np.abs(counts)):
        assert find_register(plain.astype(float)) is None
    trial = cleaned(
        {"t": T, "q": load, "u": torque(T), "load": load},
        encoders={"joint": {"column": "q", "counts_per_unit": 650, "unit": "rad", "sign_bit": 15}},
        channels={"load": {"column": "load", "unit": "", "scale": 0.001, "sign_bit": 15}},
    )
    np.testing.assert_allclose(trial.columns["q_joint"], counts / 650.0)
    np.testing.assert_allclose(trial.columns["load"], 0.001 * counts)


def test_what_a_count_is_worth_shows_in_the_weight():
    q = moved(T)
    found = find_turning(T, 2000.0 * q + 512.0, torque(T))
    assert found is not None and abs(found.size - 2000.0) < 3.0 * found.sd < 100.0
    assert abs(found.zero - 512.0) < 40.0
    yaw = torque(T) - 2.0 * np.sin(q)
    assert find_turning(T, 2000.0 * q, yaw) is None and find_turning(T, q, yaw + 2.0 * q) is None


def test_readings_at_a_rail_are_left_out_and_a_command_at_its_limit_is_not():
    q, u = moved(T), torque(T)
    clipped = cleaned({"t": T, "q": q, "u": np.clip(u, -1.5, 1.5)})
    at_rail = np.abs(u) >= 1.5
    share = np.mean([np.any([d.start_s <= t <= d.end_s for d in clipped.dead]) for t in T])
    assert share == pytest.approx(at_rail.mean(), abs=0.01)
    (said,) = clipped.repairs
    assert f"{at_rail.mean():.1%} of the samples stand at the rail -1.5 and 1.5" in said
    # The same machine, driven by what it takes: its motor has no more to give.
    force = np.clip(1.6 * np.sin(3.0 * T) + 0.5 * np.sin(7.1 * T), -1.2, 1.2)
    q, qd = np.zeros(N), 0.0
    for k in range(N - 1):
        friction = 0.2 * qd + 0.1 * np.tanh(qd / 0.01)
        qd += (force[k] - friction - 0.8 * np.sin(q[k])) / 0.05 / RATE
        q[k + 1] = q[k] + qd / RATE
    driven = cleaned({"t": T, "q": q, "u": force})
    assert np.mean(np.abs(force) == 1.2) > 0.1 and driven.dead == [] and driven.repairs == []


def test_ticks_and_levers_become_seconds_and_torques():
    columns = {"t": np.mod(np.rint(T * 8000.0) + 2.0**32 - 9000.0, 2.0**32), "q": moved(T)}
    trial = cleaned(
        columns | {"u": torque(T) / 0.31},
        time={"column": "t", "unit": "ticks", "ticks_per_s": 8000.0},
        force={"columns": ["u"], "components": ["drive"], "unit": "N", "lever_m": 0.31},
    )
    np.testing.assert_allclose(trial.t, T, atol=1e-9)
    np.testing.assert_allclose(trial.columns["force_drive"], torque(T), atol=1e-12)
    assert trial.repairs == ["clock rolls over at 32 bits once, first at row 565: unrolled"]
