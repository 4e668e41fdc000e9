"""One battery over every effect of the registry, at every target on the BAM.

Each is finite, dissipative if it says so, absent at zero strength, and recovered by least squares
from what it does along a motion, starting from a wrong guess. `test_units` holds its units, and
`test_generated_code` that the functions which simulate do the same.
"""

import re
from functools import cache

import numpy as np
import pytest
from motions import of_mechanism
from motions import typical_parameters as typical
from scipy.optimize import least_squares

from bampipe.physics import Model, compile_model, registry

BAM = registry.device("bam")
AXES = tuple(c.name for c in BAM.coordinates)
CASES = [
    f"{name}:{target}" if target else name
    for name in registry.effect_names()
    for target in registry.effect(name).targets(BAM)
]
CANONICAL = """
stribeck presliding asymmetric_coulomb quadratic_drag position_dependent_friction
load_dependent_friction thermal_damping return_spring inertia_mismatch handle_payload base_tilt
gravity_compensator_lag gravity_compensator_rate_limit gravity_compensator_mistuned brake_lag
brake_residual_torque transmission_compliance backlash force_bias force_gain force_crosstalk
force_delay force_drift force_application_point encoder_scale shear_thinning upper_stop lower_stop
maxwell_slip unbalance friction_by_pose
"""


def effect_of(case):
    return registry.effect(case.partition(":")[0])


@cache
def system_of(*effects):
    return compile_model(Model(BAM, effects))


def inputs_of(system, force, force_rate, force_curvature, brake, t):
    """Columns of u for ``system`` from all that there may be."""
    columns = {"t": t}
    for j, c in enumerate("xyz"):
        columns[f"force_{c}"] = force[:, j]
        columns[f"force_rate_{c}"] = force_rate[:, j]
        columns[f"force_curvature_{c}"] = force_curvature[:, j]
        # 250 Hz, the rate of `smooth_motion`.
        columns[f"force_third_{c}"] = 250.0 * np.gradient(force_curvature[:, j])
        lower = columns[f"force_third_{c}"]
        for order in ("fourth", "fifth", "sixth"):
            lower = columns[f"force_{order}_{c}"] = 250.0 * np.gradient(lower)
    columns |= {f"brake_{a}": brake[:, i] for i, a in enumerate(AXES)}
    return np.column_stack([columns[name] for name in system.inputs])


@cache
def smooth_motion():
    """A made-up smooth motion with loads: q, qd, qdd, then what `inputs_of` takes."""
    rng = np.random.default_rng(3)
    t = np.arange(1500) / 250.0
    frequency = 2 * np.pi * rng.uniform(0.1, 1.2, size=(9, 12))
    angle = frequency[:, :, None] * t + rng.uniform(0, 6.28, size=(9, 12, 1))
    size = rng.normal(size=(9, 12, 1)) / (1 + frequency[:, :, None] / 3)
    size *= np.array([0.25, 0.2, 0.07, 8, 6, 8, 6, 6, 6])[:, None, None]
    wave = (size * np.sin(angle)).sum(axis=1).T
    rate = (size * frequency[:, :, None] * np.cos(angle)).sum(axis=1).T
    bend = -(size * frequency[:, :, None] ** 2 * np.sin(angle)).sum(axis=1).T
    q = wave[:, :3] + np.array([0.0, 0.0, 1.1])
    rest = (wave[:, 3:6], rate[:, 3:6], bend[:, 3:6], np.abs(wave[:, 6:]), t)
    return q, rate[:, :3], bend[:, :3], rest


def residual_of(system, p, q, qd, qdd, u, t):
    at = of_mechanism(system, q, qd, qdd, u, p, t)
    z = system.memory(*at, u, p, t)
    return system.applied(*at, z, u, p) - system.required(*at, z, u, p)


def contribution(case, p_of):
    """What the effect adds to the residual along the smooth motion, (T, n_q)."""
    q, qd, qdd, rest = smooth_motion()
    with_effect, base = system_of(case), system_of()
    p = p_of(with_effect)
    changed = residual_of(with_effect, p, q, qd, qdd, inputs_of(with_effect, *rest), rest[-1])
    plain = p[: len(base.parameters)]
    return changed - residual_of(base, plain, q, qd, qdd, inputs_of(base, *rest), rest[-1])


def test_every_canonical_name_is_there():
    assert set(CANONICAL.split()) <= set(registry.effect_names())


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


