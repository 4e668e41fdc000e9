"""Exported robots: the file that was drawn, and the dynamics that were identified, by Pinocchio."""

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from exported_run import write_run
from made_results import write_result

from bampipe.data.run_folder import RunFolder
from bampipe.declarations.export import Form, export_model
from bampipe.physics import System
from bampipe.physics.robot import INERTIAL_NAMES
from bampipe.results.identify import IdentifyResult

pin = pytest.importorskip("pinocchio")

INERTIAL = """<inertial><origin xyz="{x} -0.02 0.05" rpy="0.3 -0.5 1.1"/><mass value="{m}"/>
<inertia ixx="0.02" ixy="0.001" ixz="-0.002" iyy="0.03" iyz="0.003" izz="0.025"/></inertial>"""


def link(name: str, mass: float = 0.0, inside: str = "") -> str:
    inertial = INERTIAL.format(x=0.02 + 0.03 * mass, m=mass) if mass else ""
    return f'<link name="{name}">{inside}{inertial}</link>'


def joint(name: str, kind: str, parent: str, child: str, axis: str = "0 0 1") -> str:
    """A joint whose place and turn follow from its name, all different."""
    seed = sum(map(ord, name))
    xyz = np.random.default_rng(seed).uniform(-0.3, 0.3, 3).round(3)
    rpy = np.random.default_rng(seed + 1).uniform(-1.5, 1.5, 3).round(3)
    moves = f'<axis xyz="{axis}"/><limit lower="-2" upper="1.5" effort="80" velocity="3"/>'
    return f"""<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="{" ".join(map(str, xyz))}" rpy="{" ".join(map(str, rpy))}"/>
{moves if kind != "fixed" else ""}</joint>"""


# Links fixed before, between and behind the joints, one on another; joints beside the chain at the
# base, in the middle and at the end, with what is fixed to them.
URDF = "\n".join(
    [
        '<?xml version="1.0"?><robot name="cell" xmlns:drake="http://drake.mit.edu">',
        "<!-- drawn by hand -->",
        '<material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>',
        link("floor"),
        joint("stand", "fixed", "floor", "base plate"),
        link("base plate", 5.0),
        joint("camera_turn", "revolute", "base plate", "camera"),
        link("camera", 0.4),
        joint("pan-1", "revolute", "base plate", "upper", "0 0.6 0.8"),
        link("upper", 3.0, '<visual><geometry><mesh filename="a.stl"/></geometry></visual>'),
        joint("cover_mount", "fixed", "upper", "cover"),
        link("cover", 0.7),
        joint("lamp_mount", "fixed", "cover", "lamp"),
        link("lamp", 0.2),
        joint("bracket_mount", "fixed", "upper", "bracket"),
        link("bracket", 0.5),
        joint("slide", "prismatic", "bracket", "carriage", "1 0 0"),
        link("carriage", 1.5),
        joint("hook_turn", "continuous", "carriage", "hook"),
        link("hook", 0.3),
        joint("hook_end", "fixed", "hook", "hook tip"),
        link("hook tip", 0.1),
        joint("bend", "continuous", "carriage", "lower", "0 1 0"),
        link("lower"),
        joint("flange_mount", "fixed", "lower", "flange"),
        link("flange"),
        joint("tool_mount", "fixed", "flange", "tool0"),
        link("tool0", 0.9),
        joint("left_finger", "prismatic", "tool0", "left"),
        link("left", 0.15),
        '<transmission name="t"><joint name="slide"/></transmission>',
        '<drake:joint_limits joint="slide"/></robot>',
    ]
)
MOVING = {"pan-1": "pan_1", "slide": "slide", "bend": "bend"}
DEVICE = """name = "cell"
[robot]
urdf = "cell.urdf"
tip = "tool0"
[robot.payload]
mass = 0.6
center = [0.0, 0.05, 0.1]
"""
DH = """name = "table"
[robot]
gravity = [0.0, 0.0, -9.81]
[robot.dh.waist]
d = 0.4
alpha = -1.2
offset = 0.3
mass = 3.0
center = [0.0, 0.1, 0.02]
inertia = [0.03, 0.0, 0.001, 0.02, 0.0, 0.04]
[robot.dh.reach]
kind = "prismatic"
a = 0.2
alpha = 0.7
mass = 1.0
[robot.dh.wrist]
d = 0.1
a = 0.3
alpha = 0.5
mass = 0.5
center = [0.1, 0.0, 0.0]
"""


@dataclass(frozen=True)
class Identified:
    """A run folder with one identified model, the compiled one, and its parameters."""

    run: RunFolder
    system: System
    p: np.ndarray

    def required(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, drives: bool) -> np.ndarray:
        """Joint forces of the bodies, and of the drives' inertia, without friction."""
        p = self.p.copy()
        for i, item in enumerate(self.system.parameters):
            lost = ("viscous", "coulomb") if drives else ("viscous", "coulomb", "rotor")
            if item.name.startswith(lost):
                p[i] = 0.0
        u, z = np.zeros((len(q), len(self.system.inputs))), np.zeros((len(q), 0))
        return self.system.required(q, qd, qdd, z, u, p)


