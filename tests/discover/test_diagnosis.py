"""The diagnosis of short replays with known truth, where a simulator of its own does not serve."""

import re
from dataclasses import replace

import numpy as np
import pytest
from sessions import bam, made

from bampipe.discover.bench import Bench
from bampipe.discover.chance import fit_trials, system_of
from bampipe.discover.description import describe
from bampipe.discover.diagnosis import diagnose
from bampipe.discover.settings import Settings
from bampipe.estimate.simulation import Runaway

QUICK = Settings(replicates=5, jobs=2)

SNAG = {
    "name": "snag",
    "summary": "A cable snags near one yaw position",
    "scope": "axis",
    "kind": "torque",
    "torque": "-height*exp(-((q - place)/width)**2)",
    "looks_like": "a bump at one position",
    "source": "made up for a test",
    "parameters": {
        "height": {"unit": "N.m", "prior": 0.0, "sd": 1.0, "strength": True},
        "place": {"unit": "rad", "prior": 0.0, "sd": 0.3, "lower": -0.6, "upper": 0.6},
        "width": {"unit": "rad", "prior": 0.05, "sd": 0.05, "lower": 0.02, "upper": 0.2},
    },
}
SNAGGED = {"snag.yaw.height": 1.6, "snag.yaw.place": 0.22, "snag.yaw.width": 0.07}


def verdicts(found):
    return [axis.verdict for axis in found.axes]


def run(session, recipe=None):
    recipe = recipe or bam()
    return diagnose(session, recipe, system_of(recipe).prior, QUICK)


@pytest.mark.long
def test_an_effect_that_no_mechanism_could_have_is_left_out(monkeypatch):
    recipe = bam(["stribeck:yaw"])
    session = made(recipe, {"stribeck.yaw.force": 1.1, "stribeck.yaw.speed": 0.05})
    replicas = Bench.replicas

    def moved(bench, recipe, *arguments, **more):
        if "stribeck:yaw" in recipe.effects:
            raise Runaway("the simulated motion grows without bounds")
        return replicas(bench, recipe, *arguments, **more)

    monkeypatch.setattr(Bench, "replicas", moved)
    found = run(session)
    assert "stribeck:yaw" not in found.selected
    assert found.axes[0].verdict != "nothing_missing"


@pytest.mark.long
def test_an_effect_outside_the_library_is_unknown_until_its_file_is_given():
    session = made(bam(["snag:yaw"], [SNAG]), SNAGGED)
    found = run(session)
    assert verdicts(found)[0] == "unknown_effect"
    assert found.selected == ()
    words = describe(found.evidence, 0, QUICK)
    assert "position" in words and "bump" in words
    with_file = run(session, bam([], [SNAG]))
    assert with_file.selected == ("snag:yaw",)
    values = with_file.ranking[0].parameters
    assert values["snag.yaw.place"] == pytest.approx(0.22, abs=0.02)
    assert with_file.axes[0].rmse_after < 1.2 * with_file.axes[0].noise_floor


@pytest.mark.long
def test_what_a_named_effect_leaves_is_said_to_remain():
    recipe = bam(["return_spring:yaw", "snag:yaw"], [SNAG])
    values = SNAGGED | {
        "snag.yaw.height": 0.5,
        "return_spring.yaw.stiffness": 7.0,
        "return_spring.yaw.offset": 0.5,
    }
    found = run(made(recipe, values))
    assert found.selected == ("return_spring:yaw",)
    assert [axis.remains for axis in found.axes] == [True, False, False]


def test_one_trial_cannot_be_diagnosed():
    session = made(bam(), {}, trials=1)
    with pytest.raises(ValueError, match="two trials"):
        diagnose(session, bam(), np.zeros(7))


def test_the_same_session_gives_the_same_numbers_with_one_process_or_two():
    session = made(bam(), {}, trials=2, seconds=5.0)
    one = diagnose(session, bam(), system_of(bam()).prior, Settings(replicates=4, jobs=1))
    two = diagnose(session, bam(), system_of(bam()).prior, Settings(replicates=4, jobs=2))
    assert [r.p_value for r in one.ranking] == [r.p_value for r in two.ranking]
    assert [a.noise_floor for a in one.axes] == [a.noise_floor for a in two.axes]


RIPPLE = {
    "name": "ripple",
    "summary": "A torque that ripples with position",
    "scope": "axis",
    "kind": "torque",
    "torque": "height*sin(wavenumber*q)",
    "looks_like": "periodic in position",
    "source": "made up for a test",
    "parameters": {
        "height": {"unit": "N.m", "prior": 0.5, "sd": 1.0},
        "wavenumber": {"unit": "1/rad", "prior": 25.0, "sd": 1.0},
    },
}
HUM = RIPPLE | {
    "name": "hum",
    "summary": "A vibration from outside",
    "torque": "height*sin(frequency*t)",
    "parameters": {
        "height": {"unit": "N.m", "prior": 0.5, "sd": 1.0},
        "frequency": {"unit": "rad/s", "prior": 17.0, "sd": 1.0},
    },
}


@pytest.mark.parametrize(
    ("effect", "pattern", "truth"),
    [
        (
            RIPPLE,
            r"a ripple of \S+ N.m along position that repeats every (\S+) rad",
            2 * np.pi / 25.0,
        ),
        (HUM, r"a vibration of \S+ N.m at (\S+) Hz in time", 17.0 / (2 * np.pi)),
    ],
)
def test_the_period_of_an_unknown_effect_is_said(effect, pattern, truth):
    session = made(bam([f"{effect['name']}:yaw"], [effect]), {})
    evidence = fit_trials(session, bam(), system_of(bam()).prior)
    said = re.match(pattern, describe(evidence, 0, QUICK))
    assert said
    assert float(said[1]) == pytest.approx(truth, rel=0.03)


def test_noise_within_the_band_is_no_vibration():
    session = made(bam(), {}, seconds=2.0)
    evidence = fit_trials(session, bam(), system_of(bam()).prior)
    rng, band = np.random.default_rng(3), session.band
    said = []
    for _ in range(20):
        noise = [rng.normal(size=m.q.shape) for m in session.motions]
        noisy = replace(evidence, residual=band.thin_trials(noise, [0, 1, 2]))
        said.append(describe(noisy, 0, QUICK))
    assert sum("vibration" in sentence for sentence in said) <= 1
