"""The JSON Schemas in `schemas/` are those of the declarations."""

import json
import runpy
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import pytest
from jsonschema import Draft202012Validator
from pydantic import Field

from bampipe.data.device_file import complete_device
from bampipe.errors import InputError
from bampipe.schema import (
    ByName,
    Declaration,
    Distinct,
    NamedDeclaration,
    Positive,
    faults,
    json_schema,
    read,
)

ROOT = Path(__file__).parent.parent
SHIPPED = [*ROOT.glob("pipelines/*.toml"), *ROOT.glob("sample_runs/*/*.toml")]
SHIPPED += ROOT.glob("bampipe/physics/*/*.toml")
SCRIPT = runpy.run_path(str(ROOT / ".ci" / "write_schemas.py"))


@pytest.mark.parametrize("name", SCRIPT["FILES"])
def test_a_schema_is_up_to_date(name: str) -> None:
    text = (SCRIPT["FOLDER"] / f"{name}.schema.json").read_text(encoding="utf-8")
    assert text == SCRIPT["schema_text"](SCRIPT["FILES"][name]), "run: python .ci/write_schemas.py"
    Draft202012Validator.check_schema(json.loads(text))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_what_ships_fits_its_schema(path: Path) -> None:
    """Editors hold a file to its schema, bampipe to its declaration: what both take must agree."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    kind = SCRIPT["FILES"][table["schema"].removeprefix("bampipe.").removesuffix("/1")]
    Draft202012Validator(json_schema(kind)).validate(json.loads(json.dumps(table, default=str)))
    read(kind, complete_device(table, path.parent, path.name), path.name)


TWICE = ["fast", "fast"]


class Axis(NamedDeclaration):
    gain: Positive = Field(description="Of the axis")
    modes: Distinct[Literal["slow", "fast"]] = ()

    def cross_faults(self) -> Iterator[InputError]:
        if self.gain > 5 and "slow" in self.modes:
            yield InputError("too much", where="gain", remedy="take less")


class Machine(Declaration):
    axes: Annotated[tuple[Axis, ...], ByName(str, least=1)]


@pytest.mark.parametrize(
    ("table", "lines"),
    [
        ({"axis": {}}, ["m: unknown key \"axis\", did you mean 'axes'?", "m: 'axes' is missing"]),
        ({"axes": {}}, ["m: axes: found an empty table, expected at least 1 entry"]),
        ({"axes": {"x": {}}}, ["m: axes.x: 'gain' is missing; Of the axis"]),
        (
            {"axes": {"x": {"gain": 0, "modes": ["fas"]}, "y": {"gain": 2**60}}},
            [
                "m: axes.x.gain: found 0, expected more than 0",
                'm: axes.x.modes[0]: found "fas", expected "slow" or "fast",'
                " did you mean 'fast'?",
                "m: axes.y.gain: found a whole number beyond 2^53",
            ],
        ),
        (
            {"axes": {"x": {"gain": 9, "modes": ["slow"]}, "y": {"gain": 1, "modes": TWICE}}},
            [
                "m: axes.x.gain: too much; take less",
                'm: axes.y.modes: found ["fast", "fast"], expected no entry twice',
            ],
        ),
        ({"axes": {"x": 3}}, ["m: axes.x: found 3, expected a table"]),
    ],
)
def test_every_fault_of_a_file_has_its_line(table: object, lines: list[str]) -> None:
    found = [str(fault) for fault in faults(Machine, table, "m")]
    assert found == lines
    with pytest.raises(InputError) as caught:
        read(Machine, table, "m")
    first, _, rest = str(caught.value).partition(f" (and {len(lines) - 1} more)")
    assert first + rest == lines[0]


def test_tables_are_named_by_their_keys() -> None:
    machine = read(Machine, {"axes": {"x": {"gain": 1}, "y": {"gain": 2}}}, "m")
    assert [(axis.name, axis.gain) for axis in machine.axes] == [("x", 1.0), ("y", 2.0)]
