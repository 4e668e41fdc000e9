"""Effects that meet on one channel or axis act in their order, on what the one before leaves."""

import tomllib
from itertools import combinations

import numpy as np
import pytest
import sympy as sp
from motions import with_values
from scipy.signal import lfilter

from bampipe.physics import Model, compile_model, registry
from bampipe.physics.derivation import derive

RATE = 1000.0
T = np.arange(2000) / RATE


def pairs(machine, places):
    """Pairs of effects of ``machine`` that meet at one of ``places``."""
    device = registry.device(machine)
    for place in places:
        met = [
            f"{name}:{target}" if target else name
            for name in registry.effect_names()
            for target in registry.effect(name).targets(device)
            if target in ("", *place)
        ]
        yield from ((machine, a, b) for a, b in combinations(met, 2))


def kind_of(name):
    """What decides where an effect acts, and on what."""
    e = registry.effect(name.partition(":")[0])
    by_load = bool(e.terms & {"applied", "load", "side"})
    way = (e.kind, e.scope, e.acting_link, bool(e.states))
    return (*way, "dry" in e.names, e.uses_weight, "pull" in e.terms, e.pulls, by_load)


# Of the arm, what meets on one reading and one encoder; of the others, everything.
PAIRS = [
    *pairs("magnetic_damper", [("piston", "current", "load_cell")]),
    *pairs("slider", [("carriage", "motor")]),
    *(p for p in pairs("bam", [("x", "xy")]) if "force" in p[1] and "force" in p[2]),
    ("bam", "base_tilt", "handle_payload"),
    ("bam", "encoder_scale:yaw", "transmission_compliance:yaw"),
]


def one_a_kind(machine):
    """Of the effects that meet on a machine, the first of each kind."""
    met = (effect for where, *both in PAIRS if where == machine for effect in both)
    kinds = {}
    for effect in met:
        kinds.setdefault(kind_of(effect), effect)
    return [*kinds.values()]


def numbers(equations, model):
    """Every function of the model at one made-up state, effects at their typical size."""
    rng = np.random.default_rng(3)
    at = {s: float(rng.uniform(0.3, 0.8)) for s in (*equations.q, *equations.qd, *equations.qdd)}
    at |= {s: float(rng.uniform(0.5, 1.5)) for s in sorted(equations.u, key=str)}
    at |= dict.fromkeys(equations.w, 0.0)
    for symbol, p in zip(equations.p, model.parameters, strict=True):
        at[symbol] = p.prior if p.typical is None else p.typical
    states = {n: rng.uniform(0.2, 0.4) for n in sorted(equations.z_names)}
    at |= {z: states[n] for z, n in zip(equations.z, equations.z_names, strict=True)}
    groups = [equations.applied, equations.other_now, equations.bias, equations.offset,
              equations.offset_rate]  # fmt: skip
    rates = dict(zip(equations.z_names, equations.rates, strict=True))
    expressions = [*(e for group in groups for e in group), *(rates[n] for n in sorted(rates))]
    return np.array(sp.lambdify(list(at), expressions, "numpy")(*at.values()), dtype=float)


@pytest.mark.parametrize(
    ("machine", "effects"),
    [
        *((machine, one_a_kind(machine)) for machine in ("magnetic_damper", "slider", "bam")),
        *(pytest.param(machine, both, marks=pytest.mark.long) for machine, *both in PAIRS),
    ],
)
def test_order_of_adding_does_not_matter(machine, effects):
    """Turned round, every two of several effects have changed places."""
    device = registry.device(machine)
    found = []
    for names in (effects, effects[::-1]):
        model = Model(device, names)
        found.append(numbers(derive(model), model))
    assert np.isfinite(found[0]).all()
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9, atol=1e-12)


def motion(system, **channels):
    """Two seconds of a made-up smooth motion of one coordinate, with given channels."""
    w = 2 * np.pi * 1.3
    q, qd, qdd = (0.02 * w**k * np.sin(w * T + k * np.pi / 2)[:, None] for k in range(3))
    known = {"t": T, **channels}
    u = np.column_stack([known.get(name, np.zeros(T.size)) for name in system.inputs])
    return q, qd, qdd, u


