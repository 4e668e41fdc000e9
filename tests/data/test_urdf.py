"""URDF files: chains, what hangs beside them, and what is refused, with a remedy."""

from pathlib import Path

import numpy as np
import pytest

from bampipe.data.chain import read_chain
from bampipe.data.device_file import read_device_file
from bampipe.errors import InputError
from bampipe.physics import Model, System, compile_model
from bampipe.physics.device import Device
from bampipe.physics.registry import device_from
from bampipe.physics.units import check_device
from bampipe.run.hashing import digest_session

LINK = """<link name="{name}"><inertial><origin xyz="{x} 0 0" rpy="0 0 {yaw}"/>
<mass value="{mass}"/>
<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.2" iyz="0" izz="0.25"/></inertial></link>"""
JOINT = """<joint name="{name}" type="{kind}"><origin xyz="{x} 0 0" rpy="0 0 0"/>
<parent link="{parent}"/><child link="{child}"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="2" effort="40" velocity="4"/>
<dynamics damping="0.5" friction="0.25"/></joint>"""


def link(name: str, mass: float = 1.0, x: float = 0.0, yaw: float = 0.0) -> str:
    return LINK.format(name=name, mass=mass, x=x, yaw=yaw)


def joint(name: str, parent: str, child: str, kind: str = "revolute", x: float = 0.5) -> str:
    return JOINT.format(name=name, parent=parent, child=child, kind=kind, x=x)


def chain_of(count: int, kind: str = "revolute") -> tuple[str, ...]:
    links = (link(f"l{k}") for k in range(count + 1))
    return (*links, *(joint(f"j{k}", f"l{k}", f"l{k + 1}", kind) for k in range(count)))


def write(folder: Path, *parts: str) -> Path:
    path = folder / "arm.urdf"
    path.write_text(f'<?xml version="1.0"?><robot name="arm">{"".join(parts)}</robot>')
    return path


def device_of(folder: Path, tables: str = "", parts: tuple[str, ...] | None = None) -> Device:
    """The device of an arm, with more tables in its file; of ``ARM`` by default."""
    write(folder, *(ARM if parts is None else parts))
    path = folder / "device.toml"
    path.write_text(f'name = "arm"\n[robot]\nurdf = "arm.urdf"\n{tables}')
    return device_from(read_device_file(path), str(path))


ARM = (
    link("base"), link("upper", 2.0, x=0.25), link("lower", 1.0, x=0.25, yaw=np.pi / 2),
    link("tool", 0.5), joint("shoulder-pan", "base", "upper", x=0.0),
    joint("elbow", "upper", "lower"), joint("flange", "lower", "tool", "fixed"),
)  # fmt: skip


def test_a_chain_is_read_with_what_is_fixed_to_it_and_held_beside_it(tmp_path: Path) -> None:
    joints = read_chain(write(tmp_path, *ARM), {})[0]["joints"]
    assert list(joints) == ["shoulder_pan", "elbow"]
    elbow = joints["elbow"]
    assert elbow["after"] == "shoulder_pan"
    assert elbow["mass"] == pytest.approx(1.5)  # the tool is part of it
    assert elbow["center"] == pytest.approx([(0.25 + 0.5 * 0.5) / 1.5, 0.0, 0.0])
    # Turned by a quarter, xx and yy change places; both bodies are moved to the common centre.
    apart = 1.0 * 0.5 / 1.5 * 0.25**2
    assert elbow["inertia"][0] == pytest.approx(0.2 + 0.1)
    assert elbow["inertia"][3] == pytest.approx(0.1 + 0.2 + apart)
    held = {"mass": 1.5, "center": [0.2, 0.0, 0.0]}
    robot, _, _ = read_chain(write(tmp_path, *ARM), {"tip": "tool", "payload": held})
    assert robot["joints"]["elbow"]["mass"] == pytest.approx(3.0)
    finger = (link("finger", 0.1), joint("grip", "tool", "finger", "prismatic", x=0.0))
    robot, _, notes = read_chain(write(tmp_path, *ARM, *finger), {"tip": "tool"})
    assert list(robot["joints"]) == ["shoulder_pan", "elbow"]
    assert robot["joints"]["elbow"]["mass"] == pytest.approx(1.6)
    assert notes == ["held at zero beside the chain: grip"]


def test_a_device_file_needs_no_more_than_the_urdf(tmp_path: Path) -> None:
    device = device_of(tmp_path)
    assert [c.name for c in device.coordinates] == ["shoulder_pan", "elbow"]
    assert device.forces == ("torque_shoulder_pan", "torque_elbow")
    assert device.limits["elbow"] == (-1.0, 2.0)
    assert device.friction["elbow"].viscous.prior == 0.5
    assert device.friction["elbow"].coulomb.prior == 0.25
    assert device.source == "arm.urdf, base to lower"
    assert check_device(device) == []


