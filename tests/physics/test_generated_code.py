"""Generated code: two printings of one set of equations, keyed by everything they depend on."""

import copy
import json
import string

import numpy as np
import pytest
from motions import (
    declaration,
    made_up_device,
    memory_within_reason,
    random_inputs,
    random_motion,
    run_as_python,
    typical_parameters,
)
from scipy.integrate import solve_ivp
from small_arm import ARM

from bampipe.model_functions import ROWS
from bampipe.physics import Model, compile_model, registry
from bampipe.physics.device import derivative

BAM = registry.device("bam")


def placed(name):
    """The device with the fewest axes that can have the effect, and the effect at its last target.

    Many axes take long to derive; `test_effects` has every effect at every target on the BAM.
    """
    shipped = map(registry.device, registry.device_names())
    by_size = sorted(shipped, key=lambda device: len(device.coordinates))
    for device in (*by_size, registry.device_from(ARM)):
        targets = registry.effect(name).targets(device)
        if targets:
            return device, f"{name}:{targets[-1]}" if targets[-1] else name
    raise AssertionError(f"no device can have {name}")


def models():
    """Every effect once, three in a model: what takes long is to derive one."""
    together = {}
    for name in registry.effect_names():
        device, effect = placed(name)
        together.setdefault(device.name, (device, []))[1].append(effect)
    for device, effects in together.values():
        for first in range(0, len(effects), 3):
            some = effects[first : first + 3]
            yield pytest.param(device, some, id="+".join(some))


def states_of(system, count, seed):
    """States (T, n_x), inputs and noise of so many moments, and parameters of each."""
    q, qd, _ = random_motion(system.model.device, count, seed, speed=0.5)
    qd[::4] *= 1e-3
    x = np.hstack([q, qd, memory_within_reason(system, count, seed + 1)])
    u, rng = random_inputs(system, count, seed + 2), np.random.default_rng(seed + 3)
    p = typical_parameters(system) * rng.uniform(0.9, 1.1, (count, 1))
    return x, u, p, rng.normal(size=(count, len(system.noise)))


def rates_and_readings(functions, system, x, u, p, w):
    """What `derivative` and `measure` give of each state, one after the other."""
    rates, readings = np.empty(x.shape), np.empty((len(x), 2 * len(system.coordinates)))
    for i in range(len(x)):
        functions.derivative(x[i], u[i], p[i], w[i], rates[i])
        functions.measure(x[i], u[i], p[i], readings[i])
    return rates, readings


@pytest.mark.parametrize(("device", "effects"), list(models()))
def test_columns_and_functions_of_one_state_agree(device, effects):
    """The same residual, acceleration and reading from both, to 1e-12 of their size."""
    system = compile_model(Model(device, effects))
    printed = run_as_python(system, "derivative", "measure", "residual")
    count, n, states = 40, len(system.coordinates), len(system.memory_names)
    q, qd, qdd = random_motion(device, count, 21, speed=0.5)
    qd[::4] *= 1e-3
    u, z = random_inputs(system, count, 22), memory_within_reason(system, count, 23)
    p = typical_parameters(system)

    def residual(q, qd, qdd, z, u):
        out = np.empty(q.shape)
        printed.residual(q, qd, qdd, system.body_forces(q, qd, qdd, p), z, u, p, out)
        return out

    columns = system.applied(q, qd, qdd, z, u, p) - system.required(q, qd, qdd, z, u, p)
    scale = np.abs(columns).max()
    np.testing.assert_allclose(residual(q, qd, qdd, z, u), columns, atol=1e-12 * scale)

    bare = compile_model(Model(device))
    used = [system.inputs.index(c) for c in bare.inputs]
    along = q, qd, qdd, np.zeros((count, 0)), u[:, used], p[: len(bare.parameters)]
    without = bare.applied(*along) - bare.required(*along)
    added = system.contribution(q, qd, qdd, z, u, p)
    np.testing.assert_allclose(without + added, columns, atol=1e-12 * scale)

    x, w = np.hstack([q, qd, z[:, :states]]), np.zeros((count, len(system.noise)))
    rates, _ = rates_and_readings(printed, system, x, u, [p] * count, w)
    bends, z[:, states:] = rates[:, n : 2 * n], rates[:, [2 * n + k for k in system.changes]]
    inertia = np.abs(np.einsum("tij,tj->ti", system.mass_matrix(q, p), bends)).max()
    again = residual(q, qd, bends, z, u)
    np.testing.assert_allclose(again, 0.0, atol=1e-12 * max(scale, inertia))