def identify(folder: Path, files: dict[str, str]) -> Identified:
    """Write what ingest and identify leave: a ball more on every link, other losses and drives."""
    for name, text in files.items():
        (folder / name).write_text(text)
    run, system = write_run(folder)
    rng = np.random.default_rng(4)
    p = system.prior + 0.2 * rng.uniform(size=len(system.parameters))
    balls = {j: dict(zip(INERTIAL_NAMES, ball(rng), strict=True)) for j in system.coordinates}
    for i, item in enumerate(system.parameters):
        short, _, name = item.name.rpartition(".")
        if short in INERTIAL_NAMES:
            p[i] = item.prior + (0.0 if item.fixed else balls[name][short])
    entries = {name: {"estimate": value} for name, value in system.by_name(p).items()}
    write_result(run.root, IdentifyResult, parameters=entries)
    return Identified(run, system, p)


def ball(rng: np.random.Generator) -> np.ndarray:
    """The ten numbers of a ball somewhere near the joint."""
    x, y, z = center = rng.uniform(-0.1, 0.1, 3)
    mass, own = 0.2, 0.02
    xx, yy, zz = own + mass * (center @ center - center**2)
    return np.array(
        [mass, *(mass * center), xx, -mass * x * y, -mass * x * z, yy, -mass * y * z, zz]
    )


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Identified:
    return identify(tmp_path_factory.mktemp("cell"), {"cell.urdf": URDF, "device.toml": DEVICE})


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Identified:
    return identify(tmp_path_factory.mktemp("table"), {"device.toml": DH})


def read_by_pinocchio(text: str, form: Form, folder: Path, moving: list[str]) -> object:
    """The model of a text, all joints but ``moving`` held at zero."""
    (folder / "cell.xml").write_text(text)
    read = pin.buildModelFromXML if form == "urdf" else pin.buildModelFromMJCF
    model = read(text if form == "urdf" else str(folder / "cell.xml"))
    beside = [k for k, name in enumerate(model.names) if k and name not in moving]
    return pin.buildReducedModel(model, beside, pin.neutral(model)) if beside else model


def random_motions(n: int) -> np.ndarray:
    return np.random.default_rng(3).uniform(-1.4, 1.4, (3, 20, n))


def forces(model: object, motions: np.ndarray, circles: list[int]) -> np.ndarray:
    """Forces by Pinocchio, in which a joint that turns without end is a point on a circle."""
    data = model.createData()
    found = []
    for q, qd, qdd in motions.transpose(1, 0, 2):
        parts = [[np.cos(x), np.sin(x)] if k in circles else [x] for k, x in enumerate(q)]
        found.append(pin.rnea(model, data, np.concatenate(parts), qd, qdd).copy())
    return np.array(found)


@pytest.mark.parametrize("form", ["urdf", "mjcf"])
def test_the_dynamics_are_those_of_the_identified_model(
    cell: Identified, form: Form, tmp_path: Path
) -> None:
    text = export_model(cell.run, "base", form)
    model = read_by_pinocchio(text, form, tmp_path, list(MOVING))
    motions = random_motions(3)
    found = forces(model, motions, circles=[2] if form == "urdf" else [])
    expected = cell.required(*motions, drives=form == "mjcf")
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_a_base_that_a_fixed_joint_tilts_has_the_gravity_of_the_root(tmp_path: Path) -> None:
    device = DEVICE.replace("tip =", 'base = "base plate"\ntip =')
    tilted = identify(tmp_path, {"cell.urdf": URDF, "device.toml": device})
    text = export_model(tilted.run, "base", "urdf")
    assert "gravity" not in text.partition("<material")[0]
    model = read_by_pinocchio(text, "urdf", tmp_path, list(MOVING))
    motions = random_motions(3)
    expected = tilted.required(*motions, drives=False)
    np.testing.assert_allclose(forces(model, motions, [2]), expected, rtol=1e-9, atol=1e-9)


def test_a_urdf_is_given_back_with_its_names_frames_and_shapes(cell: Identified) -> None:
    text = export_model(cell.run, "base", "urdf")
    before, after = ElementTree.fromstring(URDF), ElementTree.fromstring(text)
    for tag in ("link", "joint", "material", "transmission"):
        names = [[e.get("name") for e in root.iterfind(tag)] for root in (before, after)]
        assert names[0] == names[1]
    assert "<!-- drawn by hand -->" in text and '<drake:joint_limits joint="slide"' in text
    for root in (before, after):
        for element in root.iter():
            for inner in [*element.iterfind("inertial"), *element.iterfind("dynamics")]:
                element.remove(inner)
            element.text = element.tail = None
    assert ElementTree.tostring(before) == ElementTree.tostring(after)


