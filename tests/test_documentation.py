"""What the documents say: their examples run, their names exist, their links lead somewhere."""

import re
import tomllib
from pathlib import Path

import pytest

from bampipe.physics import Model, compile_model, registry
from bampipe.physics.expression import FUNCTIONS
from bampipe.physics.readable import describe_equations
from bampipe.physics.units import check_device, check_effect

ROOT = Path(__file__).parent.parent
DOCS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(name, language="toml"):
    """Fenced blocks of one document."""
    text = (ROOT / "docs" / name).read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, re.S)


def test_example_effect_is_consistent_and_compiles_on_every_axis():
    effect = registry.effect_from(tomllib.loads(blocks("effects.md")[0]), "snag.toml")
    device = registry.device("bam")
    for axis in effect.targets(device):
        assert check_effect(effect, device, axis) == []
        system = compile_model(Model(device, (f"snag:{axis}",), (effect,)))
        assert f"snag.{axis}.drag" in [p.name for p in system.parameters]


def test_example_device_is_consistent_and_has_the_equations_shown():
    device = registry.device_from(tomllib.loads(blocks("devices.md")[0]), "rail.toml")
    assert check_device(device) == []
    text = (ROOT / "docs/devices.md").read_text(encoding="utf-8")
    shown = re.findall(r"^ {6}([xMhQ]\S* = .*)$", text, re.M)
    assert len(shown) == 4
    derived = [line.strip() for line in describe_equations(device).splitlines()]
    assert all(line in derived for line in shown)
    for name in ("stribeck:position", "force_bias:x", "inertia_mismatch:position"):
        Model(device, (name,))


def test_functions_of_expressions_are_all_listed():
    text = (ROOT / "docs/effects.md").read_text(encoding="utf-8")
    listed = re.search(r"^ {4}(sin .*)$", text, re.M)
    assert listed is not None
    assert set(listed[1].split()) == set(FUNCTIONS)


@pytest.mark.parametrize("path", DOCS, ids=lambda p: p.name)
def test_links_lead_to_files(path):
    text = path.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text):
        if "://" not in link:
            assert (path.parent / link).exists(), link