@pytest.mark.parametrize("case", CASES)
def test_finite_everywhere(case):
    system = system_of(case)
    rng = np.random.default_rng(7)
    n = 400
    limits = np.array([BAM.limits[a] for a in AXES])
    q = rng.uniform(*limits.T, size=(n, 3))
    qd, qdd = rng.normal(size=(n, 3)) * 3, rng.normal(size=(n, 3)) * 30
    force, brake = rng.normal(size=(n, 3)) * 60, rng.uniform(0, 200, size=(n, 3))
    for rows in (slice(0, 40), slice(20, 80)):  # standstill, and no load
        qd[rows] = 0.0
        force[rows.stop - 20 : rows.stop] = 0.0
    brake[::3] = 0.0
    slope = (rng.normal(size=(n, 3)) * 500, rng.normal(size=(n, 3)) * 5e3)
    u = inputs_of(system, force, *slope, brake, rng.uniform(0, 3600, size=n))
    z = rng.normal(size=(n, len(system.memory_names)))
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
        assert np.isfinite(system.initial_memory(q[0], u[0], p)).all()


@pytest.mark.parametrize("case", [c for c in CASES if effect_of(c).dissipative])
def test_dissipative_as_claimed(case):
    _, qd, _, _ = smooth_motion()
    rng = np.random.default_rng(11)
    for _ in range(2):

        def draw(system):
            p = typical(system)
            for i, one in enumerate(system.parameters):
                top = min(one.upper, 3 * p[i])
                if one.name.startswith(case.replace(":", ".")) and not one.fixed:
                    p[i] = rng.uniform(max(one.lower, 0.0), top)
            return p

        assert (contribution(case, draw) * qd).max() < 1e-9


def test_an_active_effect_would_be_caught():
    active = registry.effect_from(
        {**registry.effect("stribeck").declaration, "name": "push", "torque": "force*sgn(qd)"}
    )
    system = compile_model(Model(BAM, ["push:yaw"], [active]))
    q, qd, qdd, rest = smooth_motion()
    p, none = typical(system), np.zeros((len(q), 0))
    base = system.required(q, qd, qdd, none, inputs_of(system, *rest), typical(system, 0.0))
    added = base - system.required(q, qd, qdd, none, inputs_of(system, *rest), p)
    assert (added * qd).max() > 0.1


@pytest.mark.parametrize("case", CASES)
def test_absent_at_zero_strength_and_there_at_typical(case):
    there = np.abs(contribution(case, typical)).max()
    left = np.abs(contribution(case, lambda system: typical(system, 0.0))).max()
    assert there > 0.2
    # A lag is never shorter than 2 ms, so that its rate stays finite; all others vanish.
    assert left <= (0.04 * there if effect_of(case).states else 1e-9)


# Recovery ---------------------------------------------------------------------------------------


PLACES = ("", "yaw", "x", "xy", "yaw-extension")
ELSEWHERE = ("extension", "z")
# Impacts across play need forces that go with the motion: it is found on simulated sessions.
RECOVERED = [
    pytest.param(c, marks=[pytest.mark.long] * (place in ELSEWHERE))
    for c, place in ((c, c.partition(":")[2]) for c in CASES if not c.startswith("backlash"))
    if place in (*PLACES, *ELSEWHERE)
]


@pytest.mark.parametrize("case", RECOVERED)
def test_recovered_from_a_wrong_guess(case):
    system = system_of(case)
    truth = typical(system)
    q, qd, qdd, rest = smooth_motion()
    along = q, qd, qdd, inputs_of(system, *rest), rest[-1]
    goal = residual_of(system, truth, *along)
    free = [i for i, p in enumerate(system.parameters) if not p.fixed]
    own = [i for i in free if system.parameters[i].name.startswith(case.replace(":", "."))]
    lower = np.array([system.parameters[i].lower for i in free])
    upper = np.array([system.parameters[i].upper for i in free])
    # A wave is only found from within half a ripple over the travel, and a stop from where it is
    # run into: the diagnosis scans both.
    factor = {"wavenumber": 0.85, "position": 0.98}
    ends = [system.parameters[i].name.rpartition(".")[2] for i in free]
    near = np.array([factor.get(end, 0.6) for end in ends])
    guess = np.where(np.isin(free, own), near, 1.3) * truth[free]

    def misfit(values):
        p = truth.copy()
        p[free] = values
        return (residual_of(system, p, *along) - goal)[::4].ravel()

    before = np.sqrt(np.mean(misfit(guess) ** 2))
    found = least_squares(
        misfit, np.clip(guess, lower, upper), bounds=(lower, upper), x_scale="jac", max_nfev=60
    )
    after = np.sqrt(np.mean(found.fun**2))
    assert after < 0.02 * before
    np.testing.assert_allclose(found.x, truth[free], rtol=0.03)


def test_dry_friction_is_what_turns_with_the_motion_of_an_axis():
    dry = {name for name in registry.effect_names() if registry.effect(name).is_dry_friction}
    assert {"presliding", "maxwell_slip", "stribeck", "load_dependent_friction"} <= dry
    assert dry.isdisjoint({"brake_lag", "return_spring", "handle_payload", "force_bias"})
