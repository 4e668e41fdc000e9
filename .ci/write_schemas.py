"""Write `schemas/<name>.schema.json` from the declarations: `python .ci/write_schemas.py`."""

import json
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

from bampipe import results
from bampipe.data.session import Session
from bampipe.declarations.accepted import Accepted
from bampipe.declarations.model import ModelFile
from bampipe.declarations.pipeline import Pipeline
from bampipe.physics.device import Device
from bampipe.physics.effect import Effect
from bampipe.results.record import Result
from bampipe.schema import Declaration, json_schema

FOLDER = Path(__file__).parent.parent / "schemas"
FILES: dict[str, type[Declaration]] = {
    "accepted": Accepted,
    "device": Device,
    "effect": Effect,
    "model": ModelFile,
    "pipeline": Pipeline,
    "session": Session,
}
for module in iter_modules(results.__path__):
    for kind in vars(import_module(f"bampipe.results.{module.name}")).values():
        if isinstance(kind, type) and issubclass(kind, Result) and kind is not Result:
            FILES[kind.__name__.removesuffix("Result").lower()] = kind


def schema_text(declared: type[Declaration]) -> str:
    """Return the text of the JSON Schema of a file."""
    return json.dumps(json_schema(declared), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    for name, declared in FILES.items():
        (FOLDER / f"{name}.schema.json").write_text(schema_text(declared), encoding="utf-8")