def test_mass_is_with_the_link_that_carries_it_or_beyond_a_joint_as_drawn(cell: Identified) -> None:
    text = export_model(cell.run, "base", "urdf")
    masses = {
        e.get("name"): float(e.find("inertial/mass").get("value"))  # type: ignore[union-attr]
        for e in ElementTree.fromstring(text).iterfind("link")
        if e.find("inertial") is not None
    }
    value = cell.system.by_name(cell.p)
    untouched = {"base plate": 5.0, "camera": 0.4, "hook": 0.3, "hook tip": 0.1, "left": 0.15}
    assert masses == {
        **untouched,
        "upper": pytest.approx(value["mass.pan_1"]),
        "carriage": pytest.approx(value["mass.slide"] - 0.4),
        "lower": pytest.approx(value["mass.bend"] - 0.15),
    }
    said = "masses fixed to a link are part of that link, not of cover, lamp, bracket and"
    assert f"{said} tool0; the payload of 0.6 kg is in the last link that moves" in text
    losses = {
        e.get("name"): e.find("dynamics") for e in ElementTree.fromstring(text).iterfind("joint")
    }
    for name, coordinate in MOVING.items():
        assert float(losses[name].get("damping")) == value[f"viscous.{coordinate}"]
        assert float(losses[name].get("friction")) == value[f"coulomb.{coordinate}"]
    assert losses["camera_turn"] is None


def test_an_mjcf_has_the_links_of_the_urdf_and_what_is_beside_the_chain_fixed(
    cell: Identified,
) -> None:
    root = ElementTree.fromstring(export_model(cell.run, "base", "mjcf"))
    drawn = ElementTree.fromstring(URDF)
    bodies = {e.get("name") for e in root.iter("body")}
    assert bodies == {e.get("name") for e in drawn.iterfind("link")}
    joints = {e.get("name"): e for e in root.iterfind("worldbody//joint")}
    assert set(joints) == set(MOVING)
    assert joints["slide"].get("range") == "-2.0 1.5"


def test_a_drawing_too_heavy_beside_the_chain_is_said(tmp_path: Path) -> None:
    heavy = URDF.replace(link("left", 0.15), link("left", 4.0))
    found = identify(tmp_path, {"cell.urdf": heavy, "device.toml": DEVICE})
    entries = {q.name: {"estimate": float(v)} for q, v in zip(
        found.system.parameters, found.p, strict=True
    )}  # fmt: skip
    entries["mass.bend"] = {"estimate": 3.0}
    for number in ("xx", "yy", "zz"):
        entries[f"inertia_{number}.bend"] = {"estimate": 2.0}
    write_result(found.run.root, IdentifyResult, parameters=entries)
    text = export_model(found.run, "base", "urdf")
    assert "no possible body remains for lower: the bodies beside the chain" in text


@pytest.mark.parametrize("form", ["urdf", "mjcf"])
def test_a_table_of_denavit_and_hartenberg_gives_its_names_and_frames(
    table: Identified, form: Form, tmp_path: Path
) -> None:
    text = export_model(table.run, "base", form)
    names = ["waist", "reach", "wrist"]
    model = read_by_pinocchio(text, form, tmp_path, names)
    assert [str(name) for name in model.names][1:] == names
    motions = random_motions(3)
    circles = [0, 2] if form == "urdf" else []
    expected = table.required(*motions, drives=form == "mjcf")
    np.testing.assert_allclose(forces(model, motions, circles), expected, rtol=1e-9, atol=1e-9)
    q = motions[0][0]
    data = model.createData()
    parts = [[np.cos(x), np.sin(x)] if k in circles else [x] for k, x in enumerate(q)]
    pin.framesForwardKinematics(model, data, np.concatenate(parts))
    place = np.eye(4)
    for row, x in zip(([0.4, 0.0, -1.2], [0.0, 0.2, 0.7], [0.1, 0.3, 0.5]), q, strict=True):
        turn, slide = (x + (0.3 if row[0] == 0.4 else 0.0), 0.0) if row[1] != 0.2 else (0.0, x)
        place = place @ denavit_hartenberg(turn, row[0] + slide, row[1], row[2])
    tool = data.oMf[model.getFrameId("wrist_frame")]
    np.testing.assert_allclose(tool.homogeneous, place, atol=1e-12)


def denavit_hartenberg(theta: float, d: float, a: float, alpha: float) -> np.ndarray:
    """The matrix of one row in standard form (Denavit and Hartenberg 1955)."""
    (ct, st), (ca, sa) = ((np.cos(v), np.sin(v)) for v in (theta, alpha))
    return np.array(
        [
            [ct, -st * ca, st * sa, a * ct],
            [st, ct * ca, -ct * sa, a * st],
            [0.0, sa, ca, d],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
