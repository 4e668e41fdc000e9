"""Write `schemas/<name>.schema.json` from the declarations: `python .ci/write_schemas.py`."""

from pathlib import Path

from bampipe.declarations.accepted import Accepted
from bampipe.declarations.model import ModelFile
from bampipe.declarations.pipeline import Pipeline
from bampipe.schema import Declaration, json_schema_text

FOLDER = Path(__file__).parent.parent / "schemas"
FILES: dict[str, type[Declaration]] = {
    "accepted": Accepted,
    "model": ModelFile,
    "pipeline": Pipeline,
}


if __name__ == "__main__":
    for name, kind in FILES.items():
        (FOLDER / f"{name}.schema.json").write_text(json_schema_text(kind), encoding="utf-8")
