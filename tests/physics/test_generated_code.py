"""Generated code: two printings of one set of equations, keyed by everything they depend on."""

import copy
import json
import string

import numpy as np
import pytest
from motions import (
    declaration,
    memory_within_reason,
    random_inputs,
    random_motion,
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

    Many axes take long to compile; `test_effects` has every effect at every target on the BAM.
    """
    shipped = map(registry.device, registry.device_names())
    by_size = sorted(shipped, key=lambda device: len(device.coordinates))
    for device in (*by_size, registry.device_from(ARM)):
        targets = registry.effect(name).targets(device)
        if targets:
            return device, f"{name}:{targets[-1]}" if targets[-1] else name
    raise AssertionError(f"no device can have {name}")


def models():
    """Every effect once, three in a model: what takes long is to compile one."""
    together = {}
    for name in registry.effect_names():
        device, effect = placed(name)
        together.setdefault(device.name, (device, []))[1].append(effect)
    for device, effects in together.values():
        for first in range(0, len(effects), 3):
            some = effects[first : first + 3]
            yield pytest.param(device, some, id="+".join(some))


@pytest.mark.parametrize(("device", "effects"), list(models()))
def test_columns_and_compiled_functions_agree(device, effects):
    """The same residual, acceleration and reading from both, to 1e-12 of their size."""
    system = compile_model(Model(device, effects))
    count, n = 40, len(system.coordinates)
    q, qd, qdd = random_motion(device, count, 21, speed=0.5)
    qd[::4] *= 1e-3
    u, z = random_inputs(system, count, 22), memory_within_reason(system, count, 23)
    p = typical_parameters(system)

    columns = system.applied(q, qd, qdd, z, u, p) - system.required(q, qd, qdd, z, u, p)
    true = q, qd, qdd
    scale = np.abs(columns).max()
    np.testing.assert_allclose(system.residual(*true, z, u, p), columns, atol=1e-12 * scale)

    bare = compile_model(Model(device))
    base = len(bare.parameters)
    used = [system.inputs.index(c) for c in bare.inputs]
    z0 = np.zeros((count, 0))
    without = bare.residual(*true, z0, np.ascontiguousarray(u[:, used]), p[:base])
    added = system.contribution(*true, z, u, p)
    np.testing.assert_allclose(without + added, columns, atol=1e-12 * scale)

    w, rate = np.zeros(len(system.noise)), np.empty(len(system.states))
    for i in range(count):
        x = np.concatenate([true[0][i], true[1][i], z[i]])
        system.derivative(x, u[i], p, w, rate)
        row = [a[i][None].copy() for a in true[:2]]
        again = system.residual(*row, rate[None, n : 2 * n], z[i][None], u[i][None], p)
        inertia = np.abs(system.mass_matrix(row[0], p)[0] @ rate[n : 2 * n]).max()
        np.testing.assert_allclose(again, 0.0, atol=1e-12 * max(scale, inertia))


def one_of_each_kind():
    """Names of effects: every kind and scope once, the others marked long."""
    seen = set()
    for name in registry.effect_names():
        effect = registry.effect(name)
        known = (effect.kind, effect.scope) in seen
        seen.add((effect.kind, effect.scope))
        yield pytest.param(name, marks=pytest.mark.long) if known else name


@pytest.mark.parametrize("name", [*one_of_each_kind()])
def test_rows_and_single_states_agree(name):
    """The functions for many states at once are those for one, but for rounding."""
    device, effect = placed(name)
    system = compile_model(Model(device, (effect,)))
    count = 30
    q, qd, _ = random_motion(device, count, 41, speed=0.5)
    qd[::4] *= 1e-3
    u, z = random_inputs(system, count, 42), memory_within_reason(system, count, 43)
    x = np.hstack([q, qd, z])
    p = typical_parameters(system) * np.random.default_rng(44).uniform(0.9, 1.1, (count, 1))
    w = np.random.default_rng(45).normal(size=(count, len(system.noise)))

    def laid_out(values):
        flat = np.zeros((values.shape[1], ROWS))
        flat[:, :count] = values.T
        return flat.ravel()

    rates, readings = np.zeros(x.shape[1] * ROWS), np.zeros(2 * q.shape[1] * ROWS)
    system.derivative_rows(count, laid_out(x), laid_out(u), laid_out(p), laid_out(w), rates)
    system.measure_rows(count, laid_out(x), laid_out(u), laid_out(p), readings)
    one, reading = np.empty(x.shape[1]), np.empty(2 * q.shape[1])
    expected_rates, expected_readings = [], []
    for i in range(count):
        system.derivative(x[i], u[i], p[i], w[i], one)
        system.measure(x[i], u[i], p[i], reading)
        expected_rates.append(one.copy())
        expected_readings.append(reading.copy())
    rates = rates.reshape(-1, ROWS)[:, :count].T
    scale = np.abs(expected_rates).max(axis=0)
    assert np.all(np.abs(rates - expected_rates) <= 1e-12 * scale)
    readings = readings.reshape(-1, ROWS)[:, :count].T
    np.testing.assert_allclose(readings, expected_readings, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", registry.effect_names())
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
    for i in range(20):
        x = np.concatenate([true[0][i], true[1][i], np.zeros(len(system.memory_names))])
        read = np.empty(2 * len(system.coordinates))
        system.measure(x, u[i], p, read)
        np.testing.assert_allclose(read, [*q[i], *qd[i]], rtol=1e-7, atol=1e-7)


def test_internal_states_settle_where_their_rate_vanishes():
    system = compile_model(Model(BAM, ("gravity_compensator_lag",)))
    t = np.arange(0.0, 4.0, 0.005)
    q = np.tile([0.0, 0.1, 0.9], (len(t), 1))
    q[t > 0.5, 2] = 1.2
    qd, u = np.zeros_like(q), np.zeros((len(t), len(system.inputs)))
    p = typical_parameters(system)
    z = system.memory(q, qd, qd, u, p, t)
    assert z.shape == (len(t), 1)
    np.testing.assert_allclose(z[t <= 0.5, 0], 0.9 - 0.461, atol=1e-12)
    lag = p[system.index("gravity_compensator_lag.time_constant")]
    later = t > 0.52
    expected = 1.2 - 0.461 - 0.3 * np.exp(-(t[later] - 0.505) / lag)
    np.testing.assert_allclose(z[later, 0], expected, atol=0.005)


def test_key_changes_with_the_text_of_an_effect_and_only_then():
    text = dict(registry.effect("stribeck").declaration)
    keys = [
        Model(BAM, ("stribeck:yaw",), (registry.effect_from(copy.deepcopy(d)),)).key
        for d in (text, text, {**text, "torque": text["torque"] + " "}, {**text, "summary": "x"})
    ]
    assert keys[0] == keys[1] == Model(BAM, ("stribeck:yaw",)).key
    assert len(set(keys)) == 3
    assert Model(BAM, ("stribeck:pitch",)).key != keys[0]


def test_key_follows_the_device():
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
    return registry.device_from(
        {
            "name": "rail",
            "coordinates": {coordinate: {"kind": "linear"}},
            "energy": {"kinetic": f"{parameter}*ddt({coordinate})**2/2"},
            "inputs": {"force": [f"force_{component}"]},
            "applied": {coordinate: f"force_{component}"},
            "parameters": {parameter: {"unit": "kg", "prior": 2.0, "sd": 1.0}},
        }
    )


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
    assert len(sources) == 7
    for word in ("wandering", "pushing", "heaviness", "presliding", "deflection", "drift"):
        assert not any(word in text for text in sources)
    assert all(set(text) <= set(string.printable) for text in sources)


@pytest.mark.parametrize(
    ("machine", "effect", "share"),
    [
        ("bam", "presliding:yaw", 2e-3),
        ("bam", "thermal_damping:yaw", 1e-4),
        ("bam", "gravity_compensator_lag", 1e-4),
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
    p = np.array([x.prior if x.typical is None else x.typical for x in system.parameters])
    found = system.memory(q, qd, 0 * q, u, p, t)

    def slope(time, z):
        at = [np.array([np.interp(time, t, c) for c in x.T]) for x in (q, qd, u)]
        x, dx = np.concatenate([at[0], at[1], z]), np.empty(2 * n + z.size)
        system.derivative(x, at[2], p, np.zeros(len(system.noise)), dx)
        return dx[2 * n :]

    exact = solve_ivp(slope, (t[0], t[-1]), found[0], t_eval=t, max_step=1e-3, rtol=1e-6)
    assert np.ptp(exact.y) > 0.0
    np.testing.assert_allclose(found, exact.y.T, atol=share * np.ptp(exact.y))
