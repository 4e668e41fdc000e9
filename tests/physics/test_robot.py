"""Robots: bodies on joints, held against Pinocchio, which shares no code with the product."""

import numpy as np
import pytest

from bampipe.physics import Model, compile_model
from bampipe.physics.device import Device
from bampipe.physics.registry import device_from
from bampipe.physics.robot import INERTIAL_NAMES, rotation_matrix
from bampipe.physics.system import System

pin = pytest.importorskip("pinocchio")

KINDS = {"revolute": "rotary", "prismatic": "linear"}
AXES = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
SAMPLES = 50


def random_robot(joints: int, seed: int) -> Device:
    """Joints of both kinds about axes of any direction, in a tree, with bodies of six points."""
    rng = np.random.default_rng(seed)
    table: dict[str, dict[str, object]] = {}
    for i in range(joints):
        points, weight = 0.1 * rng.normal(size=(6, 3)), rng.uniform(0.1, 1.0, 6)
        center = weight @ points / weight.sum()
        arms = points - center
        inertia = sum(
            w * (r @ r * np.eye(3) - np.outer(r, r)) for w, r in zip(weight, arms, strict=True)
        )
        k = int(rng.integers(5))
        right_angle = rng.random() < 0.4
        table[f"j{i}"] = {
            "kind": "prismatic" if rng.random() < 0.25 else "revolute",
            "after": f"j{rng.integers(max(0, i - 2), i)}" if i else "",
            "position": rng.normal(0.0, 0.3, 3).tolist(),
            "rotation": [np.pi / 2, 0.0, -np.pi / 2]
            if right_angle
            else rng.uniform(-3, 3, 3).tolist(),
            "axis": AXES[k] if k < 4 else rng.normal(size=3).tolist(),
            "mass": float(weight.sum()),
            "center": center.tolist(),
            "inertia": inertia[np.triu_indices(3)].tolist(),
        }
    return device_from(
        {
            "name": f"random_{joints}_{seed}",
            "coordinates": {name: {"kind": KINDS[str(j["kind"])]} for name, j in table.items()},
            "robot": {"joints": table, "gravity": [0.3, -1.0, -9.7]},
            "inputs": {"force": [f"torque_{name}" for name in table], "force_unit": "N.m"},
            "applied": {name: f"torque_{name}" for name in table},
        }
    )


class Reference:
    """The same robot in Pinocchio."""

    def __init__(self, device: Device) -> None:
        robot = device.robot
        self.model = pin.Model()
        self.model.gravity.linear = np.array(robot.gravity)
        places = {"": 0}
        for joint in robot.joints:
            axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
            slides = joint.kind == "prismatic"
            kind = pin.JointModelPrismaticUnaligned if slides else pin.JointModelRevoluteUnaligned
            placed = pin.SE3(rotation_matrix(joint.rotation), np.array(joint.position))
            place = self.model.addJoint(places[joint.after], kind(*axis), placed, joint.name)
            xx, xy, xz, yy, yz, zz = joint.inertia
            inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            body = pin.Inertia(joint.mass, np.array(joint.center), inertia)
            self.model.appendBodyToJoint(place, body, pin.SE3.Identity())
            places[joint.name] = place
        self.data = self.model.createData()
        self.order = [self.model.joints[places[j.name]].idx_v for j in robot.joints]

    def __call__(self, function: object, *columns: np.ndarray) -> np.ndarray:
        rows = []
        for row in zip(*columns, strict=True):
            given = [np.empty(len(self.order)) for _ in row]
            for own, values in zip(given, row, strict=True):
                own[self.order] = values
            rows.append(np.copy(function(self.model, self.data, *given)))  # type: ignore[operator]
        found = np.array(rows)
        return found[:, self.order] if found.ndim == 2 else found


