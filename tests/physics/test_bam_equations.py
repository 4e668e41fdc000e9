"""The derived BAM against the equations worked out by hand (sections II-B to II-D)."""

from types import SimpleNamespace

import bam_oracle as oracle
import numpy as np
import pytest
from motions import (
    conservative_bam,
    energies,
    made_up_device,
    made_up_effect,
    random_motion,
    typical_parameters,
    with_values,
)
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from bampipe.physics import Model, System, compile_model, registry

BAM = registry.device("bam")


@pytest.fixture(scope="module")
def system():
    return compile_model(Model(BAM))


def probe(expression):
    """What ``expression`` of the device file is worth along a motion: (q, qd) -> (T,)."""
    torque = {"yaw": f"scale*({expression})"}
    effect = made_up_effect("device", "torque", {"scale": ("", 1.0, 0.0)}, torque=torque)
    shown = compile_model(Model(BAM, ("made_up",), (effect,)))

    def values(q, qd):
        u = np.zeros((len(q), len(shown.inputs)))
        z = np.zeros((len(q), 0))
        return shown.contribution(q, qd, 0 * q, z, u, shown.prior)[:, 0]

    return values


def at_rest(system, rows):
    return np.zeros((rows, 0)), np.zeros((rows, len(system.inputs)))


def test_mass_matrix_is_the_one_by_hand_and_positive_definite(system):
    grids = [np.linspace(*BAM.limits[c.name], 9) for c in BAM.coordinates]
    q = np.stack(np.meshgrid(*grids), axis=-1).reshape(-1, 3)
    for mass in (0.1, 3.56, 10.0):
        matrices = system.mass_matrix(q, with_values(system, {"mass": mass}))
        assert np.array_equal(matrices, matrices.transpose(0, 2, 1))
        assert np.linalg.eigvalsh(matrices).min() > 0.05
    q, _, _ = random_motion(BAM, 200, 1)
    expected = np.array([oracle.mass_matrix(row, 3.2) for row in q])
    found = system.mass_matrix(q, with_values(system, {"mass": 3.2}))
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-15)


def test_inertia_coriolis_and_gravity_equal_those_by_hand(system):
    q, qd, qdd = random_motion(BAM, 200, 2)
    p = np.zeros(len(system.parameters))
    p[system.index("mass")] = 3.2
    z, u = at_rest(system, len(q))
    expected = []
    for a, b, c in zip(q, qd, qdd, strict=True):
        torque = oracle.mass_matrix(a, 3.2) @ c + oracle.bias(a, b, 3.2)
        expected.append(torque - [0.0, oracle.compensator(a), 0.0])
    np.testing.assert_allclose(system.required(q, qd, qdd, z, u, p), expected, atol=1e-12)


def test_accelerations_solve_the_equations_by_hand(system):
    q, qd, _ = random_motion(BAM, 50, 3)
    p = with_values(system, {"mass": 3.2})
    force, brake = np.array([4.0, -7.0, 5.0]), np.array([0.5, 0.0, 2.0])
    u = np.array([*force, *brake])
    assert system.inputs == (*BAM.forces, *BAM.brakes.values())
    for a, b in zip(q, qd, strict=True):
        rate = np.empty(6)
        system.derivative(np.concatenate([a, b]), u, p, np.zeros(4), rate)
        smooth = np.tanh(b / [1e-3, 1e-3, 2.5e-4])
        viscous, coulomb = [3.0, 3.0, 10.0] * b, [1.5, 1.5, 3.0] * smooth
        torque = oracle.user_torque(a, force) - viscous - coulomb - brake * smooth
        torque[1] += oracle.compensator(a)
        expected = np.linalg.solve(oracle.mass_matrix(a, 3.2), torque - oracle.bias(a, b, 3.2))
        np.testing.assert_allclose(rate, [*b, *expected], rtol=1e-11, atol=1e-11)


