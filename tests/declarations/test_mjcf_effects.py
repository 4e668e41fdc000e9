"""Effects in an exported MJCF: MuJoCo and our own simulation under the same inputs."""

from pathlib import Path

import numpy as np
import pytest
from exported_run import write_run
from made_results import write_result

from bampipe.declarations.export import export_model
from bampipe.estimate.simulation import make_plant, simulate
from bampipe.results.identify import IdentifyResult

mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed: pip install mujoco")

RATE, SECONDS = 1000, 2.0
URDF = """<robot name="two"><link name="base"/>
<link name="upper"><inertial><origin xyz="0.2 0 0"/><mass value="2"/>
<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.05" iyz="0" izz="0.05"/></inertial></link>
<link name="lower"><inertial><origin xyz="0.15 0 0"/><mass value="1"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/></inertial></link>
<joint name="shoulder-1" type="continuous"><parent link="base"/><child link="upper"/>
<axis xyz="0 0 1"/></joint>
<joint name="elbow-2" type="continuous"><origin xyz="0.4 0 0" rpy="0.4 0 0"/>
<parent link="upper"/><child link="lower"/><axis xyz="0 0 1"/></joint></robot>"""
DEVICE = 'name = "two"\n[robot]\nurdf = "two.urdf"\n'
MOTORS = """[robot.motors.m1]
turns = { shoulder_1 = 30.0 }
[robot.motors.m2]
turns = { shoulder_1 = 12.0, elbow_2 = 20.0 }
"""
BASE = {"viscous": 0.8, "coulomb": 0.5, "rotor_inertia": 0.1}
EFFECTS = {
    "return_spring:elbow_2": {"stiffness": 3.0, "offset": 0.4},
    "cable_torque:elbow_2": {"stiffness": 1.0, "bending": 0.8, "stiffening": 2.0, "offset": 0.3},
    "quadratic_drag:shoulder_1": {"coefficient": 1.2},
    "upper_stop:elbow_2": {"stiffness": 30.0, "position": -0.3},
    "lower_stop:elbow_2": {"stiffness": 30.0, "position": -0.1},
    "flexible_load:elbow_2": {
        "inertia": 0.15,
        "frequency": 40.0,
        "damping": 0.05,
        "coulomb_behind": 1.5,
        "viscous_behind": 2.0,
    },
    "presliding:elbow_2": {"force": 0.4, "distance": 0.05},
    "stribeck:elbow_2": {"force": 0.8, "speed": 0.3},
    "lugre:elbow_2": {"force": 0.4, "rise": 0.5, "speed": 0.3, "distance": 0.05},
    "friction_of_sum:shoulder_1-elbow_2": {"viscous": 0.5, "coulomb": 0.5},
    "friction_of_difference:shoulder_1-elbow_2": {"viscous": 0.5, "coulomb": 0.5},
    "inertia_of_sum:shoulder_1-elbow_2": {"inertia": 0.1},
    "inertia_mismatch:elbow_2": {"inertia": 0.1},
    "force_gain:torque_elbow_2": {"error": 0.2},
    "force_bias:torque_elbow_2": {"bias": 0.5},
    "actuator_lag:torque_elbow_2": {"time_constant": 0.04},
    "drive_delay:torque_elbow_2": {"delay": 0.02},
    "actuator_delay": {"delay": 0.02},
}


class Case:
    """A robot with some effects in a run folder, its parameters known."""

    def __init__(self, folder: Path, effects: dict[str, dict[str, float]], motors: str = ""):
        folder.mkdir(exist_ok=True)
        (folder / "two.urdf").write_text(URDF)
        (folder / "device.toml").write_text(DEVICE + motors)
        self.run, self.system = write_run(folder, tuple(effects))
        self.p = self.system.prior.copy()
        known = {
            f"{e.replace(':', '.')}.{k}": v for e, own in effects.items() for k, v in own.items()
        }
        for i, item in enumerate(self.system.parameters):
            usual = BASE.get(item.name.partition(".")[0], self.p[i])
            self.p[i] = known.get(item.name, usual)
            if item.name.startswith("rotor_inertia"):
                self.p[i] = 1e-4 if motors else 0.1
            elif item.name in ("viscous_m2", "coulomb_m2"):
                self.p[i] = 0.002 if "viscous" in item.name else 0.02
        entries = {n: {"estimate": v} for n, v in self.system.by_name(self.p).items()}
        write_result(self.run.root, IdentifyResult, parameters=entries)
        self.text = export_model(self.run, "base", "mjcf")

    def ours(self, torque: np.ndarray, late: tuple[float, ...] = (0.0, 0.0)) -> np.ndarray:
        """Positions (T, 2) by our own simulation, each input moved by ``late``, s."""
        system, p, t = self.system, self.p.copy(), np.arange(len(torque)) / RATE
        for i, item in enumerate(system.parameters):
            if item.name.endswith("delay"):
                p[i] = 0.0
        u = np.zeros((len(t), len(system.inputs)))
        for k, name in enumerate(system.model.device.forces):
            u[:, system.inputs.index(name)] = np.interp(t - late[k], t, torque[:, k])
        rest = np.zeros(2)
        start = np.concatenate([rest, rest, system.initial_memory(rest, rest, u[0], p)])
        plant = make_plant(p, len(system.noise), system.sign_widths)
        return simulate(system.derivative, plant, start, u, 1.0 / RATE)[0][:, :2]

    def theirs(self, torque: np.ndarray) -> np.ndarray:
        """Positions (T, 2) by MuJoCo, joint torques ``torque`` at its drives."""
        model = mujoco.MjModel.from_xml_string(self.text)
        data, t = mujoco.MjData(model), np.arange(len(torque)) / RATE
        drives = [model.actuator(f"drive_{j}").id for j in ("shoulder-1", "elbow-2")]
        joints = [model.joint(j).qposadr[0] for j in ("shoulder-1", "elbow-2")]
        found = np.empty((len(t), 2))
        steps = round(1.0 / RATE / model.opt.timestep)
        for k in range(len(t)):
            found[k] = data.qpos[joints]
            for n in range(steps):
                at = t[k] + n * model.opt.timestep
                data.ctrl[drives] = [np.interp(at, t, column) for column in torque.T]
                mujoco.mj_step(model, data)
        return found