@pytest.mark.parametrize(
    ("parts", "what", "remedy"),
    [
        (
            (*ARM, link("left"), joint("other", "upper", "left")),
            "the joints branch; chains end at lower and left",
            'choose one: base = "..." and tip = "..." in [robot]',
        ),
        (
            (*ARM, '<xacro:include filename="x" xmlns:xacro="http://ros.org/xacro"/>'),
            "a xacro file: macros that are no URDF yet",
            "expand it first: xacro arm.urdf > arm.urdf",
        ),
        (
            (link("base"), link("b"), joint("j", "base", "b", "floating")),
            "a joint of type 'floating'",
            "between base and tip joints are revolute, continuous, prismatic or fixed",
        ),
        ((*ARM, joint("loop", "base", "lower")), "two joints above it: a closed loop", "cut"),
        ((*ARM, joint("j", "lower", "nowhere")), "names link 'nowhere', which is not there", ""),
        ((*ARM, link("upper")), "two links are called 'upper'", ""),
        (
            (*ARM, link("a"), link("b"), joint("x", "a", "b"), joint("y", "b", "a")),
            "the joints above 'b' form a loop",
            "",
        ),
        ((link("a"), joint("x", "a", "a")), "the joints above 'a' form a loop", ""),
        (chain_of(250, "fixed"), "more than 200 links one behind another", ""),
        ((), "no links", ""),
        ((link("a"), link("b")), "2 links have nothing above them", "base = ..."),
    ],
)
def test_what_is_no_chain_is_refused_with_a_remedy(
    parts: tuple[str, ...], what: str, remedy: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError) as caught:
        read_chain(write(tmp_path, *parts), {})
    assert what in caught.value.what and remedy in caught.value.remedy


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("<robot>", "not XML"),
        ("<machine/>", "found <machine>, expected <robot>"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><robot/>', "no document type"),
        (
            '<robot><link name="a"><inertial><mass value="heavy"/></inertial></link></robot>',
            "heavy",
        ),
    ],
)
def test_damaged_files_are_refused(text: str, what: str, tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(text)
    with pytest.raises(InputError, match=what):
        read_chain(path, {})


def test_limits_below_zero_are_unknown_and_no_urdf_lies_outside_the_folder(tmp_path: Path) -> None:
    parts = (link("a"), link("b"), joint("j", "a", "b"))
    parts = tuple(part.replace('effort="40"', 'effort="-40"') for part in parts)
    device = device_of(tmp_path, parts=parts)
    assert {p.name: p.sd for p in device.parameters}["coulomb.j"] == 5.0
    path = tmp_path / "device.toml"
    path.write_text('name = "arm"\n[robot]\nurdf = "../arm.urdf"\n')
    with pytest.raises(InputError, match="leaves the folder"):
        read_device_file(path)


def test_a_motor_that_two_joints_turn_has_friction_and_inertia_of_their_sum(tmp_path: Path) -> None:
    device = device_of(
        tmp_path,
        "[robot.motors.one]\nturns = { shoulder_pan = 50.0 }\n"
        "[robot.motors.two]\nturns = { shoulder_pan = -32.0, elbow = 32.0 }\n"
        "rotor_inertia = 2e-4\n",
    )
    assert check_device(device) == []
    assert device.forces == ("torque_one", "torque_two")
    system = compile_model(Model(device))
    map_ = system.input_map(np.zeros((1, 2)))[0]
    np.testing.assert_allclose(map_, [[50.0, -32.0], [0.0, 32.0]])
    p = np.zeros(len(system.parameters))
    p[system.index("rotor_inertia_two")] = 2e-4
    turns = np.array([-32.0, 32.0])
    mass = system.mass_matrix(np.zeros((1, 2)), p)[0]
    np.testing.assert_allclose(mass, 2e-4 * np.outer(turns, turns), atol=1e-12)
    p[:] = 0.0
    p[system.index("viscous_two")], p[system.index("coulomb_two")] = 0.01, 0.1
    qd = np.array([[0.3, -0.2]])
    none, u = np.zeros((1, 2)), np.zeros((1, len(system.inputs)))
    speed = float(turns @ qd[0])
    required = system.required(none, qd, none, np.zeros((1, 0)), u, p)[0]
    np.testing.assert_allclose(required, turns * (0.01 * speed + 0.1 * np.sign(speed)), rtol=1e-6)


def test_motors_by_current_have_torque_constants(tmp_path: Path) -> None:
    motor = "[robot.motors.{}]\nturns = {{ {} = 100.0 }}\ntorque_constant = 0.1\n"
    first, second = motor.format("one", "shoulder_pan"), motor.format("two", "elbow")
    device = device_of(tmp_path, f"{first}torque_constant_sd = 0.01\n{second}")
    assert check_device(device) == []
    assert device.force_unit == "A"
    parameters = {p.name: p for p in device.parameters}
    assert parameters["torque_constant_one"].weighed
    assert parameters["torque_constant_two"].fixed


MOTORS = (
    "[robot.motors.one]\nturns = {{ elbow = 1.0 }}\ntorque_constant = 1.0\n{}"
    "[robot.motors.two]\nturns = {{ shoulder_pan = 1.0 }}\n{}"
)
SD = "torque_constant_sd = 0.1\n"


@pytest.mark.parametrize(
    ("tables", "parts", "what"),
    [
        ("[robot.motors.one]\nturns = { wrist = 1.0 }\n", ARM, "there is no joint 'wrist'"),
        ("[robot.motors.one]\nturns = {}\n", ARM, "at least 1"),
        (MOTORS.format("", ""), ARM, "some motors have a torque_constant, others do not"),
        (MOTORS.format(SD, f"torque_constant = 1.0\n{SD}"), ARM,
         "every torque constant is estimated, so the scale of all masses is undetermined"),
        ("[robot.payload]\ncenter = [0.0, 0.0, 0.1]\n", ARM, "'mass' is missing"),
        ("", chain_of(40), "40 joints; a robot has at most 32; choose a part"),
        ("", (link("a"), link("b", mass=1e300), joint("j", "a", "b")), "joints.j: a body beyond"),
    ],
)  # fmt: skip
def test_wrong_robots_motors_and_payloads_are_refused_in_one_line(
    tables: str, parts: tuple[str, ...], what: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=what) as caught:
        check_device(device_of(tmp_path, tables, parts))
    assert not caught.value.others and "\n" not in str(caught.value)


def test_a_table_of_denavit_and_hartenberg_is_the_same_robot(tmp_path: Path) -> None:
    """Two links in a plane: a DH frame at the end of each, the bodies' centres behind it."""
    write(tmp_path, *ARM)
    urdf, table = tmp_path / "urdf.toml", tmp_path / "dh.toml"
    urdf.write_text('name = "arm"\n[robot]\nurdf = "arm.urdf"\ngravity = [1.0, -9.0, 0.0]\n')
    bodies = device_from(read_device_file(urdf)).robot
    rows = [
        f"[robot.dh.{joint.name}]\na = 0.5\nmass = {joint.mass}\n"
        f"center = [{joint.center[0] - 0.5}, 0.0, 0.0]\ninertia = {list(joint.inertia)}\n"
        for joint in bodies.joints
    ]
    table.write_text('name = "arm"\n[robot]\ngravity = [1.0, -9.0, 0.0]\n' + "".join(rows))
    systems = [compile_model(Model(device_from(read_device_file(p)))) for p in (urdf, table)]
    q, qd, qdd = np.random.default_rng(0).normal(size=(3, 20, 2))
    u, z = np.zeros((20, 2)), np.zeros((20, 0))
    p = systems[0].prior
    one, other = (s.required(q, qd, qdd, z, u, np.append(p[:6], s.prior[6:])) for s in systems)
    np.testing.assert_allclose(one, other, atol=1e-12)


TILT = """<joint name="{name}" type="{kind}"><origin xyz="0 0 1" rpy="{rpy}"/>
<parent link="world"/><child link="base"/><axis xyz="{axis}"/></joint>"""


@pytest.mark.parametrize(
    ("kind", "rpy", "axis", "gravity", "said"),
    [
        ("fixed", "0 0 0", "0 0 1", None, ""),
        ("fixed", "0 0 1.2", "0 0 1", None, ""),
        ("prismatic", "0 0 0", "1 0 0", None, ""),
        ("fixed", "1.5707963267948966 0 0", "0 0 1", (0.0, -9.81, 0.0), "in the frame of base"),
        ("fixed", "0 0.5 0", "0 0 1", (9.81 * np.sin(0.5), 0.0, -9.81 * np.cos(0.5)), "world"),
        ("continuous", "0 0 0", "0 0 2", None, ""),
        ("continuous", "0 0 0", "1 0 0", None, "along -z of base, which mount can tilt"),
        ("floating", "0 0 0", "0 0 1", None, "along -z of base, which mount can tilt"),
    ],
)
def test_gravity_is_that_of_the_root_above_the_base(
    tmp_path: Path, kind: str, rpy: str, axis: str, gravity: tuple[float, ...] | None, said: str
) -> None:
    mount = TILT.format(name="mount", kind=kind, rpy=rpy, axis=axis)
    parts, base = (*ARM, '<link name="world"/>', mount), 'base = "base"\n'
    robot, _, notes = read_chain(write(tmp_path, *parts), {"base": "base"})
    assert robot.get("gravity") == (None if gravity is None else pytest.approx(list(gravity)))
    assert said in "".join(notes) and bool(said) == bool(notes)
    device = device_of(tmp_path, base, parts)
    assert device.robot is not None and said in device.declaration["source"]
    assert device.robot.gravity == pytest.approx(gravity or (0.0, 0.0, -9.81))
    given = device_of(tmp_path, base + "gravity = [0.0, 9.81, 0.0]\n", parts)
    assert given.robot is not None and "gravity" not in given.declaration["source"]
    assert given.robot.gravity == (0.0, 9.81, 0.0)


def test_a_session_depends_on_its_urdf_and_on_parts_of_its_trials(tmp_path: Path) -> None:
    device_of(tmp_path)
    trials = '[[trials]]\nfile = "a.csv"\n[[trials.parts]]\nfile = "./b.csv"\n'
    (tmp_path / "session.toml").write_text(f'device = "device.toml"\n{trials}')
    before = digest_session(tmp_path)
    write(tmp_path, *ARM, link("weight", 3.0), joint("grip", "tool", "weight", "fixed"))
    (tmp_path / "b.csv").write_text("t,u\n")
    after = digest_session(tmp_path)
    changed = {name for name in after if after[name] != before[name]}
    assert changed == {"session:arm.urdf", "session:./b.csv"}


FOLLOWS = '<mimic joint="{}" multiplier="{}" offset="{}"/></joint>'


def following(entry: str, other: str, ratio: float, zero: float) -> str:
    return entry.replace("</joint>", FOLLOWS.format(other, ratio, zero))


def system_of(folder: Path, *parts: str) -> System:
    folder.mkdir()
    return compile_model(Model(device_of(folder, "gravity = [3.0, -5.0, -7.0]\n", parts)))


def test_a_joint_that_follows_another_moves_with_it(tmp_path: Path) -> None:
    """By virtual work on the same chain with all its joints free."""
    links = (link("l0"), link("l1", 2.0, 0.25), link("l2", 1.0, 0.2, 0.4), link("l3", 0.7, 0.1))
    first, last = joint("a", "l0", "l1"), joint("c", "l2", "l3").replace("0 0 1", "1 0 0")
    middle = joint("b", "l1", "l2").replace("0 0 1", "0 1 0")
    free = system_of(tmp_path / "free", *links, first, middle, last)
    held = system_of(tmp_path / "held", *links, first, following(middle, "a", -0.5, 0.3), last)
    assert held.coordinates == ("a", "c")
    assert held.model.device.forces == ("torque_a", "torque_c")
    forces = []
    moves = np.array([[1.0, 0.0], [-0.5, 0.0], [0.0, 1.0]])
    q, qd, qdd = np.random.default_rng(0).normal(size=(3, 20, 2))
    for system, by in ((held, np.eye(2)), (free, moves)):
        p = system.prior
        p[[x.name.startswith(("visc", "coul", "rotor")) for x in system.parameters]] = 0.0
        at = q @ by.T + (np.array([0.0, 0.3, 0.0]) if system is free else 0.0)
        none = np.zeros((20, 0)), np.zeros((20, len(system.inputs)))
        forces.append(system.required(at, qd @ by.T, qdd @ by.T, *none, p) @ by)
    np.testing.assert_allclose(forces[0], forces[1], rtol=0.0, atol=1e-11)
    robot = held.model.device.robot
    drawn = robot.drawn_forces(q, qd, qdd, np.array(robot.gravity))
    np.testing.assert_allclose(drawn, forces[0], rtol=0.0, atol=1e-11)


def test_what_follows_a_joint_beside_the_chain_is_held(tmp_path: Path) -> None:
    beside = joint("side", "l1", "l9", x=0.1)
    parts = (*chain_of(3), link("l9"), beside)
    parts = tuple(following(p, "side", 2.0, 0.0) if 'name="j1"' in p else p for p in parts)
    robot, _, notes = read_chain(write(tmp_path, *parts), {"tip": "l3"})
    assert list(robot["joints"]) == ["j0", "j2"]
    assert any("held at zero" in note and "j1" in note for note in notes)
