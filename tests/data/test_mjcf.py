"""MJCF files: the dynamics that MuJoCo reads from them, and what is refused, with a remedy."""

from pathlib import Path

import numpy as np
import pytest

from bampipe.data.chain import read_chain
from bampipe.data.device_file import read_device_file
from bampipe.errors import InputError
from bampipe.physics import Model, compile_model
from bampipe.physics.registry import device_from

ARM = """<mujoco model="arm">
<compiler {compiler} eulerseq="xyz"/>
<option gravity="0 1.5 -9.7"/>
<default><joint damping="0.5"/><default class="wrist"><joint axis="0 1 0" damping="0.1"/></default>
</default>
<worldbody><geom type="plane" size="1 1 1"/>
 <body name="stand" pos="0 0.1 0.4" euler="{a} {b} 0"><geom type="box" size="1 1 1"/>
  <body name="upper" pos="0.1 0 0.2" quat="0.9 0.1 0.3 -0.2">
   <inertial pos="0.1 0.02 0" mass="3" diaginertia="0.02 0.03 0.04" euler="{b} 0 {a}"/>
   <joint name="lift" axis="0 0 1" pos="0.05 0.02 -0.03" range="{low} {high}" frictionloss="0.3"
    armature="0.04"/>
   <body name="lower" pos="0.3 0 0" xyaxes="0 1 0 -1 0.2 0">
    <inertial pos="0.1 0 0.05" mass="1.5" fullinertia="0.02 0.03 0.04 0.001 0.002 -0.003"/>
    <joint name="bend" class="wrist"/>
    <joint name="reach" type="slide" axis="1 0 0.5" pos="0.1 0 0" actuatorfrcrange="-40 40"/>
    <body name="tool" pos="0.2 0 0" zaxis="0 1 1">
     <inertial pos="0 0 0.1" mass="0.4" diaginertia="0.001 0.001 0.002"/>
    </body>
   </body>
  </body>
 </body>
</worldbody>
<actuator><motor joint="lift" gear="50" ctrlrange="-2 1"/></actuator>
</mujoco>"""
DEGREES = {"compiler": "", "a": "20", "b": "-35", "low": "-90", "high": "60"}
TURN = {k: str(np.radians(float(DEGREES[k]))) for k in ("a", "b", "low", "high")}
RADIANS = {"compiler": 'angle="radian"', **TURN}


def write(folder: Path, text: str) -> Path:
    (folder / "arm.xml").write_text(text)
    (folder / "device.toml").write_text('name = "arm"\n[robot]\nurdf = "arm.xml"\n')
    return folder / "device.toml"


# Position, velocity and acceleration, and the forces that MuJoCo 4.0.0 takes for them: mj_inverse
# without constraints and damping.
MUJOCO = (
    (
        ((0.3, -0.5, 0.07), (0.4, -0.2, 0.3), (1.0, -2.0, 0.5)),
        (3.0627008487741425, -0.6547878732321624, 19.767005133816955),
    ),
    (
        ((-1.1, 2.0, -0.15), (-0.7, 1.5, -0.4), (-3.0, 0.6, 2.0)),
        (0.3025953140116579, 0.1324985797497855, -12.319484319748609),
    ),
)


@pytest.mark.parametrize("angles", [DEGREES, RADIANS], ids=["degrees", "radians"])
def test_the_dynamics_are_those_of_mujoco(tmp_path: Path, angles) -> None:
    text = ARM.format(**angles)
    system = compile_model(Model(device_from(read_device_file(write(tmp_path, text)))))
    assert system.coordinates == ("lift", "bend", "reach")
    p = system.prior
    p[[not x.name.startswith(("mass", "first", "inertia")) for x in system.parameters]] = 0.0
    q, qd, qdd = np.array([motion for motion, _ in MUJOCO]).swapaxes(0, 1)
    u, z = np.zeros((2, len(system.inputs))), np.zeros((2, 0))
    forces = system.required(q, qd, qdd, z, u, p)
    np.testing.assert_allclose(forces, [force for _, force in MUJOCO], rtol=1e-10)


def test_limits_and_losses_are_heard(tmp_path: Path) -> None:
    write(tmp_path, ARM.format(**DEGREES))
    robot, limits, _ = read_chain(tmp_path / "arm.xml", {})
    assert (robot["base"], robot["tip"]) == ("world", "lower")
    lift, bend, reach = (limits[name] for name in ("lift", "bend", "reach"))
    assert (lift.lower, lift.upper) == pytest.approx((-np.pi / 2, np.pi / 3))
    assert (lift.effort, lift.damping, lift.friction) == (100.0, 0.5, 0.3)
    assert (lift.armature, bend.armature) == (0.04, 0.0)
    assert (bend.damping, bend.lower, bend.upper) == (0.1, 0.0, 0.0)
    assert (reach.effort, reach.damping) == (40.0, 0.5)
    assert robot["gravity"] == [0.0, 1.5, -9.7]


@pytest.mark.parametrize(("motors", "ratio"), [("", 1.0), ("[robot.motors.m]\n", 10.0)])
def test_estimates_start_at_losses_and_armature(tmp_path: Path, motors: str, ratio: float) -> None:
    file = write(tmp_path, ARM.format(**DEGREES))
    if motors:
        others = "".join(f"[robot.motors.{j}]\nturns = {{ {j} = 1 }}\n" for j in ("bend", "reach"))
        file.write_text(f"{file.read_text()}{motors}turns = {{ lift = -{ratio} }}\n{others}")
    found = {p.name: p for p in device_from(read_device_file(file)).parameters}
    rotor = found["rotor_inertia_m" if motors else "rotor_inertia_lift"]
    assert rotor.prior == pytest.approx(0.04 / ratio**2)
    assert rotor.sd >= 5.0 * rotor.prior and not rotor.weighed
    assert (found["viscous.lift"].prior, found["coulomb.lift"].prior) == (0.5, 0.3)
    assert found["rotor_inertia_bend"].prior > 0.0


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('<inertial pos="0 0 0.1" mass="0.4" diaginertia="0.001 0.001 0.002"/>',
         '<geom type="sphere" size="1"/>', "body 'tool'.*follow from shapes.*saveinertial"),
        ("<worldbody>", '<include file="a.xml"/><worldbody>', "<include>.*mj_saveLastXML"),
        ('class="wrist"/>', 'type="ball"/>', "joint of type 'ball'"),
        ('axis="1 0 0.5"', 'axis="1 0"', "expected 3 numbers"),
        ('name="lower"', 'name="upper"', "a second body of that name"),
        ('gear="50"', 'gear="fifty"', "<motor gear>.*expected a number"),
        ('eulerseq="xyz"', 'eulerseq="xyw"', "eulerseq.*three of x, y, z"),
        ('class="wrist"/>', 'class="wirst"/>', "class 'wirst', did you mean 'wrist'"),
        ('quat="0.9 0.1 0.3 -0.2"', 'quat="0 0 0 0"', "quat of length zero"),
        ("<worldbody>", f"<default>{'<default>' * 300}{'</default>' * 300}</default><worldbody>",
         "elements are nested more than 200 deep"),
        ("<mujoco ", "<sdf ", "not XML|expected <robot>"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_one_line(tmp_path: Path, old: str, new: str, said: str) -> None:
    text = ARM.format(**DEGREES)
    assert old in text
    with pytest.raises(InputError, match=said):
        read_device_file(write(tmp_path, text.replace(old, new)))
