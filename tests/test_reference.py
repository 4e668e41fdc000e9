"""The reference pages of the site name everything that there is."""

import dataclasses
import re
import runpy
from pathlib import Path

import pytest

import bampipe
from bampipe.physics import registry
from bampipe.schema import json_schema
from bampipe.stages import base

REFERENCE = runpy.run_path(str(Path(__file__).parent.parent / ".ci" / "reference.py"))
PAGES = REFERENCE["pages"]()


def part(page: str, heading: str, level: str = "##") -> str:
    """What stands below one heading of a page."""
    found = re.search(
        rf"^{level} {re.escape(heading)}(?: {{[^\n]*}})?\n(.*?)(?=^##|\Z)", page, re.M | re.S
    )
    assert found is not None, heading
    return found[1]


def test_every_option_of_every_command_has_its_row() -> None:
    for name, command in REFERENCE["all_commands"]().items():
        text = part(PAGES["commands.md"], name)
        for parameter in command.params:
            for option in parameter.opts:
                if option.startswith("-"):
                    assert re.search(rf"^\| `[^`]*{option}\b.*\| \S.* \|$", text, re.M), option


@pytest.mark.parametrize("name", base.STAGES)
def test_every_setting_of_a_stage_has_its_row(name: str) -> None:
    text = part(PAGES["settings.md"], name)
    for field in dataclasses.fields(base.load_stage(name).Config):
        if field.name not in ("session", "model"):
            assert re.search(rf"^\| `{field.name}` \| `[^|]+` \| \S[^|]+ \|$", text, re.M), (
                field.name
            )


@pytest.mark.parametrize("name", REFERENCE["FILES"])
def test_every_field_of_a_file_has_its_row_and_its_meaning(name: str) -> None:
    schema = json_schema(REFERENCE["FILES"][name][0])
    tables = {name: (schema, "##")} | {
        f"{name}: {key}": (node, "###")
        for key, node in schema.get("$defs", {}).items()
        if "properties" in node
    }
    for heading, (node, level) in tables.items():
        text = part(PAGES["files.md"], heading, level)
        for key in node["properties"]:
            assert re.search(rf"^\| `{key}` \| \S.* \|.*\| \S.* \|$", text, re.M), (heading, key)


@pytest.mark.parametrize("name", REFERENCE["RECORDS"])
def test_every_field_of_a_result_has_its_row(name: str) -> None:
    text = part(PAGES["results.md"], name)
    for key in json_schema(REFERENCE["RECORDS"][name])["properties"]:
        assert re.search(rf"^\| `{key}` \| \S.* \|$", text, re.M), key


def test_every_effect_and_export_has_its_part_and_every_dependency_its_version() -> None:
    for name in registry.effect_names():
        text = part(PAGES["effects.md"], name)
        assert all(f"| `{key}` |" in text for key in registry.effect(name).parameters)
    for name in registry.device_names():
        assert part(PAGES["devices.md"], name)
    for name in bampipe.__all__:
        found = getattr(bampipe, name)
        assert f"::: {found.__module__}.{found.__name__}" in PAGES["python.md"]
        assert found.__doc__
    rows = re.findall(
        r"^\| ([\w.-]+) \| ([^|]*) \| ([^|]*) \| `?(\w*)`? ?\|$", PAGES["versions.md"], re.M
    )
    assert bampipe.__version__ in PAGES["versions.md"]
    assert {"numpy", "filelock", "mkdocs"} <= {name for name, *_ in rows}
    assert [name for name, _, tried, extra in rows if not tried and extra in ("", "dev")] == []