def waves(size: float = 1.0) -> np.ndarray:
    t = np.arange(int(SECONDS * RATE)) / RATE
    first = 4.0 * np.sin(2 * np.pi * 0.8 * t) + 2.0 * np.sin(2 * np.pi * 2.1 * t)
    second = 1.8 * np.sin(2 * np.pi * 1.1 * t) + 0.8 * np.sin(2 * np.pi * 2.7 * t)
    return size * np.column_stack([first, second])


def far(a: np.ndarray, b: np.ndarray) -> float:
    """How far two motions are apart, of how far they go."""
    return float(np.sqrt(np.mean((a - b) ** 2) / np.mean((a - a.mean(axis=0)) ** 2)))


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    return Case(tmp_path_factory.mktemp("bare"), {}).theirs(waves())


@pytest.mark.parametrize("effect", EFFECTS)
def test_mujoco_moves_as_our_own_simulation(effect: str, bare: np.ndarray, tmp_path: Path) -> None:
    case = Case(tmp_path, {effect: EFFECTS[effect]})
    delay = EFFECTS[effect].get("delay", 0.0)
    late = (delay if effect == "actuator_delay" else 0.0, delay)
    ours = case.ours(waves(), late)
    error = far(ours, case.theirs(waves()))
    assert error < 0.01
    assert far(ours, bare) > 5.0 * error
    assert "not in it" not in case.text


def test_several_effects_and_shared_motors_act_together(tmp_path: Path) -> None:
    names = ("return_spring:elbow_2", "presliding:elbow_2", "stribeck:elbow_2")
    case = Case(tmp_path / "all", {name: EFFECTS[name] for name in names})
    assert far(case.ours(waves()), case.theirs(waves())) < 0.01
    shared = Case(tmp_path / "shared", {}, MOTORS)
    assert "not in it" not in shared.text
    # Motor m1 turns the shoulder alone, m2 both: what they give the joints.
    motors = waves() / np.array([30.0, 20.0])
    joints = motors @ np.array([[30.0, 0.0], [12.0, 20.0]])
    assert far(shared.ours(motors), shared.theirs(joints)) < 0.01


def test_play_before_a_load_is_nearly_so_and_said_to_be(tmp_path: Path, bare: np.ndarray) -> None:
    loose = {"inertia": 0.15, "gap": 0.05, "frequency": 60.0, "damping": 0.3, "hang": 0.01}
    case = Case(tmp_path, {"loose_link:elbow_2": loose})
    ours = case.ours(waves())
    assert far(ours, case.theirs(waves())) < min(0.1, 0.3 * far(ours, bare))
    assert "not in it: of loose_link:elbow_2 its weight, and that nothing damps it" in case.text


def test_what_mujoco_has_no_place_for_is_listed(tmp_path: Path) -> None:
    effects = {"load_dependent_friction:elbow_2": {}, "drive_reading_delay:torque_elbow_2": {}}
    effects["upper_stop:elbow_2"] = {"stiffness": 30.0, "settling": 0.01}
    case = Case(tmp_path / "a", effects)
    assert f"not in it: {', '.join(effects)}" in case.text
    # More presliding than there is friction has none, either.
    case = Case(tmp_path / "b", {"presliding:elbow_2": {"force": 0.9, "distance": 0.05}})
    assert "not in it: presliding:elbow_2" in case.text