def forces(system, p, at):
    """Applied and required force, (T,) each, along ``at`` with parameters by name."""
    *true, u = at
    values = np.array([p.get(x.name, 0.0) for x in system.parameters])
    z = system.memory(*true, u, values, T)
    return (f(*true, z, u, values)[:, 0] for f in (system.applied, system.required))


def lagged(x, time_constant, shortest):
    """What follows ``x`` with a first-order lag, linear between samples.

    No lag is shorter than ``shortest``; a longer one is hardly changed by it.
    """
    time_constant = 0.5 * (time_constant + np.hypot(time_constant, 2.0 * shortest))
    a = np.exp(-1.0 / RATE / time_constant)
    ramp = 1.0 - (1.0 - a) * time_constant * RATE
    return lfilter([ramp, 1.0 - a - ramp], [1.0, -a], x, zi=[x[0] * (1.0 - ramp)])[0]


@pytest.mark.parametrize("order", [1, -1])
def test_the_coil_of_a_damper_saturates_with_the_current_that_has_come(order):
    names = ["channel_lag:current", "channel_saturation:current"][::order]
    system = compile_model(Model(registry.device("magnetic_damper"), names))
    current = 1.0 + np.sin(2 * np.pi * 2.0 * T)
    p = {
        "channel_lag.current.time_constant": 0.04,
        "channel_saturation.current.bend": 0.5,
        "channel_saturation.current.sharpness": 2.0,
        "viscous_gain": 400.0,
        "coulomb_gain": 250.0,
    }
    at = motion(system, current=current)
    _, needed = forces(system, p, at)
    coil = lagged(current, 0.04, 0.0002)
    field = coil / np.sqrt(1.0 + (0.5 * coil) ** 2)
    speed = at[1][:, 0]
    expected = field * (400.0 * speed + 250.0 * np.tanh(speed / 2e-3))
    np.testing.assert_allclose(needed, expected, atol=0.02)


def test_a_reading_is_corrected_before_it_lags_and_the_gears_carry_what_is_delivered():
    effects = ["load_dependent_friction:carriage", "drive_sag:carriage", "actuator_lag:motor",
               "force_gain:motor", "force_bias:motor"]  # fmt: skip
    system = compile_model(Model(registry.device("slider"), effects))
    asked = 200.0 * np.sin(2 * np.pi * 1.7 * T + 0.4)
    p = {
        "force_gain.motor.error": 0.1,
        "force_bias.motor.bias": 12.0,
        "actuator_lag.motor.time_constant": 0.03,
        "drive_sag.carriage.sag": 0.002,
        "load_dependent_friction.carriage.coefficient": 0.2,
    }
    at = motion(system, force_motor=asked / 0.9 + 12.0)
    applied, needed = forces(system, p, at)
    torque = lagged(asked, 0.03, 0.0001)
    np.testing.assert_allclose(applied, torque, atol=0.01)
    delivered = torque / (1.0 + 0.002 * np.abs(torque))
    sign = np.tanh(at[1][:, 0] / system.model.device.coordinates[0].sign_width)
    expected = torque - delivered + 0.2 * np.abs(delivered) * sign
    np.testing.assert_allclose(needed, expected, atol=0.01)


def test_delays_of_sensor_and_motor_add_up():
    system = compile_model(Model(registry.device("slider"), ["actuator_delay", "force_delay"]))
    w = 2 * np.pi * 3.0
    names = ("", "_rate", "_curvature", "_third", "_fourth", "_fifth", "_sixth")
    channels = {
        f"force{n}_motor": w**k * np.sin(w * T + k * np.pi / 2) for k, n in enumerate(names)
    }
    p = {"actuator_delay.delay": 0.02, "force_delay.delay": 0.012}
    applied, _ = forces(system, p, motion(system, **channels))
    np.testing.assert_allclose(applied, np.sin(w * (T - 0.008)), atol=1e-6)