def test_rod_turns_at_the_rate_of_its_attitude_in_rod_axes():
    """Eq 8 mended: omega from A^-1 dA/dt, the axes in which the inertia tensor is given."""
    q, qd, _ = random_motion(BAM, 40, 4)
    found = np.column_stack([probe(name)(q, qd) for name in ("w_x", "w_y", "w_z")])
    step = 1e-6
    for a, b, omega in zip(q, qd, found, strict=True):
        rate = (oracle.attitude(a + step * b) - oracle.attitude(a - step * b)) / (2 * step)
        skew = oracle.attitude(a).T @ rate
        np.testing.assert_allclose(skew, -skew.T, atol=1e-8)
        np.testing.assert_allclose(omega, [skew[2, 1], skew[0, 2], skew[1, 0]], atol=1e-8)
        turned = oracle.attitude(a) @ expm(step * skew)
        np.testing.assert_allclose(turned, oracle.attitude(a + step * b), atol=1e-11)


def test_kinematics_are_orthogonal_and_so_is_joint_damping():
    """Eqs 1-4: J^T J is diagonal, hence J^T K J of a field with one damping for all directions."""
    q, _, _ = random_motion(BAM, 100, 5)
    columns = []
    for axis in range(3):
        unit = np.zeros_like(q)
        unit[:, axis] = 1.0
        columns.append(np.column_stack([probe(f"ddt({x})")(q, unit) for x in "xyz"]))
    jacobian = np.stack(columns, axis=-1)
    np.testing.assert_allclose(jacobian, [oracle.jacobian(a) for a in q], atol=1e-14)
    product = jacobian.transpose(0, 2, 1) @ jacobian
    rho, c = q[:, 2] - oracle.L, np.cos(q[:, 1])
    expected = np.zeros_like(product)
    for i, diagonal in enumerate(((rho * c) ** 2, rho**2, np.ones_like(rho))):
        expected[:, i, i] = diagonal
    np.testing.assert_allclose(product, expected, atol=1e-14)


def test_tuned_compensator_of_eq_16_is_the_weight_of_the_rod(system):
    """With L_0 = r_c F_c/(K Delta) and K of eq 15 the cable length cancels."""
    q, _, _ = random_motion(BAM, 200, 6)
    literal = np.array([oracle.compensator(a) for a in q])
    weight = oracle.DESIGN_MASS * oracle.G * (q[:, 2] - oracle.L) * np.cos(q[:, 1])
    np.testing.assert_allclose(literal, weight, rtol=1e-13)
    np.testing.assert_allclose(literal, probe("compensation")(q, 0 * q), rtol=1e-13)
    z, u = at_rest(system, len(q))
    p = with_values(system, {"mass": oracle.DESIGN_MASS})
    torque = system.required(q, 0 * q, 0 * q, z, u, p)
    np.testing.assert_allclose(torque[:, 1], 0.0, atol=1e-13)
    np.testing.assert_allclose(
        torque[:, 2], oracle.DESIGN_MASS * oracle.G * np.sin(q[:, 1]), rtol=1e-12
    )


def test_user_torque_does_the_work_of_the_force_at_the_grip(system):
    """Eqs 7 and 19 mended: the hand pushes at the grip, distance r, not r - L."""
    q, _, _ = random_motion(BAM, 60, 7)
    rng = np.random.default_rng(7)
    z, u = at_rest(system, len(q))
    u[:, :3] = rng.normal(0.0, 20.0, size=(len(q), 3))
    applied = system.applied(q, 0 * q, 0 * q, z, u, system.prior)
    mapped = np.einsum("tij,tj->ti", system.input_map(q), u[:, :3])
    np.testing.assert_allclose(mapped, applied, rtol=1e-13)
    step = 1e-6
    for a, force, torque in zip(q, u[:, :3], applied, strict=True):
        np.testing.assert_allclose(torque, oracle.user_torque(a, force), atol=1e-12)
        for axis in range(3):
            move = step * np.eye(3)[axis]
            path = oracle.position(a + move, 0.0) - oracle.position(a - move, 0.0)
            work = (oracle.attitude(a) @ force) @ path / (2 * step)
            assert work == pytest.approx(torque[axis], abs=1e-7)


def test_literal_force_point_of_the_paper_is_the_effect_with_shift_l():
    moved = compile_model(Model(BAM, ("force_application_point",)))
    q, _, _ = random_motion(BAM, 50, 8)
    z, u = at_rest(moved, len(q))
    u[:, :3] = np.random.default_rng(8).normal(0.0, 20.0, size=(len(q), 3))
    p = with_values(moved, {"force_application_point.shift": oracle.L})
    expected = [
        oracle.jacobian(a).T @ oracle.attitude(a) @ f for a, f in zip(q, u[:, :3], strict=True)
    ]
    np.testing.assert_allclose(moved.applied(q, 0 * q, 0 * q, z, u, p), expected, atol=1e-12)