@pytest.mark.parametrize(
    ("machine", "effects"),
    [
        ("slider", ("presliding:carriage", "actuator_lag:motor")),
        ("bam", ("transmission_compliance:yaw", "handle_payload")),
        ("arm", ("gear_loss:two",)),
    ],
)
def test_what_is_compiled_is_what_is_printed(machine, effects):
    """One model a kind of code: with memory, with encoders that the load moves, of a robot."""
    device = registry.device_from(ARM) if machine == "arm" else registry.device(machine)
    system = compile_model(Model(device, effects))
    count = 30
    x, u, p, w = states_of(system, count, 41)
    expected = rates_and_readings(
        run_as_python(system, "derivative", "measure"), system, x, u, p, w
    )
    found = rates_and_readings(system, system, x, u, p, w)

    def laid_out(values):
        flat = np.zeros((values.shape[1], ROWS))
        flat[:, :count] = values.T
        return flat.ravel()

    rates, readings = (np.zeros(part.shape[1] * ROWS) for part in expected)
    system.derivative_rows(count, *map(laid_out, (x, u, p, w)), rates)
    system.measure_rows(count, *map(laid_out, (x, u, p)), readings)
    rows = (part.reshape(-1, ROWS)[:, :count].T for part in (rates, readings))
    for one, many, wanted in zip(found, rows, expected, strict=True):
        scale = np.abs(wanted).max(axis=0)
        assert np.all(np.abs(one - wanted) <= 1e-12 * scale)
        assert np.all(np.abs(many - wanted) <= 1e-12 * scale)
    n = len(system.coordinates)
    along = np.random.default_rng(5).normal(size=(3, count, n))
    z, q0 = x[:, 2 * n :], p[0]
    columns = system.applied(*along, z, u, q0) - system.required(*along, z, u, q0)
    scale = np.abs(columns).max()
    np.testing.assert_allclose(system.residual(*along, z, u, q0), columns, atol=1e-12 * scale)


MOVING = [n for n in registry.effect_names() if registry.effect(n).kind == "measurement"]


@pytest.mark.parametrize("name", ["stribeck", *MOVING])
def test_reading_of_the_encoders_is_its_offset_from_the_motion(name):
    device, effect = placed(name)
    system = compile_model(Model(device, (effect,)))
    q, qd, _ = random_motion(device, 20, 31, speed=0.5)
    u, p = random_inputs(system, 20, 32), typical_parameters(system)
    change = np.zeros_like(u)
    for k, force in enumerate(system.inputs):
        if derivative(force, 1) in system.inputs:
            change[:, k] = u[:, system.inputs.index(derivative(force, 1))]
    later, sooner = (system.offset(q + by * qd, u + by * change, p) for by in (1e-6, -1e-6))
    true = q + system.offset(q, u, p), qd + (later - sooner) / 2e-6
    measure = run_as_python(system, "measure").measure
    for i in range(20):
        x = np.concatenate([true[0][i], true[1][i], np.zeros(len(system.memory_names))])
        read = np.empty(2 * len(system.coordinates))
        measure(x, u[i], p, read)
        np.testing.assert_allclose(read, [*q[i], *qd[i]], rtol=1e-7, atol=1e-7)


def test_key_changes_with_the_text_of_effect_and_device_and_only_then():
    text = dict(registry.effect("stribeck").declaration)
    keys = [
        Model(BAM, ("stribeck:yaw",), (registry.effect_from(copy.deepcopy(d)),)).key
        for d in (text, text, {**text, "torque": text["torque"] + " "}, {**text, "summary": "x"})
    ]
    assert keys[0] == keys[1] == Model(BAM, ("stribeck:yaw",)).key
    assert len(set(keys)) == 3
    assert Model(BAM, ("stribeck:pitch",)).key != keys[0]
    same, other = registry.device_from(declaration()), declaration()
    other["constants"]["L"]["value"] = 0.462
    assert Model(same).key == Model(BAM).key
    assert Model(registry.device_from(other)).key != Model(BAM).key