def test_a_force_that_leaks_is_scaled_after_its_zero_is_taken_off():
    effects = ["force_gain:x", "force_crosstalk:xy", "force_bias:x", "force_bias:y"]
    system = compile_model(Model(registry.device("bam"), effects))
    zero, gain = np.array([1.5, -2.0, 0.0]), np.array([[1.08, 0.05, 0], [0, 1, 0], [0, 0, 1]])
    values = {"force_bias.x.bias": zero[0], "force_bias.y.bias": zero[1],
              "force_crosstalk.xy.leak": 0.05, "force_gain.x.error": 1.0 - 1.0 / 1.08}  # fmt: skip
    p = with_values(system, values)
    true = np.random.default_rng(1).normal(size=(20, 3)) * 10.0
    read = true @ gain.T + zero
    column = {f"force_{c}": read[:, k] for k, c in enumerate("xyz")}
    u = np.column_stack([column.get(name, np.zeros(20)) for name in system.inputs])
    q = np.tile([0.1, 0.3, 1.0], (20, 1))
    none = np.zeros((20, 0))
    found = system.applied(q, 0 * q, 0 * q, none, u, p)
    expected = true * [np.cos(0.3), 1.0, 1.0]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_a_payload_weighs_on_a_tilted_base_too():
    device = registry.device("bam")
    system = compile_model(Model(device, ["handle_payload", "base_tilt"]))
    tilt_x, tilt_z, payload = 1e-3, -2e-3, 0.4
    values = {"base_tilt.tilt_x": tilt_x, "base_tilt.tilt_z": tilt_z}
    p = with_values(system, values | {"handle_payload.payload": payload})

    def potential(q):
        """Height of rod and payload along the vertical, from their places on the tilted base."""
        yaw, pitch, extension = q
        along = np.array([np.cos(pitch) * np.sin(yaw), np.sin(pitch), np.cos(pitch) * np.cos(yaw)])
        up = np.array([tilt_z, 1.0, -tilt_x])
        return 9.81 * (3.56 * (extension - 0.461) + payload * extension) * along @ up

    q = np.array([0.4, 0.2, 1.2])
    slope = [(potential(q + d) - potential(q - d)) / 2e-6 for d in 1e-6 * np.eye(3)]
    u = np.zeros((1, len(system.inputs)))
    still = np.zeros((1, 3))
    held = system.required(q[None], still, still, np.zeros((1, 0)), u, p)[0]
    bare = compile_model(Model(device))
    balance = bare.compensation(q[None], still, np.zeros((1, 0)), u, p[: len(bare.parameters)])[0]
    np.testing.assert_allclose(held + balance, slope, atol=2e-6)


def test_an_encoder_is_corrected_before_what_lies_behind_it():
    effects = ["transmission_compliance:extension", "encoder_scale:extension"]
    system = compile_model(Model(registry.device("bam"), effects))
    values = {"encoder_scale.extension.error": 0.05}
    values |= {"transmission_compliance.extension.compliance": 2e-4}
    p = with_values(system, values)
    u = np.zeros((1, len(system.inputs)))
    u[0, system.inputs.index("force_z")] = 30.0
    q = np.array([[0.1, 0.2, 1.0]])
    true = q + system.offset(q, u, p)
    np.testing.assert_allclose(true[0], [0.1, 0.2, 1.05 + 2e-4 * 30.0], rtol=1e-12)


def test_friction_by_load_builds_up_after_a_reversal_as_the_rest():
    device = registry.device("magnetic_damper")
    system = compile_model(Model(device, ["hysteresis:piston", "load_dependent_friction:piston"]))
    p = {"coulomb.piston": 40.0, "coulomb_gain": 100.0, "hysteresis.piston.share": 1.0,
         "load_dependent_friction.piston.coefficient": 0.3}  # fmt: skip
    values = np.array([p.get(x.name, 0.0) for x in system.parameters])
    u = np.array([[{"current": 0.5, "force_load_cell": 200.0}.get(n, 0.0) for n in system.inputs]])
    one = np.array([[0.1]])
    ends = [
        system.required(0 * one, one, 0 * one, np.array([[z]]), u, values)[0, 0] for z in (0.0, 1.0)
    ]
    assert ends[1] - ends[0] == pytest.approx(40.0 + 50.0 + 60.0, rel=1e-6)


