"""The JSON Schemas in `schemas/` are those of the declarations."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

from bampipe.schema import json_schema_text

SCRIPT = runpy.run_path(str(Path(__file__).parent.parent / ".ci" / "write_schemas.py"))


@pytest.mark.parametrize("name", SCRIPT["FILES"])
def test_a_schema_is_up_to_date(name: str) -> None:
    text = (SCRIPT["FOLDER"] / f"{name}.schema.json").read_text(encoding="utf-8")
    assert text == json_schema_text(SCRIPT["FILES"][name]), "run: python .ci/write_schemas.py"
    Draft202012Validator.check_schema(json.loads(text))