def test_friction_and_brakes_take_energy_out_at_every_speed(system):
    """Eqs 2, 18, 20: power of each axis' friction and brake is never positive, nil at rest."""
    q, qd, _ = random_motion(BAM, 400, 9)
    qd[::2] *= 10.0 ** np.random.default_rng(9).uniform(-7, 0, size=(200, 1))
    z, u = at_rest(system, len(q))
    u[:, 3:] = np.abs(np.random.default_rng(10).normal(0.0, 30.0, size=(len(q), 3)))
    rubs = [p.name for p in system.parameters if p.name.partition(".")[2]]
    frictionless = with_values(system, dict.fromkeys(rubs, 0.0))
    total = system.required(q, qd, 0 * q, z, u, system.prior)
    ideal = system.required(q, qd, 0 * q, z, 0 * u, frictionless)
    power = -(total - ideal) * qd
    assert power.max() <= 0.0
    assert (power[np.abs(qd) > 0.01] < 0.0).all()
    still = system.required(q, 0 * q, 0 * q, z, u, system.prior)
    np.testing.assert_array_equal(still, system.required(q, 0 * q, 0 * q, z, 0 * u, frictionless))


def test_singular_mass_matrix_gives_a_value_that_is_not_finite_instead_of_a_wrong_one():
    telescope = made_up_device(
        "mass*(length**2*ddt(angle)**2 + ddt(length)**2)/2",
        {"angle": "length*force_x"},
        {"mass": ("kg", 1.0, 0.1)},
        coordinates={"angle": {"kind": "rotary"}, "length": {"kind": "linear"}},
    )
    system = compile_model(Model(telescope))
    rate = np.empty(4)
    system.derivative(np.zeros(4), np.zeros(1), system.prior, np.zeros(1), rate)
    assert not np.isfinite(rate).all()
    system.derivative(np.array([0.0, 0.5, 0.0, 0.0]), np.ones(1), system.prior, np.zeros(1), rate)
    np.testing.assert_allclose(rate, [0.0, 0.0, 2.0, 0.0])


def test_least_force_gives_a_load_also_where_one_force_does_nothing():
    rng = np.random.default_rng(0)
    gains, force = rng.normal(size=(5, 3, 3)), rng.normal(size=(5, 3))

    def least_force():
        load = np.einsum("tqf,tf->tq", gains, force)
        return System.least_force(SimpleNamespace(input_map=lambda *_: gains), np.zeros(5), load)

    np.testing.assert_allclose(least_force(), force, rtol=1e-9)
    gains[2, :, 1] = 0.0
    np.testing.assert_allclose(np.delete(least_force()[2], 1), np.delete(force[2], 1), rtol=1e-9)
    assert least_force()[2, 1] == pytest.approx(0.0, abs=1e-9)


# A rubber band keeps the rod within reach.
RUBBER = made_up_effect(
    "device", "energy", {"stiffness": ("N/m", 400.0, 0.0)},
    potential="stiffness*(extension - 1)**2/2",
)  # fmt: skip


def test_energy_is_conserved_without_friction():
    """With effects of kind energy; those of the device are held against equations by hand."""
    shipped = ("handle_payload", "base_tilt", "inertia_mismatch:yaw", "inertia_mismatch:extension")
    system = compile_model(Model(conservative_bam(), ("made_up", *shipped), (RUBBER,)))
    p, u, w = typical_parameters(system), np.zeros(len(system.inputs)), np.zeros(len(system.noise))

    def derivative(_, x):
        rate = np.empty(len(x))
        system.derivative(x, u, p, w, rate)
        return rate

    start = np.array([0.2, 0.4, 1.0, 1.5, -0.8, 0.3])
    done = solve_ivp(derivative, (0.0, 10.0), start, "DOP853", rtol=1e-12, atol=1e-13)
    assert done.success
    x = done.y.T
    kinetic, potential = energies(system, x[:, :3], x[:, 3:], p)
    total = kinetic + potential
    assert np.ptp(kinetic) > 1.0
    assert np.abs(total - total[0]).max() / kinetic.max() < 1e-8
