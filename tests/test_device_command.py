"""``bampipe device`` and ``bampipe effects check``: equations, and one line for each fault."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import pytest
from conftest import Command
from independent import arm

from bampipe.physics import registry

DOCUMENT = Path(__file__).parent.parent / "docs" / "devices.md"
RAIL = re.findall(r"```toml\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.S)[0]
SNAG = re.findall(
    r"```toml\n(.*?)```", (DOCUMENT.parent / "effects.md").read_text(encoding="utf-8"), re.S
)[0]


def faults(result: tuple[int, str, str]) -> list[str]:
    """Messages of a refused command."""
    code, _, err = result
    assert code == 2 and "Traceback" not in err
    assert all(line.startswith("bampipe: error: ") for line in err.splitlines())
    return [line.removeprefix("bampipe: error: ") for line in err.splitlines()]


@pytest.fixture
def rail(tmp_path: Path) -> Callable[..., str]:
    """Write the rail of the documents with some of its text replaced."""

    def write(*changes: tuple[str, str]) -> str:
        text = RAIL
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "rail.toml").write_text(text)
        return str(tmp_path / "rail.toml")

    return write


def test_a_sound_device_shows_its_equations(rail, command: Command) -> None:
    code, out, err = command("device", "check", rail())
    assert (code, err) == (0, "")
    assert "M[x,x] = mass + 2 pulley_inertia/pulley_radius^2" in out
    assert "names, units and equations fit together" in out
    assert command("device", "check", rail(), "--quiet") == (0, "", "")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            [('unit = "m/s2"', 'unit = "m/s"'), ('"position/pulley', '"positon/pulley')],
            ["definitions.turn: unknown symbol 'positon'", "energy.potential: is kg.m2/s where"],
        ),
        (
            [('force_unit = "N"', 'force_unit = "lbf"'), ('"N", prior = 2', '"N.m", prior = 2')],
            ["inputs.force_unit: unit 'lbf'", "friction.position.coulomb: unit 'N.m' where N"],
        ),
        (
            [('kind = "linear"', 'kind = "liner"'), ("sd = 1.0", 'sd = "wide"')],
            ["coordinates.position.kind", "parameters.mass.sd: found"],
        ),
        (
            [('"mass*g*', '"mass**'), ('"position/pulley_radius"', '"open(1)"')],
            ["definitions.turn: unknown function 'open'", "energy.potential: an exponent must"],
        ),
        ([("mass*ddt(position)**2 + 2*pulley_inertia*ddt(turn)**2", "mass*g*position")],
         ["the kinetic energy must be quadratic"]),
        ([('name = "rail"', 'name = "rail"\ndefault_effects = ["stribek:position"]')],
         ["default_effects: unknown effect 'stribek', did you mean 'stribeck'"]),
        ([("[limits]\nposition", "[limits]\npositon")], ["limits: unknown axis 'positon'"]),
    ],
)  # fmt: skip
def test_every_fault_has_its_line(rail, command: Command, changes, said) -> None:
    file = rail(*changes)
    found = faults(command("device", "check", file))
    assert len(found) == len(said), found
    for line, words in zip(found, said, strict=True):
        assert line.startswith(file) and words in line


def test_faults_come_as_json_too(rail, command: Command) -> None:
    code, out, _ = command("device", "check", rail(('unit = "m/s2"', 'unit = "m/s"')), "--json")
    content = json.loads(out)
    assert code == 2 and len(content["faults"]) == 1 and not content["equations"]


@pytest.mark.parametrize("name", registry.device_names())
def test_built_in_devices_fit(name: str, command: Command) -> None:
    assert command("device", "check", name, "--quiet") == (0, "", "")
    code, out, _ = command("device", "show", name, "--json")
    shown = json.loads(out)
    assert code == 0 and shown["faults"] == []
    assert any(effect.startswith("stribeck:") for effect in shown["effects"])
    assert name in command("device", "list")[1]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("device", "check", "bma"), "unknown device 'bma', did you mean 'bam'"),
        (("device", "check", "absent.toml"), "absent.toml: no such file"),
        (("effects", "stribek"), "did you mean 'stribeck'"),
        (("effects", "stribeck:yow"), "did you mean 'yaw'"),
        (("effects", "absent.toml"), "no such file"),
        (("effects", "check"), "which effect file?"),
        (("effects", "check", "absent.toml"), "absent.toml: no such file"),
        (("effects", "stribeck", "yaw"), "'yaw' is one argument too many"),
        (("effects", "check", "stribeck", "--device", "bma"), "did you mean 'bam'"),
        (("effects", "check", "brake_lag", "--device", "slider"), "nothing that it can act on"),
    ],
)
def test_bad_arguments_are_one_line(command: Command, arguments, said) -> None:
    (line,) = faults(command(*arguments))
    assert said in line


def test_effect_files_are_checked_on_every_target(tmp_path, rail, command: Command) -> None:
    file = tmp_path / "snag.toml"
    file.write_text(SNAG)
    code, out, _ = command("effects", "check", str(file))
    assert code == 0 and "snag:yaw, snag:pitch, snag:extension" in out
    code, out, _ = command("effects", "check", str(file), "--device", rail())
    assert code == 0 and "snag:position" in out
    wrong = SNAG.replace("/width)**2", "/width + q)**2").replace("-drag*", "-drag*g_pull*")
    file.write_text(wrong)
    found = faults(command("effects", "check", str(file)))
    assert len(found) == 1 and "unknown symbol 'g_pull'" in found[0]
    file.write_text(SNAG.replace('unit = "N.m", prior = 0.0', 'unit = "N", prior = 0.0'))
    (line,) = faults(command("effects", "check", f"{file}:yaw"))
    assert "torque: is N where N.m is needed" in line


def test_a_robot_is_drawn_where_its_joints_are(tmp_path: Path, command: Command) -> None:
    folder = tmp_path / "arm"
    arm.record_logs(folder, 3, "ZYyX", trials=1, seconds=4.0)
    device = folder / "device.toml"
    device.write_text('name = "arm"\n[robot]\nurdf = "arm.urdf"\n')
    picture = tmp_path / "arm.svg"
    code, out, _ = command("device", "check", str(device), "--picture", str(picture))
    assert code == 0 and f"wrote {picture}" in out
    root = ElementTree.parse(picture).getroot()
    tag = "{http://www.w3.org/2000/svg}"
    words = [text.text for text in root.iter(f"{tag}text")]
    for name in ("base_yaw", "shoulder", "elbow", "forearm"):  # with their masses, in both views
        assert sum(bool(re.fullmatch(rf"{name}, [\d.]+ kg", text or "")) for text in words) == 2


@pytest.mark.parametrize(
    ("device", "picture", "said"),
    [
        ("slider", "rail.svg", "only robots are drawn"),
        ("sample_runs/robot_arm/device.toml", "arm.png", "ends in .svg"),
    ],
)
def test_only_robots_are_drawn_and_only_as_svg(
    tmp_path: Path, command: Command, device: str, picture: str, said: str
) -> None:
    path = tmp_path / picture
    (fault,) = faults(command("device", "check", device, "--picture", str(path)))
    assert said in fault and not path.exists()
