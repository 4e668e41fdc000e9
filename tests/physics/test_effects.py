"""One battery over every effect of the registry, at every target on the BAM, or else elsewhere.

Each is finite, dissipative if it says so, absent at zero strength, and recovered by least squares
from what it does along a motion, starting from a wrong guess. `test_units` holds its units, and
`test_generated_code` that the functions which simulate do the same.
"""

import re
from functools import cache

import numpy as np
import pytest
from motions import random_inputs, random_motion, residual, smooth_motion
from motions import typical_parameters as typical
from scipy.optimize import least_squares

from bampipe.physics import Model, compile_model, registry

BAM = registry.device("bam")
CASES = [
    f"{name}:{target}" if target else name
    for name in registry.effect_names()
    for target in registry.effect(name).targets(BAM)
]
# What the BAM has no motor or coil for, and what acts otherwise on devices that have.
ELSEWHERE = [
    *(
        f"slider/{name}"
        for name in (
            "torque_ripple:carriage", "actuator_lag:motor", "actuator_delay", "force_delay",
            "drive_sag:carriage", "flexible_load:carriage", "loose_load:carriage",
            "loose_drive:carriage",
        )
    ),
    *(
        f"magnetic_damper/{name}"
        for name in ("channel_lag:current", "channel_saturation:current", "hysteresis:piston")
    ),
]  # fmt: skip
# Through the poses, play is code of its own on every axis, and takes long to compile.
SECOND_PLAY = ("backlash:pitch", "backlash:extension")
TRIED = [
    *(pytest.param(c, marks=[pytest.mark.long] * (c in SECOND_PLAY)) for c in CASES),
    *ELSEWHERE,
]


def effect_of(case):
    return registry.effect(case.rpartition("/")[2].partition(":")[0])


def belongs(parameter, case):
    """Whether a parameter of the model is one of the effect."""
    return parameter.name.startswith(case.rpartition("/")[2].replace(":", "."))


@cache
def system_of(case, bare=False):
    machine, _, name = case.rpartition("/")
    return compile_model(Model(registry.device(machine or "bam"), () if bare else (name,)))


def contribution(case, p_of):
    """What the effect adds to the residual along the smooth motion, (T, n_q)."""
    with_effect, base = system_of(case), system_of(case, bare=True)
    p = p_of(with_effect)
    changed = residual(with_effect, p, smooth_motion(with_effect))
    return changed - residual(base, p[: len(base.parameters)], smooth_motion(base))


@pytest.mark.parametrize("name", registry.effect_names())
def test_says_what_a_user_needs(name):
    effect = registry.effect(name)
    assert effect.summary and effect.looks_like and effect.on_the_machine
    assert re.search(r"1[6-9]\d\d|20\d\d", effect.source), "the source names a year"
    for target in effect.targets(BAM)[:1]:
        bound = Model(BAM, [f"{name}:{target}" if target else name]).effects[0]
        assert any(p.strength for p in bound.parameters)
        for p in bound.parameters:
            if p.strength:
                assert p.prior == 0 and p.typical and p.sd > 0
            elif not p.fixed:
                assert p.lower < p.typical < p.upper and np.isfinite([p.lower, p.upper]).all()


# Values -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", TRIED)
def test_finite_everywhere(case):
    system = system_of(case)
    n, rng = 400, np.random.default_rng(7)
    q, qd, qdd = random_motion(system.model.device, n, 7, speed=3.0)
    qdd *= 10.0
    u, z = (
        random_inputs(system, n, 8),
        rng.normal(size=(n, len(system.memory_names + system.changes))),
    )
    u *= rng.choice([1.0, 10.0, 1e3], n)[:, None]
    for rows in (slice(0, 40), slice(20, 80)):  # standstill, and no load
        qd[rows] = 0.0
        u[rows.stop - 20 : rows.stop] = 0.0
    ends = [typical(system), typical(system, 0.0), system.prior]
    for side in ("lower", "upper"):
        end = typical(system, 2.0)
        for i, p in enumerate(system.parameters):
            if np.isfinite(getattr(p, side)):
                end[i] = getattr(p, side)
        ends.append(end)
    for p in ends:
        assert np.isfinite(system.required(q, qd, qdd, z, u, p)).all()
        assert np.isfinite(system.applied(q, qd, qdd, z, u, p)).all()
        assert np.isfinite(system.initial_memory(q[0], qd[0], u[0], p)).all()


