"""Free runs and their drift, of models whose error is known, and only of trials that count."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from independent_runs import record_trials

from bampipe.diagnosis.session import system_of
from bampipe.identification import free_run
from bampipe.identification.free_run import HORIZONS_S, find_drift
from bampipe.physics import Model, compile_model, registry
from bampipe.trials.motion import Motion

MASS, DT = 50.0, 1e-3
SLIDER = compile_model(Model(registry.device("slider")))


def motion(seconds: float = 10.0, size: float = 0.1) -> Motion:
    """A carriage on a sine, and the force that moves it without friction."""
    t = np.arange(0.0, seconds, DT)
    rate = 2.0 * np.pi * 0.7
    q = size * np.sin(rate * t)[:, None]
    qd = rate * size * np.cos(rate * t)[:, None]
    qdd = -(rate**2) * q
    channels = {name: np.zeros(t.size) for name in SLIDER.inputs}
    return Motion("t01", t, q, qd, qdd, qd * 0.0, {**channels, "force_motor": MASS * qdd[:, 0]})


def parameters(**values: float) -> np.ndarray:
    chosen = {"mass": MASS, **values}
    return np.array([chosen.get(p.name.partition(".")[0], 0.0) for p in SLIDER.parameters])


def test_a_constant_force_that_is_wrong_drifts_with_the_square_of_time():
    """An offset c makes the carriage leave by c t² / 2 m."""
    found = find_drift(SLIDER, [motion()], [parameters(offset=0.4)], [True])["carriage"]
    assert [h.horizon_s for h in found.horizons] == list(HORIZONS_S) and not found.reason
    for h in found.horizons:
        known = 0.4 * h.horizon_s**2 / (2.0 * MASS)
        assert h.median == pytest.approx(known, rel=0.01)
        assert h.quantile_90 == pytest.approx(known, rel=0.02)
    right = find_drift(SLIDER, [motion()], [parameters()], [True])["carriage"]
    assert max(h.median for h in right.horizons) < 1e-5


def test_friction_that_builds_up_within_micrometres_does_not_run_away():
    stiff = compile_model(Model(registry.device("slider"), ("presliding:carriage",)))
    friction = {"coulomb.carriage": 20.0, "presliding.carriage.force": 20.0}
    values = {"mass": MASS, **friction, "presliding.carriage.distance": 4e-5}
    p = np.array([values.get(item.name, 0.0) for item in stiff.parameters])
    trial = motion(seconds=4.0)
    pushed = trial.channels["force_motor"] + 20.0 * np.sign(trial.qd[:, 0])
    trial = replace(trial, channels={**trial.channels, "force_motor": pushed})
    found = find_drift(stiff, [trial], [p], [True])["carriage"]
    assert not found.reason and found.horizons[0].median < 1e-6


def test_only_what_means_something_is_judged():
    trials, wrong = [motion(), motion()], parameters(offset=0.4)
    found = find_drift(SLIDER, trials, [parameters(), wrong], [True, False])["carriage"]
    assert max(h.median for h in found.horizons) < 1e-5
    assert find_drift(SLIDER, trials, [wrong, wrong], [False, False])["carriage"].horizons

    def reason(trial: Motion, **values: float) -> tuple[int, str]:
        found = find_drift(SLIDER, [trial], [parameters(**values)], [True])["carriage"]
        return len(found.horizons), found.reason

    held = replace(motion(), q=motion().q * 0.0, qd=motion().qd * 0.0)
    assert reason(held) == (0, "The axis moves in only 0 windows of 0.1 s.")
    count, why = reason(motion(), viscous=-5e6)
    assert count == 0 and "diverges" in why
    count, why = reason(motion(), offset=20.0)
    assert count == 2 and why == "Within 2 s the model drifts farther than the axis moves."
    count, why = reason(motion(seconds=1.2))
    assert count == 2 and why == "The axis moves in only 0 windows of 2 s."
    damper = compile_model(Model(registry.device("magnetic_damper")))
    found = find_drift(damper, [], [], [])
    assert all("prescribes" in entry.reason and not entry.horizons for entry in found.values())


def test_the_true_model_stays_close_to_an_independent_simulator(tmp_path):
    """And drifts away where a number is wrong: twice as far where a mass is wrong by 5 %."""
    trials, spec, truth = record_trials(tmp_path, "axis", 21)
    system = system_of(spec)
    right = np.array([truth[p.name] for p in system.parameters])
    wrong = right * np.where([p.name == "mass" for p in system.parameters], 1.05, 1.0)
    judged = [True] * len(trials.motions)
    near, far = (
        find_drift(system, trials.motions, [p] * len(judged), judged)["carriage"].horizons
        for p in (right, wrong)
    )
    for h, w in zip(near, far, strict=True):
        assert h.median < 0.01 * h.displacement
        assert w.median > 2.0 * h.median
    again = find_drift(system, trials.motions, [right] * len(judged), judged)["carriage"]
    assert again.horizons == near


def test_of_more_trials_than_starts_each_of_so_many_has_one(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(free_run, "_STARTS", 12)
    trials = [motion(seconds=4.0)] * 30
    found = find_drift(SLIDER, trials, [parameters()] * 30, [True] * 30)["carriage"]
    assert found.horizons[0].windows == 12


def test_in_closed_loop_only_judged_trials_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """A trial that was fitted is followed to 1 %, one held out to 20 %, in position and command."""
    off = {"fitted": 1.01, "held": 1.2}

    def closed(run: Any, system: Any, motion: Any, p: Any, law: Any) -> free_run._Run:
        motion_of = np.sin(np.linspace(0.0, 6.0, 50))[:, None]
        both, factor = np.hstack([motion_of, motion_of]), off[motion.trial_id]
        return free_run._Run(
            motion.trial_id, both, factor * both, motion_of, factor * motion_of
        )  # fmt: skip

    monkeypatch.setattr(free_run, "_run_closed_loop", closed)
    monkeypatch.setattr(free_run, "_why_not_closed", lambda *_: "")
    monkeypatch.setattr(free_run, "why_not_free", lambda *_: "")
    monkeypatch.setattr(free_run, "compile_law", lambda _: SimpleNamespace())
    device = SimpleNamespace(prescribed=False, forces=("force_motor",))
    system: Any = SimpleNamespace(
        model=SimpleNamespace(device=device), coordinates=("axis",), coordinate_units=("m",)
    )
    motions: Any = [SimpleNamespace(trial_id=name) for name in off]
    run: Any = None
    for judged, expected in (((False, True), 20.0), ((True, False), 1.0)):
        found = free_run.free_runs(run, system, motions, [np.ones(1)] * 2, judged)
        assert found.mode == "closed_loop" and set(found.trials) == set(off)
        assert found.axes["axis"].relative_error_percent == pytest.approx(expected)
        assert found.forces["force_motor"].relative_error_percent == pytest.approx(expected)