def motion(joints: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    q, qd, qdd = np.random.default_rng(1).normal(size=(3, SAMPLES, joints))
    return q, qd, qdd


def arguments(system: System) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.zeros((SAMPLES, 0)), np.zeros((SAMPLES, len(system.inputs))), system.prior


@pytest.mark.parametrize(
    "joints", [3, *(pytest.param(n, marks=pytest.mark.long) for n in (1, 4, 6, 8))]
)
def test_every_function_equals_that_of_pinocchio(joints: int) -> None:
    device = random_robot(joints, seed=joints)
    system, reference = compile_model(Model(device)), Reference(device)
    q, qd, qdd = motion(joints)
    z, u, p = arguments(system)

    required = reference(pin.rnea, q, qd, qdd)
    assert np.abs(system.required(q, qd, qdd, z, u, p) - required).max() < 1e-10
    assert np.abs(system.residual(q, qd, qdd, z, u, p) + required).max() < 1e-10

    at_rest, gravity = np.zeros_like(q), reference(pin.rnea, q, np.zeros_like(q), np.zeros_like(q))
    for j in range(joints):
        unit = at_rest.copy()
        unit[:, j] = 1.0
        column = reference(pin.rnea, q, at_rest, unit) - gravity
        assert np.abs(system.mass_matrix(q, p)[:, :, j] - column).max() < 1e-10

    torque = np.random.default_rng(2).normal(size=q.shape)
    expected = reference(pin.aba, q, qd, torque)
    rate, noise = np.empty(2 * joints), np.zeros(len(system.noise))
    for k in range(5):
        system.derivative(np.concatenate([q[k], qd[k]]), torque[k], p, noise, rate)
        assert np.abs(rate[joints:] - expected[k]).max() < 1e-10 * np.abs(expected[k]).max()


def test_models_of_a_robot_share_compiled_bodies_whose_columns_add_up() -> None:
    device = random_robot(3, 5)
    first = device.coordinates[0].name
    some = [compile_model(Model(device, effects)) for effects in ((), (f"stribeck:{first}",))]
    for kind in ("compiled_bodies", "bodies"):
        assert len({system._whole.sources[kind] for system in some}) == 1
    for kind in ("derivative", "residual"):
        texts = [system._whole.sources[kind] for system in some]
        assert len(set(texts)) == 2
        assert not any("inertia" in text or "r_9 =" in text for text in texts)
    device = random_robot(4, seed=9)
    system, n = compile_model(Model(device)), 4
    rows = device.robot.regressor.reshape(n, -1, 10 * n)
    rng = np.random.default_rng(0)
    q, qd, qdd = (rng.uniform(-2.0, 2.0, (n, 40 * n)).T for _ in range(3))
    z, u = np.zeros((len(q), 0)), np.zeros((len(q), len(system.inputs)))
    required = system.required(q, qd, qdd, z, u, system.prior)
    assert np.abs(np.einsum("atp,p->ta", rows, system.prior) - required).max() < 1e-10


def test_a_number_that_moves_no_joint_is_not_estimated() -> None:
    """The base joint of an upright arm feels no more of its body than the inertia about itself."""
    device = random_robot(1, seed=1)
    upright = {**device.declaration["robot"]["joints"]["j0"]} | {
        "kind": "revolute",
        "axis": [0.0, 0.0, 1.0],
        "rotation": [0.0, 0.0, 0.0],
    }
    declaration = {**device.declaration, "robot": {"joints": {"j0": upright}}}
    declaration["coordinates"] = {"j0": {"kind": "rotary"}}
    free = [p.name for p in device_from(declaration).parameters if not p.fixed]
    assert free == ["inertia_zz.j0"]
    assert len(device_from(declaration).parameters) == len(INERTIAL_NAMES)


def test_impossible_bodies_are_named() -> None:
    device = random_robot(3, seed=3)
    assert device.robot.impossible == []
    joints = {name: dict(j) for name, j in device.declaration["robot"]["joints"].items()}
    joints["j0"]["mass"] = -1.0
    joints["j1"]["inertia"] = [1.0, 0.0, 0.0, 0.1, 0.0, 0.1]
    joints["j2"]["inertia"] = [1.0, 0.0, 0.0, -1.0, 0.0, 1.0]
    wrong = device_from({**device.declaration, "robot": {"joints": joints}}).robot
    first, second, third = wrong.impossible
    assert first == "j0: a mass of -1 kg"
    assert "largest moment exceeds the sum" in second
    assert "a negative moment of inertia" in third
    assert wrong.undrawn == []
    assert not wrong.joints[0].inertial.any()
    for joint in wrong.joints[1:]:
        # About the centre of mass: of no axis is the moment more than those of the other two.
        c = np.array(joint.center)
        six = joint.inertial[4:]
        about = np.array([[six[0], six[1], six[2]], [six[1], six[3], six[4]], [six[2], *six[4:]]])
        own = np.linalg.eigvalsh(about - joint.mass * (c @ c * np.eye(3) - np.outer(c, c)))
        assert own[0] >= 0.0 and own[2] <= own[0] + own[1] + 1e-9


def test_a_body_that_is_not_drawn_may_be_one() -> None:
    """Its numbers start at nothing, and are not held there."""
    device = random_robot(3, seed=3)
    joints = {name: dict(j) for name, j in device.declaration["robot"]["joints"].items()}
    joints["j1"] |= {"mass": 0.0, "center": [0.0, 0.0, 0.0], "inertia": [0.0] * 6}
    robot = device_from({**device.declaration, "robot": {"joints": joints}}).robot
    assert robot.undrawn == ["j1"] and robot.impossible == []
    sd = {p.name: p.sd for p in robot.parameters}
    heaviest = sum(joint.mass for joint in robot.joints)
    assert sd["mass.j1"] == pytest.approx(robot.uncertainty * 0.1 * heaviest)