def test_friction_by_direction_pushes_nothing_that_rests_and_is_no_part_of_what_turns():
    """Beside a hysteresis of all dry friction, whose share is half of what both ways differ by."""
    device = registry.device("magnetic_damper")
    system = compile_model(Model(device, ["hysteresis:piston", "asymmetric_coulomb:piston"]))
    p = {"coulomb.piston": 40.0, "hysteresis.piston.share": 1.0,
         "asymmetric_coulomb.piston.difference": 5.0}  # fmt: skip
    values = np.array([p.get(x.name, 0.0) for x in system.parameters])
    u, one = np.zeros((1, len(system.inputs))), np.array([[0.1]])

    def required(rate, deflection):
        z = np.array([[deflection]])
        return system.required(0 * one, rate * one, 0 * one, z, u, values)[0, 0]

    assert required(0.0, 0.0) == pytest.approx(0.0, abs=1e-9)
    forwards, backwards = required(1.0, 1.0), required(-1.0, -1.0)
    assert 0.5 * (forwards - backwards) == pytest.approx(40.0, rel=1e-6)
    assert 0.5 * (forwards + backwards) == pytest.approx(5.0, rel=1e-6)


def test_parameters_that_multiply_each_other_are_not_fitted_as_if_they_added_up():
    model = Model(registry.device("bam"), ["base_tilt"])
    system = compile_model(model)
    mass, tilt = system.index("mass"), system.index("base_tilt.tilt_x")
    assert system.linear[mass] and system.linear[tilt]
    assert system.is_linear_in([mass]) and not system.is_linear_in([mass, tilt])
    assert compile_model(Model(model.device)).is_linear_in(range(7))


def test_effects_of_the_compensator_change_its_torque_on_pitch_and_others_do_not() -> None:
    names = ("gravity_compensator_mistuned", "gravity_compensator_lag", "base_tilt")
    system = compile_model(Model(registry.device("bam"), names))
    p = with_values(system, {"gravity_compensator_mistuned.error": 0.1})
    q = np.array([[0.1, 0.2, 1.1], [-0.4, -0.3, 0.8]])
    qd = np.array([[0.3, -0.1, 0.2], [0.0, 0.4, -0.3]])
    behind = q[:, 2:] - 0.461 - 0.05
    found = system.compensation(q, qd, behind, np.zeros((2, len(system.inputs))), p)
    wanted = 1.1 * 3.56 * 9.81 * behind[:, 0] * np.cos(q[:, 1])
    np.testing.assert_allclose(found, np.outer(wanted, [0.0, 1.0, 0.0]), rtol=1e-12)
    assert [system.coordinates[i] for i in system.compensated] == ["pitch"]


def test_an_offset_where_nothing_is_to_be_balanced_is_none() -> None:
    system = compile_model(Model(registry.device("slider")))
    assert system.compensated == ()
    assert system.compensation(*[np.zeros((3, 1))] * 2, np.zeros((3, 0)), np.zeros((3, 1)),
                               system.prior).tolist() == [[0.0]] * 3  # fmt: skip


OWN = """
schema = "bampipe.effect/1"
name = "late_push"
summary = "One channel is read early"
scope = "force_component"
kind = "input"
looks_like = "residual like the rate of that force"
source = "test"
input = "f - lead*f_rate"
[parameters.lead]
unit = "s"
prior = 0.0
sd = 0.01
strength = true
"""


@pytest.mark.parametrize(
    ("device", "effects", "delays"),
    [
        ("bam", (), ()),
        ("bam", ("force_gain:x", "force_drift:y", "transmission_compliance:yaw"), ()),
        ("bam", ("stribeck:yaw", "force_delay"), ("force_delay.delay",)),
        ("bam", ("late_push:z",), ("late_push.z.lead",)),
        # Behind a lag, the force is a state, which the delay reaches by its rate.
        ("slider", ("actuator_delay", "actuator_lag:motor"), ("actuator_delay.delay",)),
    ],
)
def test_delays_are_told_from_what_they_do(
    device: str, effects: tuple[str, ...], delays: tuple[str, ...]
) -> None:
    own = registry.effect_from(tomllib.loads(OWN), "late_push.toml")
    system = compile_model(Model(registry.device(device), effects, (own,)))
    assert system.delays == delays