def test_generated_code_is_the_same_text_again(tmp_path, monkeypatch):
    texts = []
    for folder in ("a", "b"):
        monkeypatch.setenv("BAMPIPE_CACHE_DIR", str(tmp_path / folder))
        assert compile_model(Model(BAM, ("presliding:pitch", "force_delay"))).lasting
        files = sorted((tmp_path / folder).rglob("model_*.json"))
        texts.append([(f.name, f.read_text()) for f in files])
    assert len(texts[0]) == 2
    assert texts[0] == texts[1]


def awkward(names):
    """A mass on a rail whose coordinate and channel carry the names of generated variables."""
    coordinate, component, parameter = names
    force, mass = f"force_{component}", {parameter: ("kg", 2.0, 1.0)}
    kinetic, inputs = f"{parameter}*ddt({coordinate})**2/2", {"force": [force]}
    return made_up_device(kinetic, {coordinate: force}, mass, inputs=inputs)


@pytest.mark.parametrize(
    "names", [("x", "y", "m"), ("q", "u", "p"), ("dx", "w", "z"), ("c_0", "b_0", "m_00")]
)
def test_a_device_may_call_its_quantities_anything(names):
    system = compile_model(Model(awkward(names), (f"return_spring:{names[0]}",)))
    p = system.prior
    p[1] = 3.0
    rate = np.empty(2)
    system.derivative(np.array([0.5, 0.1]), np.array([4.0]), p, np.zeros(1), rate)
    np.testing.assert_allclose(rate, [0.1, (4.0 - 1.5) / 2.0])


def test_generated_code_holds_no_name_from_a_file(tmp_path, monkeypatch):
    monkeypatch.setenv("BAMPIPE_CACHE_DIR", str(tmp_path))
    device = awkward(("wandering", "pushing", "heaviness"))
    assert compile_model(Model(device, ("presliding:wandering", "force_drift:pushing"))).lasting
    files = [json.loads(f.read_text())["sources"] for f in tmp_path.rglob("model_*.json")]
    sources = [text for found in files for text in found.values()]
    assert len(sources) == 9
    for word in ("wandering", "pushing", "heaviness", "presliding", "deflection", "drift"):
        assert not any(word in text for text in sources)
    assert all(set(text) <= set(string.printable) for text in sources)


@pytest.mark.parametrize(
    ("machine", "effect", "share"),
    [
        ("bam", "presliding:yaw", 2e-3),
        pytest.param("bam", "thermal_damping:yaw", 1e-4, marks=pytest.mark.long),
        pytest.param("bam", "gravity_compensator_lag", 1e-4, marks=pytest.mark.long),
        ("bam", "maxwell_slip:yaw", 2e-3),
        ("bam", "brake_lag", 1e-4),
        ("slider", "actuator_lag:motor", 1e-4),
        ("magnetic_damper", "hysteresis:piston", 2e-3),
    ],
)
def test_internal_states_are_those_of_a_fine_integration(machine, effect, share):
    """Along a sampled motion, everything linear between samples; off by a share of their range."""
    system = compile_model(Model(registry.device(machine), [effect]))
    n, rate = len(system.coordinates), 250.0
    t = np.arange(750) / rate
    turn = 2 * np.pi * np.outer(t, 0.7 + 0.25 * np.arange(n))
    q, qd = 0.05 * np.sin(turn) + 0.9, 0.05 * np.cos(turn) * (turn[1] * rate)
    waves = np.sin(2 * np.pi * np.outer(t, 1.1 + 0.3 * np.arange(len(system.inputs))))
    u = np.abs(waves) * 20.0
    p = typical_parameters(system)
    found = system.memory(q, qd, 0 * q, u, p, t)

    def slope(time, z):
        at = [np.array([np.interp(time, t, c) for c in x.T]) for x in (q, qd, u)]
        x, dx = np.concatenate([at[0], at[1], z]), np.empty(2 * n + z.size)
        system.derivative(x, at[2], p, np.zeros(len(system.noise)), dx)
        return dx[2 * n :]

    exact = solve_ivp(slope, (t[0], t[-1]), found[0], t_eval=t, max_step=1e-3, rtol=1e-6)
    assert np.ptp(exact.y) > 0.0
    np.testing.assert_allclose(found, exact.y.T, atol=share * np.ptp(exact.y))
