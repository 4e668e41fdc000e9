"""Energy and inverse dynamics of simulated motions."""

import bam_oracle as oracle
import numpy as np
import pytest
from motions import conservative_bam, energies, random_motion, typical_parameters
from scipy.integrate import solve_ivp

from bampipe.physics import Model, compile_model, registry

BAM = registry.device("bam")
RUBBER = registry.effect_from(
    {
        "name": "rubber_band",
        "summary": "Keeps the rod within reach",
        "scope": "device",
        "kind": "energy",
        "looks_like": "a spring on extension",
        "source": "this test",
        "potential": "stiffness*(extension - 1)**2/2",
        "parameters": {"stiffness": {"unit": "N/m", "prior": 400.0, "sd": 0.0}},
    }
)


def fly(system, x0, p, u=None, seconds=10.0):
    """Motion under a constant or given input u(t) without process noise; tight DOP853."""
    w, rate = np.zeros(len(system.noise)), np.empty(len(system.states))
    constant = np.zeros(len(system.inputs))

    def derivative(t, x):
        system.derivative(x, constant if u is None else u(t), p, w, rate)
        return rate.copy()

    t = np.linspace(0.0, seconds, 500)
    done = solve_ivp(
        derivative, (0.0, seconds), x0, method="DOP853", t_eval=t, rtol=1e-12, atol=1e-13
    )
    assert done.success
    return t, done.y.T


@pytest.mark.parametrize(
    "effects",
    [(), ("handle_payload", "base_tilt", "inertia_mismatch:yaw", "inertia_mismatch:extension")],
    ids=["device", "effects of kind energy"],
)
def test_energy_is_conserved_without_friction(effects):
    device = conservative_bam()
    system = compile_model(Model(device, ("rubber_band", *effects), (RUBBER,)))
    p = typical_parameters(system)
    _, x = fly(system, np.array([0.2, 0.4, 1.0, 1.5, -0.8, 0.3]), p)
    kinetic, potential = energies(system, x[:, :3], x[:, 3:], p)
    total = kinetic + potential
    assert np.ptp(kinetic) > 1.0
    assert np.abs(total - total[0]).max() / kinetic.max() < 1e-8


def test_energy_changes_by_the_work_of_hand_compensator_friction_and_brakes():
    """Power balance: d(KE + PE)/dt is the power of every torque that is not in the energies."""
    bare = compile_model(Model(conservative_bam()))
    system = compile_model(Model(BAM))
    q, qd, _ = random_motion(BAM, 100, 11)
    p = system.prior
    u = np.column_stack([np.full((100, 3), [3.0, -4.0, 5.0]), np.full((100, 3), 2.0)])
    step = 1e-6
    for a, b, inputs in zip(q, qd, u, strict=True):
        rate = np.empty(6)
        x = np.concatenate([a, b])
        system.derivative(x, inputs, p, np.zeros(4), rate)
        around = []
        for sign in (1.0, -1.0):
            y = (x + sign * step * rate)[None]
            around.append(sum(energies(bare, y[:, :3], y[:, 3:], p[-1:]))[0])
        change = (around[0] - around[1]) / (2 * step)
        sign = np.tanh(b / [1e-3, 1e-3, 2.5e-4])
        torque = oracle.user_torque(a, inputs[:3]) - p[:6:2] * b - (p[1:6:2] + inputs[3:]) * sign
        torque[1] += oracle.compensator(a)
        assert change == pytest.approx(torque @ b, rel=1e-6, abs=1e-6)


def held(t):
    """Forces that move the device about its workspace, with brakes now and then."""
    hand = np.array([6.0 * np.sin(2 * t), 5.0 * np.sin(1.3 * t + 1), 9.0 * np.cos(1.7 * t)])
    return np.concatenate([hand, np.maximum(0.0, np.sin(0.5 * t)) * np.array([1.0, 1.0, 2.0])])


def test_inverse_dynamics_of_a_simulated_motion_returns_the_input():
    system = compile_model(Model(BAM))
    p = system.prior
    t, x = fly(system, np.array([0.0, 0.05, 1.0, 0.0, 0.0, 0.0]), p, held, seconds=5.0)
    q, qd = x[:, :3], x[:, 3:]
    u = np.array([held(s) for s in t])
    qdd = np.empty_like(q)
    for i, row in enumerate(x):
        rate = np.empty(6)
        system.derivative(row, u[i], p, np.zeros(4), rate)
        qdd[i] = rate[3:]
    assert np.ptp(q, axis=0).min() > 0.02
    needed = system.required(q, qd, qdd, np.zeros((len(t), 0)), u, p)
    force = np.linalg.solve(system.input_map(q), needed[..., None])[..., 0]
    np.testing.assert_allclose(force, u[:, :3], atol=1e-9)
