"""Which method's parameters are published, and what is said of the others."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from independent.person import Task
from independent_runs import record_run

from bampipe.estimate.least_squares import Problem
from bampipe.estimate.low_pass import Band
from bampipe.files import read_json
from bampipe.identification.estimates import Estimate
from bampipe.identification.method_choice import Judged, choose, prefer_steady

TIMID = Task({"joint": {"low": -0.3, "high": 0.3, "slow": 0.34, "fast": 0.4}}, {}, 15.0)
"""Strokes that hardly leave the middle."""


def result(run, stage):
    """One JSON result of the bare model."""
    return read_json(run.root / f"models/base/{stage}.json")


def test_a_damper_whose_motion_the_filter_loses_is_identified(tmp_path):
    """The filter gave 1,400 for a gain of 400, and least squares the bias of a useless replay."""
    run, truth = record_run(tmp_path, "damper", 501)
    found, judged = result(run, "identify"), result(run, "validate")
    assert found["method"] == "least-squares"
    for name, value in truth.items():
        entry = found["parameters"][name]
        assert abs(entry["estimate"] - value) < 4.0 * entry["sd"], name
        if name != "mass":
            assert entry["estimate"] == pytest.approx(value, rel=0.03), name
    assert judged["axes"]["piston"]["estimate"] == "accepted"
    lost = found["methods"]["ukf"]
    assert lost["held_out_rmse"]["piston"] > 5.0 * judged["axes"]["piston"]["held_out_rmse"]
    assert "viscous_gain" in lost["disagrees"]
    assert found["notes"][0].startswith("Published by least squares, not by the unscented filter: ")
    # A bench prescribes the motion and is replayed with it: the bias of filtering is small.
    gain = found["parameters"]["viscous_gain"]
    assert abs(gain["least_squares_bias"]) < 0.02 * gain["estimate"]


@pytest.mark.parametrize(("machine", "seed"), [("axis", 503), ("joint", 502)])
def test_machines_that_stand_still_are_published_right(tmp_path, machine, seed):
    """Dry friction that holds a machine leads the filter astray, and not the force."""
    run, truth = record_run(tmp_path, machine, seed, creep=False, seconds=8.0)
    found = result(run, "identify")
    for name, value in truth.items():
        entry = found["parameters"][name]
        assert abs(entry["estimate"] - value) < 4.0 * entry["sd"], name
    published = found["methods"][found["method"]]["held_out_rmse"]
    for tried in found["methods"].values():
        for axis, error in tried.get("held_out_rmse", published).items():
            assert published[axis] < 1.2 * error
    assert all(a["estimate"] == "accepted" for a in result(run, "validate")["axes"].values())


FORCE = SimpleNamespace(name="stribeck.slide.force", strength=True, shape=False, lower=0.0)
SLIDE = SimpleNamespace(
    coordinates=("slide",), undriven=(), parameters=(FORCE,),
    model=SimpleNamespace(effects=(SimpleNamespace(parameters=(FORCE,)),)),
)  # fmt: skip
"""A model of one parameter, the strength of an effect."""


def judged(method, error, value, *doubts, sd=0.1, bias=0.0, published=0.0):
    """One parameter by one method, its held-out error, and that of what it publishes."""
    one = np.ones(1)
    problem = Problem(
        lambda trial, p: one, 1, np.array([0]), -one, one, one, True, one > 0.0,
        Band(100.0, (8.0,)), (), np.zeros(1), np.zeros(1),
    )  # fmt: skip
    return Judged(
        Estimate(
            method, np.array([value, 0.0]), problem, np.array([[sd**2]]), one > 2.0, (), doubts,
            ({"least_squares_bias": bias},), {}, lambda: None,
        ),
        error * one,
        max(published, 0.9 * error) * one,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("filtered", "squares", "published"),
    [
        ((1.0, 5.0), (1.0, 5.0), 0),
        ((1.01, 7.0), (1.0, 5.0), 0),  # predicts as well: the more precise
        ((1.1, 7.0), (1.0, 5.0), 1),  # predicts worse, with other parameters
        ((1.1, 5.1), (1.0, 5.0), 0),  # the same parameters
        ((1.3, 5.1), (1.0, 5.0), 1),  # would be refused
        ((1.0, 5.0, "it is on a bound"), (1.01, 5.0), 1),
        ((1.0, 5.0, "it is on a bound"), (1.1, 7.0), 0),  # in doubt, but nothing is better
    ],
)
def test_the_filter_is_published_where_it_predicts_as_well(filtered, squares, published):
    both = [judged("ukf", *filtered), judged("least-squares", *squares)]
    assert choose(SLIDE, both) == published


def test_parameters_that_do_not_explain_their_own_trials_are_not_published():
    """What the filter had found without each trial was right; a late sample threw it off."""
    thrown_off = judged("ukf", 1.0, 5.0, published=3.0)
    both = [thrown_off, judged("least-squares", 1.01, 5.05)]
    assert choose(SLIDE, both) == 1
    assert prefer_steady(SLIDE, both, 1) == 1


@pytest.mark.parametrize(
    ("sd", "bias", "published"),
    [
        (0.1, 0.3, 1),
        (0.1, 3.0, 0),  # more than half of it is a correction
        (4.0, 0.3, 0),  # uncertain by its own size
    ],
)
def test_an_effect_that_least_squares_leave_open_does_not_speak_against_the_filter(
    sd, bias, published
):
    both = [judged("ukf", 1.1, 15.0), judged("least-squares", 1.0, 5.0, sd=sd, bias=bias)]
    assert choose(SLIDE, both) == published


@pytest.mark.parametrize(
    ("scattered", "error", "doubts", "published"),
    [
        (0.12, 1.0, (), 0),
        (0.4, 1.0, (), 1),  # thrown off: its blocks scatter
        (0.4, 1.3, (), 0),  # least squares predict worse
        (0.4, 1.0, ("no bias was taken off",), 0),
    ],
)
def test_a_filter_that_scatters_is_not_the_more_precise(scattered, error, doubts, published):
    both = [
        judged("ukf", 1.0, 5.0, sd=scattered), judged("least-squares", error, 5.0, *doubts)
    ]  # fmt: skip
    assert choose(SLIDE, both) == 0
    assert prefer_steady(SLIDE, both, 0) == published


@pytest.mark.parametrize(("smoothing", "published"), [(0.25, 0), (0.5, 1)])
def test_a_filter_that_hangs_on_how_friction_changes_its_sign_is_not_the_more_precise(
    smoothing, published
):
    unsure = judged("ukf", 1.0, 5.0, sd=np.hypot(0.1, smoothing))
    unsure = replace(
        unsure, estimate=replace(unsure.estimate, details=({"smoothing_sd": smoothing},))
    )
    both = [unsure, judged("least-squares", 1.0, 5.0)]
    assert prefer_steady(SLIDE, both, 0) == published


def test_after_one_reversal_threw_the_filter_off_least_squares_are_published(tmp_path):
    """Its uncertainty was seven times that of least squares, and its errors five times theirs."""
    run, truth = record_run(tmp_path, "joint", 8003, trials=0, seconds=15.0, tasks=(TIMID,) * 4)
    found = result(run, "identify")
    assert found["method"] == "least-squares"
    for name, value in truth.items():
        entry = found["parameters"][name]
        assert abs(entry["estimate"] - value) < 3.0 * entry["sd"], name
    for name in ("moment_across", "offset"):
        entry = found["parameters"][name]
        assert entry["sd"] < 2.0 * entry["bound_sd"], name


def test_an_axis_that_nothing_drives_has_no_say():
    system = SimpleNamespace(coordinates=("pole",), undriven=("pole",))
    assert choose(system, [judged("ukf", 2.0, 7.0), judged("least-squares", 1.0, 5.0)]) == 0