@pytest.mark.parametrize("case", [c for c in CASES + ELSEWHERE if effect_of(c).dissipative])
def test_dissipative_as_claimed(case):
    qd, rng = smooth_motion(system_of(case))[1], np.random.default_rng(11)
    for _ in range(2):

        def draw(system):
            p = typical(system)
            for i, one in enumerate(system.parameters):
                top = min(one.upper, 3 * p[i])
                if belongs(one, case) and not one.fixed:
                    p[i] = rng.uniform(max(one.lower, 0.0), top)
            return p

        assert (contribution(case, draw) * qd).max() < 1e-9


@pytest.mark.parametrize("case", TRIED)
def test_absent_at_zero_strength_and_there_at_typical(case):
    there = np.abs(contribution(case, typical)).max()
    left = np.abs(contribution(case, lambda system: typical(system, 0.0))).max()
    assert there > 0.2
    # A lag is never shorter than 2 ms, so that its rate stays finite; all others vanish.
    assert left <= (0.04 * there if effect_of(case).states else 1e-9)


# Recovery ---------------------------------------------------------------------------------------


PLACES = ("", "yaw", "x", "xy", "yaw-extension")
SECOND = ("extension", "z")
# Impacts across play need forces that go with the motion: play is found on simulated sessions, and
# `test_machine_effects` has the flight of what is loose in closed form.
RECOVERED = [
    pytest.param(c, marks=[pytest.mark.long] * (place in SECOND))
    for c, place in ((c, c.partition(":")[2]) for c in CASES if not c.startswith("backlash"))
    if place in (*PLACES, *SECOND)
]
RECOVERED += [case for case in ELSEWHERE if "loose" not in case]


@pytest.mark.parametrize("case", RECOVERED)
def test_recovered_from_a_wrong_guess(case):
    system = system_of(case)
    truth = typical(system)
    along = smooth_motion(system)
    goal = residual(system, truth, along)
    free = [i for i, p in enumerate(system.parameters) if not p.fixed]
    own = [i for i in free if belongs(system.parameters[i], case)]
    lower = np.array([system.parameters[i].lower for i in free])
    upper = np.array([system.parameters[i].upper for i in free])
    # A wave is only found from within half a ripple over the travel, a stop from where it is run
    # into, the end of a gas from beyond the travel, a resonance from near it: the
    # diagnosis scans all four.
    factor = {"wavenumber": 0.85, "position": 0.98, "end": 0.95, "flexible_load.frequency": 0.97}
    names = [system.parameters[i].name.split(".") for i in free]
    ends = [f"{own[0]}.{own[-1]}" if "flexible_load" in own else own[-1] for own in names]
    near = np.array([factor.get(end, 0.6) for end in ends])
    guess = np.where(np.isin(free, own), near, 1.3) * truth[free]

    def misfit(values):
        p = truth.copy()
        p[free] = values
        return (residual(system, p, along) - goal)[::4].ravel()

    before = np.sqrt(np.mean(misfit(guess) ** 2))
    found = least_squares(
        misfit, np.clip(guess, lower, upper), bounds=(lower, upper), x_scale="jac", max_nfev=60
    )
    after = np.sqrt(np.mean(found.fun**2))
    assert after < 0.02 * before
    # What is absent has no relative error.
    near = [1e-9 if truth[i] else 0.01 * system.parameters[i].sd for i in free]
    assert (np.abs(found.x - truth[free]) <= near + 0.03 * np.abs(truth[free])).all()


def test_dry_friction_is_what_turns_with_the_motion_of_an_axis():
    dry = {name for name in registry.effect_names() if registry.effect(name).is_dry_friction}
    assert {"presliding", "maxwell_slip", "stribeck", "load_dependent_friction"} <= dry
    assert dry.isdisjoint({"brake_lag", "return_spring", "handle_payload", "force_bias"})
